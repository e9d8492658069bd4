"""Table of a planned motion."""

from __future__ import annotations

from typing import Any

from .tables import table

_LIGHT = 0.01  # share of the rods in the mass that moves, below which nobody is told
_LEFT_OUT = (
    "rods        {:.0f} % of the mass that moves, left out of the plan: lower [limits] of the scene leave room;\n"
    '            track the plan with inertia = "condensed" in the scene\'s [plant] to see how much it takes'
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
        *([_LEFT_OUT.format(100 * rods)] if rods > _LIGHT else []),
        "",
        table(("limit", "value", "unit", "most used [%]", "at [s]", "acts [% of time]"), rows),
        "",
        f"limits {kept} at {summary['checked']} points, planned at {summary['grid']}; "
        f"{summary['iterations']} iterations",
    ]
    if "planning_s" in summary:
        lines[-1] += f" in {summary['planning_s']:.2f} s"
    return "\n".join(lines)
