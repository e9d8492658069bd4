"""Quantities along a path that know how they change with the timing, to first order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Linear:
    """A quantity of ``k`` components at M points, and its slopes by D unknowns that each point has of its own.

    Attributes
    ----------
    value : ndarray, shape (M, k)
    slope : ndarray, shape (M, k, D)
    """

    value: np.ndarray
    slope: np.ndarray

    def __add__(self, other: Linear) -> Linear:
        return Linear(self.value + other.value, self.slope + other.slope)

    def __sub__(self, other: Linear) -> Linear:
        return Linear(self.value - other.value, self.slope - other.slope)

    __array_ufunc__ = None  # a NumPy float from the left is a factor like any other

    def __rmul__(self, factor: float) -> Linear:
        return Linear(factor * self.value, factor * self.slope)

    def __mul__(self, other: Linear) -> Linear:
        """Product by component; one of the two may have a single component."""
        return Linear(
            self.value * other.value,
            self.slope * other.value[:, :, None] + self.value[:, :, None] * other.slope,
        )

    def __truediv__(self, other: Linear) -> Linear:
        value = self.value / other.value
        return Linear(value, (self.slope - value[:, :, None] * other.slope) / other.value[:, :, None])

    def sqrt(self) -> Linear:
        """Square root."""
        root = np.sqrt(self.value)
        return Linear(root, self.slope / (2.0 * root[:, :, None]))

    def through(self, matrices: np.ndarray) -> Linear:
        """Product with matrices that do not change, shape (M, l, k)."""
        return Linear(np.einsum("mlk,mk->ml", matrices, self.value), np.einsum("mlk,mkd->mld", matrices, self.slope))

    def less(self, matrices: np.ndarray, vectors: np.ndarray) -> Linear:
        """Without the products of matrices, shape (M, k, l), and vectors, (M, l), that do not change."""
        return Linear(self.value - np.einsum("mkl,ml->mk", matrices, vectors), self.slope)

    def norm(self) -> Linear:
        """Length of the vector at each point; of one that is zero, the slope is zero too."""
        length = np.linalg.norm(self.value, axis=1, keepdims=True)
        direction = self.value / np.where(length > 0.0, length, 1.0)
        return Linear(length, np.einsum("mk,mkd->md", direction, self.slope)[:, None])
