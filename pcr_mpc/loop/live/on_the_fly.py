"""How a controller is called in a loop of one's own, and how its reference is changed on the fly."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...errors import checked_period, measured_vector
from ...plant.robot import Robot
from ..parts.controllers import Decision
from .loop import LiveLoop


class OnTheFly(ABC):
    """Base of controllers that may keep time themselves, and whose reference may change while they run.

    Attributes
    ----------
    robot : Robot
        What the controller believes the robot to be.
    """

    robot: Robot
    _live: LiveLoop | None

    @abstractmethod
    def period_step(self, k: Any, x: Any) -> Decision:
        """`step` of period k from the measured state x."""

    @abstractmethod
    def _on_the_fly(self) -> LiveLoop:
        """The part that keeps time and changes the reference."""

    def step(
        self, k: int | None = None, x: Any = None, *, tip: Any = None, angles: Any = None,
        time: float | None = None, target: Any = None,
    ) -> Decision:  # fmt: skip
        """Decide on a period: by its number and the measured state, or by the time and what is measured then.

        What cannot have been measured is bridged by the prediction, and told in an event.

        Parameters
        ----------
        k : int
            Control period; beyond the end of the scene the last point of the reference is held.
        x : array_like, shape (4 + n,)
            Measured state [m, m/s, rad]; what is missing is NaN. With an observer the velocity is not looked at.
        tip : array_like, shape (2,), optional
            Measured tip position [m]; None or NaN: not measured.
        angles : array_like, shape (n,), optional
            Measured motor angles [rad], likewise.
        time : float, optional
            Of the measurement, on any clock [s]. None: one period after the last.
        target : array_like, shape (2,), optional
            Where the tip is to go now [m], instead of the path; it may move from call to call.

        Raises
        ------
        PCRError
            The controller was not started.
        MeasurementError
            The first measurement is out of reach, in other units, or its angles are wrapped.
        ValueError
            Names the argument: it has another shape, or k is no period.
        """
        if (k is None and x is None) or self._live is not None:
            return self._live_step(k, x, tip, angles, time, target)
        return self.period_step(k, x)

    def _live_step(self, k: Any, x: Any, tip: Any, angles: Any, time: Any, target: Any) -> Decision:
        live = self._on_the_fly()
        if k is None and x is None:
            return live.step(tip, angles, time, target)
        return live.decide(checked_period("k", k), measured_vector("x", x, 4 + self.robot.n_rods))

    def follow(self, path: Any, blend: float | None = None) -> None:
        """Leave what was tracked for another path, from the next step on, without a jump of velocity or acceleration.

        The path's time is 0 at the next step. What the target is away from it then fades within ``blend``.

        Parameters
        ----------
        path : Trajectory or callable
            See `Trajectory`; or a function of time [s] that returns positions [m].
        blend : float, optional
            Time that joining it takes [s]. None: as short as the motors and the rods allow.

        Raises
        ------
        UnreachableError, UnstableError, ConvergenceError
            The path, or every way to it, leads where the robot cannot be; what was tracked goes on.
        ValueError
            ``path`` is none, or ``blend`` no time above zero.
        """
        self._on_the_fly().follow(path, blend)

    def stop(self) -> None:
        """Brake from the next step on, along the path if there is one, as fast as the motors may; and stay there."""
        self._on_the_fly().stop()

    def hold(self) -> None:
        """Stay where the target is now: brake, and come back to it."""
        self._on_the_fly().hold()

    def jog(self, velocity: ArrayLike) -> None:
        """Move on at a velocity, shape (2,) [m/s], until told otherwise or as far as the robot can."""
        self._on_the_fly().jog(velocity)

    @property
    def target(self) -> np.ndarray:
        """Where the reference is in the period that was decided on: position [m], velocity, acceleration, (3, 2)."""
        return self._on_the_fly().target()
