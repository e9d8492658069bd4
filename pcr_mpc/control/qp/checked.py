"""What every QP solver is handed and answers: data that are checked, and residuals that are computed from them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.linalg.blas import ddot, dspmv

from ...errors import InfeasibleError

INFINITY = 1e30  # of OSQP and of DAQP


class Solution(NamedTuple):
    """A solved QP.

    Attributes
    ----------
    x : ndarray, shape (n,)
    y : ndarray, shape (m,)
        Multipliers, positive at upper bounds.
    iterations : int
    run_time : float
        Inside the solver, updates of its data included [s].
    primal_residual, dual_residual : float
        Largest violation of l <= A x <= u, and largest entry of P x + q + A'y, computed here from the data.
    """

    x: np.ndarray
    y: np.ndarray
    iterations: int
    run_time: float
    primal_residual: float
    dual_residual: float


class CheckedQP(ABC):
    """QPs of one size, min 1/2 x'Px + q'x subject to l <= A x <= u: dense P (upper triangle), A of one pattern.

    Solvers derive from it: every array is checked and copied before it is handed over, and a solution's residuals are
    computed from the copies.

    Parameters
    ----------
    A : scipy.sparse.csc_matrix, shape (m, n)
        Indices sorted; zeros that may become something else must be stored.
    max_iterations : int
    identity : bool
        P is the identity and stays it: `update` takes none.
    """

    def __init__(self, A: sp.csc_matrix, max_iterations: int, identity: bool) -> None:
        m, n = A.shape
        self.n, self.m = n, m
        self._identity = identity
        self._most = max_iterations
        self._n_hessian = n * (n + 1) // 2
        self._matrix = A
        self._entries = A.indices * n + np.repeat(np.arange(n), np.diff(A.indptr))  # of the dense one, row by row
        self._data: tuple[np.ndarray | None, np.ndarray, np.ndarray, np.ndarray] | None = None
        self._fresh = False
        self.reset()

    def reset(self) -> None:
        """Start afresh, with the first A, so that the same calls give the same results bit for bit.

        One that has not been used since costs nothing: to set up takes a millisecond, and a controller has many.
        """
        if self._fresh:
            return
        self._dense_a = np.ascontiguousarray(self._matrix.toarray())
        self._data = None
        self._set_up()
        self._fresh = True

    @abstractmethod
    def _set_up(self) -> None:
        """Make a new workspace for the dense A."""

    def solve(self, most: int | None = None) -> Solution:
        """Solve the current data, in at most ``most`` iterations if that is less than ``max_iterations``.

        Raises
        ------
        ValueError
            There are no data yet.
        InfeasibleError
            The solver's status is anything but "solved"; ``status`` says what, ``iterations`` how far it got,
            ``limit`` which row stands most in the way if the problem is infeasible.
        """
        if self._data is None:
            raise ValueError("there is no QP to solve: call update first")
        x, y = np.empty(self.n), np.empty(self.m)
        found = self._solve_into(x, y, self._most if most is None else max(1, min(most, self._most)))
        solution = Solution(x, y, *found, *self._residuals(x, y))
        self.judge(solution)
        return solution

    def answer(
        self,
        problem: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
        start: np.ndarray | None,
        x: np.ndarray,
        y: np.ndarray,
        *,
        sound: bool,
        afresh: bool = False,
    ) -> tuple[int, float]:
        """Update, start warm and solve in one go.

        Parameters
        ----------
        problem : tuple of ndarray
            P, q, l and u as for `update`.
        sound : bool
            The graph that made the problem has checked it, and it stays as it is until the next one.
        start : ndarray, shape (n,), or None
            From a solution; the multipliers are the last ones, or zero.
        afresh : bool
            They are zero.
        x, y : ndarray, shapes (n,) and (m,)
            The solution is written there. Its residuals are left to the caller, who lets `judge` see them.

        Returns
        -------
        (int, float)
            Iterations, and seconds inside the solver.

        Raises
        ------
        ValueError, InfeasibleError
            As `update` and `solve`.
        """
        if sound:
            self._fresh = False
            self._hand_over(*problem, None)
            self._data = problem
        else:
            self.update(*problem)
        if start is not None:
            self._start_from(start, np.zeros(self.m) if afresh else None)
        return self._solve_into(x, y, self._most)

    @abstractmethod
    def _solve_into(self, x: np.ndarray, y: np.ndarray, most: int) -> tuple[int, float]:
        """Solve the data that were handed over in at most so many iterations; return these, and seconds inside.

        Raises `InfeasibleError` for every status but "solved".
        """

    @abstractmethod
    def _hand_over(
        self,
        P: np.ndarray | None,
        q: np.ndarray,
        l: np.ndarray,  # noqa: E741
        u: np.ndarray,
        A: np.ndarray | None,
    ) -> None:
        """Give checked data to the solver; the dense A is up to date. Raises `InfeasibleError` if P is not convex."""

    @abstractmethod
    def _start_from(self, x: np.ndarray, y: np.ndarray | None) -> None:
        """Give a checked start to the solver."""

    def judge(self, solution: Solution) -> None:  # noqa: B027  most solvers have judged themselves
        """Accept a solution by its residuals, or raise `InfeasibleError`."""

    def warm_start(self, x: np.ndarray, y: np.ndarray | None = None) -> None:
        """Start the next solve from x, shape (n,), and multipliers y, shape (m,); None keeps the last ones."""
        y = None if y is None else _checked("y", y, self.m)
        self._fresh = False
        self._start_from(_checked("x", x, self.n), y)

    def update(
        self,
        P: np.ndarray | None,
        q: np.ndarray,
        l: np.ndarray,  # noqa: E741
        u: np.ndarray,
        A: np.ndarray | None = None,
    ) -> None:
        """Replace the data.

        Parameters
        ----------
        P : ndarray, shape (n (n + 1) / 2,)
            Upper triangle, column by column; None if it is the identity.
        q : ndarray, shape (n,)
        l, u : ndarray, shape (m,)
            Bounds; infinite entries are allowed.
        A : ndarray, shape (stored entries of A,), optional
            Column by column, in the order of the first A. None: as they are.

        Raises
        ------
        ValueError
            Wrong shape or type, or an entry that is not finite; the old data then stay.
        InfeasibleError
            Some bounds cross; ``limit`` is the row, and the old data stay. Or P is not convex: then the old data are
            lost, and good ones are needed before it solves again.
        """
        q = _checked("q", q, self.n)
        if (P is None) != self._identity:
            raise ValueError("P is the identity of this solver" if self._identity else "P is missing")
        if P is not None:
            P = _checked("P", P, self._n_hessian)
        l, u = _checked("l", l, self.m, bound=True), _checked("u", u, self.m, bound=True)  # noqa: E741
        gap = u - l
        if not gap.min() >= 0:
            row = int(np.argmin(gap))
            raise InfeasibleError(
                f"bounds of row {row} cross: lower {l[row]:.6g} > upper {u[row]:.6g}; relax one of them",
                status="crossed bounds",
                limit=row,
            )
        self._fresh = False
        if A is not None:
            A = _checked("A", A, self._matrix.nnz)
            self._dense_a.ravel()[self._entries] = A
        self._hand_over(P, q, l, u, A)
        self._data = P, q, l, u

    def _not_convex(self, what: str) -> InfeasibleError:
        return InfeasibleError(
            f"the QP is not convex: {what}; check the weights and the model", status="non convex", limit=None
        )

    def _unsolved(self, status: str, iterations: int, run_time: float, limit: int | None) -> InfeasibleError:
        return InfeasibleError(
            f"the QP was not solved: {status} after {iterations} iterations; "
            "relax the limits, shorten the horizon or raise max_iterations",
            status=status,
            iterations=iterations,
            run_time=run_time,
            limit=limit,
        )

    def _residuals(self, x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
        assert self._data is not None
        hessian, q, lower, upper = self._data
        ax = self._dense_a @ x
        primal = max(float((lower - ax).max()), float((ax - upper).max()), 0.0)
        # The upper triangle column by column is BLAS's packed form.
        gradient = (x if hessian is None else dspmv(self.n, 1.0, hessian, x)) + q + y @ self._dense_a
        return primal, float(np.abs(gradient).max())


def _checked(name: str, value: np.ndarray, size: int, bound: bool = False) -> np.ndarray:
    """A contiguous copy that no caller can change any more, finite except for bounds."""
    array = np.array(value, dtype=float, order="C")
    if array.shape != (size,):
        raise ValueError(f"{name} has shape {array.shape}, expected ({size},)")
    # The sum of squares is NaN if any entry is, and at most inf otherwise (BLAS does not warn of that).
    squares = float(ddot(array, array))
    if math.isnan(squares) or (not bound and not squares < math.inf and not np.isfinite(array).all()):
        raise ValueError(f"{name} is not finite")
    # Larger bounds are refused.
    return np.clip(array, -INFINITY, INFINITY) if bound and squares >= INFINITY**2 else array
