"""What the reference of a scene asks of its robot, before it is tried."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..errors import PCRError
from ..loop.feasibility import reference_excess
from ..loop.feed_forward import InverseDynamics, feed_forward
from ..loop.scene import Scene
from ..loop.trajectory import sampled
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.held_tip import solve_statics
from .remarks import NEAR, Remark

_POSES = 40  # along the reference at which K is looked at


def demands(scene: Scene, pose: Equilibrium) -> tuple[np.ndarray | None, dict[str, Any] | None, list[Remark]]:
    """Path of the reference, shape (K, 2) [m], what it asks for at its worst, and what is to be said of that."""
    if scene.trajectory is None:
        return None, None, []
    t = scene.period * np.arange(scene.n_periods + 1)
    p, v, a = np.moveaxis(sampled(scene.trajectory, t), 1, 0)
    figures: dict[str, Any] = {
        "kind": type(scene.trajectory).__name__,
        "speed_m_s": float(np.hypot(*v.T).max()),
        "acceleration_m_s2": float(np.hypot(*a.T).max()),
        # Of a sine, the rate of the one over the other is its angular frequency.
        "frequency_Hz": _ratio(float(np.hypot(*a.T).max()), float(np.hypot(*v.T).max())) / (2 * math.pi),
    }
    try:
        reference = feed_forward(scene, scene.robot, pose, 0)
    except PCRError as error:
        return p, figures, [Remark("error", "reference", str(error))]
    excess = [Remark("error", "reference", line) for line in reference_excess(scene, reference)]
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
        if row["used"] is not None and NEAR < row["used"] <= 1.0 + 1e-6
    ]
    figures["stiffness_N_m"] = _stiffness(scene, reference, pose)
    return p, figures, excess + near


def _peaks(scene: Scene, reference: InverseDynamics) -> dict[str, dict[str, Any]]:
    """The largest of what is limited, and the least of what is to be kept: value, limit, share of it, when."""
    count, period, robot, poses = scene.n_periods, scene.period, scene.robot, scene.pose_limits
    rates = np.abs(reference.inputs[:count])
    change = np.abs(np.diff(reference.inputs[:count], axis=0, prepend=np.zeros((1, robot.n_rods)))) / period
    torques = np.abs((reference.torques + reference.torques_per_force @ np.array(scene.force))[: count + 1])
    tightest = float(scene.strain_limits.min())
    # Of rods with other limits, as if they had the tightest.
    shares = np.nan_to_num(reference.strains[: count + 1] / scene.strain_limits)
    strains = shares * (tightest if math.isfinite(tightest) else 0.0)
    rows: dict[str, dict[str, Any]] = {}
    for name, values, limit, unit in (
        ("motor rate", rates, robot.rate_limit, "rad/s"),
        ("change of the motor rate", change, robot.acceleration_limit, "rad/s^2"),
        ("torque", torques, scene.torque_limit, "N m"),
        ("strain", strains, tightest, ""),
    ):
        if math.isfinite(limit):
            row, column = np.unravel_index(int(values.argmax()), values.shape)
            value = float(values[row, column])
            rows[name] = {"value": value, "limit": limit, "used": value / limit, "unit": unit,
                          "t_s": float(row * period), "at": int(column)}  # fmt: skip
    for name, series, least, unit in (
        ("rod margin", reference.rod_margin, poses.rod_margin, ""),
        ("stiffness", reference.stiffness, poses.stiffness, "N/m"),
    ):
        if np.isfinite(series).all():
            k = int(series[: count + 1].argmin())
            rows[name] = {"value": float(series[k]), "limit": least, "used": _ratio(least or 0.0, float(series[k])),
                          "unit": unit, "t_s": float(k * period), "at": None}  # fmt: skip
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
