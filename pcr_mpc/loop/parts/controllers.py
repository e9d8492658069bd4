"""Controllers as the closed loop sees them: measured state in, motor rates out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ...control.plan import Plan
from ...errors import checked_period, checked_vector
from ...frozen import read_only
from ...plant.statics.equilibrium import Equilibrium


@dataclass(frozen=True, eq=False)
class Decision:
    """What a controller decided, and what it cost.

    Attributes
    ----------
    u : ndarray, shape (n,)
        Motor rates [rad/s].
    plan : Plan or None
        Certificate of the decision.
    linearise_time : float
        [s].
    estimate : ndarray, shape (4 + n,), or None
        Of the state at the measurement, which the decision rests on.
    force : ndarray, shape (2,), or None
        Unknown force on the tip, as estimated [N].
    events : tuple of dict
        What the run should tell of this period: ``kind`` and ``message`` of each.
    """

    u: np.ndarray
    plan: Plan | None = None
    linearise_time: float = 0.0
    estimate: np.ndarray | None = None
    force: np.ndarray | None = None
    events: tuple[dict[str, str], ...] = ()


class Controller(Protocol):
    """What `simulate` needs: two methods.

    A ``name``, if there is one, is what the record calls the controller; else it is called by its class.
    """

    def start(self, pose: Equilibrium) -> None:
        """Get ready: the robot rests in ``pose``."""

    def step(self, k: int, x: np.ndarray) -> Decision | ArrayLike:
        """Decide on period k from the measured state [m, m/s, rad]; motor rates [rad/s] will do as an answer."""


def decision_of(answer: Any, n: int) -> Decision:
    """Return the answer of a controller's step as a `Decision` with checked rates.

    Parameters
    ----------
    answer : Decision or array_like, shape (n,)
        Motor rates [rad/s], or a decision that holds them.
    n : int
        Number of motors.

    Raises
    ------
    TypeError
        It is neither.
    ValueError
        The rates are not finite or of the wrong shape.
    """
    if isinstance(answer, Decision):
        checked_vector("the controller's u", answer.u, n)  # NumPy would spread one number over all motors
        return answer
    if answer is None or hasattr(answer, "u"):
        raise TypeError(f"the controller's step returned {answer!r}, expected {n} motor rates or a Decision")
    if np.shape(answer) in ((n, 1), (1, n)):
        answer = np.reshape(answer, n)
    # A copy: whoever returns an array may write into it again.
    return Decision(checked_vector("the controller's u", answer, n).copy())


def name_of(controller: Any) -> str:
    """Name of a controller in a record: its own, else that of its class."""
    name = getattr(controller, "name", None)
    return type(controller).__name__ if name is None else str(name)


class Replay:
    """Rates that were commanded before, whatever is measured.

    Parameters
    ----------
    u : ndarray, shape (M, n)
        Motor rates of every period [rad/s].
    """

    name = "replay"

    def __init__(self, u: np.ndarray) -> None:
        self._u = read_only(np.array(u, dtype=float))

    def start(self, pose: Equilibrium) -> None:
        """See `Controller`."""

    def step(self, k: int, x: np.ndarray) -> Decision:
        """See `Controller`; ValueError beyond the last period."""
        if not checked_period("k", k) < len(self._u):
            raise ValueError(f"k = {k} is beyond the {len(self._u)} periods of this replay")
        return Decision(self._u[k])


class HoldMotors:
    """No control: the motors stay where they are."""

    name = "none"

    def __init__(self, n_rods: int) -> None:
        self._u = read_only(np.zeros(n_rods))

    def start(self, pose: Any, q: Any = None) -> None:
        """See `Controller`; a measured tip and measured angles will do, too."""

    def step(self, k: Any = None, x: Any = None, **measured: Any) -> Decision:
        """See `Controller`; whatever is measured, and when."""
        return Decision(self._u)
