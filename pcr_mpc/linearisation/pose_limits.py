"""From a pose to its limits: motor torques, tip region, and the margins to the folds of rods and robot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..buffered import BufferedFunction
from ..plant import elastica
from ..plant.chart import critical_load, critical_load_slope, rough_critical_load
from ..plant.dynamics import Plant
from ..plant.equilibrium import Equilibrium
from .linear_limits import KINDS, LinearLimits

# How close to a limit a pose must come before the limit is linearised: its controller then looks a horizon ahead.
_TORQUE_WATCHED = 0.6  # of the limit
_MARGIN_WATCHED = 0.25  # above the limit
_STIFFNESS_WATCHED = 3.0  # times the limit


@dataclass(frozen=True)
class PoseLimits:
    """What every pose of a robot is to keep; a limit of None is none.

    Attributes
    ----------
    torque : float or None
        Greatest |tau| of a motor [N m].
    tip_lower, tip_upper : (float, float) or None
        Corners of the box in which the tip is to stay [m].
    rod_margin : float or None
        Least 1 - lambda / lambda_c of a rod: how far it is to stay from snapping with its tip held.
    stiffness : float or None
        Least eigenvalue of K [N/m]: how far the pose is to stay from snapping with its tip free.
    """

    torque: float | None = None
    tip_lower: tuple[float, float] | None = None
    tip_upper: tuple[float, float] | None = None
    rod_margin: float | None = None
    stiffness: float | None = None


class LimitWatch:
    """Linearises the limits of a pose where they come near, by implicit differentiation of the exact rods.

    Parameters
    ----------
    limits : PoseLimits
    plant : Plant
        Follows its branch to the poses; may be the one that is linearised, which then has little left to do. If it is
        not in closed form, a plant that is takes its place.
    """

    def __init__(self, limits: PoseLimits, plant: Plant) -> None:
        self.limits = limits
        self._robot = robot = plant.robot
        self._plant = plant if plant.method == "closed_form" else Plant(robot)
        n = robot.n_rods
        counts = (
            2 * n * (limits.torque is not None),
            4 * (limits.tip_lower is not None),
            n * (limits.rod_margin is not None),
            1 * (limits.stiffness is not None),
        )
        self.kinds = tuple(kind for kind, count in zip(KINDS, counts, strict=True) for _ in range(count))
        units = (limits.torque, float(robot.lengths.mean()), 1.0, limits.stiffness)
        self._scale = np.array([u for u, count in zip(units, counts, strict=True) for _ in range(count)], dtype=float)
        self._first = np.cumsum((0, *counts[:-1])).tolist()
        self._moment_units = robot.stiffnesses / robot.lengths

    @cached_property
    def _curvature(self) -> BufferedFunction:
        return BufferedFunction(elastica.rod_curvature())

    def reset(self, x: np.ndarray, pose: Equilibrium) -> None:
        """Follow the branch of ``pose`` from state x."""
        self._plant.reset(x, pose)

    def rows(self, x: np.ndarray) -> LinearLimits | None:
        """Limits about state x, following the branch; None where none of them is near.

        Raises
        ------
        UnreachableError, ConvergenceError, UnstableError
            As `Plant.force`.
        """
        if not self.kinds:
            return None
        state = self._plant.rods(x[:2], x[4:])
        n, limits = self._robot.n_rods, self.limits
        c, d = np.zeros((len(self.kinds), 4 + n)), np.full(len(self.kinds), -1.0)
        if limits.torque is not None:
            tau = -self._moment_units * state.loads[2]
            if np.abs(tau).max() > _TORQUE_WATCHED * limits.torque:
                slopes = -self._moment_units[:, None] * state.load_tangents[2].reshape(n, 3)
                rows = np.hstack(
                    [slopes[:, :2] / self._robot.lengths[:, None], np.zeros((n, 2)), np.diag(slopes[:, 2])]
                )
                rows, offset = rows / limits.torque, (tau - rows @ x) / limits.torque
                c[: 2 * n], d[: 2 * n] = np.vstack([rows, -rows]), np.append(offset, -offset) - 1.0
        if limits.tip_lower is not None and limits.tip_upper is not None:
            at, unit = self._first[1], self._scale[self._first[1]]
            c[at : at + 2, :2], c[at + 2 : at + 4, :2] = np.eye(2) / unit, -np.eye(2) / unit
            d[at : at + 4] = np.append(np.negative(limits.tip_upper), limits.tip_lower) / unit
        if limits.rod_margin is not None:
            for i in range(n):
                self._rod_margin(i, state.unknowns[:2, i], state.tangents[:2, 3 * i : 3 * i + 3], x, c, d)
        if limits.stiffness is not None and state.k[0, 0] < np.inf:
            a, b, e = float(state.k[0, 0]), float(state.k[0, 1]), float(state.k[1, 1])
            softest = (a + e) / 2 - math.hypot((a - e) / 2, b)
            if softest < _STIFFNESS_WATCHED * limits.stiffness:
                gradient = self._softening(state.unknowns, state.poses, state.k)
                c[-1] = -gradient / limits.stiffness
                d[-1] = 1.0 - softest / limits.stiffness + float(gradient @ x) / limits.stiffness
        return LinearLimits(self.kinds, c, d, self._scale) if c.any() else None

    def _rod_margin(
        self, i: int, unknowns: np.ndarray, tangent: np.ndarray, x: np.ndarray, c: np.ndarray, d: np.ndarray
    ) -> None:
        """Fill in the row of rod i: least - (1 - lambda / lambda_c)."""
        log_tip_angle, load = unknowns.tolist()
        least = self.limits.rod_margin
        assert least is not None
        if load < (1.0 - least - _MARGIN_WATCHED) * rough_critical_load(log_tip_angle):
            return
        critical = critical_load(log_tip_angle)
        slope = critical_load_slope(log_tip_angle, critical)
        by_pose = (tangent[1] - load / critical * slope * tangent[0]) / critical
        row, length = self._first[2] + i, self._robot.rods[i].length
        c[row, :2], c[row, 4 + i] = by_pose[:2] / length, by_pose[2]
        d[row] = least - 1.0 + load / critical - float(c[row] @ x)

    def _softening(self, unknowns: np.ndarray, poses: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Gradient of the least eigenvalue of K, shape (4 + n,): v' dK v with v its eigenvector."""
        n = self._robot.n_rods
        v = np.linalg.eigh(k)[1][:, 0]
        gradient = np.zeros(4 + n)
        for i, rod in enumerate(self._robot.rods):
            self._curvature.inputs[0][:] = unknowns[:, i]
            self._curvature.inputs[1][:] = poses[:, i]
            self._curvature()
            unit = rod.bending_stiffness / rod.length**3
            # Each column holds d K / d pose_j of this rod.
            by_pose = unit * (np.outer(v, v).ravel() @ self._curvature.outputs[0])
            gradient[:2] += by_pose[:2] / rod.length
            gradient[4 + i] = by_pose[2]
        return gradient
