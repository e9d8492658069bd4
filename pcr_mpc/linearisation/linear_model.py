"""The linear model that a controller predicts with: x+ = A x + B u + c."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..frozen import Frozen


@dataclass(frozen=True, eq=False)
class LinearModel(Frozen):
    """Affine discrete-time model x+ = A x + B u + c with x = [p, v, q] and u held over dt.

    The external force that it was made for is in c; a further force f adds E f.

    Attributes
    ----------
    A : ndarray, shape (4 + n, 4 + n)
    B : ndarray, shape (4 + n, n)
    c : ndarray, shape (4 + n,)
    E : ndarray, shape (4 + n, 2)
        Effect of a constant force on the tip [m/N], [m/s/N], 0.
    dt : float
        Period [s].
    force : ndarray, shape (2,)
        The external force that it was made for [N].
    """

    A: np.ndarray
    B: np.ndarray
    c: np.ndarray
    E: np.ndarray
    dt: float
    force: np.ndarray

    def __call__(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Predict the next state."""
        return np.asarray(self.A @ x + self.B @ u + self.c)

    @property
    def reach(self) -> float:
        """How far the balanced tip moves at most when the motors turn [m/rad]: the length by which angles count."""
        at_rest = np.linalg.lstsq(np.eye(4) - self.A[:4, :4], self.A[:4, 4:], rcond=None)[0]
        return float(np.linalg.norm(at_rest[:2], 2))

    def to_control(self) -> Any:
        """Return the linear part as a `control.StateSpace` with the tip position as output."""
        import control  # takes seconds, and nothing else needs it

        n_states, n_inputs = self.B.shape
        output = np.eye(2, n_states)
        return control.ss(self.A, self.B, output, np.zeros((2, n_inputs)), self.dt)
