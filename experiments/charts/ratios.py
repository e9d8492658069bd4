"""What the charts say in a few numbers: ours against others, and which of our own methods others of ours beat."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from experiments.charts.control import CROCODDYL, DO_MPC, filed_settings
from experiments.charts.motion import ELASTICA, MUJOCO, YARDSTICK
from experiments.charts.points import Row, failures
from experiments.charts.statics import LITERAL, LITERAL_AT_ONCE
from experiments.charts.statics_poses import CLASSES
from experiments.motion.rod_inertia import RELEASES
from pcr_mpc.report.tables import table

# What the project promises: how many times faster, and how many times more accurate.
WANTED = {LITERAL: (1000.0, 1.0), LITERAL_AT_ONCE: (1000.0, 1.0), MUJOCO: (10.0, 50.0), DO_MPC: (50.0, 0.5)}
# Filed controllers of the two scenes.
_FILED = {"nominal": "default", "limited": "slow_motors"}


def ratios(rows: list[Row]) -> list[dict[str, Any]]:
    """Comparisons for which the rows of all levels hold both sides.

    Returns
    -------
    list of dict
        ``case``; ``ours`` and ``theirs``, method and settings; ``faster``, their time over ours; ``more_accurate``,
        their error over ours; both errors and times; ``wanted`` and ``met`` where something was promised.
    """
    found = [_compared(case, _pick(rows, case, "closed form"), _pick(rows, case, name, "N = 8, 4 x rk4"))
             for name in (LITERAL, LITERAL_AT_ONCE) for case in CLASSES]  # fmt: skip
    for release in RELEASES:
        ours = _pick(rows, release, "none", "semi_implicit_euler, 1 ms")
        for name in (LITERAL, LITERAL_AT_ONCE):
            theirs = _pick(rows, release, name)
            # The same equations and scheme, the same error of motion; what differs is the error of F.
            found.append(_compared(release, ours, theirs, wanted=WANTED.get(name), by_force=_force_errors(rows, name)))
        for name in (MUJOCO, ELASTICA):
            theirs = _best(row for row in rows if (row["case"], row["method"]) == (release, name))
            need = WANTED.get(name, (1.0, 1.0))[0]
            fast = [row for row in rows if (row["case"], row["method"]) == (release, "condensed")
                    and theirs and row["time_p50"] * need <= theirs["time_p50"]]  # fmt: skip
            found.append(_compared(release, _best(fast), theirs, wanted=WANTED.get(name)))
    for scene, file in _FILED.items():
        ours = _pick(rows, scene, file, filed_settings(file))
        horizon = ours["settings"].split(",")[0] if ours else ""
        found.append(_compared(scene, ours, _pick(rows, scene, DO_MPC, horizon), wanted=WANTED[DO_MPC]))
        for name in (CROCODDYL, "nonlinear"):
            found.append(_compared(scene, ours, _pick(rows, scene, name, horizon)))
    return [one for one in found if one]


def beaten(rows: list[Row], family: Callable[[Row], str]) -> dict[str, str]:
    """Families of our methods that are no default for a reason: whatever their settings, another of ours is better.

    Returns
    -------
    dict
        Family -> by which others each of its points without failures, in every case, is beaten: by one without
        failures that is neither slower nor less accurate.
    """
    ours = [row for row in rows if row["ours"] and row["method"] != YARDSTICK and not failures(row)]
    found: dict[str, str] = {}
    for name in dict.fromkeys(map(family, ours)):
        by: set[str] = set()
        for row in (row for row in ours if family(row) == name):
            better = next((other for other in ours if family(other) != name and _beats(other, row)), None)
            if better is None:
                break
            by.add(family(better))
        else:
            found[name] = ", ".join(sorted(by))
    return found


def report(comparisons: list[dict[str, Any]]) -> str:
    """Table of comparisons."""

    def cells(one: dict[str, Any]) -> tuple[str, ...]:
        promised = "-" if one["wanted"] is None else ("met: " if one["met"] else "NOT MET: ") + one["wanted"]
        return (
            one["case"],
            one["ours"],
            one["theirs"],
            f"{one['faster']:.3g}",
            f"{one['more_accurate']:.3g}",
            promised,
        )

    header = ("case", "ours", "theirs", "times faster", "times more accurate", "promised")
    return table(header, [cells(one) for one in comparisons])


def _compared(
    case: str,
    ours: Row | None,
    theirs: Row | None,
    *,
    wanted: tuple[float, float] | None = None,
    by_force: tuple[float, float] | None = None,
) -> dict[str, Any] | None:
    if theirs is None or (ours is None and wanted is None):
        return None
    promise = None if wanted is None else f"{wanted[0]:g} times faster, {wanted[1]:g} times as accurate"
    if ours is None:  # nothing of ours comes near the promise, or it failed: that is not to drop out of the table
        return {"case": case, "ours": "nothing", "theirs": f"{theirs['method']}, {theirs['settings']}",
                "faster": math.nan, "more_accurate": math.nan, "wanted": promise, "met": False}  # fmt: skip
    errors = by_force or (ours["error"], theirs["error"])
    faster, more_accurate = theirs["time_p50"] / ours["time_p50"], errors[1] / errors[0]
    return {
        "case": case,
        "ours": f"{ours['method']}, {ours['settings']}",
        "theirs": f"{theirs['method']}, {theirs['settings']}",
        "faster": faster,
        "more_accurate": more_accurate,
        "error": {"of": "F" if by_force else ours["level"], "ours": errors[0], "theirs": errors[1]},
        "time_s": {"ours": ours["time_p50"], "theirs": theirs["time_p50"]},
        "remark": theirs["remark"],
        "failures": {"ours": failures(ours), "theirs": failures(theirs)},
        "wanted": promise,
        "met": None
        if wanted is None
        else bool(faster >= wanted[0] and more_accurate >= wanted[1] and not failures(ours)),
    }


def _force_errors(rows: list[Row], name: str) -> tuple[float, float] | None:
    """Our error of F and the literal reading's in the class where ours looks worst."""
    pairs = [(_pick(rows, case, "closed form"), _pick(rows, case, name, "N = 8, 4 x rk4")) for case in CLASSES]
    errors = [(ours["error"], theirs["error"]) for ours, theirs in pairs if ours and theirs]
    return max(errors, key=lambda pair: pair[0] / pair[1], default=None)


def _pick(rows: list[Row], case: str, method: str, settings: str = "") -> Row | None:
    """First row of a method whose settings begin so, unless it failed throughout."""
    for row in rows:
        if (row["case"], row["method"]) == (case, method) and row["settings"].startswith(settings) and row["success"]:
            return row
    return None


def _best(rows: Any) -> Row | None:
    return min((row for row in rows if not failures(row)), key=lambda row: row["error"], default=None)


def _beats(one: Row, other: Row) -> bool:
    same = one["case"] == other["case"]
    return bool(same and one["time_p50"] <= other["time_p50"] and one["error"] <= other["error"])
