"""The reference as a controller reads it: a window of rows for each period."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ..scene.scene import Scene
from .feed_forward import InverseDynamics, held


class Track:
    """Windows of a reference, cut from one memory.

    Parameters
    ----------
    reference : InverseDynamics
    payloads : ndarray, shape (K,)
        That the tip carries in each period [kg]; what comes after the last is as the last.
    last : int
        Period from which the end of the reference is held.
    horizon : int
        Periods in a window.
    hold : callable
        () -> InverseDynamics of the end that is held, one row at least; called once, if it comes to that.

    Attributes
    ----------
    reference : InverseDynamics
    carries : bool
        Whether there is any payload.
    """

    def __init__(
        self,
        reference: InverseDynamics,
        payloads: np.ndarray,
        last: int,
        horizon: int,
        hold: Callable[[], InverseDynamics],
    ) -> None:
        self._rows, self._last, self._horizon, self._hold = _rows(reference), last, horizon, hold
        self._payloads, self.reference = payloads, reference
        self.carries = bool(payloads.any())
        self._end: np.ndarray | None = None

    def window(self, k: int, delay: int) -> np.ndarray:
        """Rows of a `Foresight` window for a decision in period k that acts ``delay`` periods later."""
        if k < self._last:
            return self._rows[k + delay : k + delay + self._horizon]
        if self._end is None:
            self._end = np.repeat(_rows(self._hold())[:1], self._horizon, axis=0)
        return self._end

    def payloads(self, k: int, count: int) -> np.ndarray:
        """That the tip carries from period k on."""
        first = min(k, len(self._payloads) - count)
        return self._payloads[first : first + count]


def track_of(
    scene: Scene, robot: Robot, pose: Equilibrium, reference: InverseDynamics, horizon: int, tail: int
) -> Track:
    """Windows of a scene's reference, which was solved ``tail`` periods beyond the end, from ``pose`` on."""
    # Longer than any place is ahead of the end.
    payloads = scene.carried(scene.period * np.arange(scene.n_periods + 2 * tail))

    def hold() -> InverseDynamics:
        return held(reference, scene.n_periods, robot, pose, float(payloads[-1]), 1)

    return Track(reference, payloads, scene.n_periods, horizon, hold)


def _rows(reference: InverseDynamics) -> np.ndarray:
    """State at the end, rates and force at the end of every period."""
    return np.hstack([reference.states[1:], reference.inputs, reference.forces[1:]])
