"""What a planned motion is to keep, each as a share of its limit, and how the shares change with the timing."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from ...errors import check_numbers
from ...linearisation.pose_limits import PoseLimits
from ...loop.scene.scene import Scene
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.many_poses.equilibria import Equilibria
from ...plant.statics.margins import largest_strains, loads
from .angles import followed
from .linear import Linear

# Of the limits, by their names; those on motor angles and on the tip's region are intervals.
UNITS = {
    "motor rate": "rad/s",
    "change of rate": "rad/s^2",
    "motor torque": "N m",
    "motor angle": "rad",
    "tip region": "m",
    "tip speed": "m/s",
    "tip acceleration": "m/s^2",
    "tip jerk": "m/s^3",
    "stiffness": "N/m",
    "rod margin": "1",
    "strain": "1",
}
MOST_MARGIN = 0.9  # of a rod, that may be asked for
_WATCHED = 0.8  # of a margin's limit, from which on its slope is computed
_ANGLE = 1e-5  # by which motors are turned to see how margins change [rad]


@dataclass(frozen=True)
class PlanLimits:
    """Limits of a planned motion; infinite is none.

    Attributes
    ----------
    rate, acceleration, torque : float
        Of every motor [rad/s], [rad/s^2], [N m].
    tip_speed, tip_acceleration, tip_jerk : float
        [m/s], [m/s^2], [m/s^3].
    rod_margin : float
        Least 1 - lambda / lambda_c of a rod; of plain rods only. -infinity is none.
    stiffness : float
        Least eigenvalue of K [N/m]. 0 is none.
    tip_lower, tip_upper : (float, float) or None
        Corners of the box in which the tip is to stay [m].
    strains : tuple of float
        Largest strain of each rod [-]; infinite is none. Empty: of none.
    """

    rate: float
    acceleration: float
    torque: float
    tip_speed: float = math.inf
    tip_acceleration: float = math.inf
    tip_jerk: float = math.inf
    rod_margin: float = -math.inf
    stiffness: float = 0.0
    tip_lower: tuple[float, float] | None = None
    tip_upper: tuple[float, float] | None = None
    strains: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for field in fields(self)[:6]:
            if getattr(self, field.name) != math.inf:
                check_numbers(self, {field.name: {"above": 0.0}})
        if self.rod_margin != -math.inf:
            check_numbers(self, {"rod_margin": {"maximum": MOST_MARGIN}})
        check_numbers(self, {"stiffness": {"minimum": 0.0}})

    def value(self, kind: str) -> float | None:
        """Value of a limit by its name, of strains the least; None if it is an interval."""
        if kind == "strain":
            return min(self.strains)
        names = {"motor rate": "rate", "change of rate": "acceleration", "motor torque": "torque"}
        found: float | None = getattr(self, names.get(kind, kind.replace(" ", "_")), None)
        return found

    @classmethod
    def of_scene(cls, scene: Scene, **more: Any) -> PlanLimits:
        """Those of a scene and its robot, and more by name."""
        poses: PoseLimits = scene.pose_limits
        return cls(
            scene.robot.rate_limit,
            scene.robot.acceleration_limit,
            scene.torque_limit,
            rod_margin=-math.inf if poses.rod_margin is None else poses.rod_margin,
            stiffness=poses.stiffness or 0.0,
            tip_lower=poses.tip_lower,
            tip_upper=poses.tip_upper,
            strains=tuple(scene.strain_limits.tolist()) if np.isfinite(scene.strain_limits).any() else (),
            **more,
        )


@dataclass(frozen=True, eq=False)
class Asked:
    """What a motion asks for at M points.

    Attributes
    ----------
    p : ndarray, shape (M, 2)
        [m].
    velocity, acceleration, jerk : Linear, two components
        Of the tip.
    q, rate, change, torque : Linear, n components
        Motor angles, their rates, the change of these, and torques.
    poses : Equilibria
    pose : Equilibrium
        From which their branch was followed.
    """

    p: np.ndarray
    velocity: Linear
    acceleration: Linear
    jerk: Linear
    q: Linear
    rate: Linear
    change: Linear
    torque: Linear
    poses: Equilibria
    pose: Equilibrium

    @cached_property
    def turned(self) -> Equilibria:
        """Poses with all motors turned a little more: rods do not couple at a held tip."""
        return _turned(self, slice(None))


@dataclass(frozen=True, eq=False)
class Use:
    """Share of a limit that is used at M points: 1 is all of it.

    Attributes
    ----------
    limit : str
    share : Linear
        Its components are motors or rods, where there are several.
    both : bool
        Whether -1 is a bound too.
    """

    limit: str
    share: Linear
    both: bool

    @property
    def largest(self) -> np.ndarray:
        """Of the components, shape (M,)."""
        return np.asarray((np.abs(self.share.value) if self.both else self.share.value).max(axis=1))


def uses(limits: PlanLimits, asked: Asked) -> list[Use]:
    """Every limit that there is, by what the motion uses of it."""
    robot = asked.poses.robot
    low, high = robot.angle_limits.T
    middle, half = (low + high) / 2, (high - low) / 2
    angle = Linear((asked.q.value - middle) / half, asked.q.slope / half[:, None])
    found = [
        Use("motor rate", (1.0 / limits.rate) * asked.rate, both=True),
        Use("change of rate", (1.0 / limits.acceleration) * asked.change, both=True),
        Use("motor torque", (1.0 / limits.torque) * asked.torque, both=True),
        Use("motor angle", angle, both=True),
    ]
    for name, limit, vector in (
        ("tip speed", limits.tip_speed, asked.velocity),
        ("tip acceleration", limits.tip_acceleration, asked.acceleration),
        ("tip jerk", limits.tip_jerk, asked.jerk),
    ):
        if limit != math.inf:
            found.append(Use(name, (1.0 / limit) * vector.norm(), both=False))
    if limits.tip_lower is not None and limits.tip_upper is not None:
        corners = np.array([limits.tip_lower, limits.tip_upper])
        middle, half = corners.mean(axis=0), np.diff(corners, axis=0)[0] / 2
        none = np.zeros((*asked.p.shape, asked.q.slope.shape[2]))  # of the path, which is given
        found.append(Use("tip region", Linear((asked.p - middle) / half, none), both=True))
    if limits.stiffness > 0.0:
        found.append(_stiffness(limits.stiffness, asked))
    if limits.rod_margin > -math.inf and asked.poses.method == "closed_form":
        found.append(_rod_margin(limits.rod_margin, asked))
    if limits.strains:
        found.append(_strain(np.array(limits.strains), asked))
    return found


def _stiffness(least: float, asked: Asked) -> Use:
    """Least eigenvalue of K: the limit over it."""
    poses = asked.poses
    values, vectors = np.linalg.eigh((poses.dforce_dp + poses.dforce_dp.transpose(0, 2, 1)) / 2)
    softest, vector = values[:, 0], vectors[:, :, 0]
    # Where the pose is not even stable, what counts is that it is far beyond the limit.
    share = least / np.maximum(softest, 0.1 * least)
    slope = np.zeros_like(poses.q)
    if asked.q.slope.size and share.max() > _WATCHED:
        for i in range(poses.q.shape[1]):
            change = (_turned(asked, i).dforce_dp - poses.dforce_dp) / _ANGLE
            slope[:, i] = np.einsum("mi,mij,mj->m", vector, change, vector)
    by_angle = -(share**2)[:, None] / least * slope
    by_own = np.einsum("mi,mid->md", by_angle, asked.q.slope)[:, None]
    return Use("stiffness", Linear(share[:, None], by_own), both=False)


def _rod_margin(least: float, asked: Asked) -> Use:
    """Lambda over lambda_c, over the most that is allowed; good to 1 %, and to 5 % at most, where it is far from it."""
    poses, most = asked.poses, 1.0 - least
    rough = loads(poses, np.zeros(poses.q.shape, dtype=bool))
    near = rough > _WATCHED * most
    here, slope = loads(poses, near) if near.any() else rough, np.zeros_like(poses.q)
    if asked.q.slope.size and near.any():
        slope[near] = (loads(asked.turned, near) - here)[near] / _ANGLE
    return Use("rod margin", (1.0 / most) * Linear(here, slope[:, :, None] * asked.q.slope), both=False)


def _strain(limits: np.ndarray, asked: Asked) -> Use:
    """Largest strain of each rod over what it bears; none where no thickness is known."""
    here = np.nan_to_num(largest_strains(asked.poses) / limits)
    slope = np.zeros_like(here)
    if asked.q.slope.size and here.max() > _WATCHED:
        slope = (np.nan_to_num(largest_strains(asked.turned) / limits) - here) / _ANGLE
    return Use("strain", Linear(here, slope[:, :, None] * asked.q.slope), both=False)


def _turned(asked: Asked, motors: int | slice) -> Equilibria:
    """Poses with some motors turned a little more."""
    poses = asked.poses
    q = poses.q.copy()
    q[:, motors] += _ANGLE
    return followed(asked.pose, poses.p, q, poses)
