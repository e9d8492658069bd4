"""What was found of a robot or a scene before a run, as tables and as a record."""

from __future__ import annotations

from typing import Any

from ...design.examination import Examination
from ..tables import digits, table

_MODES_SHOWN = 6


def check_record(found: Examination) -> dict[str, Any]:
    """Everything, ready for JSON."""
    return {
        "name": found.name,
        "of": "robot" if found.scene is None else "scene",
        "can_run": not found.errors,
        "remarks": [{"level": one.level, "about": one.about, "text": one.text} for one in found.remarks],
        **found.figures,
    }


def check_table(found: Examination) -> str:
    """The figures, then what is to be said of them."""
    kind = "robot" if found.scene is None else "scene"
    parts = [f"{kind} {found.name}: {found.robot.n_rods} rods"]
    if "start" in found.figures:
        parts[0] += f", mode {found.figures['start']['mode']}"
        parts += [_pose(found), _times(found)]
        if found.figures.get("modes"):
            parts.append(_modes(found.figures["modes"], found.figures["start"]))
        if found.figures.get("workspace"):
            parts.append(_workspace(found))
        if (found.figures.get("reference") or {}).get("peaks"):
            parts.append(_reference(found.figures["reference"]))
    parts.append(remarks_text(found))
    return "\n\n".join(parts)


def remarks_text(found: Examination) -> str:
    """One line for each remark, the gravest first."""
    return "\n".join(f"{one.level if one.level == 'note' else one.level.upper()}: {one.text}" for one in found.remarks)


def _pose(found: Examination) -> str:
    start = found.figures["start"]
    where = "at the start" if found.scene is not None else "held at"
    torque, limit = max(start["torque_Nm"]), found.robot.torque_limit
    if found.scene is not None:
        limit = found.scene.torque_limit
    rows = [
        ("tip [m]", _pair(start["p_m"]), "", ""),
        ("motor angles [rad]", _list(start["q_rad"]), "", ""),
        ("largest torque [N m]", f"{torque:.4g}", f"{limit:.4g}", _percent(torque / limit)),
    ]
    strains = [one for one in start["strain"] if one is not None]
    limits = [rod["strain_limit"] for rod in found.figures["rods"] if rod["strain_limit"]]
    if strains:
        most = f"{100 * min(limits):.3g}" if limits else "-"
        used = _percent(max(strains) / min(limits)) if limits else ""
        rows.append(("largest strain [%]", f"{100 * max(strains):.3g}", most, used))
    margins = [one for one in start["rod_margins"] if one is not None]
    if margins:
        rows.append(("rod margin, 0 at a snap", f"{min(margins):.3g}", "", ""))
    rows.append(("stiffness K [N/m]", _list(start["stiffness_N_m"]), "", ""))
    return table((where, "", "limit", "used"), rows)


def _times(found: Examination) -> str:
    start, steps = found.figures["start"], found.figures.get("steps")
    own = [rod["own_frequency_Hz"] for rod in found.figures["rods"] if rod["own_frequency_Hz"]]
    rows = [
        ("tip on its rods, motors held [Hz]", _list(start["natural_frequencies_Hz"])),
        ("a rod alone [Hz]", f"{min(own):.3g}" if own else "no mass is stated"),
        ("moving mass [kg]", f"{_list(start['moving_mass_kg'])}, rods {_percent(start['share_of_rods'])}"),
    ]
    if steps:
        rows.append(
            ("control period [s]", f"{steps['control_period_s']:g}, {steps['periods_per_swing']:.3g} to a swing")
        )
        longest = steps["longest_stable_step_s"]
        bound = (
            f"{steps['integrator']} is stable up to {longest:.3g}"
            if longest
            else f"{steps['integrator']}, always stable"
        )
        rows.append(("plant step [s]", f"{steps['plant_step_s']:g}, {bound}"))
    reference = found.figures.get("reference")
    if reference:
        rows.append(
            ("reference", f"{reference['speed_m_s']:.3g} m/s, {reference['acceleration_m_s2']:.3g} m/s^2, "
             f"about {reference['frequency_Hz']:.2g} Hz")
        )  # fmt: skip
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name.ljust(width)}  {text}" for name, text in rows)


def _modes(rows: list[dict[str, Any]], start: dict[str, Any]) -> str:
    possible = sorted((row for row in rows if row["possible"]), key=lambda row: float(row["energy_J"]))
    own = [row for row in possible if row["mode"] == start["mode"]]
    possible = own + [row for row in possible if row not in own]
    cells = [
        (
            row["mode"] + (" (this one)" if row["mode"] == start["mode"] else ""),
            f"{row['torque_Nm']:.3g}",
            "-" if row["strain"] is None else f"{100 * row['strain']:.3g}",
            f"{row['least_stiffness_N_m']:.3g}",
        )
        for row in possible[:_MODES_SHOWN]
    ]
    more = len(possible) - _MODES_SHOWN
    none = [row["mode"] for row in rows if not row["possible"]]
    text = table(("modes that hold this tip", "torque [N m]", "strain [%]", "least K [N/m]"), cells)
    text += f"\nand {more} more" if more > 0 else ""
    return text + (f"\nnot found: {', '.join(none)}" if none else "")


def _workspace(found: Examination) -> str:
    space = found.figures["workspace"]
    if not space["x_m"]:
        return "workspace   no neighbour of this pose can be held"
    ends = (
        ", ".join(f"{name} {count}" for name, count in sorted(space["ends"].items())) or "nothing but the rods' reach"
    )
    return (
        f"workspace of this mode  {digits(1e4 * space['area_m2'])} cm^2 of "
        f"{digits(1e4 * space['within_rods_reach_m2'])} cm^2 within the rods' reach"
        f"{_overloaded(space)}, x {_range(space['x_m'])} m, y {_range(space['y_m'])} m\n"
        f"ways that end before    {ends}"
    )


def _overloaded(space: dict[str, Any]) -> str:
    area = space["overloaded_m2"]
    return f", {digits(1e4 * area)} cm^2 more beyond torque or strain" if area else ""


def _reference(reference: dict[str, Any]) -> str:
    rows = []
    for name, row in reference["peaks"].items():
        scale, unit = (100.0, "%") if name == "strain" else (1.0, row["unit"])
        limit = "-" if row["limit"] is None else f"{scale * row['limit']:.4g}"
        word = "least " if name in ("rod margin", "stiffness") else "largest "
        at = f"{row['t_s']:.3g}" + ("" if row["at"] is None else f", motor {row['at']}")
        rows.append((f"{word}{name}" + (f" [{unit}]" if unit else ""), f"{scale * row['value']:.4g}", limit,
                     _percent(row["used"]), at))  # fmt: skip
    return table(("the reference asks for", "", "limit", "used", "at [s]"), rows)


def _pair(values: list[float]) -> str:
    return f"({values[0]:.4g}, {values[1]:.4g})"


def _list(values: list[float]) -> str:
    return ", ".join(f"{value:.3g}" for value in values)


def _range(values: list[float]) -> str:
    return f"{values[0]:.3g} to {values[1]:.3g}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
