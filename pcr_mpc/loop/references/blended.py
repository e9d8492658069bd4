"""Begin and end at rest, go round again, take longer: any path, in another time."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from functools import cached_property

import numpy as np

from ...errors import ModelError, check_numbers, number_problem
from .trajectory import Trajectory, risen, sampled

# A blend takes this share of the path's duration, and no longer than that [s], where nothing else is said.
_SHARE, _LONGEST = 0.25, 1.0
FOR_EVER = "for ever"
_SAMPLES = 129
# What is slower, and slows down less, than these shares of the largest speed and acceleration is at rest: rows of a
# file, and a spline through them, are not exact.
_AT_REST = np.array([1e-3, 1e-2])
_SAME = 1e-6  # of the extent, and of the largest speed and acceleration, at both ends of a path that is closed


def duration_of(trajectory: Trajectory) -> float:
    """Time at which a trajectory comes to its end, its attribute ``duration`` [s]; infinite if it has none."""
    value = getattr(trajectory, "duration", math.inf)
    return math.inf if number_problem(value, above=0.0) else float(value)


@dataclass(frozen=True)
class Blended:
    """A path that is begun and ended at rest, with continuous velocity and acceleration; it stays at its end.

    The path's own time runs at a rate that rises from 0 to 1 in the first blend by a quintic, and falls back in the
    last one: the tip leaves the path nowhere, and comes half the duration of a blend later than without it.

    Attributes
    ----------
    path : Trajectory
        One that comes to an end says when by an attribute ``duration`` [s].
    repeat : float or "for ever"
        How many times it is gone along, without a stop; infinity is for ever, too. More than once needs a path that is
        closed, in position, velocity and acceleration.
    start, end : float or None
        Duration of the blends [s], in the path's time. None: a quarter of the path's duration, at most 1 s; or 0 where
        it is at rest there by itself. Zero also leaves a jump of acceleration as it is, but none of velocity.
    time_scale : float
        All of it takes this many times as long, blends too.
    """

    path: Trajectory
    _: KW_ONLY
    repeat: float | str = 1.0
    start: float | None = None
    end: float | None = None
    time_scale: float = 1.0

    def __post_init__(self) -> None:
        if not callable(self.path):
            raise ModelError(f"path is {self.path!r}, expected a trajectory", key="path")
        check_numbers(self, {"time_scale": {"above": 0.0}})
        if self.repeat == math.inf:
            object.__setattr__(self, "repeat", FOR_EVER)  # which prints as what can be read again
        if self.repeat != FOR_EVER:
            check_numbers(self, {"repeat": {"minimum": 1.0}})
            if self.laps != round(self.laps):
                raise ModelError(f"repeat: expected a whole number, or for ever, found {self.laps:g}", key="repeat")
        for name in ("start", "end"):
            if getattr(self, name) is not None:
                check_numbers(self, {name: {"minimum": 0.0}})
        if self.laps > 1:
            self._require_closed()
        if self.end is not None and math.isinf(self._own):
            raise ModelError("a path that never ends has no end to blend; leave out end, or repeat it less", key="end")
        self._require_rest()

    @property
    def duration(self) -> float:
        """With the blends [s]; infinite for a path that goes on for ever."""
        return self.time_scale * (self._own + sum(self._blends) / 2)

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """See `Trajectory`."""
        own, rate, change = self._warped(np.asarray(t, dtype=float) / self.time_scale)
        own = self._within(own)
        place, velocity, acceleration = np.moveaxis(sampled(self.path, own), 1, 0)
        rate, change = rate[:, None] / self.time_scale, change[:, None] / self.time_scale**2
        return np.stack([place, velocity * rate, acceleration * rate**2 + velocity * change], axis=1)

    @property
    def laps(self) -> float:
        """How many times it is gone along; infinite for ever."""
        return math.inf if isinstance(self.repeat, str) else self.repeat

    @property
    def later(self) -> float:
        """How much later than its path's own times, taken ``time_scale`` times as long, it comes [s]."""
        return self.time_scale * self._blends[0] / 2

    @property
    def full_speed(self) -> tuple[float, float, float]:
        """When the first blend ends, how long a lap takes from then on, and when the last blend begins [s]."""
        start, end = self._blends
        return self.time_scale * start, self.time_scale * self._lap, self.duration - self.time_scale * end

    def clock(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Laps gone at the times t [s], their rate [1/s] and its change [1/s^2]; of a path that has laps."""
        own, rate, change = self._warped(np.asarray(t, dtype=float) / self.time_scale)
        scale = self._lap * self.time_scale
        return own / self._lap, rate / scale, change / (scale * self.time_scale)

    @property
    def _lap(self) -> float:
        return duration_of(self.path)

    @property
    def _own(self) -> float:
        """The path's own time in which it is all gone along [s]."""
        return self.laps * self._lap

    def _within(self, own: np.ndarray) -> np.ndarray:
        """The path's own time within a lap."""
        if self.laps == 1 or math.isinf(self._lap):
            return own
        laps = np.minimum(np.floor(own / self._lap), self.laps - 1)
        return np.asarray(np.clip(own - laps * self._lap, 0.0, self._lap))

    def _warped(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The path's own time [s], its rate and that one's change [1/s]."""
        start, end = self._blends
        own, rate, change = risen(np.maximum(t, 0.0), start)
        rate[t < 0.0] = 0.0
        if math.isinf(self._own):
            return own, rate, change
        whole = self._own + (start + end) / 2
        late = t > whole - end
        own[late], rate[late], change[late] = self._own, 0.0, 0.0
        if end > 0:
            late &= t < whole
            left, falling, slowing = risen(whole - t[late], end)
            own[late], rate[late], change[late] = self._own - left, falling, -slowing
        return own, rate, change

    @cached_property
    def _blends(self) -> tuple[float, float]:
        """Duration of the first and of the last one [s]."""
        usual = min(_SHARE * self._lap, _LONGEST)
        scale = self._scale[1:]
        found = []
        for given, (_, *motion) in zip((self.start, self.end), self._ends, strict=True):
            moves = (np.linalg.norm(motion, axis=1) > _AT_REST * scale).any()
            found.append(given if given is not None else usual if moves else 0.0)
        return found[0], 0.0 if math.isinf(self._own) else found[1]

    @cached_property
    def _ends(self) -> np.ndarray:
        """The path at its first and at its last moment, shape (2, 3, 2)."""
        last = 0.0 if math.isinf(self._lap) else self._lap
        return sampled(self.path, np.array([0.0, last]))

    @cached_property
    def _scale(self) -> np.ndarray:
        """Extent [m], largest speed [m/s] and acceleration [m/s^2], shape (3,)."""
        last = _LONGEST if math.isinf(self._lap) else self._lap
        samples = sampled(self.path, np.linspace(0.0, last, _SAMPLES))
        samples[:, 0] -= samples[0, 0]
        return np.asarray(np.linalg.norm(samples, axis=2).max(axis=0))

    def _require_rest(self) -> None:
        speeds = np.linalg.norm(self._ends[:, 1], axis=1)
        for name, given, speed in zip(("start", "end"), (self.start, self.end), speeds, strict=True):
            if given == 0.0 and speed > _AT_REST[0] * self._scale[1]:
                raise ModelError(
                    f"{name} = 0, but there the path moves at {speed:.3g} m/s, and its velocity would jump; give "
                    f"{name} some time, or leave it out",
                    key=name,
                )
        taken = sum(self._blends) / 2
        if taken > self._own * (1.0 + 1e-9):
            raise ModelError(
                f"start and end are {self._blends[0]:g} and {self._blends[1]:g} s, of which half, {taken:g} s, passes "
                f"on the path, and that takes {self._own:g} s; make them shorter",
                key="start",
            )

    def _require_closed(self) -> None:
        if math.isinf(self._lap):
            raise ModelError(
                f"{type(self.path).__name__} has no duration, and so cannot be repeated; give it an attribute duration",
                key="repeat",
            )
        jumps = np.linalg.norm(self._ends[1] - self._ends[0], axis=1)
        for jump, scale, what in zip(
            jumps, self._scale, ("position by {} m", "velocity by {} m/s", "acceleration by {} m/s^2"), strict=True
        ):
            if jump > _SAME * scale:
                raise ModelError(
                    f"repeat is {self.repeat}, but from its end to its beginning the path jumps in "
                    f"{what.format(f'{jump:.3g}')}; close it, or go along it once",
                    key="repeat",
                )
