"""Hard limits on the motors, and what keeps them whoever decides."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..frozen import Frozen

# Two sums of the same commands differ by rounding [rad].
SAME_ANGLE = 1e-9
_MET = 1e-12  # of the limit on the change of rate, by which a change that meets it may be less


@dataclass(frozen=True, eq=False)
class Limits(Frozen):
    """Hard limits on the motors.

    Attributes
    ----------
    rate : float
        Greatest ``|u|`` [rad/s].
    rate_change : float
        Greatest ``|u_k - u_{k-1}|`` between control periods [rad/s].
    angle_lower, angle_upper : ndarray, shape (n,)
        Least and greatest motor angles [rad].
    """

    rate: float
    rate_change: float
    angle_lower: np.ndarray
    angle_upper: np.ndarray

    def __post_init__(self) -> None:
        # Infinite limits are none; written so that NaN is refused.
        if not (self.rate > 0 and self.rate_change > 0):
            raise ValueError(f"rate = {self.rate} and rate_change = {self.rate_change} must be positive")
        lower, upper = np.asarray(self.angle_lower), np.asarray(self.angle_upper)
        if lower.ndim != 1 or lower.shape != upper.shape or not (lower <= upper).all():
            raise ValueError(f"angle_lower = {lower} and angle_upper = {upper} must be vectors, lower <= upper")
        for name, angles in (("angle_lower", lower), ("angle_upper", upper)):
            object.__setattr__(self, name, angles.astype(float))  # a copy, the limits' own
        super().__post_init__()

    def kept(
        self, u: np.ndarray, u_previous: np.ndarray, q: np.ndarray, dt: float, reckoned: np.ndarray | None = None
    ) -> np.ndarray:
        """Rates nearest to u that keep all limits now, and leave every motor able to stop before its stop.

        A motor that turns at u may slow down by ``rate_change`` in each period from the next one on, and what it turns
        meanwhile must fit too; so what is kept once can be kept ever after. Where a start does not allow that,
        because a motor is too fast for its stop or beyond it, the limit on the rate has priority, then that on its
        change: the motor brakes, or comes back, as fast as these two allow.

        Parameters
        ----------
        u, u_previous : ndarray, shape (n,)
            Wanted rates, and those of the last period [rad/s].
        q : ndarray, shape (n,)
            Motor angles at the start of the period [rad]; what is not finite has no stop.
        dt : float
            Period [s].
        reckoned : ndarray, shape (n,), optional
            The angles by another opinion [rad], as the sum of the commands is one: stops are kept for both. Where only
            one of them is beyond a stop, the motor goes no further, but is not sent back.
        """
        rate, change = self.rate, self.rate_change  # on a few floats Python is faster than NumPy
        found = []
        each = zip(u.tolist(), u_previous.tolist(), q.tolist(), self.angle_lower.tolist(), self.angle_upper.tolist(),
                   q.tolist() if reckoned is None else reckoned.tolist(), strict=True)  # fmt: skip
        for now, before, at, lower, upper, also in each:
            if math.isfinite(at):
                low, high = at, at
                if abs(also - at) > SAME_ANGLE:
                    low, high = min(at, also), max(at, also)
                most = self._fastest((upper - high) / dt, (upper - low) / dt)
                least = -self._fastest((low - lower) / dt, (high - lower) / dt)
                now = max(least, min(most, now))
            found.append(max(-rate, min(rate, max(before - change, min(before + change, now)))))
        return np.array(found)

    def slowed(self, u: np.ndarray) -> np.ndarray:
        """Rates one period after the rates u of motors that brake as hard as they may."""
        change = self.rate_change
        return np.array([max(before - change, min(before + change, 0.0)) for before in u.tolist()])

    def _fastest(self, room: float, most_room: float) -> float:
        """Greatest rate towards a stop from which a motor can brake in time; negative where it must come back.

        ``room`` is the way to the stop over dt, ``most_room`` the same by the more hopeful opinion [rad/s]. A rate u
        needs u + (u - c) + (u - 2c) + .., as long as these are positive, with c the change of rate.
        """
        if room < 0.0:
            return min(0.0, most_room)
        if room >= self.clear:
            return self.rate
        if math.isinf(self.rate_change):
            return room
        steps = math.floor((math.sqrt(1.0 + 8.0 * room / self.rate_change) - 1.0) / 2.0)
        return room / (steps + 1) + self.rate_change * steps / 2.0

    @cached_property
    def clear(self) -> float:
        """Way to a stop, over dt, from which even the greatest rate can be braked [rad/s]."""
        if math.isinf(self.rate) or math.isinf(self.rate_change):
            return self.rate
        steps = math.floor(self.rate / self.rate_change)
        return (steps + 1) * (self.rate - self.rate_change * steps / 2.0)

    def met_by(self, u: np.ndarray, u_previous: np.ndarray) -> tuple[str, ...]:
        """Which limits the clipped rates u meet: on the rate, on its change, or else on an angle."""
        met = {"rate": np.abs(u) >= self.rate, "rate change": np.abs(u - u_previous) >= self.rate_change * (1 - _MET)}
        return tuple(kind for kind, where in met.items() if where.any()) or ("angle",)
