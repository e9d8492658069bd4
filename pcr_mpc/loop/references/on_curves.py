"""Trajectories that go along a curve: a circle, a line, a polygon, way-points, a spline through points.

None of them rests at its ends by itself unless it says so: `Blended` sees to that.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ...errors import ModelError, check_numbers, checked_array, checked_vector, number_problem
from .curves import Circular, Curve, Points, Rounded, Smooth
from .trajectory import check_flag

_POSITIVE = {"above": 0.0}
_PEAK = 15 / 8  # largest over mean rate of a quintic from rest to rest


class OnCurve(ABC):
    """Base of trajectories that go along a curve, and stay at its end."""

    @property
    @abstractmethod
    def curve(self) -> Curve:
        """Where it leads, by arc length."""

    @property
    def duration(self) -> float:
        """Time at which it comes to the end of its curve [s]."""
        return float(self._knots[0][-1])

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """See `Trajectory`."""
        s, rate, change = self._progress(np.asarray(t, dtype=float))
        place, along, bend = np.moveaxis(self.curve(s), 1, 0)
        rate, change = rate[:, None], change[:, None]
        return np.stack([place, along * rate, bend * rate**2 + along * change], axis=1)

    @property
    @abstractmethod
    def _knots(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times [s], arc lengths [m] and rates [m/s] at which there is no change of rate."""

    def _progress(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Arc length [m], its rate [m/s] and that one's change [m/s^2]: quintics from knot to knot.

        The rate is a cubic step from that of one knot to that of the next, plus what the way takes beyond it as
        30 u^2 (1 - u)^2. Rates at knots of at most twice the mean ones beside them never make it negative.
        """
        times, marks, rates = self._knots
        within = np.clip(t, times[0], times[-1])
        i = np.clip(np.searchsorted(times, within, side="right") - 1, 0, len(times) - 2)
        h = times[i + 1] - times[i]
        u = (within - times[i]) / h
        first, step = rates[i], rates[i + 1] - rates[i]
        more = (marks[i + 1] - marks[i]) / h - (rates[i] + rates[i + 1]) / 2
        s = marks[i] + h * (first * u + step * (u**3 - u**4 / 2) + more * u**3 * (10.0 - 15.0 * u + 6.0 * u**2))
        rate = first + step * u**2 * (3.0 - 2.0 * u) + more * 30.0 * u**2 * (1.0 - u) ** 2
        change = (step * 6.0 * u * (1.0 - u) + more * 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u)) / h
        beyond = within != t
        return s, np.where(beyond, 0.0, rate), np.where(beyond, 0.0, change)


class _Steady(OnCurve):
    """Along a curve at one speed."""

    speed: float

    @cached_property
    def _knots(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        length = self.curve.length
        return np.array([0.0, length / self.speed]), np.array([0.0, length]), np.full(2, self.speed)


@dataclass(frozen=True)
class Circle(_Steady):
    """Once round a circle at constant speed.

    Attributes
    ----------
    centre : (float, float)
        [m].
    radius : float
        [m].
    period : float
        Of the turn [s].
    angle : float
        At which it begins, counter-clockwise from x [rad]; by default at the bottom.
    clockwise : bool
    """

    centre: tuple[float, float]
    radius: float
    period: float
    angle: float = -np.pi / 2
    clockwise: bool = False

    def __post_init__(self) -> None:
        try:
            centre = checked_vector("centre", self.centre, 2).tolist()
        except ValueError as error:
            raise ModelError(str(error), key="centre") from None
        object.__setattr__(self, "centre", tuple(centre))
        check_numbers(self, {"radius": _POSITIVE, "period": _POSITIVE, "angle": {}})
        check_flag(self, "clockwise")

    @cached_property
    def curve(self) -> Circular:
        """See `OnCurve`."""
        return Circular(self.centre, self.radius, self.angle, self.clockwise)

    @property
    def speed(self) -> float:  # type: ignore[override]
        """[m/s]."""
        return 2 * np.pi * self.radius / self.period


@dataclass(frozen=True)
class Line(_Steady):
    """Straight from one point to another at constant speed.

    Attributes
    ----------
    points : ((float, float), (float, float))
        [m].
    speed : float
        [m/s].
    """

    points: Points
    speed: float

    def __post_init__(self) -> None:
        _check_points(self, "points", 2, closed=False)
        if len(self.points) != 2:
            raise ModelError(f"points: a line has 2, found {len(self.points)}; take waypoints", key="points")
        check_numbers(self, {"speed": _POSITIVE})

    @cached_property
    def curve(self) -> Rounded:
        """See `OnCurve`."""
        return Rounded(self.points, 0.0, closed=False)


@dataclass(frozen=True)
class Polygon(_Steady):
    """Once round a polygon with rounded corners at constant speed, from the middle of its first corner.

    Attributes
    ----------
    corners : tuple of (float, float)
        [m].
    radius : float
        Smallest radius of curvature of the corners [m] (see `Rounded`).
    speed : float
        [m/s].
    """

    corners: Points
    radius: float
    speed: float

    def __post_init__(self) -> None:
        _check_points(self, "corners", 3, closed=True)
        check_numbers(self, {"radius": _POSITIVE, "speed": _POSITIVE})
        _ = self.curve

    @cached_property
    def curve(self) -> Rounded:
        """See `OnCurve`."""
        return Rounded(self.corners, self.radius, closed=True)


@dataclass(frozen=True)
class _ThroughPoints(OnCurve):
    """Along a curve by points, at a speed, at a speed for each leg, or by the times at the points.

    Attributes
    ----------
    points : tuple of (float, float)
        [m].
    speed : float or tuple of float or None
        One for all [m/s], kept exactly, or the mean speed of each leg.
    times : tuple of float or None
        At which it is at the points, from 0 on [s]; where it is closed, one more: when it is back at the first. Open
        ones rest at both ends. One of speed and times is given.
    closed : bool
        Back to the first point.
    """

    points: Points
    speed: float | tuple[float, ...] | None = None
    times: tuple[float, ...] | None = None
    closed: bool = False

    def __post_init__(self) -> None:
        check_flag(self, "closed")
        _check_points(self, "points", 3 if self.closed else 2, closed=self.closed)
        if (self.speed is None) == (self.times is None):
            raise ModelError("give either speed or times", key="speed")
        legs = len(self.points) - (not self.closed)
        if self.times is not None:
            times = _numbers("times", self.times, legs + 1)
            if times[0] != 0.0:
                raise ModelError(f"times begin at {times[0]:g} s, expected 0", key="times")
            for i in np.flatnonzero(np.diff(times) <= 0.0):
                raise ModelError(
                    f"times[{i + 1}] = {times[i + 1]:g} s is not after times[{i}] = {times[i]:g} s", key="times"
                )
            object.__setattr__(self, "times", times)
        elif isinstance(self.speed, tuple | list | np.ndarray):
            speeds = _numbers("speed", self.speed, legs)
            if min(speeds) <= 0.0:
                raise ModelError(f"speed: {min(speeds):g} m/s, expected more than 0", key="speed")
            object.__setattr__(self, "speed", speeds)
        else:
            check_numbers(self, {"speed": _POSITIVE})

    @property
    def stops(self) -> bool:
        """Whether it rests at every point."""
        return False

    @property
    @abstractmethod
    def curve(self) -> Rounded | Smooth:
        """See `OnCurve`."""

    @cached_property
    def _knots(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        marks = self.curve.marks
        ways = np.diff(marks)
        if self.times is not None:
            times = np.array(self.times)
        elif isinstance(self.speed, float) and not self.stops:
            return np.array([0.0, marks[-1] / self.speed]), marks[[0, -1]], np.full(2, self.speed)
        else:
            # From rest to rest the stated speed is the largest on the way.
            times = np.concatenate([[0.0], np.cumsum((_PEAK if self.stops else 1.0) * ways / np.array(self.speed))])
        rates = np.zeros(len(marks))
        if self.stops:
            return times, marks, rates
        means = ways / np.diff(times)
        # The harmonic mean is at most twice the smaller one.
        rates[1:-1] = 2.0 / (1.0 / means[:-1] + 1.0 / means[1:])
        if self.closed:
            rates[[0, -1]] = 2.0 / (1.0 / means[0] + 1.0 / means[-1])
        elif self.times is None:
            rates[[0, -1]] = means[[0, -1]]
        return times, marks, rates


@dataclass(frozen=True)
class Waypoints(_ThroughPoints):
    """Straight from point to point: round the corners, or with a rest at every point.

    Attributes
    ----------
    points, speed, times, closed
        See above. Round a corner the time is that of its middle. With rests, speed is the largest on each leg.
    radius : float
        Smallest radius of curvature of the corners [m] (see `Rounded`). Zero: it rests at every point.
    """

    radius: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(self, {"radius": {"minimum": 0.0}})
        _ = self.curve

    @property
    def stops(self) -> bool:
        """Whether it rests at every point."""
        return self.radius == 0.0

    @cached_property
    def curve(self) -> Rounded:
        """See `OnCurve`."""
        return Rounded(self.points, self.radius, self.closed)


@dataclass(frozen=True)
class Spline(_ThroughPoints):
    """Smoothly through points (see `Smooth`).

    Attributes
    ----------
    points, speed, times, closed
        As of `Waypoints`.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.curve

    @cached_property
    def curve(self) -> Smooth:
        """See `OnCurve`."""
        return Smooth(self.points, self.closed)


def _numbers(name: str, values: Any, count: int) -> tuple[float, ...]:
    if not isinstance(values, tuple | list | np.ndarray) or len(values) != count:
        found = f"{len(values)}" if isinstance(values, tuple | list | np.ndarray) else repr(values)
        raise ModelError(f"{name}: expected {count} numbers for these points, found {found}", key=name)
    for i, value in enumerate(values):
        if problem := number_problem(value):
            raise ModelError(f"{name}[{i}]: {problem}", key=name)
    return tuple(float(value) for value in values)


def _check_points(instance: Any, name: str, least: int, *, closed: bool) -> None:
    """Make a tuple of points of what is given: at least so many, and no two neighbours the same."""
    given = getattr(instance, name)
    try:
        points = checked_array(name, given, (len(given), 2))
    except (ValueError, TypeError) as error:
        message = str(error) if isinstance(error, ValueError) else f"{name} is {given!r}, expected points"
        raise ModelError(message, key=name) from None
    if len(points) < least:
        raise ModelError(f"{name}: expected at least {least} points, found {len(points)}", key=name)
    following = np.roll(points, -1, axis=0) if closed else points[1:]
    for i in np.flatnonzero((points[: len(following)] == following).all(axis=1)):
        if closed and i == len(points) - 1:
            raise ModelError(f"{name}: the last is the first again; leave it out, the way back is closed", key=name)
        raise ModelError(f"{name}[{i + 1}] is the same as the one before, {tuple(points[i].tolist())} m", key=name)
    object.__setattr__(instance, name, tuple((x, y) for x, y in points.tolist()))
