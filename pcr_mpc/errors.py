"""Failures of the toolkit: each says what happened, with which numbers, and what to do next.

The numbers are keyword attributes of the exception (``error.residual``), and survive pickling.
"""

from __future__ import annotations

import math
import numbers
from typing import Any

import numpy as np

_FLOAT = np.dtype(float)


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


class ReadOnlyError(PCRError, AttributeError):
    """An attribute that cannot be set was: its name is ``attribute``; the message says what to do instead."""


class MeasurementError(PCRError, ValueError):
    """A controller's first measurement contradicts the pose in which it was started, or fits no pose of the robot."""


class AmbiguousPoseError(PCRError, ValueError):
    """Several poses fit what was measured at a start: ``candidates``, pairs of working mode and load [N]."""


class CompilerError(PCRError):
    """No machine code could be made of a graph; ``command`` is what was run."""


class GenerationError(PCRError, ValueError):
    """C cannot be generated of a scene: ``part`` is what it does not have yet."""


class NoRungError(PCRError):
    """No rung of the ladder of physics meets a scene's ``need``: ``best_error`` [m], and why each was ``rejected``."""


class LogError(PCRError, ValueError):
    """A recorded motion cannot be read, or is none of the scene's robot: names the ``file``."""


class IdentificationError(PCRError, ValueError):
    """A robot's numbers cannot be found as asked, or the best that there are do not explain what was recorded."""


class MarginsError(PCRError, ValueError):
    """A loop has no margins that can be told: it has no reference, or no law that is linear."""


class OutputError(PCRError):
    """A file cannot be written, or is somebody's work and is left alone: ``path``."""


class StudyError(PCRError):
    """A study of many runs cannot go on, or ended without some of its results; names the file of those that it has."""


def described(error: BaseException) -> str:
    """What happened, for one line on a terminal; for the system's errors with the file, and what to do."""
    if not isinstance(error, OSError) or error.filename is None:
        return str(error) or type(error).__name__
    advice = next((words for kind, words in _ADVICE.items() if isinstance(error, kind)), error.strerror or "failed")
    return f"{error.filename}: {advice}"


_ADVICE: dict[type[OSError], str] = {
    FileNotFoundError: "no such file or folder",
    IsADirectoryError: "is a folder, expected a file",
    # A folder is made where there is none; only a file of its name is in the way.
    FileExistsError: "is a file, where a folder is to be made; give another name",
    NotADirectoryError: "is a path through a file, expected a folder",
    PermissionError: "access is denied; change its rights, or take another place",
}


def cause(error: PCRError) -> str:
    """What happened, without the next step, which a message sets off by a semicolon: for one that has its own."""
    return str(error).partition("; ")[0]


def checked_integer(name: str, value: Any, *, minimum: int = 1) -> int:
    """Return ``value`` as an int of at least ``minimum``, NumPy's integers too, or say what it is instead.

    Raises
    ------
    ValueError
        Names the argument, its value and the bound.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < minimum:
        raise ValueError(f"{name} = {value!r} must be a whole number of at least {minimum}")
    return int(value)


def checked_vector(name: str, value: Any, size: int) -> np.ndarray:
    """Return ``value`` as a finite float64 vector of ``size`` entries, or say what it is instead.

    Raises
    ------
    ValueError
        Names the argument and both shapes, or the entries that are not finite or not numbers.
    """
    # Most callers pass what is wanted; looking first saves a third of a microsecond.
    ready = type(value) is np.ndarray and value.dtype is _FLOAT and value.shape == (size,) and value.flags.c_contiguous
    array = value if ready else _float_array(name, value, (size,))
    # Faster than NumPy on the few entries of a state.
    if not all(map(math.isfinite, array.tolist())):
        raise ValueError(f"{name} is not finite: {array}")
    return array


def measured_vector(name: str, value: Any, size: int) -> np.ndarray:
    """Return ``value`` as a float64 vector of ``size`` entries, finite or not; a row or a column means the same.

    Raises
    ------
    ValueError
        Names the argument and both shapes, or the entries that are not numbers.
    """
    if type(value) is np.ndarray and value.dtype is _FLOAT and value.shape == (size,):
        return value
    if np.shape(value) in ((size, 1), (1, size)):
        value = np.reshape(value, size)
    return _float_array(name, value, (size,))


def checked_period(name: str, value: Any) -> int:
    """Return ``value`` as the number of a control period, or say what it is instead.

    Raises
    ------
    ValueError
        Names the argument and its value.
    """
    if type(value) is int and value >= 0:  # a tenth of the time of what follows
        return value
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, numbers.Integral) or value < 0:
        raise ValueError(f"{name} = {value!r} must be a whole number, counted from 0")
    return int(value)


def checked_array(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return ``value`` as a finite float64 array of the given shape; errors as `checked_vector`."""
    array = _float_array(name, value, shape)
    # The sum of squares is finite only if all entries are, and BLAS warns of nothing; if it overflows, look again.
    if not math.isfinite(np.vdot(array, array)) and not np.isfinite(array).all():
        raise ValueError(f"{name} is not finite")
    return array


def _float_array(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    # NumPy would take True for 1.0 and "1" for 1.0.
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} is {value!r}, expected numbers")
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    return np.ascontiguousarray(array, dtype=float)


def checked_number(
    name: str,
    value: Any,
    *,
    above: float = -math.inf,
    minimum: float = -math.inf,
    maximum: float = math.inf,
) -> float:
    """Return ``value`` as a finite float within bounds, or say what it is instead.

    Raises
    ------
    ValueError
        Names the argument, its value and the bounds.
    """
    problem = number_problem(value, above=above, minimum=minimum, maximum=maximum)
    if problem:
        raise ValueError(f"{name}: {problem}")
    return float(value)


def check_numbers(instance: Any, bounds: dict[str, dict[str, float]]) -> None:
    """Replace numbers of a frozen dataclass by floats within bounds (see `checked_number`), in its ``__post_init__``.

    Raises
    ------
    ModelError
        Names the attribute, its value and the bounds.
    """
    for name, bound in bounds.items():
        try:
            object.__setattr__(instance, name, checked_number(name, getattr(instance, name), **bound))
        except ValueError as error:
            raise ModelError(str(error), key=name) from None


def number_problem(
    value: Any, *, above: float = -math.inf, minimum: float = -math.inf, maximum: float = math.inf
) -> str | None:
    """What keeps ``value`` from being a finite number within bounds; None if nothing does."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return f"expected a number, found {value!r}"
    try:
        number = float(value)
    except OverflowError:  # an integer beyond the range of a float
        number = math.inf
    if math.isnan(number):
        return "expected a number, found nan"
    if math.isfinite(number) and number > above and minimum <= number <= maximum:
        return None
    bounds = [f"{sign} {bound:g}" for sign, bound in ((">", above), (">=", minimum), ("<=", maximum))
              if math.isfinite(bound)]  # fmt: skip
    return f"is {number:g}, expected a finite number {' and '.join(bounds)}".rstrip()
