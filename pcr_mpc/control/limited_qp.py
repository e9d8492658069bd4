"""The QP with everything that may be softened: angle limits where a start breaks them, and the limits of poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..linearisation.linear_limits import LinearLimits
from ..linearisation.linear_model import LinearModel
from .osqp_solver import QPSolver, Solution
from .qp import QuadraticProgram, constraint_matrix
from .tuning import Tuning

# An exact penalty: more than any multiplier of the hard problem, per m^2 of position weight, for one radian of an angle
# or one unit of a row of `LinearLimits`.
_PENALTY = 0.3
_CURVATURE = 1e-6  # of a slack's cost, relative to the penalty: the QP stays strictly convex
_SLACK_SEEN = 1e-4  # rad or units of a row: less is the solver's tolerance


@dataclass(frozen=True, eq=False)
class Limited:
    """A solution and what it cost in limits.

    Attributes
    ----------
    inputs : ndarray, shape (N n,)
    states : ndarray, shape (N + 1, 4 + n), or None
        That it leads to, where they were needed to find it.
    slack : dict
        By how much limits had to give, by kind, in their own units.
    active : tuple of str
        Kinds of limits with a multiplier.
    solution : Solution
        Of the extended QP.
    """

    inputs: np.ndarray
    states: np.ndarray | None
    slack: dict[str, float]
    active: tuple[str, ...]
    solution: Solution


class LimitedQP:
    """Rates and their changes are hard; angles are, or give way by s_i >= 0 a motor; poses by one s >= 0 a kind.

    A slack costs w s. The penalty is exact: where the hard problem has a solution, this one has the same. Its matrix is

                       U            s of the angles    s of the poses
        rates        [ constraint   0                  0            ]
        changes      [ matrix,      0                  0            ]
        angles  <=   [ see          -1                 0            ]
        angles  >=   [ `qp`         +1                 0            ]
        poses   <=   [ C dx/dU      0                  -1           ]
        slacks       [ 0            1                  1            ]

    with all rows in rad/s, and only C dx/dU, which is block lower triangular, changing from call to call.

    Parameters
    ----------
    tuning : Tuning
    n : int
        Motors.
    dt : float
        Control period [s].
    kinds : tuple of str
        Of the rows of the `LinearLimits` to come; empty if there are none.
    """

    def __init__(self, tuning: Tuning, n: int, dt: float, kinds: tuple[str, ...] = ()) -> None:
        horizon, size, m = tuning.horizon, tuning.horizon * n, len(kinds)
        self._horizon, self._n, self._dt, self._size = horizon, n, dt, size
        self._kinds = tuple(dict.fromkeys(kinds))
        self._penalty = _PENALTY * tuning.position_weight
        matrix = constraint_matrix(horizon, n)
        angles = matrix[2 * size :]
        # Every entry of the blocks on and below the diagonal may be there: one as a placeholder.
        poses = sp.kron(np.tril(np.ones((horizon, horizon))), np.ones((m, n)))
        by_motor = sp.kron(np.ones((horizon, 1)), sp.identity(n))
        by_kind = np.tile([[float(kind == one) for one in self._kinds] for kind in kinds], (horizon, 1))
        slacks = n + len(self._kinds)
        blocks: list[list[Any]] = [
            [matrix[: 2 * size], None, None],
            [angles, -by_motor, None],
            [angles, by_motor, None],
            *([[poses, None, sp.csc_matrix(-by_kind)]] if m else []),
            [None, sp.identity(n), None],
            *([[None, None, sp.identity(len(self._kinds))]] if m else []),
        ]
        extended = sp.csc_matrix(sp.bmat([row[: 3 if m else 2] for row in blocks]))
        extended.sort_indices()
        self._data = extended.data.copy()
        column = np.repeat(np.arange(extended.shape[1]), np.diff(extended.indptr))
        first = 4 * size
        changing = (extended.indices >= first) & (extended.indices < first + horizon * m) & (column < size)
        self._changing = np.flatnonzero(changing)
        self._rows, self._columns = extended.indices[changing] - first, column[changing]
        bounds = {"rate": size, "rate change": size, "angle": 2 * size}
        self._groups = np.array([name for name, count in bounds.items() for _ in range(count)] + list(kinds) * horizon)
        self._solver = QPSolver(extended, tuning.tolerance, tuning.max_iterations)
        self._slack_columns = slacks

    def reset(self) -> None:
        """Start afresh."""
        self._solver.reset()

    def solve(
        self,
        qp: QuadraticProgram,
        x: np.ndarray,
        models: Sequence[LinearModel],
        limits: LinearLimits | None,
        *,
        soft_angles: bool,
        warm: np.ndarray | None = None,
    ) -> Limited:
        """Solve ``qp`` with limits of poses and, if so wanted, with its angle limits softened.

        Raises
        ------
        InfeasibleError
            As `QPSolver.solve`.
        """
        n, size, slacks = self._n, self._size, self._slack_columns
        below, above = np.full(size, -np.inf), np.full(size, np.inf)
        pose_bounds = np.empty(0)
        matrix = None
        if self._kinds:
            assert limits is not None
            response, pose_bounds = self._poses(x, models, limits)
            self._data[self._changing] = response[self._rows, self._columns]
            matrix = self._data
        most = np.append(np.full(n, np.inf if soft_angles else 0.0), np.full(slacks - n, np.inf))
        # The new columns of the upper triangle: zeros, and a little curvature on the diagonal.
        columns = [np.append(np.zeros(size + i), _CURVATURE * self._penalty) for i in range(slacks)]
        hard, angles = slice(0, 2 * size), slice(2 * size, None)
        self._solver.update(
            np.concatenate([qp.P, *columns]),
            np.append(qp.q, np.full(slacks, self._penalty * self._dt)),
            np.concatenate([qp.l[hard], below, qp.l[angles], np.full(len(pose_bounds), -np.inf), np.zeros(slacks)]),
            np.concatenate([qp.u[hard], qp.u[angles], above, pose_bounds, most]),
            matrix,
        )
        if warm is not None:
            self._solver.warm_start(np.append(warm, np.zeros(slacks)))
        solution = self._solver.solve()
        given = self._dt * solution.x[size:]
        slack = {} if given[:n].max() <= _SLACK_SEEN else {"angle": float(given[:n].max())}
        for kind, amount in zip(self._kinds, given[n:].tolist(), strict=True):
            if amount > _SLACK_SEEN:
                assert limits is not None
                slack[kind] = amount * float(limits.scale[limits.kinds.index(kind)])
        return Limited(solution.x[:size], None, slack, active_kinds(solution.y, self._groups), solution)

    def _poses(
        self, x: np.ndarray, models: Sequence[LinearModel], limits: LinearLimits
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows of C x_k + d <= 0 over all periods as (rows) U <= (bounds), both over dt."""
        n, horizon, m = self._n, self._horizon, len(limits.d)
        response = np.zeros((len(x), self._size))
        rows, bounds = np.empty((horizon * m, self._size)), np.empty(horizon * m)
        for k in range(horizon):
            model = models[k] if len(models) > 1 else models[0]
            response = model.A @ response
            response[:, k * n : (k + 1) * n] = model.B
            x = model.A @ x + model.c
            rows[k * m : (k + 1) * m] = limits.C @ response
            bounds[k * m : (k + 1) * m] = -(limits.C @ x + limits.d)
        return rows / self._dt, bounds / self._dt


def active_kinds(y: np.ndarray, groups: np.ndarray) -> tuple[str, ...]:
    """Kinds of limits that have a multiplier; ``groups`` names the kind of each row, and may be shorter than y."""
    y = np.abs(y[: len(groups)])
    largest = float(y.max(initial=0.0))
    if largest < 1e-9:
        return ()
    return tuple(dict.fromkeys(groups[y > 1e-6 * largest].tolist()))
