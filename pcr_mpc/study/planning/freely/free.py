"""The path between way-points is free too: from the plan of a given path to the fastest of all near it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BPoly, CubicSpline

from ....errors import ConvergenceError, ModelError
from ....loop.references.blended import Blended
from ....loop.references.trajectory import PickAndPlace, Trajectory
from ....plant.rods.physics import require_plain
from ....plant.statics.symbolic import rod_unknowns
from ..along_path.pace import times
from ..along_path.timing import EXACT, Problem, Timing, asked_of
from ..angles import angles, followed, stood
from ..limits import Asked, Use, uses
from ..motion import motion
from ..timed_path import Move
from .collocation import NODES, Collocated, solved

_MOST_POINTS = 100  # more are samples of a path, and no way-points
_FEWEST = 4  # intervals from one way-point to the next
FINE = 10 * len(NODES)  # points of an interval where limits are checked
_LARGEST_EXCESS, _LITTLE, _MOST_ATTEMPTS = 1e-3, 1e-2, 8
_NEAR = 0.9  # share of a limit from which on it is kept from the start
_BY_BOUNDS = {"motor rate", "change of rate", "motor angle", "tip region"}  # kept always


@dataclass(frozen=True, eq=False)
class Hermite(Move):
    """Polynomials of degree 7 through position, velocity, acceleration and jerk at the ends of intervals.

    The motors' rates follow from the jerk: where it is continuous, they are.

    Attributes
    ----------
    t : ndarray, shape (K + 1,)
        [s].
    samples : ndarray, shape (K + 1, 4, 2)
    """

    t: np.ndarray
    samples: np.ndarray

    @property
    def duration(self) -> float:
        """See `Move`."""
        return float(self.t[-1])

    def at(self, t: np.ndarray) -> np.ndarray:
        """See `Move`."""
        return np.moveaxis(self.derivatives(t)[:3], 0, 1)

    def derivatives(self, t: np.ndarray) -> np.ndarray:
        """Position and its first four derivatives, shape (5, len(t), 2)."""
        spline = BPoly.from_derivatives(self.t, self.samples)
        return np.stack([spline(t), *(spline.derivative(order)(t) for order in range(1, 5))])

    def breaks(self) -> np.ndarray:
        """See `Move`."""
        return self.t


@dataclass(frozen=True, eq=False)
class Freed:
    """A motion through way-points, and what it asks for at points ten times as dense as those where limits were kept.

    Attributes
    ----------
    move : Hermite
    t : ndarray, shape (M,)
        [s].
    asked : Asked
    uses : list of Use
        Of all limits but those on strain.
    grid : int
        Points at which limits were kept.
    iterations : int
    """

    move: Hermite
    t: np.ndarray
    asked: Asked
    uses: list[Use]
    grid: int
    iterations: int


def freed(timing: Timing, points: np.ndarray, intervals: int, allowed: float) -> Freed:
    """Find the fastest motion through way-points near that of a given path.

    Parameters
    ----------
    timing : Timing
        To start from.
    points : ndarray, shape (W, 2)
        In their order [m].
    intervals : int
        About so many.
    allowed : float
        Share of the limits that may be used.

    Raises
    ------
    ModelError
        The rods are not plain.
    InfeasibleError
        The nonlinear program was not solved.
    ConvergenceError
        A limit is exceeded between the points where it was kept.
    """
    # Strain is no part of the programs: of the result is said how large it is.
    problem = replace(timing.problem, limits=replace(timing.problem.limits, strains=()))
    require_plain(problem.pose.robot, "a free path (free)")
    hands, rods = rod_unknowns(problem.pose.robot, problem.pose)
    moved = _started(timing, points, intervals, rods)
    # Most limits are far: those that turn out not to be are added.
    kinds = frozenset(use.limit for use in timing.uses if use.largest.max() > _NEAR) - _BY_BOUNDS
    attempts = 0
    while True:
        moved, attempts = solved(moved, problem, hands, points, allowed, kinds), attempts + 1
        found = _checked(moved, problem)
        beyond = {use.limit for use in found.uses if use.largest.max() > 1.0 + _LARGEST_EXCESS}
        if not beyond:
            return found
        new = beyond - kinds - _BY_BOUNDS
        worst = max(found.uses, key=lambda use: float(use.largest.max()))
        excess = float(worst.largest.max()) - 1.0
        if not new and excess < _LITTLE and attempts < _MOST_ATTEMPTS:
            allowed -= 1.5 * excess  # what is exceeded between the points is left at them
        elif not new:
            raise ConvergenceError(
                f"the plan of a free path exceeds the limit on {worst.limit} by "
                f"{100 * excess:.3g} % at {found.t[worst.largest.argmax()]:.4f} s, between the "
                f"points where it was kept; take more cells than {intervals}",
                residual=excess,
                iterations=found.iterations,
                last=moved.states,
            )
        kinds |= new


def _started(timing: Timing, points: np.ndarray, intervals: int, rods: Callable[..., np.ndarray]) -> Collocated:
    """The motion along the given path, in intervals of nearly equal length."""
    t, n = times(timing.pace, timing.x), timing.turned.q.value.shape[1]
    moved, turned = timing.moved, timing.turned
    spline = CubicSpline(t, np.concatenate([moved.path[0], moved.velocity.value, turned.q.value, turned.rate.value,
                                            moved.acceleration.value], axis=1))  # fmt: skip
    fine = np.linspace(0.0, t[-1], 4001)
    tips, passed, first = spline(fine)[:, :2], [0.0], 0
    for point in points[1:-1]:
        # The nearest place that comes after the one before: a path may cross itself.
        first += _first_valley(np.linalg.norm(tips[first:] - point, axis=1))
        passed.append(float(fine[first]))
    spans = np.diff([*passed, t[-1]])
    counts = np.maximum(_FEWEST, np.rint(intervals * spans / t[-1]).astype(int))
    steps = np.repeat(spans / counts, counts)
    ends = np.concatenate([[0.0], np.cumsum(steps)])
    x = spline(ends)[:, : 4 + 2 * n]
    inside = spline((ends[:-1, None] + steps[:, None] * NODES).ravel())
    unknowns = rods(inside[:, :2], inside[:, 4 : 4 + n])
    shape = (len(steps), len(NODES))
    changes = np.diff(x[:, 4 + n :], axis=0) / steps[:, None]
    return Collocated(x, changes, inside[:, -2:].reshape(*shape, 2), unknowns.reshape(*shape, 2 * n), spans, counts)


def _checked(moved: Collocated, problem: Problem) -> Freed:
    """What the written path of the tip asks for, by statics at every point of a dense grid.

    The motors' motion is that by which the rods carry the path's forces, not that of the program: what is between its
    points differs.
    """
    robot, carrier, pose, steps = problem.pose.robot, problem.carrier, problem.pose, moved.steps
    n = robot.n_rods
    ends = np.concatenate([[0.0], np.cumsum(steps)])
    p, v, q, u = np.split(moved.states, [2, 4, 4 + n], axis=1)
    poses = followed(pose, p, q, None)
    if not poses.solved.all():
        lost = int(np.argmin(poses.solved))
        raise ConvergenceError(
            f"the rods could not be followed along the planned path at p = {p[lost]} m: {poses.reason[lost]}",
            residual=float("nan"),
            iterations=moved.iterations,
            last=q[lost],
        )
    a = (carrier.weight - poses.force - robot.drag * v) / carrier.mass
    turned = np.einsum("mij,mj->mi", poses.dforce_dp, v) + np.einsum("mij,mj->mi", poses.dforce_dq, u)
    move = Hermite(ends, np.stack([p, v, a, -(turned + robot.drag * a) / carrier.mass], axis=1))

    part = np.append(np.tile(np.arange(FINE) / FINE, len(steps)), 1.0)
    row = np.append(np.repeat(np.arange(len(steps)), FINE), len(steps) - 1)
    since = part * steps[row]
    t = ends[row] + since
    guess = q[row] + since[:, None] * u[row] + since[:, None] ** 2 / 2 * moved.changes[row]
    # In time: at a pace of 1.
    course = motion(np.repeat([[1.0], [0.0], [0.0], [0.0]], len(t), axis=1), move.derivatives(t), carrier, slopes=False)
    asked = asked_of(course, angles(course, stood(course, pose, guess, None, EXACT), t))
    grid = len(steps) * len(NODES) + 1
    return Freed(move, t, asked, uses(problem.limits, asked), grid, moved.iterations)


def _first_valley(away: np.ndarray) -> int:
    """Index of the first local minimum that is hardly higher than the least of all."""
    low = np.flatnonzero(away < away.min() + 0.02 * np.ptp(away))
    last = low[0] + int(np.argmax(np.append(np.diff(low), 2) > 1)) if len(low) else 0
    return int(low[0] + away[low[0] : last + 1].argmin())


def way_points(trajectory: Trajectory) -> np.ndarray:
    """Way-points of a reference, shape (W, 2) [m].

    Raises
    ------
    ModelError
        It has none.
    """
    while isinstance(trajectory, Blended):
        trajectory = trajectory.path
    if isinstance(trajectory, PickAndPlace):
        return np.array([trajectory.pick, trajectory.place])
    points, closed = getattr(trajectory, "points", None), getattr(trajectory, "closed", False)
    if points is None or closed or len(points) > _MOST_POINTS:
        kind = f"{'closed ' if closed else ''}{type(trajectory).__name__}"
        raise ModelError(
            f"a {kind} has no way-points between which its path could be free; give a spline or waypoints that are "
            f"open (closed = false), at most {_MOST_POINTS}, or plan its timing alone",
            key="reference",
        )
    return np.array(points)
