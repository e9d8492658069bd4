"""The QP with its angle limits softened: for a start that already breaks them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from .osqp_solver import QPSolver, Solution
from .qp import QuadraticProgram
from .tuning import Tuning

# An exact penalty: more than any multiplier of the hard problem, per m^2 of position weight.
_PENALTY = 0.3
_CURVATURE = 1e-6  # of the slack's cost, relative to the penalty: the QP stays strictly convex


@dataclass(frozen=True, eq=False)
class Softened:
    """A solution and what it cost in limits.

    Attributes
    ----------
    inputs : ndarray, shape (N n,)
    slack : ndarray, shape (n,)
        By how much each motor's angle limits had to give [rad].
    solution : Solution
        Of the extended QP.
    """

    inputs: np.ndarray
    slack: np.ndarray
    solution: Solution


class SoftenedQP:
    """Rates and their changes stay hard; the angle of motor i may break its limits by s_i >= 0 at a cost w s_i.

    The penalty is exact: where the hard problem has a solution, this one has the same.

    Parameters
    ----------
    tuning : Tuning
    matrix : scipy.sparse.csc_matrix, shape (3 N n, N n)
        Rows of the hard problem, see `qp.constraint_matrix`.
    n : int
        Motors.
    dt : float
        Control period [s].
    """

    def __init__(self, tuning: Tuning, matrix: sp.csc_matrix, n: int, dt: float) -> None:
        size = matrix.shape[1]
        self._n, self._dt, self._hard = n, dt, 2 * size
        self._penalty = _PENALTY * tuning.position_weight
        hard, angles = matrix[: self._hard], matrix[self._hard :]
        slacks = sp.kron(np.ones((tuning.horizon, 1)), sp.identity(n))
        beside = [sp.csc_matrix((self._hard, n)), -slacks, slacks]
        rows = [sp.hstack(pair) for pair in zip((hard, angles, angles), beside, strict=True)]
        extended = sp.csc_matrix(sp.vstack([*rows, sp.hstack([sp.csc_matrix((n, size)), sp.identity(n)])]))
        extended.sort_indices()
        self._solver = QPSolver(extended, tuning.tolerance, tuning.max_iterations)

    def reset(self) -> None:
        """Start afresh."""
        self._solver.reset()

    def solve(self, qp: QuadraticProgram) -> Softened:
        """Solve the softened version of ``qp``; raises InfeasibleError as `QPSolver.solve`."""
        n, hard = self._n, self._hard
        size = len(qp.q)
        # The new columns of the upper triangle: zeros, and a little curvature on the diagonal.
        columns = [np.append(np.zeros(size + i), _CURVATURE * self._penalty) for i in range(n)]
        below, above = np.full(size, -np.inf), np.full(size, np.inf)
        self._solver.update(
            np.concatenate([qp.P, *columns]),
            np.append(qp.q, np.full(n, self._penalty * self._dt)),
            np.concatenate([qp.l[:hard], below, qp.l[hard:], np.zeros(n)]),
            np.concatenate([qp.u[:hard], qp.u[hard:], above, np.full(n, np.inf)]),
        )
        solution = self._solver.solve()
        return Softened(solution.x[:size], self._dt * solution.x[size:], solution)
