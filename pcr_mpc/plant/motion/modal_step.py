"""The plant's time step for rods of distributed mass: it keeps the modes that a state of the plant does not hold."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ..robot import Robot
from ..statics.equilibrium import Equilibrium
from .distributed import DistributedRods, ModalState
from .mass_matrix import MassMatrix


class Balanced(Protocol):
    """What the step asks of a plant."""

    @property
    def dt(self) -> float:
        """Step [s]."""

    def equilibrium(self, x: np.ndarray) -> Equilibrium:
        """Everything about the rods at rest at state x."""

    def mass(self, p: np.ndarray, q: np.ndarray) -> MassMatrix:
        """Mass matrix at (p, q) and its slopes."""


class ModalStep:
    """Gauss collocation of `DistributedRods`, one step of order 4 for each of the plant's.

    A state that is not the one that the last step returned finds the rods in equilibrium, moving with the tip as
    their equilibrium does: so do the first one after a reset, and one that was changed from outside.

    Parameters
    ----------
    robot : Robot
    modes : int
        Strain modes per rod.
    """

    def __init__(self, robot: Robot, modes: int) -> None:
        self.rods = DistributedRods(robot, modes)
        self._last: tuple[np.ndarray, ModalState] | None = None

    def forget(self) -> None:
        """Start with rods in equilibrium."""
        self._last = None

    def pick_up(self, plant: Balanced, mass: float, x: np.ndarray) -> np.ndarray | None:
        """State after a mass at rest has joined the tip at x; None if the rods have no state there yet."""
        if self._last is None or (x != self._last[0]).any():
            return None
        state = self.rods.picked_up(self._last[1], mass)
        end = self._seen(plant, state)
        self._last = end.copy(), state
        return end

    def __call__(self, plant: Balanced, x: np.ndarray, rate: np.ndarray, f_ext: np.ndarray) -> np.ndarray:
        """Advance by one step."""
        if self._last is not None and (x == self._last[0]).all():
            state = self._last[1]
        else:
            state = self.rods.settled(x[:2], x[2:4], x[4:], plant.equilibrium(x).nodes)
        state = self.rods.step(state, rate, f_ext, plant.dt)
        end = self._seen(plant, state)
        self._last = end.copy(), state
        return end

    @staticmethod
    def _seen(plant: Balanced, state: ModalState) -> np.ndarray:
        """State of the plant, with the tip's velocity once the motors stop and the rods have calmed down."""
        mass, _ = plant.mass(state.p, state.q)
        v = state.v + np.linalg.solve(mass[:2, :2], mass[:2, 2:] @ state.u)
        return np.concatenate([state.p, v, state.q])
