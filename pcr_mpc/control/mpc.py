"""Linear model-predictive control: predict with linear models, solve a QP, apply the first input."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import control
import numpy as np

from ..errors import InfeasibleError, checked_vector
from ..frozen import freeze
from ..linearisation.linear_model import LinearModel
from .osqp_solver import QPSolver, Solution
from .qp import QuadraticProgram, Reference, build_qp, constraint_matrix, model_sequence
from .softened import SoftenedQP
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
        "solved", or what went wrong.
    fallback : {None, "softened", "shifted_plan", "lqr", "hold"}
        Rung of the ladder that answered instead (see `LinearMPC`).
    slack : float
        By how much the angle limits had to give [rad].
    iterations : int
        Of OSQP.
    primal_residual, dual_residual : float
        Recomputed from the QP's data; NaN if unsolved.
    update_time, solve_time : float
        Assembling the QP, and handing it over and solving it [s].
    """

    inputs: np.ndarray
    x: np.ndarray
    models: LinearModel | Sequence[LinearModel] | None
    status: str
    fallback: str | None
    slack: float
    iterations: int
    primal_residual: float
    dual_residual: float
    update_time: float
    solve_time: float

    def __post_init__(self) -> None:
        freeze(self)

    @cached_property
    def states(self) -> np.ndarray:
        """Predicted states, the current one first, shape (N + 1, 4 + n)."""
        if self.models is None:
            raise ValueError(f"no model to predict with: {self.status}")
        states = [self.x]
        for k, u in enumerate(self.inputs):
            model = self.models if isinstance(self.models, LinearModel) else self.models[k]
            states.append(model(states[-1], u))
        return np.array(states)


class LinearMPC:
    """Tracks a reference with a linear model and hard limits on the motors.

    It remembers the solver's workspace and the last plan; `reset` forgets both. Every call answers, and says how:
    the QP solved; softened, where its angle limits cannot be kept; else the last plan moved on by one period, as long
    as it lasts; else the LQR of the terminal weight, clipped to the limits; else the motors brought to rest.
    (With ``fallback = "raise"`` in the tuning only the first answer counts.)

    Parameters
    ----------
    tuning : Tuning
    limits : Limits
    """

    def __init__(self, tuning: Tuning, limits: Limits) -> None:
        self.tuning = tuning
        self.limits = limits
        self._workspace: _Workspace | None = None
        self._terminal_weight: np.ndarray | None = None
        self._gain: np.ndarray | None = None
        self._last: Plan | None = None
        self._age = 0  # periods since the last plan was solved

    def reset(self) -> None:
        """Start afresh: the same calls then give the same plans, bit for bit."""
        self._last, self._age = None, 0
        self._terminal_weight = None
        if self._workspace is not None:
            self._workspace.reset()

    def prepare(self, model: LinearModel) -> None:
        """Take the terminal weight from ``model`` and build the solvers; else the first `solve` does it."""
        self._gain, self._terminal_weight = _riccati(model, self.tuning)
        self._dt = model.dt
        if self._workspace is None:
            self._workspace = _Workspace(self.tuning, model)

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
            The QP was not solved, and the tuning asks to raise; or the model has no terminal weight.
        ValueError
            Names an argument that is not finite or of the wrong shape; the controller is as it was before.
        """
        began = time.perf_counter()
        first = model_sequence(models, self.tuning.horizon)[0]
        n_states, n = first.B.shape
        x, u_previous = checked_vector("x", x, n_states), checked_vector("u_previous", u_previous, n)
        if self._terminal_weight is None or self._workspace is None:
            self.prepare(first)
        assert self._terminal_weight is not None
        assert self._workspace is not None
        self._workspace.require(first)
        qp = build_qp(x, models, reference, u_previous, self.tuning, self.limits, self._terminal_weight)
        warm = None if self._last is None else _shifted(self._last.inputs).ravel()
        updated = time.perf_counter()
        fallback, slack = None, 0.0
        try:
            solution = self._workspace.solve(qp, warm)
            inputs, status = solution.x, "solved"
        except InfeasibleError as error:
            if self.tuning.fallback == "raise":
                raise
            status = error.status
            try:
                softened = self._workspace.softened.solve(qp)
            except InfeasibleError as again:
                return self.fall_back(f"{status}; softened: {again.status}", x, reference, u_previous)
            fallback, solution = "softened", softened.solution
            inputs, slack = softened.inputs, float(softened.slack.max())
        solved = time.perf_counter()
        inputs = inputs.reshape(-1, n)
        inputs[0] = self._clipped(inputs[0], u_previous)
        self._age = 0
        self._last = Plan(
            inputs=inputs,
            x=x.copy(),
            models=models,
            status=status,
            fallback=fallback,
            slack=slack,
            iterations=solution.iterations,
            primal_residual=solution.primal_residual,
            dual_residual=solution.dual_residual,
            update_time=updated - began,
            solve_time=solved - updated,
        )
        return self._last

    def fall_back(self, status: str, x: np.ndarray, reference: Reference, u_previous: np.ndarray) -> Plan:
        """Answer without a QP: because it was not solved, or because there is no model or no measurement.

        Parameters
        ----------
        status : str
            What went wrong.
        x, reference, u_previous
            As for `solve`; x may be NaN.
        """
        n = len(u_previous)
        inputs = np.zeros((self.tuning.horizon, n))
        if self._last is not None and self._age < self.tuning.horizon - 1:
            fallback = "shifted_plan"
            inputs = _shifted(self._last.inputs)
        elif self._gain is not None and np.isfinite(x).all():
            fallback = "lqr"
            # Where the reference is now, one period before its first state.
            wanted, dt = reference.states[0].copy(), self._dt
            wanted[:2] -= dt * wanted[2:4]
            wanted[4:] -= dt * reference.inputs[0]
            u = reference.inputs[0] - self._gain @ (x - wanted)
            inputs[0] = np.clip(u, (self.limits.angle_lower - x[4:]) / dt, (self.limits.angle_upper - x[4:]) / dt)
        else:
            fallback = "hold"
        inputs[0] = self._clipped(inputs[0], u_previous)
        if fallback == "shifted_plan":
            inputs[-1] = self._clipped(np.zeros(n), inputs[-2] if len(inputs) > 1 else inputs[0])
        else:
            for k in range(1, len(inputs)):
                inputs[k] = self._clipped(np.zeros(n), inputs[k - 1])
        self._age += 1
        self._last = Plan(
            inputs=inputs,
            x=np.array(x),
            models=None if self._last is None else self._last.models,
            status=status,
            fallback=fallback,
            slack=0.0,
            iterations=0,
            primal_residual=np.nan,
            dual_residual=np.nan,
            update_time=0.0,
            solve_time=0.0,
        )
        return self._last

    def _clipped(self, u: np.ndarray, u_previous: np.ndarray) -> np.ndarray:
        """Meet the limits on rate and change exactly; OSQP meets them to its tolerance."""
        rate, change = self.limits.rate, self.limits.rate_change
        within = np.minimum(np.maximum(u, u_previous - change), u_previous + change)
        return np.asarray(np.minimum(np.maximum(within, -rate), rate))


class _Workspace:
    """Solvers for the same problem: one knows the limits on the rates alone, one knows all, one has some softened."""

    def __init__(self, tuning: Tuning, model: LinearModel) -> None:
        self.n, self.dt = model.B.shape[1], model.dt
        self._tolerance = tuning.tolerance
        matrix = constraint_matrix(tuning.horizon, self.n)
        self._dense = matrix.toarray()
        self.complete = QPSolver(matrix, tuning.tolerance, tuning.max_iterations)
        self.rates_only = QPSolver(matrix[: matrix.shape[1]].tocsc(), tuning.tolerance, tuning.max_iterations)
        self.softened = SoftenedQP(tuning, matrix, self.n, self.dt)

    def reset(self) -> None:
        """Start afresh."""
        for solver in (self.rates_only, self.complete, self.softened):
            solver.reset()

    def require(self, model: LinearModel) -> None:
        """Raise if the model is for another robot or period."""
        if (model.B.shape[1], model.dt) != (self.n, self.dt):
            raise ValueError(
                f"model has {model.B.shape[1]} motors and dt = {model.dt} s, but this controller was built for "
                f"{self.n} and {self.dt} s; make a new one"
            )

    def solve(self, qp: QuadraticProgram, warm: np.ndarray | None) -> Solution:
        """Solve with the rates' rows alone; where that breaks another row, or fails, with all of them.

        An optimum of the smaller problem that keeps the left-out rows is the optimum of the whole, and costs half;
        its multipliers are those of the rates' rows, the others being zero.
        """
        n_rates, spent = self.rates_only.m, 0
        try:
            self.rates_only.update(qp.P, qp.q, qp.l[:n_rates], qp.u[:n_rates])
            if warm is not None:
                self.rates_only.warm_start(warm)
            solution = self.rates_only.solve()
        except InfeasibleError as error:
            spent = error.details.get("iterations", 0)
        else:
            rows = self._dense @ solution.x
            broken = max(float((qp.l - rows).max()), float((rows - qp.u).max()), 0.0)
            if broken <= self._tolerance:
                return replace(solution, primal_residual=broken)
            spent, warm = solution.iterations, solution.x
        self.complete.update(qp.P, qp.q, qp.l, qp.u)
        if warm is not None:
            self.complete.warm_start(warm)
        solution = self.complete.solve()
        return replace(solution, iterations=spent + solution.iterations)


def terminal_weight(model: LinearModel, tuning: Tuning) -> np.ndarray:
    """Cost-to-go of the unconstrained LQR with the tuning's weights, shape (4 + n, 4 + n)."""
    return _riccati(model, tuning)[1]


def _riccati(model: LinearModel, tuning: Tuning) -> tuple[np.ndarray, np.ndarray]:
    """Gain (n, 4 + n) and cost-to-go (4 + n, 4 + n) of the unconstrained LQR."""
    n_states, n = model.B.shape
    # A little weight on the angles keeps the Riccati equation solvable where the tip does not see them all
    # (more than two motors), and changes the gains by less than 0.1 %.
    angle = max(tuning.angle_weight, 1e-6 * tuning.position_weight)
    stage = np.diag([tuning.position_weight] * 2 + [tuning.velocity_weight] * 2 + [angle] * (n_states - 4))
    gain, cost, _ = control.dlqr(model.A, model.B, stage, tuning.input_weight * np.eye(n))
    return np.asarray(gain), np.asarray(cost)


def _shifted(inputs: np.ndarray) -> np.ndarray:
    return np.concatenate([inputs[1:], inputs[-1:]])


__all__ = ["LinearMPC", "Plan", "Reference", "terminal_weight"]
