"""Tables for the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..loop.demand.feasibility import demand_line
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.stability import assess_stability

_TOLD = ("warning", "strain")  # kinds of events that are put into words


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Align columns: the first to the left, the others to the right."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = [[cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))]
             for row in [header, *rows]]  # fmt: skip
    lines.insert(1, ["-" * w for w in widths])
    return "\n".join("  ".join(line).rstrip() for line in lines)


def digits(value: float, count: int = 3) -> str:
    """Write a number with so many digits, and without an exponent below a million."""
    return f"{float(f'{value:.{count}g}'):g}"


def without_rounding(values: np.ndarray, scale: float) -> np.ndarray:
    """Round to a billionth of a scale, so that what is zero but for rounding reads as zero, and never as -0."""
    return np.asarray(np.where(np.abs(values) < 1e-9 * scale, 0.0, values))


def summary_table(summary: dict[str, Any]) -> str:
    """Figures of a run; first of all what is wrong with it."""
    lines = [
        *([f"FAILED      {summary['verdict']}", ""] if summary["verdict"] else []),
        f"scene       {summary['scene']} ({summary['duration_s']:g} s)",
        f"controller  {summary['controller']}",
        f"plant       {summary['plant']}",
        *_need_lines(summary["rung"], summary["need"]),
        *_margin_lines(summary.get("delay_margin")),
        "",
    ]
    tracking = [
        ("RMS", "rms_mm"),
        ("RMS after 1 s", "rms_after_1s_mm"),
        ("maximum", "max_mm"),
        ("at the end", "final_error_mm"),
    ]
    rows: list[tuple[str, ...]]
    if summary["rms_mm"] is not None:
        rows = [(name, "-" if summary[key] is None else f"{summary[key]:.4f}") for name, key in tracking]
        lines += [table(("tracking error", "mm"), rows), ""]
    if summary.get("laps_rms_mm"):
        rows = [(f"  lap {i}", f"{error:.4f}") for i, error in enumerate(summary["laps_rms_mm"], start=1)]
        lines += [table(("learning: RMS of each lap at full speed", "mm"), rows), ""]
    if "by_model_inertia" in summary:
        rows = [
            (f"  {inertia}", *("-" if figures[key] is None else f"{figures[key]:.4f}" for _, key in tracking[:3]))
            for inertia, figures in summary["by_model_inertia"].items()
        ]
        lines += [table(("rods' inertia in the controller's model", "RMS [mm]", "after 1 s", "maximum"), rows), ""]
    times = [("plant step", summary["plant_step_us"], summary["plant_budget_us"])]
    if summary["control_step_us"]["p50"] is not None:
        times.append(("control step", summary["control_step_us"], summary["control_budget_us"]))
        times.append(("  its CPU time", summary["control_cpu_us"], None))
        times += [(f"  {name}", values, None) for name, values in summary["control_parts_us"].items()]
    lines += [times_table(times), ""]
    iterations = summary["qp_iterations"]
    lines += [
        f"inside the solver {_percent(summary['solver_share'])} of the control steps' time",
        f"QP iterations     p50 {iterations['p50']}, max {iterations['max']}",
        *([f"asked for         {demand_line(summary['asked'])}"] if summary.get("asked") else []),
        f"peak torque       {summary['peak_torque_Nm']:.3f} N m (limit {summary['torque_limit_Nm']:g}, soft)",
        *_strain_line(summary["peak_strain"], summary["strain_limit"]),
        f"poses beyond      {_counts({k: v for k, v in summary['pose_violations'].items() if v})}",
        f"limits active in  {_counts(summary['active_limits'])} of {summary['control_steps']} periods",
        f"largest slack     {', '.join(f'{k} {v:.3g}' for k, v in summary['slack'].items()) or 'none'}",
        f"limit violations  {summary['limit_violations']}",
        f"fall-backs        {summary['fallbacks']}",
        f"deadline misses   {summary['deadline_misses']}",
        f"not believed      {summary['refused_measurements']} measurements",
        f"failures          {summary['failures']}",
        *(f"warning           {event['message']}" for event in summary["events"] if event["kind"] in _TOLD),
    ]
    return "\n".join(lines)


def _strain_line(strain: float | None, limit: float | None) -> list[str]:
    if strain is None:
        return []
    return [f"largest strain    {100 * strain:.3f} %" + ("" if limit is None else f" (limit {100 * limit:g} %, soft)")]


def _margin_lines(margin: dict[str, Any] | None) -> list[str]:
    if margin is None:
        return []
    predicted, needed = margin["predicted_ms"], margin["needed_ms"]
    text = "no limit found" if predicted is None else f"bears {predicted:.3g} ms more, predicted"
    text = text if predicted != 0.0 else "NOT STABLE, predicted: see pcr-mpc margins"
    if needed is not None:
        enough = predicted is None or predicted >= needed
        text += f"; needed are {needed:g} ms" + ("" if enough else ": NOT ENOUGH, see pcr-mpc margins")
    return [f"delay       {text}"]


def _need_lines(rung: dict[str, Any] | None, need: dict[str, Any] | None) -> list[str]:
    if need is None:
        return []
    physics = "another engine" if rung is None else ", ".join(
        f"{name} {rung[name]}" for name in ("inertia", "weight", "rods", "payload") if rung[name]
    ) + (", motors ideal" if rung.get("motors") == "ideal" else "")  # fmt: skip
    tip = f"tip to {need['tip_accuracy_mm']:g} mm: "
    tip += f"within {need['tip_error_mm']:.2g} mm" if need["verified"] else "not verified; see pcr-mpc choose"
    slow = [name for name in ("plant_step", "control_step") if not need[f"{name}_met"]]
    times = "in time" if not slow else ", ".join(f"{name.replace('_', ' ')} too slow" for name in slow)
    return [f"rung        {physics}", f"need        {tip}; {times}"]


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.0f} %"


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items()) or "0"


def times_table(rows: Sequence[tuple[str, dict[str, Any], float | None]]) -> str:
    """Percentiles of wall times in us against budgets."""
    cells = [
        (name, *(_us(values[key]) for key in ("p50", "p95", "p99", "max")), _us(budget))
        for name, values, budget in rows
    ]
    return table(("wall time [us]", "p50", "p95", "p99", "max", "budget"), cells)


def _us(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def equilibrium_record(eq: Equilibrium) -> dict[str, Any]:
    """Fields of an equilibrium, ready for JSON."""
    return {
        "robot": eq.robot.name,
        "p": eq.p.tolist(),
        "q": eq.q.tolist(),
        "method": eq.method,
        "mode": eq.mode,
        "stable": eq.stable,
        "unstable_rods": list(eq.unstable_rods),
        "stiffness_eigenvalues": eq.stiffness_eigenvalues.tolist(),
        "force": eq.force.tolist(),
        "dforce_dp": eq.dforce_dp.tolist(),
        "dforce_dq": eq.dforce_dq.tolist(),
        "motor_torque": eq.motor_torque.tolist(),
        "energy": eq.energy,
        "rod_forces": eq.rod_forces.tolist(),
        "max_strain": [None if math.isnan(strain) else strain for strain in eq.max_strain.tolist()],
        "strain_limit": [None if math.isinf(limit) else limit for limit in eq.robot.strain_limits.tolist()],
        "overstrained": list(eq.overstrained),
        "residual_norm": eq.residual_norm,
        "iterations": eq.iterations,
        "drift": eq.drift,
        "converged": eq.converged,
    }


def strain_warnings(eq: Equilibrium) -> list[str]:
    """Say of each rod that is strained beyond its limit what would help."""
    return [
        f"rod {i} is strained by {100 * eq.max_strain[i]:.3g} %, and its material bears {100 * limit:.3g} %: it "
        f"will not come back as it was, if at all; take a pose that bends it less, or a section at most "
        f"{2e3 * limit / eq.max_strain[i] * (eq.robot.rods[i].half_thickness or 0.0):.3g} mm thick"
        for i, limit in ((i, eq.robot.strain_limits[i]) for i in eq.overstrained)
    ]


def _strains(eq: Equilibrium) -> str:
    """Of each rod, of what its material bears."""
    limits = ["" if math.isinf(limit) else f" of {100 * limit:g}" for limit in eq.robot.strain_limits.tolist()]
    strains = ["not known" if math.isnan(strain) else f"{100 * strain:.4g}" for strain in eq.max_strain.tolist()]
    return ", ".join(strain + limit for strain, limit in zip(strains, limits, strict=True))


def equilibria_table(found: Sequence[Equilibrium]) -> str:
    """One line for each equilibrium, with its verdict."""
    rows = []
    for number, eq in enumerate(found, start=1):
        stability = assess_stability(eq)
        (p_x, p_y), (f_x, f_y) = _position(eq), without_rounding(eq.force, eq.robot.force_scale)
        verdict = "stable" if stability.stable else f"{stability.unstable_directions} unstable"
        rows.append(
            (
                f"{number} {eq.mode}",
                verdict,
                f"{eq.energy:.4f}",
                f"({p_x:.4f}, {p_y:.4f})",
                f"({f_x:.3f}, {f_y:.3f})",
                " ".join(f"{margin:.2f}" for margin in stability.rod_margins),
                f"{stability.stiffness_eigenvalues[0]:.4g}",
            )
        )
    header = ("shape", "verdict", "U [J]", "tip [m]", "F [N]", "rod margins", "least K [N/m]")
    return table(header, rows)


def _position(eq: Equilibrium) -> np.ndarray:
    return without_rounding(eq.p, float(eq.robot.lengths.max()))


def equilibrium_table(eq: Equilibrium) -> str:
    """Figures of an equilibrium."""

    def vector(values: Any) -> str:
        return "(" + ", ".join(f"{v:.6g}" for v in values) + ")"

    length = float(eq.robot.lengths.max())
    rows = [
        ("tip p [m]", vector(_position(eq))),
        ("motor angles q [rad]", vector(eq.q)),
        ("working mode", eq.mode),
        ("verdict", "stable" if eq.stable else f"UNSTABLE (rods {list(eq.unstable_rods)})"),
        ("force F = dU/dp [N]", vector(without_rounding(eq.force, eq.robot.force_scale))),
        ("motor torque dU/dq [N m]", vector(without_rounding(eq.motor_torque, eq.robot.force_scale * length))),
        ("eigenvalues of K [N/m]", vector(eq.stiffness_eigenvalues)),
        ("energy U [J]", f"{eq.energy:.8g}"),
        *([("largest strain [%]", _strains(eq))] if np.isfinite(eq.max_strain).any() else []),
        (
            "method",
            f"{eq.method}, {eq.iterations} iterations, residual {eq.residual_norm:.1e}, drift {eq.drift:.1e}",
        ),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name.ljust(width)}  {value}" for name, value in rows)
