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
    """

    first: float
    duration: float
    count: int
    clock: Clock

    def edges(self, period: float) -> np.ndarray:
        """First control periods of the laps, and the first after the last, shape (count + 1,)."""
        starts = (self.first + self.duration * np.arange(self.count + 1)) / period
        return np.asarray(np.ceil(starts - _ROUNDING * np.maximum(starts, 1.0)), dtype=int)


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
    count = math.floor((min(until, end) - first) / duration + _ROUNDING)
    return Laps(first, duration, max(count, 0), clock)


def _eights(path: Lemniscate) -> Clock:
    def clock(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        own, rate, change = risen(np.asarray(t, dtype=float), path.ramp)
        return own / path.period, rate / path.period, change / path.period

    return clock
