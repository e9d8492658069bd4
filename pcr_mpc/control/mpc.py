"""Linear model-predictive control: predict with linear models, solve a QP, apply the first input."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import control
import numpy as np

from ..errors import InfeasibleError
from ..linearisation.linear_model import LinearModel
from .osqp_solver import QPSolver, Solution
from .qp import QuadraticProgram, Reference, build_qp, constraint_matrix
from .tuning import Limits, Tuning


@dataclass(frozen=True, eq=False)
class Plan:
    """Result of one control step.

    Attributes
    ----------
    inputs : ndarray, shape (N, n)
        Motor rates; the first row is to be applied [rad/s].
    x : ndarray, shape (4 + n,)
        State it starts from.
    models : LinearModel or sequence of N
        What it was predicted with.
    status : str
        "solved", or the solver's word for what went wrong.
    fallback : str or None
        What replaced an unsolved QP.
    iterations : int
        Of OSQP.
    primal_residual, dual_residual : float
        Recomputed from the QP's data; NaN if unsolved.
    update_time, solve_time : float
        Assembling the QP, and handing it over and solving it [s].
    """

    inputs: np.ndarray
    x: np.ndarray
    models: LinearModel | Sequence[LinearModel]
    status: str
    fallback: str | None
    iterations: int
    primal_residual: float
    dual_residual: float
    update_time: float
    solve_time: float

    @cached_property
    def states(self) -> np.ndarray:
        """Predicted states, the current one first, shape (N + 1, 4 + n)."""
        states = [self.x]
        for k, u in enumerate(self.inputs):
            model = self.models if isinstance(self.models, LinearModel) else self.models[k]
            states.append(model(states[-1], u))
        return np.array(states)


class LinearMPC:
    """Tracks a reference with a linear model and hard limits on the motors.

    It remembers the solver's workspace and the last plan; `reset` forgets both.

    Parameters
    ----------
    tuning : Tuning
    limits : Limits
    """

    def __init__(self, tuning: Tuning, limits: Limits) -> None:
        self.tuning = tuning
        self.limits = limits
        self._rates_only: QPSolver | None = None
        self._solver: QPSolver | None = None
        self._dense = np.empty((0, 0))
        self._terminal_weight: np.ndarray | None = None
        self._last: Plan | None = None

    def reset(self) -> None:
        """Start afresh: the same calls then give the same plans, bit for bit."""
        self._last = None
        self._terminal_weight = None
        for solver in (self._rates_only, self._solver):
            if solver is not None:
                solver.reset()

    def solve(
        self,
        x: np.ndarray,
        models: LinearModel | Sequence[LinearModel],
        reference: Reference,
        u_previous: np.ndarray,
    ) -> Plan:
        """Plan the motor rates over the horizon.

        Parameters
        ----------
        x : ndarray, shape (4 + n,)
            Current state.
        models : LinearModel or sequence of N
            Predicts from x; the first one also sets the terminal weight on the first call after a reset.
        reference : Reference
            Over the horizon.
        u_previous : ndarray, shape (n,)
            Rates applied in the last period [rad/s].

        Raises
        ------
        InfeasibleError
            The QP was not solved, and the tuning asks to raise or there is no earlier plan to fall back to.
        """
        began = time.perf_counter()
        first = models if isinstance(models, LinearModel) else models[0]
        n = first.B.shape[1]
        if self._terminal_weight is None:
            self._terminal_weight = terminal_weight(first, self.tuning)
        if self._solver is None or self._rates_only is None:
            matrix = constraint_matrix(self.tuning.horizon, n, first.dt)
            settings = self.tuning.tolerance, self.tuning.max_iterations
            self._dense = matrix.toarray()
            self._solver = QPSolver(matrix, *settings)
            self._rates_only = QPSolver(matrix[: matrix.shape[1]].tocsc(), *settings)
        qp = build_qp(x, models, reference, u_previous, self.tuning, self.limits, self._terminal_weight)
        warm = None if self._last is None else _shifted(self._last.inputs).ravel()
        updated = time.perf_counter()
        try:
            solution = self._solve(qp, self._rates_only, self._solver, warm)
        except InfeasibleError as error:
            self._last = self._fall_back(error, x, models, time.perf_counter() - began)
            return self._last
        solved = time.perf_counter()
        inputs = solution.x.reshape(-1, n)
        # OSQP meets bounds to its tolerance; what is applied meets them exactly.
        first_change = n * len(inputs)
        lower = np.maximum(qp.l[:n], qp.l[first_change : first_change + n])
        upper = np.minimum(qp.u[:n], qp.u[first_change : first_change + n])
        inputs[0] = np.minimum(np.maximum(inputs[0], lower), upper)
        self._last = Plan(
            inputs=inputs,
            x=x.copy(),
            models=models,
            status="solved",
            fallback=None,
            iterations=solution.iterations,
            primal_residual=solution.primal_residual,
            dual_residual=solution.dual_residual,
            update_time=updated - began,
            solve_time=solved - updated,
        )
        return self._last

    def _solve(
        self, qp: QuadraticProgram, rates_only: QPSolver, complete: QPSolver, warm: np.ndarray | None
    ) -> Solution:
        """Solve with the rates' rows alone; where that breaks another row, with all of them.

        An optimum of the smaller problem that keeps the left-out rows is the optimum of the whole, and costs half.
        """
        n_rates = rates_only.m
        rates_only.update(qp.P, qp.q, qp.l[:n_rates], qp.u[:n_rates])
        if warm is not None:
            rates_only.warm_start(warm)
        solution = rates_only.solve()
        rows = self._dense @ solution.x
        broken = max(float((qp.l - rows).max()), float((rows - qp.u).max()), 0.0)
        if broken <= self.tuning.tolerance:
            return Solution(solution.x, solution.y, solution.iterations, broken, solution.dual_residual)
        complete.update(qp.P, qp.q, qp.l, qp.u)
        complete.warm_start(solution.x)
        return complete.solve()

    def _fall_back(
        self, error: InfeasibleError, x: np.ndarray, models: LinearModel | Sequence[LinearModel], spent: float
    ) -> Plan:
        if self.tuning.fallback == "raise" or self._last is None:
            raise error
        return replace(
            self._last,
            inputs=_shifted(self._last.inputs),
            x=x.copy(),
            models=models,
            status=error.status,
            fallback="shifted_plan",
            iterations=error.details.get("iterations", 0),
            primal_residual=np.nan,
            dual_residual=np.nan,
            update_time=spent,
            solve_time=0.0,
        )


def terminal_weight(model: LinearModel, tuning: Tuning) -> np.ndarray:
    """Cost-to-go of the unconstrained LQR with the tuning's weights, shape (4 + n, 4 + n)."""
    n_states, n = model.B.shape
    # A little weight on the angles keeps the Riccati equation solvable where the tip does not see them all
    # (more than two motors), and changes nothing else.
    angle = max(tuning.angle_weight, 1e-6 * tuning.position_weight)
    stage = np.diag([tuning.position_weight] * 2 + [tuning.velocity_weight] * 2 + [angle] * (n_states - 4))
    _, cost, _ = control.dlqr(model.A, model.B, stage, tuning.input_weight * np.eye(n))
    return np.asarray(cost)


def _shifted(inputs: np.ndarray) -> np.ndarray:
    return np.concatenate([inputs[1:], inputs[-1:]])


__all__ = ["LinearMPC", "Plan", "Reference", "terminal_weight"]
