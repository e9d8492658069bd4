"""Table of a planned motion."""

from __future__ import annotations

from typing import Any

from .tables import table

_LIGHT = 0.01  # share of the rods in the mass that moves, below which nobody is told
_LEFT_OUT = (
    "rods        {:.0f} % of the mass that moves, left out of the plan: lower [limits] of the scene leave room;\n"
    '            with inertia = "condensed" in the model of the scene\'s tuning the plan reckons with them'
)


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
    excess, rods = summary["largest_excess"], summary.get("share_of_rods", 0.0)
    kept = f"kept, {-100 * excess:.3f} % are left" if excess <= 0 else f"exceeded by {100 * excess:.3f} %"
    lines = [
        f"scene       {summary['scene']}",
        f"duration    {summary['duration_s']:.4f} s, rest to rest",
        f"path        {summary['length_mm']:.1f} mm, within {summary['deviation_mm']:.3g} mm of the reference's",
        f"top speed   {summary['top_speed_m_s']:.3g} m/s",
        *_rods_lines(summary.get("rods"), rods),
        "",
        table(("limit", "value", "unit", "most used [%]", "at [s]", "acts [% of time]"), rows),
        "",
        f"limits {kept} at {summary['checked']} points, planned at {summary['grid']}; "
        f"{summary['iterations']} iterations",
    ]
    if "planning_s" in summary:
        lines[-1] += f" in {summary['planning_s']:.2f} s"
    return "\n".join(lines)


def _rods_lines(rods: dict[str, Any] | None, share: float) -> list[str]:
    if rods is None:
        return [_LEFT_OUT.format(100 * share)] if share > _LIGHT else []
    parts = [
        f"{rods['asked'][name]:.4g} of {rods['limits'][name]:.4g} {unit}"
        for name, unit in (("rate_rad_s", "rad/s"), ("rate_change_rad_s2", "rad/s^2"), ("torque_Nm", "N m"))
    ]
    return [
        f"rods        {100 * share:.0f} % of the mass that moves ({rods['inertia']}); with it the motors are asked for",
        f"            {', '.join(parts)} at the control periods; the limits below are lowered for that",
    ]
