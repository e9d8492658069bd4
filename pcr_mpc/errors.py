"""Failures of the toolkit: each says what happened, with which numbers, and what to do next.

The numbers are keyword attributes of the exception (``error.residual``), and survive pickling.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np


class PCRError(Exception):
    """Base of every failure that the toolkit names.

    Parameters
    ----------
    message : str
        What happened, the numbers, the next step.
    **details
        The evidence; each becomes an attribute.
    """

    def __init__(self, message: str, **details: Any) -> None:
        super().__init__(message)
        self.details = details

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["details"][name]
        except KeyError:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}") from None

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (type(self), str(self), self.details)


def _rebuild(kind: type[PCRError], message: str, details: dict[str, Any]) -> PCRError:
    return kind(message, **details)


class ModelError(PCRError, ValueError):
    """A robot, scene or tuning file is wrong; names file, key and the nearest known key."""


class UnreachableError(PCRError):
    """A tip position lies outside the reach of a rod: ``rod``, ``distance``, ``length`` [m]."""


class ConvergenceError(PCRError):
    """A solve did not converge: ``residual``, ``iterations``, ``last`` (the last iterate)."""


class UnstableError(PCRError):
    """An equilibrium is not stable: ``rod`` or ``eigenvalue``."""


class InfeasibleError(PCRError):
    """A QP has no usable solution: ``status`` of the solver and ``limit`` that is in the way."""


class SimulationError(PCRError):
    """A closed-loop run ended early; ``run`` holds everything until then."""


def checked_vector(name: str, value: Any, size: int) -> np.ndarray:
    """Return ``value`` as a finite float64 vector of ``size`` entries, or say what it is instead.

    Raises
    ------
    ValueError
        Names the argument and both shapes, or the non-finite entries.
    """
    array = np.ascontiguousarray(value, dtype=float)
    if array.shape != (size,):
        raise ValueError(f"{name} has shape {array.shape}, expected ({size},)")
    # Faster than NumPy on the few entries of a state.
    if not all(map(math.isfinite, array.tolist())):
        raise ValueError(f"{name} is not finite: {array}")
    return array
