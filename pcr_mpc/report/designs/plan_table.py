"""Table of a planned motion."""

from __future__ import annotations

from typing import Any

from ..tables import table

LIGHT = 0.01  # share of the rods in the mass that moves, below which nobody is told
_RESOLUTION = 1e-3  # of a limit, between the points at which a plan keeps it
_KNOWN = 'inertia = "condensed" under [model] in the scene\'s tuning lets the plan reckon with it'


def plan_table(summary: dict[str, Any]) -> str:
    """Figures of a plan."""
    rows = [
        (
            row["limit"],
            "-" if row["value"] is None else f"{row['value']:.4g}",
            row["unit"],
            f"{100 * row['largest_share']:.2f}",
            f"{row['at_s']:.3f}",
            f"{100 * row['acts_share']:.0f}",
        )
        for row in summary["limits"]
    ]
    lines = [
        f"scene       {summary['scene']}",
        f"duration    {summary['duration_s']:.4f} s, rest to rest",
        f"path        {summary['length_mm']:.1f} mm, within {summary['deviation_mm']:.3g} mm of the reference's",
        f"top speed   {summary['top_speed_m_s']:.3g} m/s",
        *_rods_lines(summary),
        "",
        table(("limit", "value", "unit", "most used [%]", "at [s]", "acts [% of time]"), rows),
        "",
        f"{_verdict(summary)} at {summary['checked']} points, planned at {summary['grid']}; "
        f"{summary['iterations']} iterations",
    ]
    if "planning_s" in summary:
        lines[-1] += f" in {summary['planning_s']:.2f} s"
    return "\n".join(lines)


def _rods_lines(summary: dict[str, Any]) -> list[str]:
    share, rods = summary.get("share_of_rods", 0.0), summary.get("rods")
    begin = f"rods        {100 * share:.0f} % of the mass that moves"
    if rods is not None:
        return [
            f"{begin} ({rods['inertia']}); with it the motors are asked for",
            f"            {_motors(rods)} at the control periods{_rods(rods)}",
            "            the limits below are lowered for that",
        ]
    if share <= LIGHT:
        return []
    left_out = summary.get("rods_left_out")
    lines = [f"{begin}, left out of the plan: the model of the scene's tuning has no inertia of the rods"]
    if left_out is not None and "error" in left_out:
        lines.append(f"            with it the motors cannot follow: {left_out['error']}")
    elif left_out is not None:
        lines.append(f"            with it the motors are asked for {_motors(left_out)} at the control periods")
        lines[-1] += _rods(left_out)
    return [*lines, f"            {_KNOWN}"]


def _motors(rods: dict[str, Any]) -> str:
    """What is asked of the motors with the rods' mass."""
    return ", ".join(
        f"{rods['asked'][name]:.4g} of {rods['limits'][name]:.4g} {unit}"
        for name, unit in (("rate_rad_s", "rad/s"), ("rate_change_rad_s2", "rad/s^2"), ("torque_Nm", "N m"))
    )


def _rods(rods: dict[str, Any]) -> str:
    """What is used of the limits on poses with the rods' mass."""
    names = {"strains": "strain", "rod_margin": "the rod margin", "stiffness": "stiffness"}
    used = [f"{100 * rods['shares'][kind]:.1f} % of {name}" for kind, name in names.items() if rods["shares"].get(kind)]
    return f"; {', '.join(used)}" if used else ""


def _verdict(summary: dict[str, Any]) -> str:
    """Whether the limits are kept; what is within the grid's resolution is not taken for an excess."""
    excess, light = summary["largest_excess"], summary.get("rods") is None and summary.get("share_of_rods", 0.0) > LIGHT
    used = f"{100 * (1 + excess):.3f} % of one at most"
    if excess > _RESOLUTION:
        return f"limits exceeded: {used}"
    within = "" if excess <= 0 else f" to {100 * _RESOLUTION:g} %"
    return f"limits kept{' by rods without mass' if light else ''}{within}, {used},"
