"""The choice of a rung as a table and as a record."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from ...loop.scene.scene import Scene
from ...loop.scene.settings import PlantSettings
from ...study.choice.choice import Choice, Measured, apart
from ...study.choice.estimates import Estimate
from ...study.choice.rungs import ladders, levels, named
from ..tables import table

_NOT_WORTH = "not worth its time"


def choice_record(choice: Choice) -> dict[str, Any]:
    """Everything about a choice, ready for JSON."""
    need = choice.scene.need
    assert need is not None
    return {
        "scene": choice.scene.name,
        "need": {
            "tip_accuracy_mm": 1e3 * need.tip_accuracy,
            "plant_step_us": 1e6 * need.plant_step,
            "control_step_us": 1e6 * need.control_step,
        },
        "yardstick": {**_rung(choice.yardstick), "step_error_mm": 1e3 * choice.step_error},
        "yardstick_lacks_mm": {name: 1e3 * estimate.error for name, estimate in choice.lacking.items()},
        "estimates": [
            {"ladder": ladder, "level": level, "effect": effect, "mm": 1e3 * estimate.error, "reason": estimate.reason}
            for ladder, level, effect, estimate in _estimates(choice)
        ],
        "neighbours": [
            {
                "ladder": ladder,
                "from": low,
                "to": high,
                "mm": _finite(1e3 * difference),
                "worth_its_time": _worth(choice, difference),
            }
            for ladder, low, high, difference in neighbours(choice)
        ],
        "numbers": _numbers(choice),
        "physics": [{**_measured(one), "worth_its_time": choice.worth_its_time(one)} for one in choice.physics],
        "unavailable": [{**_rung(rung), "reason": reason} for rung, reason in choice.unavailable],
        "discretisations": [_measured(one) for one in choice.discretisations],
        "control_step_us": None if choice.control_step is None else 1e6 * choice.control_step,
        "chosen": {**_measured(choice.chosen), "tip_error_mm": 1e3 * choice.tip_error},
    }


def _numbers(choice: Choice) -> dict[str, Any] | None:
    """What the robot's numbers cost, ready for JSON."""
    cost = choice.numbers
    if cost is None:
        return None
    return {
        "mm": 1e3 * cost.error,
        "sampled_mm": _finite(1e3 * cost.sampled),
        "third_mm": 1e3 * cost.least,
        "by_number_mm": {name: 1e3 * each for name, each in cost.by_number.items()},
        "assumed": cost.assumed,
    }


def _worth(choice: Choice, difference: float) -> bool:
    """Whether what a step up changes is more than a third of what the numbers cost."""
    return choice.numbers is None or difference > choice.numbers.least


def _numbers_lines(choice: Choice) -> list[str]:
    cost = choice.numbers
    if cost is None:
        return [
            "what the robot's numbers are worth is not told of this motion: a payload is picked up, or rods are lost"
        ]
    ranked = sorted(cost.by_number.items(), key=lambda pair: -pair[1])
    rows = [(name, _mm(each)) for name, each in ranked]
    source = (
        "default ranges; an [uncertainty] table in its file says better, see pcr-mpc identify"
        if cost.assumed
        else "the [uncertainty] table of its file"
    )
    return [
        f"what the robot's numbers are worth, by {source}:",
        table(("known to one standard deviation", "mm of the tip"), [("all of them together", _mm(cost.error)), *rows]),
        f"  robots that were drawn and moved: {_mm(cost.sampled)} mm; a step finer than a third, {_mm(cost.least)} mm, "
        "is not worth its time before the numbers are known better",
    ]


def neighbours(choice: Choice) -> list[tuple[str, str, str, float]]:
    """What a step up on one ladder changes in the tip at most [m], where the rest is as in the yardstick."""
    found = []
    for ladder, steps in ladders(choice.scene).items():
        own = [_on(choice, ladder, level) for level in steps]
        for low, high, one, other in zip(steps, steps[1:], own, own[1:], strict=False):
            if one is not None and other is not None:
                found.append((ladder, low, high, apart(one, other)))
    return found


def choice_table(choice: Choice) -> str:
    """Estimates, measurements and the rung chosen."""
    need, scene = choice.scene.need, choice.scene
    assert need is not None
    effects = [
        (f"{effect} ({ladder} {level})", _mm(estimate.error), estimate.reason)
        for ladder, level, effect, estimate in _estimates(choice)
    ]
    steps = [
        (f"{ladder}: {low} -> {high}", _mm(difference), "" if _worth(choice, difference) else _NOT_WORTH)
        for ladder, low, high, difference in neighbours(choice)
    ]
    refused = sorted({f"  {named(scene, rung)}: {reason}" for rung, reason in choice.unavailable})
    lines = [
        f"{scene.name} needs the tip to {1e3 * need.tip_accuracy:g} mm, {1e6 * need.plant_step:g} us a plant step and "
        f"{1e6 * need.control_step:g} us a control step",
        "",
        _left(table(("what leaving it out costs, estimated", "mm", "why"), effects)),
        "",
        f"yardstick: {named(scene, choice.yardstick)}; {discretisation(choice.yardstick)}, "
        f"twice that step changes {_mm(choice.step_error)} mm",
        *(f"  it lacks {name}: {_mm(estimate.error)} mm are added" for name, estimate in choice.lacking.items()),
        "",
        _left(table(("a step up, the rest as in the yardstick", "mm", ""), steps)) if steps else "",
        "",
        *_numbers_lines(choice),
        "",
        table(
            ("rung, lowest first", "mm off the yardstick", "us a step", ""),
            [(*_row(scene, one), "" if choice.worth_its_time(one) else _NOT_WORTH) for one in choice.physics],
        ),
        *(["", "not available:", *refused] if refused else []),
        "",
        table(
            ("its discretisations, cheapest first", "mm off the yardstick", "us a step"),
            [_row(scene, one, discretised=True) for one in choice.discretisations],
        ),
        "",
        *_verdict(choice),
    ]
    return "\n".join(lines)


def _verdict(choice: Choice) -> list[str]:
    need, rung = choice.scene.need, choice.chosen.rung
    assert need is not None
    below = choice.physics[: [levels(one.rung) for one in choice.physics].index(levels(rung))]
    closest = min((one.error + choice.unmeasured for one in below), default=None)
    lines = [
        f"chosen: {named(choice.scene, rung)}; {discretisation(rung)}",
        f"  the tip is within {_mm(choice.tip_error)} mm, of which {_mm(choice.unmeasured)} mm are the yardstick's own",
        "  no lower rung is, "
        + (f"the best of them is off by {_mm(closest)} mm" if closest is not None else "for there is none"),
        f"  plant step {1e6 * choice.chosen.step_time:.0f} us (at most {1e6 * need.plant_step:g})",
    ]
    if choice.control_step is not None:
        lines.append(f"  control step {1e6 * choice.control_step:.0f} us (at most {1e6 * need.control_step:g})")
    return lines


def discretisation(rung: PlantSettings) -> str:
    """How a rung is discretised, in words."""
    rods = rung.method.replace("_", " ")
    if rung.method != "closed_form":
        rods += f" of {rung.segments} segments, {rung.steps} {rung.scheme} each"
    return f"{rung.integrator} at {1e3 * rung.dt:g} ms, {rods}"


def _on(choice: Choice, ladder: str, level: str) -> Measured | None:
    """The rung that has ``level`` on a ladder, and for the rest what the yardstick has."""
    wanted = {**levels(choice.yardstick), ladder: level}
    return next((one for one in choice.physics if levels(one.rung) == wanted), None)


def _estimates(choice: Choice) -> list[tuple[str, str, str, Estimate]]:
    found = []
    for ladder, steps in ladders(choice.scene).items():
        for level in steps:
            lacking = choice.estimates.of_level(ladder, level)
            found += [(ladder, level, effect, estimate) for effect, estimate in lacking.items()]
    rung = choice.chosen.rung
    found.append(("step", rung.integrator, "time step", choice.estimates.step(rung.integrator, rung.dt)))
    found.append(("rods", rung.method, "discretisation", choice.estimates.rods(rung)))
    return found


def _rung(rung: PlantSettings) -> dict[str, Any]:
    kept = asdict(rung)
    del kept["on_snap"]
    return kept


def _measured(one: Measured) -> dict[str, Any]:
    return {
        **_rung(one.rung),
        "error_mm": _finite(1e3 * one.error),
        "step_us": _finite(1e6 * one.step_time),
        "failure": one.failure or None,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _row(scene: Scene, one: Measured, discretised: bool = False) -> tuple[str, str, str]:
    name = discretisation(one.rung) if discretised else named(scene, one.rung)
    return name, "failed" if one.failure else _mm(one.error), f"{1e6 * one.step_time:.0f}"


def _mm(error: float) -> str:
    return f"{1e3 * error:.2g}" if error else "0"


def _left(text: str) -> str:
    """The table with its last column, of words, to the left."""
    rows = text.split("\n")
    width = rows[1].rindex("  ") + 2
    return "\n".join(row[:width] + row[width:].lstrip() for row in rows)
