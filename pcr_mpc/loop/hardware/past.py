"""Estimates of the last periods: what a late measurement is compared with, and corrects."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from ...linearisation.linear_model import LinearModel


class PastEstimates:
    """Position, velocity and force of the tip as they were estimated, back to when a late picture was taken.

    A correction of the past is predicted anew up to the present. The prediction is linear, so what it adds to the
    present is the correction, moved on by the models of the periods in between.

    Parameters
    ----------
    age : float
        Of a picture when it arrives, in control periods.
    dt : float
        Control period [s].
    """

    def __init__(self, age: float, dt: float) -> None:
        self._age, self._dt = age, dt
        size = math.ceil(age - 1e-9) or 1
        self._estimates: deque[np.ndarray] = deque(maxlen=size)  # [p, v, force], the oldest first
        self._moves: deque[np.ndarray] = deque(maxlen=size)  # of them, to the next period

    def clear(self) -> None:
        """Forget."""
        self._estimates.clear()
        self._moves.clear()

    def remember(self, estimate: np.ndarray, model: LinearModel) -> None:
        """Add the estimate [x, force] of a period that ends, in which the robot moves by a model."""
        self._estimates.append(np.concatenate([estimate[:4], estimate[-2:]]))
        moves = np.eye(6)
        moves[:4, :4], moves[:4, 4:] = model.A[:4, :4], model.E[:4]
        self._moves.append(moves)

    def _when(self) -> tuple[int, float]:
        """Period of the picture among those that are remembered, and what fraction of a period later it was taken."""
        at = max(len(self._estimates) - self._age, 0.0)
        whole = min(math.floor(at + 1e-9), len(self._estimates))
        return whole, max(at - whole, 0.0)

    def tip(self, now: np.ndarray) -> np.ndarray:
        """Where the tip was taken to be when the picture was taken; ``now`` is the present estimate of the state."""
        whole, fraction = self._when()
        knots = [*self._estimates, now]
        start = knots[whole]
        if fraction <= 0.0 or whole + 1 >= len(knots):
            return start[:2]
        end, dt, s = knots[whole + 1], self._dt, fraction
        # Hermite's cubic: positions and velocities at both ends are known.
        return np.asarray(
            (1 + 2 * s) * (1 - s) ** 2 * start[:2] + s * (1 - s) ** 2 * dt * start[2:4]
            + s**2 * (3 - 2 * s) * end[:2] - s**2 * (1 - s) * dt * end[2:4]
        )  # fmt: skip

    def correct(self, change: np.ndarray) -> np.ndarray:
        """Correct the estimate of that time by a ``change`` of [p, v, force]; return what it is now, shape (6,)."""
        whole, _ = self._when()
        for j in range(whole, len(self._estimates)):
            self._estimates[j] = self._estimates[j] + change
            change = self._moves[j] @ change
        return change
