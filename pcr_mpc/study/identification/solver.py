"""Levenberg and Marquardt's method, by orthogonal factors: information of very different size is not mixed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ... import interrupt
from ...errors import IdentificationError, PCRError
from .problem import Problem

_MOST_ITERATIONS, _MOST_REFUSED = 40, 30
# A step that promises less than this of half a chi squared is none: no estimate moves by a hundredth of its deviation.
_PROMISE = 1e-5
_LITTLE = 1e-3  # of half a chi squared, in two steps one after the other
_LEAST_DAMPING, _LARGEST_DAMPING = 1e-8, 1e12


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the search ended.

    Attributes
    ----------
    vector : ndarray, shape (size,)
    loss : float
    iterations, refused : int
        Steps that were tried, and those of them that made it worse or lost the rods.
    residuals : ndarray
    jacobian : ndarray
        At the end, with the weights of the loss in both.
    """

    vector: np.ndarray
    loss: float
    iterations: int
    refused: int
    residuals: np.ndarray
    jacobian: np.ndarray


def solve(
    problem: Problem, start: np.ndarray, tell: Callable[[float], None] = lambda _: None, *, enough: float = 1e-15
) -> Solution:
    """Find the least loss near a start, to a part ``enough`` of itself.

    A step whose rods leave their branch, or cannot reach the tip, is refused like one that makes the loss worse.

    Raises
    ------
    PCRError
        The rods cannot even follow at the start.
    IdentificationError
        No convergence.
    """
    vector, damping, refused, little = start.copy(), 1e-3, 0, 0
    residuals, jacobian = problem.linearised(vector)
    loss = problem.loss(residuals)
    for iteration in range(1, _MOST_ITERATIONS + 1):
        interrupt.check()
        weights = problem.weights(residuals)
        weighted = weights[:, None] * jacobian
        # With the residuals beside it: their part in the Jacobian's range comes for nothing.
        factor = np.asarray(np.linalg.qr(np.column_stack([weighted, -weights * residuals]), "r"))[: len(vector)]
        triangle, target = factor[:, :-1], factor[:, -1]
        size = np.maximum(np.linalg.norm(triangle, axis=0), 1e-12)
        while True:
            step = np.linalg.lstsq(
                np.vstack([triangle, np.diag(np.sqrt(damping) * size)]),
                np.concatenate([target, np.zeros(len(size))]),
                rcond=1e-15,
            )[0]
            promised = 0.5 * float(target @ target - np.sum((triangle @ step - target) ** 2))
            if promised <= max(_PROMISE, enough * loss) or little > 1:
                return Solution(vector, loss, iteration, refused, weights * residuals, weighted)
            # With the derivatives at once: steps that are refused are few.
            new = _tried(problem, vector + step)
            gain = (loss - new[0]) / promised
            if gain > 0.05:
                break
            refused += 1
            damping = max(8.0 * damping, _LEAST_DAMPING)
            if refused > _MOST_REFUSED:
                raise _unsolved(f"{refused} steps were refused", loss)
            if damping > _LARGEST_DAMPING:
                return Solution(vector, loss, iteration, refused, weights * residuals, weighted)
        vector = vector + step
        damping *= 0.1 if gain > 0.6 else 0.5 if gain > 0.25 else 2.0
        if damping < _LEAST_DAMPING:  # else what was believed, and nothing else tells, would count for less
            damping = 0.0
        gained = loss - new[0]
        loss, residuals, jacobian = new
        tell(loss)
        little = little + 1 if gained < max(_LITTLE, 1e-9 * loss) else 0
    raise _unsolved(f"{_MOST_ITERATIONS} steps were not enough", loss)


def _unsolved(why: str, loss: float) -> IdentificationError:
    return IdentificationError(
        f"no convergence: {why} (half a chi squared of {loss:.4g}); is it a log of this robot? If so, free fewer "
        "parameters, or record a motion that moves more",
        loss=loss,
    )


def _tried(problem: Problem, vector: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Loss, residuals and Jacobian; an infinite loss where the rods do not follow."""
    try:
        with np.errstate(all="ignore"):
            residuals, jacobian = problem.linearised(vector)
            loss = problem.loss(residuals)
    except (PCRError, ValueError):
        return np.inf, np.empty(0), np.empty((0, 0))
    return (loss if np.isfinite(loss) else np.inf), residuals, jacobian
