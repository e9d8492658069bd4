"""What the reference of a scene asks of its robot, before it is tried."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..errors import PCRError
from ..loop.demand.feasibility import reference_demand, reference_excess, reference_of
from ..loop.demand.feed_forward import InverseDynamics
from ..loop.references.blended import Blended
from ..loop.references.trajectory import Trajectory, sampled
from ..loop.scene.scene import Scene
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.held_tip import solve_statics
from .remarks import NEAR, Remark

_POSES = 40  # along the reference at which K is looked at
# Of `reference_demand`: what it is called, and its unit.
_LIMITED = {
    "rate_rad_s": ("motor rate", "rad/s"),
    "rate_change_rad_s2": ("change of the motor rate", "rad/s^2"),
    "torque_Nm": ("torque", "N m"),
    "rod_margin": ("rod margin", ""),
    "stiffness_N_m": ("stiffness", "N/m"),
}


def demands(scene: Scene, pose: Equilibrium) -> tuple[np.ndarray | None, dict[str, Any] | None, list[Remark]]:
    """Path of the reference, shape (K, 2) [m], what it asks for at its worst, and what is to be said of that."""
    if scene.trajectory is None:
        return None, None, []
    t = scene.period * np.arange(scene.n_periods + 1)
    p, v, a = np.moveaxis(sampled(scene.trajectory, t), 1, 0)
    speed, acceleration = (float(np.hypot(*one.T).max()) for one in (v, a))
    figures: dict[str, Any] = {
        "kind": type(scene.trajectory).__name__,
        "speed_m_s": speed,
        "acceleration_m_s2": acceleration,
        # Of a sine, the rate of the one over the other is its angular frequency.
        "frequency_Hz": _ratio(acceleration, speed) / (2 * math.pi),
    }
    later = _later(scene.trajectory)
    try:
        reference = reference_of(scene, pose)
    except PCRError as error:
        return p, figures, [Remark("error", "reference", str(error)), *later]
    excess = [Remark("error", "reference", line) for line in reference_excess(scene, reference, pose)]
    peaks = _peaks(scene, reference)
    figures["peaks"] = peaks
    near = [
        Remark(
            "warning",
            "reference",
            f"the reference takes {100 * row['used']:.0f} % of the limit on {name}, {row['value']:.4g} of "
            f"{row['limit']:.4g} {row['unit']} at t = {row['t_s']:.3g} s; little is left for errors",
        )
        for name, row in peaks.items()
        if NEAR < row["used"] <= 1.0 + 1e-6
    ]
    figures["stiffness_N_m"] = _stiffness(scene, reference, pose)
    return p, figures, excess + near + later


def _later(trajectory: Trajectory) -> list[Remark]:
    """That a path which moves from its first moment on is not where its own times say."""
    if not isinstance(trajectory, Blended) or not trajectory.later:
        return []
    start, *_ = trajectory.full_speed
    return [
        Remark(
            "note",
            "reference",
            f"the path moves at its start, so it begins in a blend of {start:.3g} s: the tip comes "
            f"{trajectory.later:.3g} s later than the path's own times say; let it begin at rest, or give `start` of "
            "[reference]",
        )
    ]


def _peaks(scene: Scene, reference: InverseDynamics) -> dict[str, dict[str, Any]]:
    """The largest of what is limited, and the least of what is to be kept: value, limit, share of it, when."""
    demand, rows = reference_demand(scene, reference), {}
    for key, (name, unit) in _LIMITED.items():
        if key in demand:
            value, limit = demand[key]["asked"], demand[key]["limit"]
            used = _ratio(limit or 0.0, value) if key in ("rod_margin", "stiffness_N_m") else value / limit
            rows[name] = {"value": value, "limit": limit, "used": used, "unit": unit, "t_s": demand[key]["t_s"],
                          "at": demand[key].get("motor")}  # fmt: skip
    limits = scene.strain_limits
    shares = np.nan_to_num(reference.strains[: scene.n_periods + 1] / limits)
    if np.isfinite(limits).any():
        k, i = np.unravel_index(int(shares.argmax()), shares.shape)
        rows["strain"] = {"value": float(reference.strains[k, i]), "limit": float(limits[i]), "unit": "",
                          "used": float(shares[k, i]), "t_s": float(k * scene.period), "at": int(i)}  # fmt: skip
    return rows


def _stiffness(scene: Scene, reference: InverseDynamics, pose: Equilibrium) -> list[float]:
    """Least and greatest eigenvalue of K along the reference [N/m]."""
    at = np.unique(np.linspace(0, scene.n_periods, _POSES).astype(int))
    eq, found = pose, [pose.stiffness_eigenvalues]
    for state in reference.states[at]:
        eq = solve_statics(scene.robot, state[:2], state[4:], guess=eq, method=pose.method)
        found.append(eq.stiffness_eigenvalues)
    return [float(np.min(found)), float(np.max(found))]


def _ratio(one: float, other: float) -> float:
    return one / other if other > 0 else 0.0
