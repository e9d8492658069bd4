"""OSQP behind calls that cannot fail silently.

OSQP's own ``update`` drops the return code, misreads strided arrays, keeps old data when something is wrong and
still says "solved"; one NaN poisons later solves; the x of an unsolved problem is a number. Here every array is
checked before it is handed over, every return code is read, and x exists only if the problem was solved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import osqp
import scipy.sparse as sp
from scipy.linalg.blas import ddot, dspmv

from ..errors import InfeasibleError

_RHO = 0.1
_INFINITY = 1e30


@dataclass(frozen=True, eq=False)
class Solution:
    """A solved QP.

    Attributes
    ----------
    x : ndarray, shape (n,)
    y : ndarray, shape (m,)
        Multipliers, positive at upper bounds.
    iterations : int
    run_time : float
        Inside OSQP, updates of its data included [s].
    primal_residual, dual_residual : float
        Largest violation of l <= A x <= u, and largest entry of P x + q + A'y, computed here from the data.
    """

    x: np.ndarray
    y: np.ndarray
    iterations: int
    run_time: float
    primal_residual: float
    dual_residual: float


class QPSolver:
    """One OSQP workspace for QPs of one size: dense P (upper triangle), A of one pattern.

    Parameters
    ----------
    A : scipy.sparse.csc_matrix, shape (m, n)
        Indices sorted; zeros that may become something else must be stored.
    tolerance : float
        Absolute and relative.
    max_iterations : int
    identity : bool
        P is the identity and stays it: `update` takes none.
    """

    def __init__(
        self, A: sp.csc_matrix, tolerance: float = 1e-5, max_iterations: int = 4000, *, identity: bool = False
    ) -> None:
        m, n = A.shape
        self._identity = identity
        self.n, self.m = n, m
        self._n_hessian = n * (n + 1) // 2
        self._matrix = A
        self._settings = {
            "verbose": False,
            "eps_abs": tolerance,
            "eps_rel": tolerance,
            "max_iter": max_iterations,
            "adaptive_rho": 1,  # by iterations, not by time
            "adaptive_rho_interval": 25,  # twice as eager as OSQP's defaults: the longest solves take half as long
            "adaptive_rho_tolerance": 2.0,
            "rho": 1.0 if self._identity else _RHO,
            "scaling": 0 if self._identity else 2,
            "check_termination": 5,
            "polishing": False,
        }
        self._dense_a = np.ascontiguousarray(A.toarray())
        self._data: tuple[Any, ...] | None = None
        self._entries = A.indices * n + np.repeat(np.arange(n), np.diff(A.indptr))  # of the dense one, row by row
        self.reset()

    def reset(self) -> None:
        """Start afresh, so that the same calls give the same results bit for bit.

        A new workspace: OSQP scales and unscales A at every update of P, and its rounding would stay.
        """
        n, m = self.n, self.m
        self._osqp, self._data = osqp.OSQP(), None
        self._most = self._allowed = self._settings["max_iter"]
        if self._identity:
            self._osqp.setup(sp.identity(n, format="csc"), np.zeros(n), self._matrix, -np.ones(m), np.ones(m),
                             **self._settings)  # fmt: skip
            return
        # An explicit pattern: zeros of the start must not drop out of it.
        rows = np.concatenate([np.arange(j + 1) for j in range(n)])
        starts = np.arange(n + 1) * (np.arange(n + 1) + 1) // 2
        diagonal = (rows == np.repeat(np.arange(n), np.arange(1, n + 1))).astype(float)
        hessian = sp.csc_matrix((diagonal, rows, starts), shape=(n, n))
        self._osqp.setup(hessian, np.zeros(n), self._matrix, -np.ones(m), np.ones(m), **self._settings)

    def warm_start(self, x: np.ndarray, y: np.ndarray | None = None) -> None:
        """Start the next solve from x, shape (n,), and multipliers y, shape (m,); None keeps the last ones."""
        y = None if y is None else self._checked("y", y, self.m)
        self._require(self._osqp.warm_start(self._checked("x", x, self.n), y), "warm_start")

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
            Some bounds cross; ``limit`` is the row, and the old data stay. Or P is not convex: then OSQP has lost the
            old data, and needs good ones before it solves again.
        """
        q = self._checked("q", q, self.n)
        if (P is None) != self._identity:
            raise ValueError("P is the identity of this solver" if self._identity else "P is missing")
        if P is not None:
            P = self._checked("P", P, self._n_hessian)
        l, u = self._checked("l", l, self.m, bound=True), self._checked("u", u, self.m, bound=True)  # noqa: E741
        gap = u - l
        if not gap.min() >= 0:
            row = int(np.argmin(gap))
            raise InfeasibleError(
                f"bounds of row {row} cross: lower {l[row]:.6g} > upper {u[row]:.6g}; relax one of them",
                status="crossed bounds",
                limit=row,
            )
        core = self._osqp._solver
        if A is not None:
            A = self._checked("A", A, self._matrix.nnz)
            self._dense_a.ravel()[self._entries] = A
        if (P is not None or A is not None) and core.update_data_mat(P_x=P, P_i=None, A_x=A, A_i=None):
            # OSQP keeps the refused P, and would say "solved" of a mixture.
            self.reset()
            raise InfeasibleError(
                "the QP is not convex: P has a negative eigenvalue; check the weights and the model",
                status="non convex",
                limit=None,
            )
        self._require(core.update_data_vec(q=q, l=l, u=u), "update_data_vec")
        self._data = P, q, l, u

    def solve(self, most: int | None = None, *, certified: bool = True) -> Solution:
        """Solve the current data, in at most ``most`` iterations if that is less than ``max_iterations``.

        Unless it is to be ``certified``, the residuals are left to the caller: NaN.

        Raises
        ------
        ValueError
            There are no data yet.
        InfeasibleError
            OSQP's status is anything but "solved"; ``status`` says what, ``iterations`` how far it got, ``limit``
            which row stands most in the way if the problem is infeasible.
        """
        if self._data is None:
            raise ValueError("there is no QP to solve: call update first")
        core = self._osqp._solver
        allowed = self._most if most is None else max(1, min(most, self._most))
        if allowed != self._allowed:
            self._osqp.update_settings(max_iter=allowed)
            self._allowed = allowed
        core.solve()
        info = core.info
        if info.status_val != osqp.SolverStatus.OSQP_SOLVED:
            status, iterations, limit = info.status, int(info.iter), None
            if info.status_val == osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE:
                # The row that weighs most in the proof that no point meets all bounds.
                limit = int(np.argmax(np.abs(core.solution.prim_inf_cert)))
            # An unsolved problem's iterate and step size must not start the next one.
            self._require(self._osqp.warm_start(np.zeros(self.n), np.zeros(self.m)), "warm_start")
            self._osqp.update_settings(rho=self._settings["rho"])
            raise InfeasibleError(
                f"the QP was not solved: {status} after {iterations} iterations; "
                "relax the limits, shorten the horizon or raise max_iterations",
                status=status,
                iterations=iterations,
                run_time=float(info.run_time),
                limit=limit,
            )
        x, y = np.array(core.solution.x), np.array(core.solution.y)
        primal, dual = self._residuals(x, y, *self._data) if certified else (math.nan, math.nan)
        return Solution(x, y, int(info.iter), float(info.run_time), primal, dual)

    def _residuals(
        self,
        x: np.ndarray,
        y: np.ndarray,
        hessian: np.ndarray | None,
        q: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
    ) -> tuple[float, float]:
        ax = self._dense_a @ x
        primal = max(float((lower - ax).max()), float((ax - upper).max()), 0.0)
        # The upper triangle column by column is BLAS's packed form.
        gradient = (x if hessian is None else dspmv(self.n, 1.0, hessian, x)) + q + y @ self._dense_a
        return primal, float(np.abs(gradient).max())

    @staticmethod
    def _checked(name: str, value: np.ndarray, size: int, bound: bool = False) -> np.ndarray:
        array = np.ascontiguousarray(value, dtype=float)
        if array.shape != (size,):
            raise ValueError(f"{name} has shape {array.shape}, expected ({size},)")
        # The sum of squares is NaN if any entry is, and at most inf otherwise (BLAS does not warn of that).
        squares = float(ddot(array, array))
        if math.isnan(squares) or (not bound and not squares < math.inf and not np.isfinite(array).all()):
            raise ValueError(f"{name} is not finite")
        # OSQP's infinity is 1e30: larger bounds are refused by it.
        return np.clip(array, -_INFINITY, _INFINITY) if bound and squares >= _INFINITY**2 else array

    @staticmethod
    def _require(code: int | None, call: str) -> None:
        if code:
            raise RuntimeError(f"OSQP refused {call} with code {code}; the old data are still in place")
