"""A linear program that grows and is solved again: HiGHS goes on from the last basis, which takes a few iterations."""

from __future__ import annotations

from typing import Any

import highspy
import numpy as np

from ....errors import ConvergenceError

_OPTIONS: dict[str, Any] = {
    "output_flag": False,
    "solver": "simplex",
    "threads": 1,
    "presolve": "off",  # there is nothing to find, and looking takes a quarter of the time
}


class _Quiet(highspy.Highs):
    """HiGHS without its callbacks: none are used, and to enable them prints a banner on stdout."""

    def enableCallbacks(self) -> None:
        """See above."""


class LinearProgram:
    """Least ``costs @ x`` with ``low <= x <= high`` and rows that come one after the other.

    Parameters
    ----------
    costs : ndarray, shape (N,)
    """

    def __init__(self, costs: np.ndarray) -> None:
        self._solver: Any = _Quiet()  # type: ignore[no-untyped-call]
        for name, value in _OPTIONS.items():
            self._solver.setOptionValue(name, value)
        count = len(costs)
        program = highspy.HighsLp()
        program.num_col_, program.num_row_ = count, 0
        program.col_cost_ = costs
        program.col_lower_, program.col_upper_ = np.full(count, -np.inf), np.full(count, np.inf)
        self._demand(self._solver.passModel(program))
        self._count = count

    def add_rows(self, low: np.ndarray, high: np.ndarray, columns: np.ndarray, values: np.ndarray) -> None:
        """Add rows of equally many entries, shape (R, j), whose sums are to stay within bounds, shape (R,)."""
        if len(low):
            starts = (columns.shape[1] * np.arange(len(low))).astype(np.int32)
            places = np.ascontiguousarray(columns, dtype=np.int32).ravel()
            entries = np.ascontiguousarray(values, dtype=float).ravel()
            self._demand(self._solver.addRows(len(low), low, high, entries.size, starts, places, entries))

    def charge(self, unknown: int, cost: float) -> None:
        """Give an unknown another cost."""
        self._demand(self._solver.changeColCost(unknown, cost))

    def bound_rows(self, low: np.ndarray, high: np.ndarray) -> None:
        """Give all rows other bounds."""
        if len(low):
            self._demand(self._solver.changeRowsBounds(len(low), np.arange(len(low), dtype=np.int32), low, high))

    def bound(self, low: np.ndarray, high: np.ndarray) -> None:
        """Give the unknowns other bounds."""
        self._demand(self._solver.changeColsBounds(self._count, np.arange(self._count, dtype=np.int32), low, high))

    def solved(self) -> np.ndarray:
        """Return the best x.

        Raises
        ------
        ConvergenceError
            There is none, or it was not found.
        """
        self._solver.run()
        status = self._solver.getModelStatus()
        if status != highspy.HighsModelStatus.kOptimal:
            raise ConvergenceError(
                f"a linear program of the plan was not solved: {self._solver.modelStatusToString(status)}; take fewer "
                "or more cells",
                residual=float("nan"),
                iterations=int(self._solver.getInfo().simplex_iteration_count),
                last=None,
            )
        return np.array(self._solver.getSolution().col_value)

    def held(self) -> np.ndarray:
        """Which rows hold the last answer, shape (R,); there must be one."""
        basic = highspy.HighsBasisStatus.kBasic
        return np.array([status != basic for status in self._solver.getBasis().row_status], dtype=bool)

    def begin_as(self, other: LinearProgram) -> None:
        """Begin at another program's answer; the rows here, with their upper bounds, are those that hold it."""
        basis = other._solver.getBasis()
        basis.row_status = [highspy.HighsBasisStatus.kUpper] * self._solver.getNumRow()
        self._demand(self._solver.setBasis(basis))

    def _demand(self, status: Any) -> None:
        if status == highspy.HighsStatus.kError:
            raise ConvergenceError(
                "a linear program of the plan was refused by HiGHS; are its numbers finite?",
                residual=float("nan"),
                iterations=0,
                last=None,
            )
