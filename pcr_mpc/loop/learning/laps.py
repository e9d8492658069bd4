"""The laps of a reference: where each begins, and how far round it is at any time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..references.blended import Blended
from ..references.trajectory import Lemniscate, Trajectory, risen

# Laps gone at times [s], their rate [1/s] and its change [1/s^2].
Clock = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
_ROUNDING = 1e-9
_LEAST = 0.5  # of a lap, that a rest must have to be told of


@dataclass(frozen=True, eq=False)
class Laps:
    """Whole laps at full speed.

    Attributes
    ----------
    first : float
        When the first begins: the path is at full speed [s].
    duration : float
        Of each [s].
    count : int
        How many there are.
    clock : callable
        t (K,) -> laps gone, their rate [1/s] and its change [1/s^2]; also before the first and after the last.
    rest : float
        Time at full speed after the last of them, before the path comes to its end [s]: 0 where that is less than half
        a lap.
    """

    first: float
    duration: float
    count: int
    clock: Clock
    rest: float = 0.0

    def edges(self, period: float) -> np.ndarray:
        """First control periods of the laps, and the first after the last, shape (count + 1,)."""
        return _periods(self.first + self.duration * np.arange(self.count + 1), period)

    def judged(self, period: float) -> np.ndarray:
        """The same with the rest as a last lap, shape (count + 1,) or (count + 2,): what was learnt shows in it too."""
        edges = self.edges(period)
        if not self.rest:
            return edges
        end = self.first + self.count * self.duration + self.rest
        return np.append(edges, _periods(np.array([end]), period))


def laps_of(trajectory: Trajectory | None, until: float) -> Laps | None:
    """Laps of a reference up to a time [s]; None for one that does not come round."""
    if isinstance(trajectory, Lemniscate):
        first, duration, end = trajectory.ramp, trajectory.period, math.inf if trajectory.ramp else trajectory.period
        clock: Clock = _eights(trajectory)
    elif isinstance(trajectory, Blended) and trajectory.laps > 1:
        first, duration, end = trajectory.full_speed
        clock = trajectory.clock
    else:
        return None
    count = max(math.floor((min(until, end) - first) / duration + _ROUNDING), 0)
    rest = end - first - count * duration
    whole = rest < _LEAST * duration or until < end - _ROUNDING * duration
    return Laps(first, duration, count, clock, 0.0 if whole else rest)


def _periods(times: np.ndarray, period: float) -> np.ndarray:
    """First control periods from these times on."""
    starts = times / period
    return np.asarray(np.ceil(starts - _ROUNDING * np.maximum(starts, 1.0)), dtype=int)


def _eights(path: Lemniscate) -> Clock:
    def clock(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        own, rate, change = risen(np.asarray(t, dtype=float), path.ramp)
        return own / path.period, rate / path.period, change / path.period

    return clock
