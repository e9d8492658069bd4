"""Inverse dynamics of a scene's reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..control.qp import Reference
from ..errors import PCRError
from ..plant.equilibrium import Equilibrium
from ..plant.free_tip import inverse_statics
from ..plant.robot import Robot
from .scene import Scene


@dataclass(frozen=True, eq=False, kw_only=True)
class InverseDynamics(Reference):
    """What the reference asks of the motors at K times from the start on.

    Attributes
    ----------
    states : ndarray, shape (K, 4 + n)
    inputs : ndarray, shape (K - 1, n)
        Rates that lead from each state to the next [rad/s].
    forces : ndarray, shape (K, 2)
        That the rods carry [N].
    angles_per_force : ndarray, shape (K, n, 2)
        Least change of the motor angles by which they carry one more newton [rad/N].
    """

    angles_per_force: np.ndarray


def feed_forward(scene: Scene, robot: Robot, pose: Equilibrium, horizon: int) -> InverseDynamics:
    """Inverse dynamics of the reference at every period, and one horizon beyond the end.

    The motor angles are those at which the rods carry F = -m a - c v on the reference; the rates lead from
    each to the next.

    Raises
    ------
    PCRError
        The reference leaves the workspace; the message says when.
    """
    assert scene.trajectory is not None
    t = scene.period * np.arange(scene.n_periods + horizon + 1)
    samples = scene.trajectory(t)
    states, forces = np.empty((len(t), 4 + robot.n_rods)), np.empty((len(t), 2))
    levers = np.empty((len(t), robot.n_rods, 2))
    eq = pose
    for k in range(len(t)):
        p, v, a = samples[k]
        forces[k] = -robot.tip_mass * a - robot.drag * v
        try:
            eq = inverse_statics(robot, p, forces[k], guess=eq)
        except PCRError as error:
            raise type(error)(f"reference at t = {t[k]:.3f} s: {error}", **error.details) from None
        states[k] = np.concatenate([p, v, eq.q])
        levers[k] = np.linalg.pinv(eq.dforce_dq)
    rates = np.diff(states[:, 4:], axis=0) / scene.period
    return InverseDynamics(states, rates, forces, angles_per_force=levers)
