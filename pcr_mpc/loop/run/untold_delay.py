"""Commands that come later than anybody was told, by any time."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

_ROUNDING = 1e-9  # of a step


class UntoldDelay:
    """Hands the rates of each plant step on, a time later.

    A command that comes within a step is given by the step's mean rates, so that every motor turns by what it must: at
    the ends of the steps the angles are exact for any time.

    Parameters
    ----------
    time : float
        [s].
    dt : float
        Step of the plant [s].
    n : int
        Motors, which stand still before.
    """

    def __init__(self, time: float, dt: float, n: int) -> None:
        self.steps = math.floor(time / dt + _ROUNDING)
        self.fraction = max(time / dt - self.steps, 0.0)
        if self.fraction < _ROUNDING:
            self.fraction = 0.0
        length = self.steps + (self.fraction > 0.0)
        self._waiting = deque([np.zeros(n)] * length)

    def __call__(self, u: np.ndarray) -> np.ndarray:
        """Take the rates that would now reach the motors, shape (n,) [rad/s], and return those that do."""
        if not self._waiting:
            return u
        waiting = self._waiting
        waiting.append(u)
        last = waiting.popleft()
        return last if not self.fraction else self.fraction * last + (1.0 - self.fraction) * waiting[0]
