"""A run in figures, and whether it is any good."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np

from ...plain import plain
from .finding import verified
from .limits import too_fast


def summary(run: Any) -> dict[str, Any]:
    """Figures of the run, ready for JSON; what does not apply is None."""
    tracked = bool(np.isfinite(run.reference).all()) and len(run.t) > 0
    error_mm = 1e3 * run.error
    late = error_mm[run.t >= 1.0]
    kinds = [event["kind"] for event in run.events]
    rungs = Counter(event["rung"] for event in run.events if event["kind"] == "fallback")
    least = float(run.scene.strain_limits.min())
    return {
        "scene": run.scene.name,
        "verdict": run.verdict(),
        "controller": run.controller,
        "plant": run.plant,
        "rung": plain(run.rung),
        "need": plain(need_of(run)),
        "seed": run.seed,
        "duration_s": float(run.t[-1]),
        "rms_mm": _rms(error_mm) if tracked else None,
        "rms_after_1s_mm": _rms(late) if tracked and len(late) else None,
        "max_mm": float(error_mm.max()) if tracked else None,
        "final_error_mm": float(error_mm[-1]) if tracked else None,
        "final_tip_m": run.x[-1, :2].tolist(),
        "plant_step_us": percentiles(1e6 * run.plant_time),
        "control_step_us": percentiles(1e6 * run.control_time[:, 0]),
        "control_cpu_us": percentiles(1e6 * run.control_time[:, 5]),
        "control_parts_us": {
            name: percentiles(1e6 * run.control_time[:, 1 + i])
            for i, name in enumerate(("linearise", "update", "solve", "solver"))
        },
        "solver_share": _share(run.control_time[:, 4], run.control_time[:, 0]),
        "plant_budget_us": 1e6 * run.dt,
        "control_budget_us": 1e6 * run.scene.period,
        "qp_iterations": {
            "p50": int(np.median(run.iterations)) if len(run.iterations) else None,
            "max": int(run.iterations.max(initial=0)),
        },
        "asked": run.asked,
        "peak_torque_Nm": run.peak_torque,
        "torque_limit_Nm": run.scene.torque_limit,
        "peak_strain": run.peak_strain,
        "strain_limit": least if math.isfinite(least) else None,
        "pose_violations": run.pose_violations(),
        "statics_rungs": run.rungs,
        "limit_violations": run.limit_violations(),
        "control_steps": len(run.u),
        "active_limits": run.active_limits,
        "slack": run.slack,
        "fallbacks": kinds.count("fallback"),
        "control_rungs": {"solved": len(run.u) - kinds.count("fallback"), **rungs},
        "deadline_misses": run.deadline_misses(),
        "snaps": kinds.count("snap"),
        "warnings": kinds.count("warning"),
        "refused_measurements": kinds.count("measurement"),
        "failures": kinds.count("failure") or len(lost(run)),
        "events": sorted([*run.events, *run.overstrained()], key=lambda event: float(event["t"])),
        "run_hash": run.hash(),
        **({"laps_rms_mm": (1e3 * run.lap_errors()).tolist()} if run.tuning and run.tuning.learning else {}),
    }


def lost(run: Any) -> list[str]:
    """What makes a run that may have come to its end a failure."""
    found = []
    solved = len(run.u) - sum(event["kind"] == "fallback" for event in run.events)
    if 2 * solved < len(run.u):
        found.append(f"only {solved} of {len(run.u)} decisions were solved")
    if broken := int(too_fast(run).sum()):
        found.append(f"commands broke the motors' limits on rate or its change in {broken} of {len(run.u)} periods")
    if np.isfinite(run.reference).all() and len(run.t):
        worst = int(run.error.argmax())
        if not run.error[worst] <= run.scene.allowed_error:  # so written that NaN is lost
            found.append(
                f"tip lost: {1e3 * run.error[worst]:.1f} mm from the reference at t = {run.t[worst]:.3f} s, "
                f"allowed are {1e3 * run.scene.allowed_error:g} mm"
            )
    return found


def need_of(run: Any) -> dict[str, Any] | None:
    """What the scene asks of the simulation, and what is known of that."""
    need, finding = run.scene.need, run.scene.finding
    if need is None:
        return None
    holds = run.rung is not None and verified(run.scene)
    steps = float(np.median(run.plant_time)) if len(run.plant_time) else math.inf
    control = float(np.median(run.control_time[:, 0])) if len(run.control_time) else 0.0
    return {
        "tip_accuracy_mm": 1e3 * need.tip_accuracy,
        "tip_error_mm": 1e3 * finding.tip_error if finding is not None and holds else None,
        "verified": holds,
        "plant_step_us": 1e6 * need.plant_step,
        "plant_step_met": steps <= need.plant_step,
        "control_step_us": 1e6 * need.control_step,
        "control_step_met": control <= need.control_step,
    }


def percentiles(values: np.ndarray) -> dict[str, float | None]:
    """p50, p95, p99 and maximum; None where there is nothing to count."""
    if not len(values):
        return dict.fromkeys(("p50", "p95", "p99", "max"))
    p50, p95, p99 = np.percentile(values, [50, 95, 99])
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99), "max": float(values.max())}


def _share(part: np.ndarray, whole: np.ndarray) -> float | None:
    return float(part.sum() / whole.sum()) if whole.sum() else None


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
