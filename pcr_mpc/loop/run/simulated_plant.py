"""What the closed loop needs of a plant, whoever simulates it."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.solver import Snap


class SimulatedPlant(Protocol):
    """A robot in motion: `Plant`, or that of another engine, such as `MuJoCoPlant`.

    Attributes
    ----------
    method, integrator : str
        How it is simulated, for the record.
    dt : float
        Step [s].
    """

    method: str
    integrator: str
    dt: float

    @property
    def snaps(self) -> list[Snap]:
        """Snaps since the reset, in order."""

    @property
    def rungs(self) -> dict[str, int]:
        """How many poses each rung of the statics' ladder has solved."""

    def reset(self, x: Any, guess: Equilibrium | None = None) -> None:
        """Put the rods on the branch of ``guess`` at state x."""

    def carry(self, payload: float, x: Any) -> np.ndarray:
        """Let the tip carry a payload [kg] from state x on; return the state just after."""

    def step(self, x: Any, u: Any, f_ext: Any = (0.0, 0.0)) -> np.ndarray:
        """Advance by one time step with the motor rates held."""
