"""Inverse dynamics of a scene's reference."""

from __future__ import annotations

import numpy as np

from ..control.qp import Reference
from ..errors import PCRError
from ..plant.equilibrium import Equilibrium
from ..plant.free_tip import inverse_statics
from ..plant.robot import Robot
from .scene import Scene


def feed_forward(scene: Scene, robot: Robot, pose: Equilibrium, horizon: int) -> Reference:
    """Inverse dynamics of the reference at every period, and one horizon beyond the end.

    The motor angles are those at which the rods carry F = -m a - c v on the reference, m with what the scene says that
    the tip carries, whose weight is a part of F too; the rates lead from each to the next.

    Returns
    -------
    Reference
        At K times from the start on: states (K, 4 + n), inputs (K - 1, n), forces (K, 2).

    Raises
    ------
    PCRError
        The reference leaves the workspace; the message says when.
    """
    assert scene.trajectory is not None
    t = scene.period * np.arange(scene.n_periods + horizon + 1)
    samples = scene.trajectory(t)
    states, forces = np.empty((len(t), 4 + robot.n_rods)), np.empty((len(t), 2))
    loads = scene.carried(t)[:, None] * (robot.gravity - samples[:, 2])
    eq = pose
    for k in range(len(t)):
        p, v, a = samples[k]
        forces[k] = -robot.tip_mass * a - robot.drag * v + loads[k]
        try:
            eq = inverse_statics(robot, p, forces[k], guess=eq)
        except PCRError as error:
            raise type(error)(f"reference at t = {t[k]:.3f} s: {error}", **error.details) from None
        states[k] = np.concatenate([p, v, eq.q])
    return Reference(states, np.diff(states[:, 4:], axis=0) / scene.period, forces)
