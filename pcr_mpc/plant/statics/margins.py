"""What many poses leave of their limits: rod margins, stiffness and strain."""

from __future__ import annotations

import numpy as np

from ..rods.closed_form.chart import critical_load, rough_critical_load
from ..rods.physics import robot_physics
from ..rods.strain import largest_moment, largest_strain
from .many_poses.equilibria import Equilibria

# Accuracy of a rough critical load, and where it is steep, near a log tip_angle.
_ROUGH, _ROUGH_STEEP, _STEEP, _NEAR_STEEP = 0.011, 0.05, -0.14, 0.1


def loads(poses: Equilibria, exact: np.ndarray) -> np.ndarray:
    """Lambda over lambda_c of plain rods in closed form, shape (R, n).

    Parameters
    ----------
    poses : Equilibria
    exact : ndarray of bool, shape (R, n)
        Of which rods it is to be exact; of the others it is good to 1 %, and to 5 % near log tip_angle = -0.14.
    """
    robot = poses.robot
    load = robot.lengths * np.sqrt(np.linalg.norm(poses.rod_forces, axis=2) / robot.stiffnesses)
    critical = rough_critical_load(poses.unknowns[:, :, 0])
    for row, rod in np.argwhere(exact):
        critical[row, rod] = critical_load(float(poses.unknowns[row, rod, 0]))
    return np.asarray(load / critical)


def least_rod_margins(poses: Equilibria) -> np.ndarray:
    """`least_rod_margin` of each pose that was solved, shape (R,).

    The least of all is exact; of others lambda is good to 1 %, and to 5 % where lambda_c is steep.
    """
    if poses.method != "closed_form":
        return np.full(len(poses.p), np.nan)
    rough = loads(poses, np.zeros(poses.q.shape, dtype=bool))
    error = np.where(np.abs(poses.unknowns[:, :, 0] - _STEEP) < _NEAR_STEEP, _ROUGH_STEEP, _ROUGH)
    exact = loads(poses, (1.0 + error) * rough >= ((1.0 - error) * rough).max())
    return np.asarray(1.0 - exact.max(axis=1))


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
