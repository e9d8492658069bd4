"""Trajectories of the tip: position, velocity and acceleration at any time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...errors import ModelError, check_numbers, checked_array, checked_vector

_POSITIVE = {"above": 0.0}


class Trajectory(Protocol):
    """A path of the tip in time."""

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """Position [m], velocity [m/s] and acceleration [m/s^2] at times t, shape (len(t), 3, 2)."""


def sampled(trajectory: Trajectory, t: np.ndarray) -> np.ndarray:
    """Position, velocity and acceleration at times t [s], shape (len(t), 3, 2), of a trajectory that may be anybody's.

    Raises
    ------
    ValueError
        It returned something else, or numbers that are not finite.
    """
    return checked_array(f"what the trajectory {type(trajectory).__name__} returned", trajectory(t), (len(t), 3, 2))


def smooth_step(s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quintic from 0 to 1 with zero velocity and acceleration at both ends, and its two derivatives."""
    s = np.clip(s, 0.0, 1.0)
    value = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    slope = 30.0 * s**2 * (1.0 - s) ** 2
    curvature = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s)
    return value, slope, curvature


def risen(t: np.ndarray, blend: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time [s] that passes at a rate which rises from 0 to 1 by a quintic, that rate and its change [1/s].

    Parameters
    ----------
    t : ndarray
        [s].
    blend : float
        How long it rises [s].
    """
    s = np.clip(t / blend, 0.0, 1.0) if blend > 0 else np.ones(len(t))
    rate, change, _ = smooth_step(s)
    # Integral of the quintic from 0 to s, times its duration, then constant rate.
    own = blend * (s**4 * (2.5 - 3.0 * s + s**2)) + np.maximum(t - blend, 0.0)
    return own, rate, change / blend if blend > 0 else np.zeros(len(t))


@dataclass(frozen=True)
class Hold:
    """Stay at a point."""

    position: tuple[float, float]

    def __post_init__(self) -> None:
        _check_points(self, "position")

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """See `Trajectory`."""
        samples = np.zeros((len(t), 3, 2))
        samples[:, 0] = self.position
        return samples


@dataclass(frozen=True)
class Lemniscate:
    """Figure of eight that starts from rest at its centre.

    x = c_x + w/2 sin(phi), y = c_y + h/2 sin(2 phi); the rate of phi rises from 0 to 2 pi / period over the
    ramp by a quintic, so that acceleration is continuous.

    Attributes
    ----------
    centre : (float, float)
        [m].
    size : (float, float)
        Width w and height h [m].
    period : float
        [s].
    ramp : float
        [s]. Zero: it moves from the start on, and its lap has a duration.
    """

    centre: tuple[float, float]
    size: tuple[float, float]
    period: float
    ramp: float

    def __post_init__(self) -> None:
        _check_points(self, "centre", "size")
        check_numbers(self, {"period": _POSITIVE, "ramp": {"minimum": 0.0}})

    @property
    def duration(self) -> float:
        """Of a lap, if it is a lap; else it goes on for ever [s]."""
        return math.inf if self.ramp else self.period

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """See `Trajectory`."""
        omega = 2.0 * np.pi / self.period
        own, rate, change = risen(np.asarray(t, dtype=float), self.ramp)
        phase, rate, rate_change = omega * own, omega * rate, omega * change
        samples = np.empty((len(t), 3, 2))
        for axis, multiple in enumerate((1, 2)):
            sin, cos = np.sin(multiple * phase), np.cos(multiple * phase)
            half = self.size[axis] / 2.0
            samples[:, 0, axis] = self.centre[axis] + half * sin
            samples[:, 1, axis] = half * multiple * rate * cos
            samples[:, 2, axis] = half * multiple * (rate_change * cos - multiple * rate**2 * sin)
        return samples


@dataclass(frozen=True)
class PickAndPlace:
    """From one pose to another over a lift, rest to rest, with quintic timing.

    Attributes
    ----------
    pick, place : (float, float)
        [m].
    lift : float
        Height above the straight line at half way [m].
    wait : float
        Rest before the move [s].
    move : float
        Duration of the move [s].
    """

    pick: tuple[float, float]
    place: tuple[float, float]
    lift: float
    wait: float
    move: float

    def __post_init__(self) -> None:
        _check_points(self, "pick", "place")
        check_numbers(self, {"lift": {}, "wait": {"minimum": 0.0}, "move": _POSITIVE})

    @property
    def duration(self) -> float:
        """Of wait and move [s]."""
        return self.wait + self.move

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """See `Trajectory`."""
        s, slope, curvature = smooth_step((t - self.wait) / self.move)
        rate, rate_change = slope / self.move, curvature / self.move**2
        samples = np.empty((len(t), 3, 2))
        along = np.subtract(self.place, self.pick)
        # The lift 16 s^2 (1-s)^2 leaves and arrives tangentially.
        bump = 16.0 * s**2 * (1.0 - s) ** 2
        bump_slope = 32.0 * s * (1.0 - s) * (1.0 - 2.0 * s)
        bump_curvature = 32.0 * (1.0 - 6.0 * s + 6.0 * s**2)
        up = np.array([0.0, self.lift])
        samples[:, 0] = self.pick + np.outer(s, along) + np.outer(bump, up)
        direction = along + np.outer(bump_slope, up)
        samples[:, 1] = direction * rate[:, None]
        samples[:, 2] = direction * rate_change[:, None] + np.outer(bump_curvature * rate**2, up)
        return samples


def _check_points(instance: Trajectory, *names: str) -> None:
    for name in names:
        try:
            point = checked_vector(name, getattr(instance, name), 2).tolist()
        except ValueError as error:
            raise ModelError(str(error), key=name) from None
        object.__setattr__(instance, name, tuple(point))


def check_flag(instance: Trajectory, name: str) -> None:
    """Raise `ModelError` if an attribute is neither true nor false."""
    if not isinstance(getattr(instance, name), bool | np.bool_):
        raise ModelError(f"{name} is {getattr(instance, name)!r}, expected True or False", key=name)
    object.__setattr__(instance, name, bool(getattr(instance, name)))
