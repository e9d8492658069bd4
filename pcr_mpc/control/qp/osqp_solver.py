"""OSQP behind calls that cannot fail silently.

OSQP's own ``update`` drops the return code, misreads strided arrays, keeps old data when something is wrong and
still says "solved"; one NaN poisons later solves; the x of an unsolved problem is a number. Here every array is
checked before it is handed over, every return code is read, and x exists only if the problem was solved.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NoReturn

import numpy as np
import osqp
import scipy.sparse as sp

from .checked import CheckedQP

_CORE = osqp.OSQP().ext
_RHO = 0.1
_SOLVED = int(osqp.SolverStatus.OSQP_SOLVED)


class QPSolver(CheckedQP):
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
        self._settings = _CORE.OSQPSettings()
        _CORE.osqp_set_default_settings(self._settings)
        self._rho = 1.0 if identity else _RHO
        settings = {
            "verbose": False,
            "eps_abs": tolerance,
            "eps_rel": tolerance,
            "max_iter": max_iterations,
            "adaptive_rho": 1,  # by iterations, not by time
            "adaptive_rho_interval": 25,  # twice as eager as OSQP's defaults: the longest solves take half as long
            "adaptive_rho_tolerance": 2.0,
            "rho": self._rho,
            "scaling": 0 if identity else 2,
            "check_termination": 5,
            "polishing": False,
        }
        for name, value in settings.items():
            setattr(self._settings, name, value)
        super().__init__(A, max_iterations, identity)

    def _set_up(self) -> None:
        # A new one: OSQP scales and unscales A at every update of P, and its rounding would stay. By its own module,
        # for the wrapper takes a millisecond to look at every argument again.
        self._allowed, self._settings.max_iter = self._most, self._most
        self._core = _CORE.OSQPSolver(*self._beginning, self.m, self.n, self._settings)

    @cached_property
    def _beginning(self) -> tuple[Any, ...]:
        """P, q, A, l and u of a new workspace, in OSQP's own form."""
        n, m = self.n, self.m
        hessian = sp.identity(n, format="csc")
        if not self._identity:
            # An explicit pattern: zeros of the start must not drop out of it.
            rows = np.concatenate([np.arange(j + 1) for j in range(n)])
            starts = np.arange(n + 1) * (np.arange(n + 1) + 1) // 2
            diagonal = (rows == np.repeat(np.arange(n), np.arange(1, n + 1))).astype(float)
            hessian = sp.csc_matrix((diagonal, rows, starts), shape=(n, n))
        return _CORE.CSC(hessian), np.zeros(n), _CORE.CSC(self._matrix.astype(float)), -np.ones(m), np.ones(m)

    def _start_from(self, x: np.ndarray, y: np.ndarray | None) -> None:
        if code := self._core.warm_start(x, y):
            self._refused("warm_start", code)

    def _hand_over(
        self,
        P: np.ndarray | None,
        q: np.ndarray,
        l: np.ndarray,  # noqa: E741
        u: np.ndarray,
        A: np.ndarray | None,
    ) -> None:
        core = self._core
        if (P is not None or A is not None) and core.update_data_mat(P, None, A, None):
            # OSQP keeps the refused P, and would say "solved" of a mixture.
            self.reset()
            raise self._not_convex("P has a negative eigenvalue")
        if code := core.update_data_vec(q, l, u):
            self._refused("update_data_vec", code)

    def _solve_into(self, x: np.ndarray, y: np.ndarray, most: int) -> tuple[int, float]:
        core = self._core
        if most != self._allowed:
            self._allowed = self._settings.max_iter = most
            core.update_settings(self._settings)
        core.solve()
        info = core.info
        if info.status_val != _SOLVED:
            status, iterations, limit = info.status, int(info.iter), None
            if info.status_val == osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE:
                # The row that weighs most in the proof that no point meets all bounds.
                limit = int(np.argmax(np.abs(core.solution.prim_inf_cert)))
            # An unsolved problem's iterate and step size must not start the next one.
            self._start_from(np.zeros(self.n), np.zeros(self.m))
            core.update_rho(self._rho)
            raise self._unsolved(status, iterations, float(info.run_time), limit)
        found = core.solution
        x[:], y[:] = found.x, found.y
        return info.iter, info.run_time

    @staticmethod
    def _refused(call: str, code: int) -> NoReturn:
        raise RuntimeError(f"OSQP refused {call} with code {code}; the old data are still in place")
