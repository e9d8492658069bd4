"""Controllers as the closed loop sees them: measured state in, motor rates out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..control.plan import Plan
from ..errors import checked_period
from ..frozen import read_only
from ..plant.statics.equilibrium import Equilibrium


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
    """What `simulate` needs."""

    name: str

    def start(self, pose: Equilibrium) -> None:
        """Get ready: the robot rests in ``pose``."""

    def step(self, k: int, x: np.ndarray) -> Decision:
        """Decide on period k from the measured state."""


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

    def start(self, pose: Equilibrium) -> None:
        """See `Controller`."""

    def step(self, k: int, x: np.ndarray) -> Decision:
        """See `Controller`."""
        return Decision(self._u)
