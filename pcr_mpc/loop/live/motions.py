"""Where the target goes from where it is: along a path that is joined, to a point, with a velocity, to a stand.

Every motion begins in the target's own state and keeps position, velocity and acceleration continuous.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from ...errors import checked_array
from ..references.blended import Blended, duration_of
from ..references.trajectory import Trajectory, sampled, smooth_step

_SUBSTEPS = 4  # of a period in which a target is pursued
_DIFFERENCE = 1e-3  # s, of a function that tells positions only


class Motion(Protocol):
    """What the target does next."""

    def ahead(self, state: np.ndarray, k: int, count: int) -> np.ndarray:
        """Position [m], velocity and acceleration in the ``count`` periods after period k, shape (count, 3, 2).

        ``state``, shape (3, 2), is the same of the target in period k.
        """

    def stopped(self, k: int, periods: int) -> Motion:
        """The same, brought to a stand from period k on, in so many periods."""


@dataclass(frozen=True, eq=False)
class Following:
    """Along a path, which runs from the start on; what the target is away from it fades by a quintic.

    Attributes
    ----------
    path : Trajectory
    period : float
        [s].
    start : int
        Period in which the path's time is 0.
    offset : ndarray, shape (3, 2)
        Target less path at the start of joining: position, velocity, acceleration.
    joins : int
        Period in which it begins to fade.
    fading : int
        Periods until it is gone.
    """

    path: Trajectory
    period: float
    start: int
    offset: np.ndarray
    joins: int
    fading: int

    @classmethod
    def joining(cls, path: Trajectory, period: float, start: int, state: np.ndarray, k: int, fading: int) -> Following:
        """Join ``path`` from the target's ``state`` in period k on."""
        of_path = _of_path(path, np.array([(k - start) * period]))[0]
        return cls(path, period, start, state - of_path, k, fading)

    def ahead(self, state: np.ndarray, k: int, count: int) -> np.ndarray:
        """See `Motion`."""
        return self.at((k + np.arange(1, count + 1)) * self.period)

    def at(self, t: np.ndarray) -> np.ndarray:
        """Samples at times t [s] of the loop, shape (len(t), 3, 2)."""
        found = _of_path(self.path, t - self.start * self.period)
        joined = t.min() >= (self.joins + self.fading) * self.period
        return found if joined else np.asarray(found + self._apart(t))

    def _apart(self, t: np.ndarray) -> np.ndarray:
        span = self.fading * self.period
        s = np.clip((t - self.joins * self.period) / span, 0.0, 1.0)[:, None]
        d, v, a = self.offset[0], span * self.offset[1], span**2 * self.offset[2]
        cubic, quartic, quintic = -(10 * d + 6 * v + 1.5 * a), 15 * d + 8 * v + 1.5 * a, -(6 * d + 3 * v + 0.5 * a)
        apart = d + s * (v + s * (a / 2 + s * (cubic + s * (quartic + s * quintic))))
        slope = v + s * (a + s * (3 * cubic + s * (4 * quartic + s * 5 * quintic)))
        curvature = a + s * (6 * cubic + s * (12 * quartic + s * 20 * quintic))
        gone = s >= 1.0
        parts = (np.where(gone, 0.0, each) for each in (apart, slope / span, curvature / span**2))
        return np.stack(list(parts), axis=1)

    def stopped(self, k: int, periods: int) -> Motion:
        """See `Motion`."""
        return Slowed(self, k, periods)


def _of_path(path: Trajectory, t: np.ndarray) -> np.ndarray:
    """Samples of a path; before its start, of which it may know nothing, by the acceleration with which it starts."""
    found = sampled(path, np.maximum(t, 0.0))
    early = t < 0.0
    if early.any():
        before = t[early, None]
        p, v, a = np.moveaxis(found[early], 1, 0)
        found = found.copy()
        found[early, 0], found[early, 1] = p + before * (v + before * a / 2), v + before * a
    return found


@dataclass(frozen=True, eq=False)
class Slowed:
    """Along the same path, ever slower, to a stand: its time comes to rest by a quintic.

    Attributes
    ----------
    motion : Following
    since : int
        Period in which it begins.
    periods : int
        That it takes, of which the path's time goes on by half.
    """

    motion: Following
    since: int
    periods: int

    def ahead(self, state: np.ndarray, k: int, count: int) -> np.ndarray:
        """See `Motion`."""
        period, span = self.motion.period, self.periods * self.motion.period
        s = np.clip((k + np.arange(1, count + 1) - self.since) / self.periods, 0.0, 1.0)
        value, slope, _ = smooth_step(s)
        passed = span * (s - s**4 * (2.5 - 3.0 * s + s**2))
        speed, change = 1.0 - value, -slope / span
        found = self.motion.at(self.since * period + passed)
        p, v, a = np.moveaxis(found, 1, 0)
        return np.stack([p, v * speed[:, None], a * speed[:, None] ** 2 + v * change[:, None]], axis=1)

    def stopped(self, k: int, periods: int) -> Motion:
        """See `Motion`: it is braking already."""
        return self


@dataclass(frozen=True, eq=False)
class Pursuit:
    """After a point that may move, or at a velocity: three equal poles, with limits on velocity and acceleration.

    Attributes
    ----------
    period : float
        [s].
    point : (float, float) or None
        To go to [m]. None: nowhere in particular, at ``velocity``.
    velocity : (float, float)
        At which the point moves [m/s], if it does.
    seen : int
        Period in which it was at the point.
    quickness : float
        Of the poles [1/s].
    speed, acceleration, jerk : float
        Greatest ones [m/s], [m/s^2], [m/s^3].
    """

    period: float
    point: tuple[float, float] | None
    velocity: tuple[float, float]
    seen: int
    quickness: float
    speed: float
    acceleration: float
    jerk: float

    def ahead(self, state: np.ndarray, k: int, count: int) -> np.ndarray:
        """See `Motion`."""
        (px, py), (vx, vy), (ax, ay) = state.tolist()
        rate, speed, h = self.quickness, self.speed, self.period / _SUBSTEPS
        most, jerk, (wx, wy) = self.acceleration, self.jerk, self.velocity
        goes = math.hypot(wx, wy) > 0.0
        found = []
        for j in range(count):
            for i in range(_SUBSTEPS):  # on a few floats Python is faster than NumPy
                ux, uy = wx, wy
                if self.point is not None:
                    since = self.period * (k + j - self.seen) + i * h if goes else 0.0
                    ux += rate / 3 * (self.point[0] + since * wx - px)
                    uy += rate / 3 * (self.point[1] + since * wy - py)
                ux, uy = _shortened(ux, uy, speed)
                bx, by = _shortened(rate * (ux - vx), rate * (uy - vy), most)
                jx, jy = _shortened(3 * rate * (bx - ax), 3 * rate * (by - ay), jerk)
                px, py = px + h * (vx + h * (ax / 2 + h * jx / 6)), py + h * (vy + h * (ay / 2 + h * jy / 6))
                vx, vy = vx + h * (ax + h * jx / 2), vy + h * (ay + h * jy / 2)
                ax, ay = ax + h * jx, ay + h * jy
            found.append(((px, py), (vx, vy), (ax, ay)))
        return np.array(found)

    def stopped(self, k: int, periods: int) -> Motion:
        """See `Motion`: as quickly as its poles do."""
        return replace(
            self, point=None, velocity=(0.0, 0.0), quickness=max(self.quickness, 6 / (periods * self.period))
        )


def _shortened(x: float, y: float, most: float) -> tuple[float, float]:
    size = math.hypot(x, y)
    return (x, y) if size <= most else (x * most / size, y * most / size)


class OfPositions:
    """A trajectory of a function that tells positions only: its derivatives are differences.

    Parameters
    ----------
    function : callable
        Time [s], a number or an array, -> position, shape (2,) or (len(t), 2) [m].
    many : bool
        Whether it takes arrays of times.
    """

    def __init__(self, function: Any, many: bool) -> None:
        self._function, self._many = function, many

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """See `Trajectory`."""
        h = _DIFFERENCE
        # Forwards at the start, where a path may not be asked for earlier times.
        centre = np.maximum(t, 2 * h)
        five = np.stack([self._positions(centre + j * h) for j in (-2, -1, 0, 1, 2)])
        s = ((t - centre) / h)[:, None]
        first = (five[0] - 8 * five[1] + 8 * five[3] - five[4]) / 12
        second = (-five[0] + 16 * five[1] - 30 * five[2] + 16 * five[3] - five[4]) / 12
        third = (-five[0] + 2 * five[1] - 2 * five[3] + five[4]) / 2
        fourth = five[0] - 4 * five[1] + 6 * five[2] - 4 * five[3] + five[4]
        p = five[2] + s * (first + s * (second / 2 + s * (third / 6 + s * fourth / 24)))
        v = first + s * (second + s * (third / 2 + s * fourth / 6))
        a = second + s * (third + s * fourth / 2)
        return np.stack([p, v / h, a / h**2], axis=1)

    def _positions(self, t: np.ndarray) -> np.ndarray:
        found = self._function(t) if self._many else [np.reshape(self._function(one), 2) for one in t.tolist()]
        return checked_array("what the path returns", found, (len(t), 2))


def as_trajectory(path: Any) -> Trajectory:
    """Return a `Trajectory` of one, or of a function of time that tells positions only.

    One that says when it ends, and is not at rest then, is blended to a rest at both ends (see `Blended`).

    Raises
    ------
    ValueError
        It is neither; names the shapes that it returned.
    """
    if not callable(path):
        raise ValueError(f"path is {path!r}, expected a Trajectory or a function of time")
    two = np.array([0.0, 0.01])
    try:
        shape = np.shape(path(two))
    except Exception:  # a function of one time, as math.sin makes it
        shape = ()
    if shape == (2, 3, 2):
        return _ending(path)
    # Two times and two axes: a function of one time that NumPy spreads over both returns its transpose.
    if shape == (2, 2) and np.allclose(path(two)[0], np.reshape(path(two[:1]), -1)[:2]):
        return OfPositions(path, many=True)
    one = np.shape(path(0.0))
    if one in ((2,), (2, 1), (1, 2)):
        return OfPositions(path, many=False)
    raise ValueError(
        f"path returned shape {shape or one}, expected (len(t), 3, 2) of positions, velocities and accelerations for "
        "an array of times, or a position of shape (2,) for one"
    )


def _ending(path: Trajectory) -> Trajectory:
    duration = duration_of(path)
    if duration == math.inf or not sampled(path, np.array([duration]))[0, 1].any():
        return path
    return Blended(path)
