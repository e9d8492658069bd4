"""Linear model-predictive control: predict with linear models, solve a QP, apply the first input."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import control
import numpy as np

from ..errors import InfeasibleError, checked_array, checked_vector
from ..linearisation.linear_limits import LinearLimits
from ..linearisation.linear_model import LinearModel
from .limited_qp import Limited, LimitedQP, active_kinds
from .osqp_solver import QPSolver
from .plan import Plan
from .qp import QuadraticProgram, Reference, Rollout, assemble, constraint_matrix, model_sequence
from .tuning import Limits, Tuning

_FEWEST_ITERATIONS = 10  # with which OSQP is tried at all


class LinearMPC:
    """Tracks a reference with a linear model, hard limits on the motors and soft ones on the pose.

    It remembers the solver's workspace and the last plan; `reset` forgets both. Every call answers, and says how:
    the QP solved; softened, where a pose's limits or, from beyond them, the angles' cannot be kept; else the last plan
    moved on by one period, as long as it lasts; else the LQR of the terminal weight, clipped to the limits; else the
    motors brought to rest. (With ``fallback = "raise"`` in the tuning only the first two count.)

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

    def prepare(self, model: LinearModel, combinations: Sequence[tuple[str, ...]] = ()) -> None:
        """Take the terminal weight from ``model`` and build the solvers; else the first `solve` does it.

        ``combinations`` are the kinds that the `LinearLimits` to come may have.
        """
        self._gain, self._terminal_weight = riccati(model, self.tuning)
        self._dt = model.dt
        if self._workspace is None:
            self._workspace = _Workspace(self.tuning, model)
        for kinds in ((), *combinations):
            self._workspace.limited(kinds)

    def solve(
        self,
        x: np.ndarray,
        models: LinearModel | Sequence[LinearModel],
        reference: Reference,
        u_previous: np.ndarray,
        pose_limits: LinearLimits | None = None,
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
        pose_limits : LinearLimits, optional
            To be kept at the end of every period, if they can be.

        Raises
        ------
        InfeasibleError
            The QP was not solved, and the tuning asks to raise; or the model has no terminal weight.
        ValueError
            Names an argument that is not finite or of the wrong shape; the controller is as it was before.
        """
        began = time.perf_counter()
        sequence = model_sequence(models, self.tuning.horizon)
        first = sequence[0]
        n_states, n = first.B.shape
        x, u_previous = checked_vector("x", x, n_states), checked_vector("u_previous", u_previous, n)
        horizon = self.tuning.horizon
        wanted = checked_array("reference.states", reference.states, (horizon, n_states))
        feed_forward = checked_array("reference.inputs", reference.inputs, (horizon, n))
        if self._terminal_weight is None or self._workspace is None:
            self.prepare(first)
        assert self._terminal_weight is not None
        assert self._workspace is not None
        self._workspace.require(sequence)
        window = Reference(wanted, feed_forward)
        qp = assemble(x, sequence, window, u_previous, self.tuning, self.limits, self._terminal_weight)
        warm = None if self._last is None else _shifted(self._last.inputs).ravel()
        updated = time.perf_counter()
        status, fallback = "solved", None
        try:
            answer = self._workspace.solve(qp, x, sequence, pose_limits, self.limits, warm)
        except InfeasibleError as error:
            if self.tuning.fallback == "raise":
                raise
            status, fallback = error.status, "softened"
            try:
                answer = self._workspace.soften(qp, x, sequence, pose_limits)
            except InfeasibleError as again:
                return self.fall_back(f"{status}; softened: {again.status}", x, reference, u_previous)
        if answer.slack and fallback is None:
            status, fallback = f"cannot keep {', '.join(answer.slack)}", "softened"
        solved = time.perf_counter()
        inputs = answer.inputs.reshape(-1, n)
        # OSQP keeps limits to its tolerance, this keeps them exactly.
        inside = inputs[0] if fallback else self.limits.within_stops(inputs[0], x[4:], first.dt)
        first_rates = self.limits.clipped(inside, u_previous)
        states = answer.states
        if states is None or inputs[0].tolist() != first_rates.tolist():
            inputs[0] = first_rates
            states = self._workspace.rollout(x, sequence, inputs)
        self._age = 0
        self._last = Plan(
            inputs=inputs,
            states=states,
            models=models,
            status=status,
            fallback=fallback,
            active=answer.active,
            slack=answer.slack,
            iterations=answer.solution.iterations,
            primal_residual=answer.solution.primal_residual,
            dual_residual=answer.solution.dual_residual,
            update_time=updated - began,
            solve_time=solved - updated,
            solver_time=answer.solution.run_time,
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
            inputs[0] = self.limits.within_stops(lqr_rates(self._gain, x, reference, self._dt), x[4:], self._dt)
        else:
            fallback = "hold"
        inputs[0] = wanted = self.limits.clipped(asked := inputs[0].copy(), u_previous)
        if fallback == "shifted_plan":
            inputs[-1] = self.limits.clipped(np.zeros(n), inputs[-2] if len(inputs) > 1 else inputs[0])
        else:
            for k in range(1, len(inputs)):
                inputs[k] = self.limits.clipped(np.zeros(n), inputs[k - 1])
        self._age += 1
        models, states = None, None
        if self._last is not None and self._last.models is not None and np.isfinite(x).all():
            assert self._workspace is not None
            models = self._last.models
            states = self._workspace.rollout(x, model_sequence(models, self.tuning.horizon), inputs)
        active = () if np.array_equal(wanted, asked) else self.limits.met_by(wanted, u_previous)
        self._last = Plan(inputs, states, models, status, fallback, active)
        return self._last


class _Workspace:
    """Solvers for the same problem: one knows the limits on the rates alone, the others all of them."""

    def __init__(self, tuning: Tuning, model: LinearModel) -> None:
        self.n, self.dt = model.B.shape[1], model.dt
        self._tuning = tuning
        rates = constraint_matrix(tuning.horizon, self.n)[: 2 * tuning.horizon * self.n].tocsc()
        self._rates_only = QPSolver(rates, tuning.tolerance, tuning.max_iterations)
        self._groups = np.repeat(["rate", "rate change"], tuning.horizon * self.n)
        self._limited: dict[tuple[str, ...], LimitedQP] = {}
        self._limits_matter = False  # in the last plan, beside those on the rates
        self._spent, self._inside = 0, 0.0  # iterations and seconds of OSQP in this control step
        self.rollout = Rollout(tuning.horizon, self.n)

    def limited(self, kinds: tuple[str, ...]) -> LimitedQP:
        """Solver for limits of these kinds, made once."""
        if kinds not in self._limited:
            self._limited[kinds] = LimitedQP(self._tuning, self.n, self.dt, kinds)
        return self._limited[kinds]

    def reset(self) -> None:
        """Start afresh."""
        self._limits_matter = False
        self._rates_only.reset()
        for solver in self._limited.values():
            solver.reset()

    def require(self, models: Sequence[LinearModel]) -> None:
        """Raise if a model is for another robot or period."""
        for model in models:
            if (model.B.shape[1], model.dt) == (self.n, self.dt):
                continue
            raise ValueError(
                f"model has {model.B.shape[1]} motors and dt = {model.dt} s, but this controller was built for "
                f"{self.n} and {self.dt} s; make a new one"
            )

    def solve(
        self,
        qp: QuadraticProgram,
        x: np.ndarray,
        models: Sequence[LinearModel],
        pose_limits: LinearLimits | None,
        limits: Limits,
        warm: np.ndarray | None,
    ) -> Limited:
        """Solve with the rates' rows alone; where that breaks another limit, or fails, with all of them.

        An optimum of the smaller problem that keeps the left-out rows is the optimum of the whole, and costs half;
        its multipliers are those of the rates' rows, the others being zero. While other limits shape the plans, the
        whole is solved at once.
        """
        self._spent, self._inside = 0, 0.0
        if not self._limits_matter:
            n_rates = self._rates_only.m
            try:
                self._rates_only.update(qp.P, qp.q, qp.l[:n_rates], qp.u[:n_rates])
                if warm is not None:
                    self._rates_only.warm_start(warm)
                solution = self._rates_only.solve()
            except InfeasibleError as error:
                self._count(error)
            else:
                states = self.rollout(x, models, solution.x)
                angles = states[1:, 4:]
                broken = max(float((limits.angle_lower - angles).max()), float((angles - limits.angle_upper).max()))
                if pose_limits is not None:
                    rows = states[1:] @ pose_limits.C.T
                    broken = max(
                        broken, float((pose_limits.lower - rows).max()), float((rows - pose_limits.upper).max())
                    )
                if broken <= self._tuning.tolerance * self.dt:
                    return Limited(solution.x, states, {}, active_kinds(solution.y, self._groups), solution)
                self._spent, self._inside, warm = solution.iterations, solution.run_time, solution.x
        return self._solve_whole(qp, x, models, pose_limits, warm, soft_angles=False)

    def soften(
        self, qp: QuadraticProgram, x: np.ndarray, models: Sequence[LinearModel], pose_limits: LinearLimits | None
    ) -> Limited:
        """Solve with the angle limits softened too, with the iterations that `solve` has left."""
        return self._solve_whole(qp, x, models, pose_limits, None, soft_angles=True)

    def _solve_whole(
        self,
        qp: QuadraticProgram,
        x: np.ndarray,
        models: Sequence[LinearModel],
        pose_limits: LinearLimits | None,
        warm: np.ndarray | None,
        soft_angles: bool,
    ) -> Limited:
        kinds = () if pose_limits is None else pose_limits.kinds
        left = self._tuning.max_iterations - self._spent
        if left < _FEWEST_ITERATIONS:
            raise InfeasibleError(
                f"the {self._tuning.max_iterations} iterations allowed are spent", status="maximum iterations reached",
                iterations=self._spent, limit=None,
            )  # fmt: skip
        try:
            answer = self.limited(kinds).solve(
                qp, x, models, pose_limits, soft_angles=soft_angles, warm=warm, most=left
            )
        except InfeasibleError as error:
            self._count(error)
            raise
        self._spent += answer.solution.iterations
        self._inside += answer.solution.run_time
        self._limits_matter = not set(answer.active) <= {"rate", "rate change"}
        solution = replace(answer.solution, iterations=self._spent, run_time=self._inside)
        return replace(answer, solution=solution)

    def _count(self, error: InfeasibleError) -> None:
        self._spent += error.details.get("iterations", 0)
        self._inside += error.details.get("run_time", 0.0)


def terminal_weight(model: LinearModel, tuning: Tuning) -> np.ndarray:
    """Cost-to-go of the unconstrained LQR with the tuning's weights, shape (4 + n, 4 + n)."""
    return riccati(model, tuning)[1]


def riccati(model: LinearModel, tuning: Tuning) -> tuple[np.ndarray, np.ndarray]:
    """Gain (n, 4 + n) and cost-to-go (4 + n, 4 + n) of the unconstrained LQR."""
    n_states, n = model.B.shape
    # A little weight on the angles keeps the Riccati equation solvable where the tip does not see them all
    # (more than two motors), and changes the gains by less than 0.1 %.
    angle = max(tuning.angle_weight, 1e-6 * tuning.position_weight)
    stage = np.diag([tuning.position_weight] * 2 + [tuning.velocity_weight] * 2 + [angle] * (n_states - 4))
    gain, cost, _ = control.dlqr(model.A, model.B, stage, tuning.input_weight * np.eye(n))
    return np.asarray(gain), np.asarray(cost)


def lqr_rates(gain: np.ndarray, x: np.ndarray, reference: Reference, dt: float) -> np.ndarray:
    """Rates of the LQR about where the reference is now, one period before its first state, shape (n,) [rad/s]."""
    wanted = reference.states[0].copy()
    wanted[:2] -= dt * wanted[2:4]
    wanted[4:] -= dt * reference.inputs[0]
    return np.asarray(reference.inputs[0] - gain @ (x - wanted))


def _shifted(inputs: np.ndarray) -> np.ndarray:
    return np.concatenate([inputs[1:], inputs[-1:]])
