"""A rate that follows its command with a first-order lag."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Lag:
    """T w' = u - w over a step of dt in which the command u is held, solved exactly.

    Attributes
    ----------
    left : float
        Share of the rate at the start in the rate at the end, exp(-dt/T).
    mean : float
        Share of the rate at the start in the mean rate, T/dt (1 - exp(-dt/T)).
    """

    left: float
    mean: float

    @classmethod
    def of(cls, time_constant: float, dt: float) -> Lag:
        """Lag with a time constant [s], 0 for none, over steps of dt [s]."""
        if time_constant <= 0.0:
            return cls(0.0, 0.0)
        step = dt / time_constant
        return cls(math.exp(-step), -math.expm1(-step) / step)

    def mean_rate(self, u: Any, rate: Any) -> Any:
        """Mean rate over the step: with it, held, a motor ends at the same angle."""
        return u + self.mean * (rate - u)

    def end_rate(self, u: Any, rate: Any) -> Any:
        """Rate at the end of the step."""
        return u + self.left * (rate - u)
