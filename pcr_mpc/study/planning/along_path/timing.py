"""A pace along a course, and what follows from it: motion, motor angles, shares of the limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, CubicSpline

from ....plant.statics.equilibrium import Equilibrium
from ....plant.statics.many_poses.equilibria import Equilibria
from ..angles import Angles, Stand, angles, stood
from ..limits import Asked, PlanLimits, Use, uses
from ..motion import ORDERS_OF_PACE, Carrier, Motion, motion
from .course import PacedPath
from .pace import duration

# Force of the rods that may be missing, in units of sum EI/L^2: on the way, and in the end.
NEAR, EXACT = 1e-4, 1e-6


@dataclass(frozen=True, eq=False)
class Problem:
    """What is planned.

    Attributes
    ----------
    course : PacedPath
    pose : Equilibrium
        Near the start.
    carrier : Carrier
    limits : PlanLimits
    """

    course: PacedPath
    pose: Equilibrium
    carrier: Carrier
    limits: PlanLimits


@dataclass(frozen=True, eq=False)
class Timing:
    """A pace along a problem's course, and what follows from it at the points x.

    Attributes
    ----------
    problem : Problem
    pace : BSpline
        b.
    x : ndarray, shape (M,)
    moved : Motion
    turned : Angles
    uses : list of Use
    """

    problem: Problem
    pace: BSpline
    x: np.ndarray
    moved: Motion
    turned: Angles
    uses: list[Use]

    @property
    def duration(self) -> float:
        """[s]."""
        return duration(self.pace)

    @property
    def shares(self) -> np.ndarray:
        """Largest share of each limit at each point, shape (limits, M)."""
        return np.stack([use.largest for use in self.uses])

    @property
    def worst(self) -> float:
        """Largest share of any limit."""
        return float(self.shares.max())

    def at(self, x: np.ndarray, tolerance: float = EXACT) -> Timing:
        """Return the same at other points."""
        q = np.asarray(CubicSpline(self.x, self.turned.q.value)(x))
        return evaluated(self.problem, self.pace, x, q, self.near(x), tolerance, all_the_way=False)

    def with_slopes(self) -> Timing:
        """Return the same, and how it changes."""
        moved = _moving(self.problem, self.pace, self.x, slopes=True)
        return _timing(self.problem, self.pace, self.x, moved, self.turned.stand)

    def near(self, x: np.ndarray) -> Equilibria:
        """Poses at the points nearest to x."""
        return self.turned.poses.rows(np.rint(np.interp(x, self.x, np.arange(len(self.x)))).astype(int))


def evaluated(
    problem: Problem,
    pace: BSpline,
    x: np.ndarray,
    q: np.ndarray,
    near: Equilibria | None = None,
    tolerance: float = NEAR,
    *,
    all_the_way: bool = True,
) -> Timing:
    """Evaluate a pace at the points x, without slopes; errors, ``near`` and ``tolerance`` as `balanced`.

    Parameters
    ----------
    q : ndarray, shape (len(x), n)
        Guess [rad].
    all_the_way : bool
        Whether x leads along the path, so that more than two motors can be followed on it (see `stood`).
    """
    moved = _moving(problem, pace, x, slopes=False)
    stand = stood(moved, problem.pose, q, near, tolerance, x if all_the_way else None)
    return _timing(problem, pace, x, moved, stand)


def on_stand(problem: Problem, pace: BSpline, x: np.ndarray, stand: Stand) -> Timing:
    """Estimate a pace from rods that were solved for another one, by their derivatives there."""
    return _timing(problem, pace, x, _moving(problem, pace, x, slopes=False), stand)


def _moving(problem: Problem, pace: BSpline, x: np.ndarray, *, slopes: bool) -> Motion:
    values = np.stack([pace(x, nu=order) for order in range(ORDERS_OF_PACE)])
    return motion(values, problem.course(x), problem.carrier, slopes=slopes)


def _timing(problem: Problem, pace: BSpline, x: np.ndarray, moved: Motion, stand: Stand) -> Timing:
    turned = angles(moved, stand, x)
    return Timing(problem, pace, x, moved, turned, uses(problem.limits, asked_of(moved, turned)))


def asked_of(moved: Motion, turned: Angles) -> Asked:
    """What a motion asks for of tip, motors and rods."""
    return Asked(
        moved.path[0],
        moved.velocity,
        moved.acceleration,
        moved.jerk,
        turned.q,
        turned.rate,
        turned.acceleration,
        turned.torque,
        turned.poses,
        turned.stand.pose,
    )
