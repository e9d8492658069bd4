"""The linear model that a controller predicts with: x+ = A x + B u + c."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, overload

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
        """How far the balanced tip moves at most when the motors turn [m/rad]: the length by which angles count.

        Of a tip that nothing holds, how far it moves in a period.
        """
        at_rest = np.linalg.lstsq(np.eye(4) - self.A[:4, :4], self.A[:4, 4:], rcond=None)[0]
        found = float(np.linalg.norm(at_rest[:2], 2))
        return found if found > 0.0 else float(self.dt * np.linalg.norm(self.A[2:4, 4:], 2)) or 1.0

    def to_control(self) -> Any:
        """Return the linear part as a `control.StateSpace` with the tip position as output."""
        import control  # takes seconds, and nothing else needs it

        n_states, n_inputs = self.B.shape
        output = np.eye(2, n_states)
        return control.ss(self.A, self.B, output, np.zeros((2, n_inputs)), self.dt)


class LinearModels(Sequence[LinearModel]):
    """Linear models of consecutive periods, as the columns that graphs write and read.

    Parameters
    ----------
    columns : ndarray, shape (size, K)
        [vec(A), c, vec(B), vec(E)] of each.
    dt : float
        Period [s].
    force : ndarray, shape (2,)
        The external force that they were made for [N].
    """

    def __init__(self, columns: np.ndarray, dt: float, force: np.ndarray) -> None:
        self.columns, self.dt, self.force = columns, dt, force
        self._n_states = n_states(len(columns))

    @classmethod
    def of(cls, models: Sequence[LinearModel]) -> LinearModels:
        """Models that were made one by one."""
        if isinstance(models, LinearModels):
            return models
        parts = [[m.A.ravel("F"), m.c, m.B.ravel("F"), m.E.ravel("F")] for m in models]
        return cls(np.stack([np.concatenate(each) for each in parts], axis=1), models[0].dt, models[0].force)

    def copy(self) -> LinearModels:
        """The same, in memory of their own."""
        new = object.__new__(LinearModels)  # its size is known
        new.columns, new.dt, new.force = self.columns.copy(order="F"), self.dt, self.force.copy()
        new._n_states = self._n_states
        return new

    def moved(self, k: int, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Predict the next state by model k, without making that model: bit for bit the same."""
        m, column = self._n_states, self.columns[:, k].copy()  # in one piece, or BLAS adds in another order
        square, input_end = m * m, m * (2 * m - 3)
        a = column[:square].reshape(m, m, order="F")
        b = column[square + m : input_end].reshape(m, m - 4, order="F")
        return np.asarray(a @ x + b @ u + column[square : square + m])

    @property
    def n(self) -> int:
        """Motors."""
        return int(self._n_states - 4)

    def __len__(self) -> int:
        return int(self.columns.shape[1])

    @overload
    def __getitem__(self, k: int) -> LinearModel: ...
    @overload
    def __getitem__(self, k: slice) -> LinearModels: ...
    def __getitem__(self, k: int | slice) -> LinearModel | LinearModels:
        if isinstance(k, slice):
            return LinearModels(self.columns[:, k], self.dt, self.force)
        m = self._n_states
        a, c, b, e = np.split(self.columns[:, k].copy(), [m * m, m * (m + 1), m * (2 * m - 3)])
        shaped = (part.reshape(m, -1, order="F") for part in (a, b, e))
        a, b, e = shaped
        return LinearModel(a, b, c, e, self.dt, self.force.copy())


def column_size(n_states: int) -> int:
    """Numbers of a model as a column."""
    return n_states * (2 * n_states - 1)


def n_states(size: int) -> int:
    """States of a model whose column has ``size`` numbers."""
    found = (1 + math.isqrt(1 + 8 * size)) // 4
    if column_size(found) != size:
        raise ValueError(f"a column of {size} numbers holds no linear model")
    return found
