"""Control laws without a horizon: the yardsticks of the linear MPC, called as it is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NoReturn, Protocol

import numpy as np

from ..frozen import set_once
from ..linearisation.linear_limits import LinearLimits
from ..linearisation.linear_model import LinearModel
from .motor_limits import Limits
from .mpc import lqr_rates, riccati
from .plan import Plan
from .qp.program import Reference
from .tuning import Tuning


class Law(Protocol):
    """What turns an estimated state and a reference into motor rates; see `LinearMPC` for the arguments."""

    def reset(self) -> None:
        """Start afresh."""

    def prepare(self, model: LinearModel, combinations: Sequence[tuple[str, ...]] = ()) -> None:
        """Get ready for a robot that rests where ``model`` was made."""

    def solve(
        self,
        x: np.ndarray,
        models: LinearModel | Sequence[LinearModel],
        reference: Reference,
        u_previous: np.ndarray,
        pose_limits: LinearLimits | None = None,
    ) -> Plan:
        """Motor rates from now on."""

    def fall_back(self, status: str, x: np.ndarray, reference: Reference, u_previous: np.ndarray) -> Plan:
        """Motor rates where there is no model or no measurement."""

    def retune(self, tuning: Tuning) -> None:
        """Let another tuning of the same law take effect."""


@set_once("call retune, which lets all of it take effect", "tuning")
class _OneStep(ABC):
    """Rates for one period, clipped to the motors' limits; what poses are to keep is ignored."""

    def __init__(self, tuning: Tuning, limits: Limits) -> None:
        self.tuning = tuning
        self.limits = limits
        self._model: LinearModel | None = None
        self._dt = 1.0  # of any model; until there is one, motors are only brought to rest

    def reset(self) -> None:  # noqa: B027  it remembers nothing
        """See `Law`."""

    def prepare(self, model: LinearModel, combinations: Sequence[tuple[str, ...]] = ()) -> None:
        """See `Law`."""
        self._dt, self._model = model.dt, model

    def retune(self, tuning: Tuning) -> None:
        """See `Law`."""
        new = object.__new__(type(self))
        new.__dict__.update(self.__dict__, tuning=tuning)
        if new._model is not None:
            new.prepare(new._model)
        self.__dict__.update(new.__dict__)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle and copy as what it was made of; the copy starts afresh."""
        return type(self), (self.tuning, self.limits)

    @abstractmethod
    def _rates(self, x: np.ndarray, reference: Reference) -> np.ndarray:
        """Wanted rates, before they are clipped."""

    def solve(
        self,
        x: np.ndarray,
        models: LinearModel | Sequence[LinearModel],
        reference: Reference,
        u_previous: np.ndarray,
        pose_limits: LinearLimits | None = None,
    ) -> Plan:
        """See `Law`."""
        wanted = self._rates(x, reference)
        u = self.limits.kept(wanted, u_previous, x[4:], self._dt)
        active = () if np.array_equal(u, wanted) else self.limits.met_by(u, u_previous)
        return Plan(u[None], None, models, "solved", None, active)

    def fall_back(self, status: str, x: np.ndarray, reference: Reference, u_previous: np.ndarray) -> Plan:
        """See `Law`: the motors are brought to rest."""
        u = self.limits.kept(np.zeros(len(u_previous)), u_previous, x[4:], self._dt)
        return Plan(u[None], None, None, status, "hold")


class FeedForward(_OneStep):
    """Open loop: the inverse dynamics of the reference, whatever is measured."""

    def _rates(self, x: np.ndarray, reference: Reference) -> np.ndarray:
        return np.asarray(reference.inputs[0])

    def fall_back(self, status: str, x: np.ndarray, reference: Reference, u_previous: np.ndarray) -> Plan:
        """See `Law`: it needs no measurement."""
        u = self.limits.kept(reference.inputs[0], u_previous, x[4:], self._dt)
        return Plan(u[None], None, None, "solved")


class LQR(_OneStep):
    """Feed-forward and the steady gain of `control.dlqr` about the start."""

    def prepare(self, model: LinearModel, combinations: Sequence[tuple[str, ...]] = ()) -> None:
        """See `Law`."""
        super().prepare(model)
        self._gain, _ = riccati(model, self.tuning)

    def _rates(self, x: np.ndarray, reference: Reference) -> np.ndarray:
        return lqr_rates(self._gain, x, reference, self._dt)


class PD(_OneStep):
    """Inverse statics of a tip that is displaced by the error and its rate.

    Parameters
    ----------
    tuning : Tuning
        With gains ``pd``.
    limits : Limits
    inverse : callable
        (tip (2) [m], nearby motor angles (n) [rad], force on the rods (2) [N]) -> motor angles (n) that hold it.
    """

    def __init__(
        self,
        tuning: Tuning,
        limits: Limits,
        inverse: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    ) -> None:
        super().__init__(tuning, limits)
        self._inverse = inverse

    def __reduce__(self) -> NoReturn:
        raise TypeError("PD holds a function, and can be neither pickled nor copied: pickle its controller instead")

    def _rates(self, x: np.ndarray, reference: Reference) -> np.ndarray:
        proportional, derivative = self.tuning.pd
        ahead = reference.states[0]
        wanted = ahead[:2] - self._dt * ahead[2:4]  # where the reference is now
        p = ahead[:2] + proportional * (wanted - x[:2]) + derivative * (ahead[2:4] - x[2:4])
        return np.asarray((self._inverse(p, ahead[4:], reference.forces[0]) - x[4:]) / self._dt)
