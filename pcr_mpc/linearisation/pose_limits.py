"""From a pose to its limits: motor torques, tip region, and the margins to the folds of rods and robot."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from ..buffered import BufferedFunction
from ..frozen import Remade, set_once
from ..plant.motion.plant import Plant
from ..plant.robot import Robot
from ..plant.rods.closed_form import elastica
from ..plant.rods.closed_form.chart import LEAST_CRITICAL_LOAD, critical_load, critical_load_slope, rough_critical_load
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.state import RobotState
from .linear_limits import KINDS, LinearLimits, Rows
from .strain_watch import StrainWatch

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
    strain : float, tuple of float or None
        Largest strain of the rods, of all or of each; infinite for a rod that may be strained as it likes.
    """

    torque: float | None = None
    tip_lower: tuple[float, float] | None = None
    tip_upper: tuple[float, float] | None = None
    rod_margin: float | None = None
    stiffness: float | None = None
    strain: float | tuple[float, ...] | None = None

    def strains(self, robot: Robot) -> np.ndarray:
        """Largest strain of each rod, shape (n,): infinite where it is not limited, or where no thickness is known."""
        limits = np.full(robot.n_rods, math.inf)
        known = [rod.half_thickness is not None for rod in robot.rods]
        if self.strain is not None:
            limits[known] = np.broadcast_to(self.strain, limits.shape)[known]
        return limits


@set_once("make a new LimitWatch with them", "limits")
class LimitWatch(Remade):
    """Linearises the limits of a pose where they come near, by implicit differentiation of the exact rods.

    Parameters
    ----------
    limits : PoseLimits
    plant : Plant
        Follows its branch to the poses; may be the one that is linearised, which then has little left to do. If it is
        not in closed form, a plant that is takes its place, unless its rods are not plain.

    Notes
    -----
    The margins to folds are known of plain rods only, by the closed form: for others (see `Robot.needs_shooting`)
    limits on them are not watched, only torque, tip region and strain. Where a plant condenses the rods' weight, all
    are those of the weightless rods.
    """

    def __init__(self, limits: PoseLimits, plant: Plant) -> None:
        self._robot = robot = plant.robot
        if plant.method == "closed_form":
            self._plant, plain = plant, True
            self._follows_model = True
        else:
            plain = plant.weight != "exact" and robot.weightless().needs_shooting is None
            self._plant = Plant(robot, weight="none") if plain else plant
            self._follows_model = False
        if not plain:
            limits = replace(limits, rod_margin=None, stiffness=None)
        self.limits = limits
        self._strain = StrainWatch(limits.strains(robot), self._plant)
        strained = self._strain.count or None
        given = (limits.torque, limits.tip_lower, limits.rod_margin, limits.stiffness, strained)
        self._present = tuple(kind for kind, limit in zip(KINDS, given, strict=True) if limit is not None)
        n = robot.n_rods
        self._counts = dict(zip(KINDS, (n, 2, n, 1, self._strain.count), strict=True))
        self._moment_units = robot.stiffnesses / robot.lengths
        # See `far`; what is not limited is never near.
        margin = limits.rod_margin
        self._watched = (
            limits.tip_lower is not None,
            math.inf if limits.torque is None else _TORQUE_WATCHED * limits.torque,
            -math.inf if limits.stiffness is None else _STIFFNESS_WATCHED * limits.stiffness,
            math.inf if margin is None else (1.0 - margin - _MARGIN_WATCHED) * LEAST_CRITICAL_LOAD,
        )
        # What takes long at first is not left to the first limit that comes near.
        if limits.rod_margin is not None:
            critical_load(0.0)
        if limits.stiffness is not None:
            self._curvature = BufferedFunction(elastica.rod_curvature())

    @property
    def idle(self) -> bool:
        """Whether there is nothing to watch."""
        return not self._present

    def combinations(self) -> list[tuple[str, ...]]:
        """Every ``kinds`` that `rows` may give."""
        return [
            tuple(kind for kind in some for _ in range(self._counts[kind]))
            for count in range(1, len(self._present) + 1)
            for some in itertools.combinations(self._present, count)
        ]

    @property
    def plant(self) -> Plant:
        """Whose rods are asked."""
        return self._plant

    def reset(self, x: np.ndarray, pose: Equilibrium) -> None:
        """Follow the branch of ``pose`` from state x."""
        self._plant.reset(x, pose)

    @property
    def follows_model(self) -> bool:
        """Whether the plant that was given is the one that is asked, so that it may be told where its rods are."""
        return self._follows_model

    def far(self, signs: list[float]) -> bool:
        """Whether no limit can be near a pose of rods in closed form, so that `rows` need not be asked.

        ``signs`` are the least eigenvalue of K [N/m], torques [N m], and log tip angles and loads of the rods (see
        `elastica`); NaN is not far.
        """
        never, torque, stiffness, load = self._watched
        loads = signs[1 + 2 * self._robot.n_rods :]
        if never or not signs[0] > stiffness or not self._strain.far(loads):
            return False
        for found in signs[1 : 1 + self._robot.n_rods]:
            if not -torque < found < torque:
                return False
        return max(loads) <= load

    def recall(self, record: np.ndarray) -> None:
        """Tell the plant where its rods are (see `Plant.recall`)."""
        self._plant.recall(record)

    def rows(self, x: np.ndarray) -> LinearLimits | None:
        """Limits that are near state x, following the branch; None if none is.

        Raises
        ------
        UnreachableError, ConvergenceError, UnstableError
            As `Plant.force`.
        """
        if not self._present:
            return None
        state = self._plant.rods(x[:2], x[4:])
        near = {
            "torque": self._torque(x, state),
            "tip region": self._tip_region(len(x)),
            "rod margin": self._rod_margins(x, state),
            "stiffness": self._stiffness(x, state),
            "strain": self._strain.rows(x, state),
        }
        found = [(kind, *rows) for kind, rows in near.items() if rows is not None]
        if not found:
            return None
        c, lower, upper, scale = (np.concatenate(parts) for parts in zip(*(rows[1:] for rows in found), strict=True))
        return LinearLimits(tuple(k for k, *_ in found for _ in range(self._counts[k])), c, lower, upper, scale)

    def _torque(self, x: np.ndarray, state: RobotState) -> Rows | None:
        limit, n = self.limits.torque, len(x) - 4
        if limit is None:
            return None
        tau = -self._moment_units * state.loads[2]
        if max(map(abs, tau.tolist())) < _TORQUE_WATCHED * limit:
            return None
        slopes = -self._moment_units[:, None] * state.load_tangents[2].reshape(n, 3) / limit
        rows = np.zeros((n, 4 + n))
        rows[:, :2] = slopes[:, :2] / self._robot.lengths[:, None]
        rows[:, 4:] = np.diag(slopes[:, 2])
        rest = tau / limit - rows @ x
        return rows, -1.0 - rest, 1.0 - rest, np.full(n, limit)

    def _tip_region(self, n_states: int) -> Rows | None:
        if self.limits.tip_lower is None or self.limits.tip_upper is None:
            return None
        unit = float(self._robot.lengths.mean())
        lower, upper = np.array(self.limits.tip_lower) / unit, np.array(self.limits.tip_upper) / unit
        return np.eye(2, n_states) / unit, lower, upper, np.full(2, unit)

    def _rod_margins(self, x: np.ndarray, state: RobotState) -> Rows | None:
        least, n = self.limits.rod_margin, len(x) - 4
        if least is None:
            return None
        shapes = state.unknowns[:2].T.tolist()
        near = (1.0 - least - _MARGIN_WATCHED) * LEAST_CRITICAL_LOAD
        if not any(
            load > near and load > (1.0 - least - _MARGIN_WATCHED) * rough_critical_load(log_tip_angle)
            for log_tip_angle, load in shapes
        ):
            return None
        rows, lower = np.zeros((n, 4 + n)), np.empty(n)
        for i, (log_tip_angle, load) in enumerate(shapes):
            # Of lambda_c (log tip_angle) too: both follow the pose.
            critical = critical_load(log_tip_angle)
            tangent = state.tangents[:2, 3 * i : 3 * i + 3]
            slope = critical_load_slope(log_tip_angle, critical)
            by_pose = (load / critical * slope * tangent[0] - tangent[1]) / critical
            rows[i, :2], rows[i, 4 + i] = by_pose[:2] / self._robot.rods[i].length, by_pose[2]
            lower[i] = least - (1.0 - load / critical) + float(rows[i] @ x)
        return rows, lower, np.full(n, np.inf), np.ones(n)

    def _stiffness(self, x: np.ndarray, state: RobotState) -> Rows | None:
        """The least eigenvalue of K moves as v' dK v, with v its eigenvector."""
        least = self.limits.stiffness
        if least is None:
            return None
        (a, b), (_, e) = state.k.tolist()
        softest = (a + e) / 2 - math.hypot((a - e) / 2, b)
        if softest > _STIFFNESS_WATCHED * least:
            return None
        v = np.linalg.eigh(state.k)[1][:, 0]
        row = np.zeros((1, len(x)))
        for i, rod in enumerate(self._robot.rods):
            self._curvature.inputs[0][:] = state.unknowns[:, i]
            self._curvature.inputs[1][:] = state.poses[:, i]
            self._curvature()
            unit = rod.bending_stiffness / rod.length**3 / least
            by_pose = unit * (np.outer(v, v).ravel() @ self._curvature.outputs[0])  # column j: d K / d pose_j
            row[0, :2] += by_pose[:2] / rod.length
            row[0, 4 + i] = by_pose[2]
        lower = 1.0 - softest / least + row @ x
        return row, lower, np.full(1, np.inf), np.full(1, least)
