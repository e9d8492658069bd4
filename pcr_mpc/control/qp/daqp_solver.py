"""DAQP, a dense dual active-set method, behind the same checks as OSQP.

What DAQP does of itself, and what is done about it here: ``update`` drops arrays of a wrong shape without a word and
keeps pointers to the others (they are checked and copied); a P that is not positive definite is shifted until it is,
and another problem is solved (forbidden); rows that become soft after set-up overrun its memory (all that may ever be
soft are so at set-up); the multipliers that it returns of an unsolved problem are those of the one before (they exist
only if the problem was solved); after an unsolved problem it goes on from where it gave up (it begins with no active
row); it leaves rows out that are violated by less than 1e-6 (by less than the tolerance here), and nothing checks its
answer (residuals are computed from the data, and decide).
"""

from __future__ import annotations

import time

import daqp
import numpy as np
import scipy.sparse as sp

from .checked import CheckedQP, Solution

_SOLVED = (1, 2)  # 2: some soft row gives way
_INFEASIBLE = (-1, -6)  # -6: the equalities alone contradict each other
_NOT_CONVEX = -5
_STATUS = {-2: "cycling", -4: "maximum iterations reached", 4: "solved inaccurate"}
_ACTIVE, _ACTIVE_BELOW, _SOFT = 1, 3, 8
_FIRM = 1e-2  # of the tolerance: DAQP's own, so that a row that it may leave out cannot decide on acceptance
_GIVING = 1e-8  # reciprocal price where every row gives way


class DAQPSolver(CheckedQP):
    """One DAQP workspace for QPs of one size: dense P (upper triangle), positive definite, A of one pattern.

    It starts from the rows that were active in the last solution, or those with a multiplier in `warm_start`; an x
    tells an active set nothing more.

    Soft rows are told by slack columns, as they are to OSQP; DAQP is given the rows without them. With P the
    identity, slack costs price s + s^2/2, which DAQP's own soft rows can be told to cost too. A is then

                    x      s-     s+
        hard      [ A                   ]
        soft      [ A      1     -1     ]
        slacks    [        1            ]      0 <= s <= 0 (hard after all) or infinity
                  [               1     ]

    Parameters
    ----------
    A : scipy.sparse.csc_matrix, shape (m, n)
        Indices sorted; zeros that may become something else must be stored.
    tolerance : float
        Absolute and relative, on the residuals.
    max_iterations : int
        Each adds a row to the active set or takes one out.
    identity : bool
        P is the identity and stays it: `update` takes none.
    soft : int
        Number of soft rows, with two slack columns each; only if P is the identity.
    """

    def __init__(
        self,
        A: sp.csc_matrix,
        tolerance: float = 1e-5,
        max_iterations: int = 4000,
        *,
        identity: bool = False,
        soft: int = 0,
    ) -> None:
        m, n = A.shape
        if soft and not identity:
            raise ValueError(f"{soft} soft rows, but P is not the identity: their slack needs a cost of its own")
        self._tolerance, self._soft = tolerance, soft
        self._rows, self._columns = m - 2 * soft, n - 2 * soft  # DAQP's own
        self._hessian = np.eye(self._columns)
        # The packed triangle's entry for each of the full matrix.
        row, column = np.indices((n, n))
        low, high = np.minimum(row, column), np.maximum(row, column)
        self._unpacked = low + high * (high + 1) // 2
        super().__init__(A, max_iterations, identity)

    def _set_up(self) -> None:
        rows, columns, soft = self._rows, self._columns, self._soft
        self._y = np.zeros(rows)
        self._flag, self._spent, self._allowed = 0, 0.0, self._most
        self._prices: np.ndarray | None = None
        self._sense = np.zeros(rows, dtype=np.intc)
        self._sense[rows - soft :] = _SOFT
        self._core = self._dense_a[:rows, :columns].copy()
        # DAQP's bounds on x itself cost less than rows.
        self._bounds = columns if not soft and self._begins_with_x() else 0
        self._model = daqp.Model()
        self._model.settings = {
            "eps_prox": 0.0,  # shift nothing
            "primal_tol": _FIRM * self._tolerance,
            "iter_limit": self._most + 1,
        }
        flag, _ = self._model.setup(np.eye(columns), np.zeros(columns), self._core[self._bounds :], np.ones(rows),
                                    -np.ones(rows), self._sense.copy())  # fmt: skip
        self._require(flag, "setup")

    def _begins_with_x(self) -> bool:
        return np.array_equal(self._core[: self._columns], np.eye(self._columns))

    def _start_from(self, x: np.ndarray, y: np.ndarray | None) -> None:
        if y is None:
            return
        self._y = y[: self._rows]
        if self._data is not None:
            began = time.perf_counter()
            self._flag = self._model.update(sense=self._senses())
            self._spent += time.perf_counter() - began

    def _senses(self) -> np.ndarray:
        """What DAQP is told of each row: soft or not, active or not."""
        sense = self._sense.copy()
        if self._y.any():
            sense += _ACTIVE * (self._y > 0) + _ACTIVE_BELOW * (self._y < 0)
        return sense

    def _hand_over(
        self,
        P: np.ndarray | None,
        q: np.ndarray,
        l: np.ndarray,  # noqa: E741
        u: np.ndarray,
        A: np.ndarray | None,
    ) -> None:
        began = time.perf_counter()
        rows, columns, soft = self._rows, self._columns, self._soft
        if A is not None:
            np.copyto(self._core, self._dense_a[:rows, :columns])
            if self._bounds and not self._begins_with_x():
                self._set_up()
        if soft:
            self._take_prices(q[columns:])
            self._sense[rows - soft :] = np.where(u[rows : rows + soft] > 0, _SOFT, 0)
        if P is not None:
            np.take(P, self._unpacked, out=self._hessian, mode="clip")  # without a buffer
        # Everything, always: what is left out, DAQP takes from before.
        self._flag = self._model.update(
            H=None if P is None else self._hessian,
            f=q[:columns],
            A=self._core[self._bounds :] if rows > self._bounds else None,
            bupper=u[:rows],
            blower=l[:rows],
            sense=self._senses(),
        )
        if self._flag == _NOT_CONVEX:
            self.reset()
            raise self._not_convex("P is not positive definite")
        if self._flag not in (0, *_INFEASIBLE):
            flag = self._flag
            self.reset()
            self._require(flag, "update")
        self._spent = time.perf_counter() - began

    def _take_prices(self, prices: np.ndarray) -> None:
        if self._prices is not None and np.array_equal(prices, self._prices):
            return
        soft = self._soft
        hard = np.ones(self._rows - soft)  # no matter
        self._model.soft_weights(
            rho_l=np.ones(self._rows),
            rho_u=np.ones(self._rows),
            w_l=np.concatenate([hard, prices[:soft]]),
            w_u=np.concatenate([hard, prices[soft:]]),
        )
        self._prices = prices

    def _solve_into(self, x: np.ndarray, y: np.ndarray, most: int) -> tuple[int, float]:
        if most != self._allowed:
            self._model.settings = {"iter_limit": most + 1}
            self._allowed = most
        began = time.perf_counter()
        if self._flag == 0:
            core, _, flag, info = self._model.solve()
            iterations = min(int(info["iterations"]), most)
        else:
            flag, iterations = self._flag, 0
        spent = self._spent + time.perf_counter() - began
        if flag not in _SOLVED:
            self._forget()
            status = "primal infeasible" if flag in _INFEASIBLE else _STATUS.get(flag, f"DAQP's exit {flag}")
            raise self._unsolved(status, iterations, spent, self._worst_row() if flag in _INFEASIBLE else None)
        self._whole(core, info["lam"], x, y)
        return iterations, spent

    def judge(self, solution: Solution) -> None:
        """Accept a solution whose residuals do not miss the tolerance, or raise `InfeasibleError`."""
        x, y, iterations, spent, primal, dual = solution
        # So written that NaN is not accepted.
        if not max(primal, dual) <= self._tolerance and not self._accepted(x, y, primal, dual):
            self._forget()
            raise self._unsolved(f"solved inaccurate, residuals {primal:.2g} and {dual:.2g}", iterations, spent, None)
        self._y = y[: self._rows]

    def _forget(self) -> None:
        """Let no row of an unsolved problem be active in the next."""
        self._y = np.zeros(self._rows)
        self._flag = self._model.update(sense=self._senses())

    def _whole(self, core: np.ndarray, multipliers: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
        """Write x and y with the slacks and their multipliers."""
        rows, columns, soft = self._rows, self._columns, self._soft
        x[:columns], y[:rows] = core, multipliers
        if not soft:
            return
        assert self._data is not None
        _, q, lower, upper = self._data
        value = self._core[rows - soft :] @ core
        gives = self._sense[rows - soft :] == _SOFT
        under = np.where(gives, np.maximum(lower[rows - soft : rows] - value, 0.0), 0.0)
        over = np.where(gives, np.maximum(value - upper[rows - soft : rows], 0.0), 0.0)
        x[columns:] = slacks = np.concatenate([under, over])
        tied = multipliers[rows - soft :]
        y[rows:] = -(slacks + q[columns:] + np.concatenate([tied, -tied]))

    def _accepted(self, x: np.ndarray, y: np.ndarray, primal: float, dual: float) -> bool:
        """Whether the residuals are within the tolerance relative to what they are differences of, as OSQP judges."""
        assert self._data is not None
        _, q, _, _ = self._data
        tension = y @ self._dense_a
        greatest = max(float(np.abs(q).max()), float(np.abs(tension).max()), float(np.abs(q + tension).max()))
        return (
            primal <= self._tolerance * (1 + float(np.abs(self._dense_a @ x).max()))
            and dual <= self._tolerance * (1 + greatest)
        )  # fmt: skip

    def _worst_row(self) -> int | None:
        """The hard row that gives most where all do, at a price on the squares of their distances."""
        assert self._data is not None
        hard = np.flatnonzero(self._sense == 0)
        rows, (_, _, lower, upper) = self._core[hard], self._data
        lower, upper = lower[hard], upper[hard]
        x, _, flag, _ = daqp.solve(
            np.eye(self._columns), np.zeros(self._columns), rows, upper, lower,
            np.full(len(hard), _SOFT, dtype=np.intc), rho_soft=_GIVING, iter_limit=self._most + 1,
        )  # fmt: skip
        if flag not in _SOLVED:
            return None
        value = rows @ x
        return int(hard[np.argmax(np.maximum(lower - value, value - upper))])

    @staticmethod
    def _require(flag: int, call: str) -> None:
        if flag < 0:
            raise RuntimeError(f"DAQP refused {call} with code {flag}; the data are lost, call update with good ones")
