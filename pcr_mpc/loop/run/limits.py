"""Which limits a run broke: of the motors, of the rods and of poses."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...errors import PCRError
from ...frozen import read_only
from ...linearisation.linear_limits import KINDS
from ...plant.motion.plant import Plant
from ...plant.statics.stability import least_rod_margin
from .untold_delay import UntoldDelay

# Commands within this of a limit keep it: rounding for rates, relative to it, the QP's tolerance for angles [rad].
_LIMIT_SLACK = 1e-9
_ANGLE_SLACK = 1e-5
# Of a limit on poses, relative to it: the controller keeps them to its solver's tolerance.
_POSE_SLACK = 1e-3


def too_fast(run: Any) -> np.ndarray:
    """Control periods in which a command broke the limit on rate or on its change, which no motor does; booleans."""
    robot, period = run.scene.robot, run.scene.period
    change = np.diff(run.u, axis=0, prepend=np.zeros((1, robot.n_rods)))
    found = np.abs(run.u).max(axis=1, initial=0.0) > (1 + _LIMIT_SLACK) * robot.rate_limit
    found |= np.abs(change).max(axis=1, initial=0.0) > (1 + _LIMIT_SLACK) * robot.acceleration_limit * period
    return np.asarray(found)


def limit_violations(run: Any) -> int:
    """Control periods in which a command broke the limit on rate, on its change, or on the angle."""
    robot, period = run.scene.robot, run.scene.period
    # Where the command leads from when it arrives, not where the motor's stop lets it get.
    later = UntoldDelay(run.scene.untold_delay, run.dt, robot.n_rods)
    first = run.scene.delay * run.steps_per_period + later.steps
    starts = run.x[first :: run.steps_per_period, 4:][: len(run.u)]
    lower, upper = robot.angle_limits.T
    if later.fraction:  # the command before has the rest of a step
        before = np.vstack([np.zeros(robot.n_rods), run.u])[: len(starts)]
        moved = starts + later.fraction * run.dt * before
        starts = np.clip(moved, np.minimum(lower, starts), np.maximum(upper, starts))
    angles = starts + period * run.u[: len(starts)]
    broken = too_fast(run)
    # Coming back from beyond a stop breaks nothing.
    outside = (angles < lower - _ANGLE_SLACK) & (angles <= starts) | (angles > upper + _ANGLE_SLACK) & (
        angles >= starts
    )
    broken[: len(outside)] |= outside.any(axis=1)
    return int(broken.sum())


def pose_figures(run: Any) -> np.ndarray:
    """Of the exact rods at the starts and ends of control periods: torques, strains, rod margin, stiffness.

    NaN from where the rods were lost, if they were: by a run that failed there, or by a snap.
    """
    plant, states = Plant(run.scene.robot, dt=run.dt), run.x[:: run.steps_per_period]
    plant.reset(run.x[0], run.pose)
    found = np.full((len(states), 2 * run.scene.robot.n_rods + 2), np.nan)
    for k, x in enumerate(states):
        try:
            eq = plant.equilibrium(x)
        except (PCRError, ValueError):
            break
        found[k] = *eq.motor_torque, *eq.max_strain, least_rod_margin(eq), eq.stiffness_eigenvalues[0]
    return read_only(found)


def overstrained(run: Any) -> list[dict[str, Any]]:
    """Events of a rod that is strained beyond its limit: one for each stretch of time, with the largest strain."""
    limits, period = run.scene.strain_limits, run.scene.period
    found = []
    for i, (strains, limit) in enumerate(zip(run.strains.T, limits.tolist(), strict=True)):
        # Written so that NaN is no excess.
        beyond = np.concatenate([[False], strains > (1 + _POSE_SLACK) * limit, [False]])
        for first, after in np.flatnonzero(np.diff(beyond)).reshape(-1, 2).tolist():
            worst = first + int(strains[first:after].argmax())
            found.append(
                {
                    "t": first * period,
                    "kind": "strain",
                    "message": f"rod {i} is strained by up to {100 * strains[worst]:.3g} % (at t = "
                    f"{worst * period:.3f} s), beyond its limit of {100 * limit:.3g} %, for {after - first} of "
                    f"{len(strains)} starts and ends of periods",
                }
            )
    return sorted(found, key=lambda event: float(event["t"]))


def pose_violations(run: Any) -> dict[str, int]:
    """Starts and ends of control periods at which the robot was beyond a limit on poses, for each kind of limit.

    The controller keeps these limits where it can, and may leave the reference for it.
    """
    limits, tips = run.scene.pose_limits, run.x[:: run.steps_per_period, :2]
    margins, stiffness = run.pose_figures[:, -2:].T
    strained = True if np.isfinite(run.scene.strain_limits).any() else None
    given = dict(zip(KINDS, (True, limits.tip_lower, limits.rod_margin, limits.stiffness, strained), strict=True))
    broken = {"torque": (np.abs(run.torques) > (1 + _POSE_SLACK) * run.scene.torque_limit).any(axis=1)}
    if limits.tip_lower is not None and limits.tip_upper is not None:
        lower, upper = np.array(limits.tip_lower), np.array(limits.tip_upper)
        slack = _POSE_SLACK * (upper - lower)
        broken["tip region"] = ((tips < lower - slack) | (tips > upper + slack)).any(axis=1)
    if limits.rod_margin is not None:
        broken["rod margin"] = margins < limits.rod_margin - _POSE_SLACK
    if limits.stiffness is not None:
        broken["stiffness"] = stiffness < (1 - _POSE_SLACK) * limits.stiffness
    broken["strain"] = (run.strains > (1 + _POSE_SLACK) * run.scene.strain_limits).any(axis=1)
    return {kind: int(broken[kind].sum()) for kind, limit in given.items() if limit is not None}
