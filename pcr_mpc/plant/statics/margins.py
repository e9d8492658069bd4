"""What many poses leave of their limits: rod margins, stiffness and strain."""

from __future__ import annotations

import numpy as np

from ..rods.closed_form.chart import LEAST_CRITICAL_LOAD, critical_load
from ..rods.physics import robot_physics
from ..rods.strain import largest_moment, largest_strain
from .many_poses.equilibria import Equilibria
from .stability import NEAR


def loads(poses: Equilibria, exact_from: float) -> np.ndarray:
    """Lambda over lambda_c of plain rods in closed form, shape (R, n); too much where it is less than given."""
    robot = poses.robot
    load = robot.lengths * np.sqrt(np.linalg.norm(poses.rod_forces, axis=2) / robot.stiffnesses)
    critical = np.full(load.shape, LEAST_CRITICAL_LOAD)
    for row, rod in np.argwhere(load > exact_from * LEAST_CRITICAL_LOAD):
        critical[row, rod] = critical_load(float(poses.unknowns[row, rod, 0]))
    return np.asarray(load / critical)


def least_rod_margins(poses: Equilibria) -> np.ndarray:
    """`least_rod_margin` of each pose that was solved, shape (R,)."""
    if poses.method != "closed_form":
        return np.full(len(poses.p), np.nan)
    return np.asarray(1.0 - loads(poses, 1.0 - NEAR).max(axis=1))


def least_stiffnesses(poses: Equilibria) -> np.ndarray:
    """Least eigenvalue of K at each pose, shape (R,) [N/m]."""
    return np.asarray(np.linalg.eigvalsh((poses.dforce_dp + poses.dforce_dp.transpose(0, 2, 1)) / 2)[:, 0])


def largest_strains(poses: Equilibria) -> np.ndarray:
    """`Equilibrium.max_strain` of each pose that was solved, shape (R, n) [-]; NaN where no thickness is known."""
    robot, count = poses.robot, len(poses.p)
    found = np.full((count, robot.n_rods), np.nan)
    for i, (rod, physics) in enumerate(zip(robot.rods, robot_physics(robot) or (None,) * robot.n_rods, strict=True)):
        if rod.thickness_ratio is None:
            continue
        if physics is not None:
            found[:, i] = [largest_strain(rod, poses.nodes(row)[i], physics)[1] for row in range(count)]
            continue
        unit = rod.bending_stiffness / rod.length**2
        n_x, n_y = poses.rod_forces[:, i].T / unit
        moment = -poses.motor_torque[:, i] / (unit * rod.length)
        found[:, i] = rod.thickness_ratio * largest_moment(poses.q[:, i], n_x, n_y, moment)
    return found
