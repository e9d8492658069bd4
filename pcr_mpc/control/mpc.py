"""Linear model-predictive control: predict with linear models, solve a QP, apply the first input."""

from __future__ import annotations

import time
from collections.abc import Sequence

import control
import numpy as np

from ..errors import InfeasibleError, checked_array, checked_vector
from ..linearisation.linear_limits import LinearLimits
from ..linearisation.linear_model import LinearModel
from .plan import Plan
from .qp import Reference, assemble, model_sequence
from .tuning import Limits, Tuning
from .workspace import Workspace


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
        self._workspace: Workspace | None = None
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
            self._workspace = Workspace(self.tuning, model)
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


def terminal_weight(model: LinearModel, tuning: Tuning) -> np.ndarray:
    """Cost-to-go of the unconstrained LQR with the tuning's weights, shape (4 + n, 4 + n)."""
    return riccati(model, tuning)[1]


_UNSEEN = 7.7e-5  # weight on angles that the tip does not see, over that on the way that they move it


def riccati(model: LinearModel, tuning: Tuning) -> tuple[np.ndarray, np.ndarray]:
    """Gain (n, 4 + n) and cost-to-go (4 + n, 4 + n) of the unconstrained LQR.

    The equation is solved in the model's own units, the way of the tip per radian and the period, in which similar
    robots have the same numbers.
    """
    n_states, n = model.B.shape
    reach = model.reach
    units = np.array([reach] * 2 + [reach / model.dt] * 2 + [1.0] * (n_states - 4))
    # A little weight on the angles keeps the Riccati equation solvable where the tip does not see them all
    # (more than two motors), and changes the gains by less than 0.1 %.
    position = tuning.position_weight * reach**2
    angle = max(tuning.angle_weight, _UNSEEN * position)
    velocity = tuning.velocity_weight * (reach / model.dt) ** 2
    stage = np.diag([position] * 2 + [velocity] * 2 + [angle] * (n_states - 4))
    a, b = model.A * units / units[:, None], model.B / units[:, None] / model.dt
    gain, cost, _ = control.dlqr(a, b, stage / position, tuning.input_weight / (position * model.dt**2) * np.eye(n))
    return np.asarray(gain) / units / model.dt, position * np.asarray(cost) / np.outer(units, units)


def lqr_rates(gain: np.ndarray, x: np.ndarray, reference: Reference, dt: float) -> np.ndarray:
    """Rates of the LQR about where the reference is now, one period before its first state, shape (n,) [rad/s]."""
    wanted = reference.states[0].copy()
    wanted[:2] -= dt * wanted[2:4]
    wanted[4:] -= dt * reference.inputs[0]
    return np.asarray(reference.inputs[0] - gain @ (x - wanted))


def _shifted(inputs: np.ndarray) -> np.ndarray:
    return np.concatenate([inputs[1:], inputs[-1:]])
