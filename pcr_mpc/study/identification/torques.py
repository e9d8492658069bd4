"""Torques of the motors on a motion, by statics of the exact rods, with derivatives: what tells the scale of forces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import ConvergenceError
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.many_poses.batch import solve_statics_batch


@dataclass(frozen=True, eq=False)
class Torques:
    """Torques and their derivatives.

    Attributes
    ----------
    values : ndarray, shape (M, n)
        [N m].
    by_state : ndarray, shape (M, n, 4 + n)
    by_number : dict of str to ndarray, shape (M, n)
        In each number of the robot that they depend on.
    """

    values: np.ndarray
    by_state: np.ndarray
    by_number: dict[str, np.ndarray]


def torques_along(robot: Robot, x: np.ndarray, pose: Equilibrium) -> Torques:
    """Torques that hold plain rods at states along a path.

    A rod's torque is EI/L times a function of its angle and of (p - base)/L: that in p gives the other derivatives.

    Parameters
    ----------
    robot : Robot
        Of plain rods.
    x : ndarray, shape (M, 4 + n)
    pose : Equilibrium
        On whose branch the rods are.

    Raises
    ------
    ConvergenceError
        The rods did not follow.
    """
    found = solve_statics_batch(robot, x[:, :2], x[:, 4:], guess=pose, along=True)
    if not found.solved.all():
        row = int(np.flatnonzero(~found.solved)[0])
        raise ConvergenceError(
            f"no torque at p = {x[row, :2]} m: {found.reason[row]}", residual=float("nan"), iterations=0, last=x[row]
        )
    n = robot.n_rods
    by_state, values = np.zeros((len(x), n, 4 + n)), found.motor_torque
    by_state[:, :, :2] = found.dforce_dq.transpose(0, 2, 1)
    by_state[:, range(n), range(4, 4 + n)] = found.dtorque_dq
    by_number: dict[str, np.ndarray] = {}
    for i, rod in enumerate(robot.rods):
        alone = np.zeros((4, len(x), n))
        slope = by_state[:, i, :2]
        alone[0, :, i] = values[:, i] / rod.bending_stiffness
        alone[1, :, i] = -(values[:, i] + np.sum((x[:, :2] - rod.base) * slope, axis=1)) / rod.length
        alone[2:, :, i] = -slope.T
        names = ("bending_stiffness", "length", "base_x", "base_y")
        by_number |= {f"rods[{i}].{name}": each for name, each in zip(names, alone, strict=True)}
    return Torques(values, by_state, by_number)
