"""From the times at which a loop calls to control periods."""

from __future__ import annotations

import math
from dataclasses import dataclass

# A call counts for the next period from so much after the last one on, and as long as it is no further than that from
# the period's own time [periods]: jitter decides nothing.
_EARLY, _OFF = 0.3, 0.75
_SAME_CLOCK = 1.5  # periods between two calls on a clock that was set


@dataclass(frozen=True)
class Tick:
    """What a call means.

    Attributes
    ----------
    periods : int
        That have passed since the last one; 0: the call is for the same period again.
    late : float
        How much later than its period begins the call comes [s]; negative: earlier.
    events : tuple of (kind, message)
    """

    periods: int
    late: float = 0.0
    events: tuple[tuple[str, str], ...] = ()


class Clock:
    """Counts control periods by the times that it is told.

    Periods lie on a grid from the first call on. A call that comes at its time, but for jitter, begins the next period;
    a late one begins the one in which it comes, so that the loop keeps to real time; one that comes less than a third
    of a period after the last belongs to that. A time that does not go on, or is no number, is told, and counts for
    nothing; a clock that was set is followed from the second call on.

    Parameters
    ----------
    period : float
        [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self.start()

    def start(self) -> None:
        """Begin at the next call."""
        self._origin: float | None = None
        self._last = self._told = 0.0
        self._k = -1

    def tick(self, time: float | None) -> Tick:
        """Count the call at ``time`` [s]; None: one period after the last."""
        if time is None:
            return self._untimed()
        if not math.isfinite(time):
            tick = self._untimed()
            return Tick(tick.periods, 0.0, (("clock", f"time = {time} is no time; taken for one period later"),))
        told, self._told = self._told, time
        if self._origin is None:
            self._origin, self._last, self._k = time, time, 0
            return Tick(1)
        since = (time - self._last) / self._period
        if since < 0.0:
            if self._k and _EARLY <= (time - told) / self._period <= _SAME_CLOCK:
                self._origin, self._last, self._k = time - (self._k + 1) * self._period, time, self._k + 1
                return Tick(1, 0.0, (("clock", f"the clock was set: it goes on from {time:.6g} s"),))
            message = f"time runs backwards, from {self._last:.6g} to {time:.6g} s; the rates of this period go on"
            return Tick(0, 0.0, (("clock", message),))
        if since < _EARLY:
            kind, said = ("clock", "again") if since == 0.0 else ("early", f"{1e3 * (time - self._last):.3g} ms later")
            return Tick(0, 0.0, ((kind, f"called for the time {time:.6g} s {said}; the rates of this period go on"),))
        at = (time - self._origin) / self._period
        periods = 1 if abs(at - (self._k + 1)) <= _OFF else max(0, round(at) - self._k)
        self._last = time
        if not periods:  # of a loop that is a little faster than the period, once in a while
            return Tick(0)
        self._k += periods
        return Tick(periods, time - self._origin - self._k * self._period)

    def _untimed(self) -> Tick:
        """One period later, by nobody's clock."""
        if self._origin is None:
            self._origin = self._last = self._told = 0.0
        else:
            self._last += self._period
        self._k += 1
        return Tick(1)
