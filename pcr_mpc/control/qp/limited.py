"""The QP with everything that may be softened: angle limits where a start breaks them, and the limits of poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.linalg.blas import dtrsm, dtrsv
from scipy.linalg.lapack import dpotrf

from ...errors import InfeasibleError
from ...linearisation.linear_limits import LinearLimits
from ...linearisation.linear_model import LinearModels
from ..tuning import Tuning
from .checked import CheckedQP, Solution
from .daqp_solver import DAQPSolver
from .osqp_solver import QPSolver
from .program import QuadraticProgram, constraint_matrix

# Price of a row that gives way by its own length, over the cost of the tip's way per radian. The penalty is exact while
# it exceeds every multiplier, and those are what a limit costs in tracking.
PENALTY = 0.154
_TOLERANCE = 10.0  # times the tuning's: the rows are scaled, and the inputs still right to 0.01 rad/s
_SLACK_SEEN = 1e-4  # rad or units of a row: less is the solver's tolerance


class Limited(NamedTuple):
    """A solution and what it cost in limits.

    Attributes
    ----------
    inputs : ndarray, shape (N n,)
    states : ndarray, shape (N + 1, 4 + n), or None
        That it leads to, where they were needed to find it.
    kept : bool
        The first inputs keep all limits of motors for certain.
    slack : dict
        By how much limits had to give, by kind, in their own units.
    active : tuple of str
        Kinds of limits with a multiplier.
    solution : Solution
        Of the QP that was solved.
    """

    inputs: np.ndarray
    states: np.ndarray | None
    kept: bool
    slack: dict[str, float]
    active: tuple[str, ...]
    solution: Solution


class LimitedQP:
    """Rates and their changes are hard; angles are, or give way; poses give way, each at a price per unit.

    The penalty is exact: where the hard problem has a solution, this one has the same. Many nearly parallel rows are
    hard on OSQP, so it is given the problem in coordinates V = L'U in which the cost is 1/2 |V - V*|^2 (P = L L'), and
    every row scaled to length one: hundreds of iterations instead of thousands. Its matrix is

                             V                  s-     s+
        rates, changes     [ A inv(L')                    ]
        angles, poses      [ A inv(L')          1      -1 ]
        slacks             [                    1         ]
                           [                           1  ]

    Parameters
    ----------
    tuning : Tuning
    n : int
        Motors.
    dt : float
        Control period [s].
    kinds : tuple of str
        Of the rows of the `LinearLimits` to come; empty if there are none.
    reach : float
        Way of the tip per radian [m/rad] (see `LinearModel`), which makes prices of angles from those of positions.
    """

    def __init__(self, tuning: Tuning, n: int, dt: float, kinds: tuple[str, ...] = (), *, reach: float) -> None:
        horizon, size = tuning.horizon, tuning.horizon * n
        self._horizon, self._n, self._dt, self._size = horizon, n, dt, size
        self._kinds = kinds
        self._motor_rows = np.asfortranarray(constraint_matrix(horizon, n).toarray())
        self._penalty = PENALTY * tuning.position_weight * reach**2
        self._groups = np.array(
            [kind for kind in ("rate", "rate change", "angle") for _ in range(size)] + [*kinds] * horizon
        )
        soft = size + horizon * len(kinds)
        self._soft = soft
        rows = 2 * size + soft
        matrix = soft_pattern(size, soft)
        self._data = matrix.data.copy()
        self._dense = slice(0, rows * size)  # the first columns are stored first, each in full
        self._triangle = np.tril_indices(size)
        # Where each row's neighbour one period later is; the last period's stay.
        widths = [n, n, n, *([len(kinds)] if kinds else [])]
        later, first = [], 0
        for width in [*widths, *widths[2:], *widths[2:]]:
            rows_of = first + np.arange(horizon * width)
            later.append(np.append(rows_of[width:], rows_of[-width:]))
            first += horizon * width
        self._later = np.concatenate(later)
        self._last: Solution | None = None
        settings = _TOLERANCE * tuning.tolerance, tuning.max_iterations
        self._solver: CheckedQP
        if tuning.solver == "daqp":
            self._solver = DAQPSolver(matrix, *settings, identity=True, soft=soft)
        else:
            self._solver = QPSolver(matrix, *settings, identity=True)

    def reset(self) -> None:
        """Start afresh."""
        self._last = None
        self._solver.reset()

    def solve(
        self,
        qp: QuadraticProgram,
        x: np.ndarray,
        models: LinearModels,
        limits: LinearLimits | None,
        *,
        soft_angles: bool,
        warm: np.ndarray | None = None,
        most: int | None = None,
    ) -> Limited:
        """Solve ``qp`` with limits of poses and, if so wanted, with its angle limits softened.

        ``warm`` are inputs to start from, with the last solution's slacks and multipliers moved on by one period;
        ``most`` iterations are allowed.

        Raises
        ------
        InfeasibleError
            As `QPSolver.solve`.
        """
        size, soft = self._size, self._soft
        rows, lower, upper = self._motor_rows, qp.l, qp.u
        if limits is not None:
            response, low, high = self._poses(x, models, limits)
            rows = np.asfortranarray(np.vstack([rows, response]))
            lower, upper = np.concatenate([lower, low]), np.concatenate([upper, high])
        factor = self._factor(qp)
        rows = dtrsm(1.0, factor, rows, side=1, lower=1, trans_a=1)  # A inv(L')
        length = np.linalg.norm(rows, axis=1)
        length = np.maximum(length, 1e-12 * length.max())
        rows /= length[:, None]
        self._data[self._dense] = rows.ravel(order="F")
        slackest = np.full(soft, np.inf)
        slackest[:size] = np.inf if soft_angles else 0.0
        self._solver.update(
            None,
            np.append(dtrsv(factor, qp.q, lower=1), np.full(2 * soft, self._penalty)),
            np.concatenate([lower / length, np.zeros(2 * soft)]),
            np.concatenate([upper / length, slackest, slackest]),
            self._data,
        )
        if warm is not None:
            slacks, y = np.zeros(2 * soft), np.zeros(self._solver.m)
            if self._last is not None:
                y = self._last.y[self._later]
                slacks = self._last.x[size:][self._later[-2 * soft :] - (2 * size + soft)]
            self._solver.warm_start(np.append(np.tril(factor).T @ warm, slacks), y)
        self._last = None
        self._last = solution = self._solver.solve(most)
        inputs = dtrsv(factor, solution.x[:size], lower=1, trans=1)
        given = np.maximum(solution.x[size : size + soft], solution.x[size + soft :])
        return Limited(
            inputs,
            None,
            False,
            self._slack(self._dt * given * length[2 * size :], limits),
            active_kinds(solution.y, self._groups),
            solution,
        )

    def _factor(self, qp: QuadraticProgram) -> np.ndarray:
        """L, lower triangular, with P = L L'."""
        lower = np.zeros((self._size, self._size), order="F")
        lower[self._triangle] = qp.P  # the upper triangle column by column is the lower one row by row
        factor, failed = dpotrf(lower, lower=1, clean=0)
        if failed:
            raise InfeasibleError(
                f"the QP is not convex: the leading minor {failed} of P is not positive; check weights and model",
                status="non convex",
                limit=None,
            )
        return np.asarray(factor)

    def _poses(
        self, x: np.ndarray, models: LinearModels, limits: LinearLimits
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows over all periods as (bounds) <= (rows) U <= (bounds), all over dt."""
        n, horizon, m = self._n, self._horizon, len(limits.kinds)
        response = np.zeros((len(x), self._size))
        rows, free = np.empty((horizon * m, self._size)), np.empty((horizon, m))
        for k in range(horizon):
            if k < len(models):
                model = models[k]
            response = model.A @ response
            response[:, k * n : (k + 1) * n] = model.B
            x = model.A @ x + model.c
            rows[k * m : (k + 1) * m] = limits.C @ response
            free[k] = limits.C @ x
        low, high = (limits.lower - free) / self._dt, (limits.upper - free) / self._dt
        return rows / self._dt, low.ravel(), high.ravel()

    def _slack(self, given: np.ndarray, limits: LinearLimits | None) -> dict[str, float]:
        worst = {"angle": float(given[: self._size].max())}
        if limits is not None:
            most = given[self._size :].reshape(self._horizon, -1).max(axis=0) * limits.scale
            for kind, amount, unit in zip(limits.kinds, most.tolist(), limits.scale.tolist(), strict=True):
                if amount > _SLACK_SEEN * unit:
                    worst[kind] = max(worst.get(kind, 0.0), amount)
        if worst["angle"] <= _SLACK_SEEN:
            del worst["angle"]
        return worst


def soft_pattern(size: int, soft: int) -> sp.csc_matrix:
    """The matrix of a `LimitedQP` of ``size`` inputs and ``soft`` soft rows, with ones where it is dense."""
    rows = 2 * size + soft
    ties = sp.vstack([sp.csc_matrix((2 * size, 2 * soft)), sp.hstack([sp.identity(soft), -sp.identity(soft)])])
    slacks = sp.hstack([sp.csc_matrix((2 * soft, size)), sp.identity(2 * soft)])
    matrix = sp.csc_matrix(sp.vstack([sp.hstack([sp.csc_matrix(np.ones((rows, size))), ties]), slacks]))
    matrix.sort_indices()
    return matrix


def active_kinds(y: np.ndarray, groups: np.ndarray) -> tuple[str, ...]:
    """Kinds of limits that have a multiplier; ``groups`` names the kind of each row, and may be shorter than y."""
    y = np.abs(y[: len(groups)])
    return active_of({kind: float(y[groups == kind].max()) for kind in dict.fromkeys(groups.tolist())})


def active_of(pulls: dict[str, float]) -> tuple[str, ...]:
    """Kinds of limits whose largest multipliers count."""
    largest = max(pulls.values(), default=0.0)
    return () if largest < 1e-9 else tuple(kind for kind, pull in pulls.items() if pull > 1e-6 * largest)
