"""Linear model-predictive control: predict with linear models, solve a QP, apply the first input."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import solve_discrete_are

from ..errors import InfeasibleError, checked_array, checked_vector
from ..frozen import set_once
from ..linearisation.linear_limits import LinearLimits
from ..linearisation.linear_model import LinearModel, LinearModels
from .motor_limits import Limits
from .plan import Plan
from .qp.condensing import condensing
from .qp.program import QuadraticProgram, Reference, assemble, model_sequence
from .qp.workspace import Workspace
from .tuning import Tuning, time_unit

_NOT_OF_THE_PROBLEM = ("name", "fallback", "model", "observer", "pd", "period", "learning")  # fields of a tuning
# Between the sizes of one problem and the next: then the last one says nothing about this one.
_JUMP = 1e3
_LONG = 24  # periods
_POSES = 30.0  # at most between entries of linear models of one robot
_SLIGHT = 1e-6  # of the greatest rates: a gradient that asks for less is rounding


@set_once("call retune, which lets all of it take effect", "tuning")
class LinearMPC:
    """Tracks a reference with a linear model, hard limits on the motors and soft ones on the pose.

    It remembers the solver's workspace and the last plan; `reset` forgets both. Every call answers, and says how:
    the QP solved; softened, where a pose's limits or, from beyond them, the angles' cannot be kept; else the last plan
    moved on by one period, as long as it lasts; else the LQR of the terminal weight, clipped to the limits; else the
    motors brought to rest. (With ``fallback = "raise"`` in the tuning only the first two count.)

    It starts from the last solution where the problem is of the same kind. Where the sizes of the two differ by orders
    of magnitude, or the limits are others, it starts afresh, so that one absurd problem does not spoil the next.

    Parameters
    ----------
    tuning : Tuning
        See `retune`.
    limits : Limits
        May be replaced by others at any time.
    """

    def __init__(self, tuning: Tuning, limits: Limits) -> None:
        self.tuning = tuning
        self.limits = limits
        self._workspace: Workspace | None = None
        self._terminal_weight: np.ndarray | None = None
        self._gain: np.ndarray | None = None
        self._last: Plan | None = None
        self._age = math.inf  # periods since a plan was solved
        self._dt = 1.0  # of any model; until there is one, motors are only brought to rest
        self._prepared: tuple[LinearModel, Sequence[tuple[str, ...]]] | None = None
        self._first: LinearModel | None = None  # whose terminal weight it is, if nobody called prepare
        self._problem: tuple[Limits, float, float] | None = None  # limits and sizes of the last problem

    def reset(self) -> None:
        """Start afresh: the same calls then give the same plans, bit for bit."""
        self._gain = self._terminal_weight = self._first = self._prepared = None
        self._forget()

    def _forget(self) -> None:
        """Forget the last plan and its problem."""
        self._last, self._age, self._problem = None, math.inf, None
        if self._workspace is not None:
            self._workspace.reset()

    def prepare(self, model: LinearModel, combinations: Sequence[tuple[str, ...]] = ()) -> None:
        """Take the terminal weight from ``model`` and build the solvers; else the first `solve` does it.

        ``combinations`` are the kinds that the `LinearLimits` to come may have.
        """
        self._gain, self._terminal_weight = riccati(model, self.tuning)
        self._dt, self._first = model.dt, None
        self._prepared = model, combinations
        if self._workspace is None:
            self._workspace = Workspace(self.tuning, model)
        # For a long horizon a solver takes a second to set up: then those that are needed are made where they are.
        if self.tuning.horizon <= _LONG:
            for kinds in ((), *combinations):
                self._workspace.limited(kinds)

    def condensing(self, n: int, models: int, *, inline: bool = True) -> Any:
        """Graph that assembles the QP for n motors from 1 or N models (see `condensing`)."""
        tuning = self.tuning
        weighed = {"velocity": tuning.velocity_weight > 0, "angle": tuning.angle_weight > 0}
        return condensing(tuning.horizon, n, models, **weighed, inline=inline)

    @property
    def terminal(self) -> np.ndarray:
        """Terminal weight, from `prepare` on, shape (4 + n, 4 + n)."""
        assert self._terminal_weight is not None
        return self._terminal_weight

    def retune(self, tuning: Tuning) -> None:
        """Let another tuning take effect, all of it, between two steps.

        The next plan is that of a new controller, prepared as this one was; the rates of the last one remain, for a
        fall-back. It may take a second where there are graphs to build.
        """
        others = {name: getattr(self.tuning, name) for name in _NOT_OF_THE_PROBLEM}
        if replace(tuning, **others) == self.tuning:
            self.__dict__["tuning"] = tuning
            return
        new = LinearMPC(tuning, self.limits)
        if self._prepared is not None:
            new.prepare(*self._prepared)
            new._first = self._first
        if self._last is not None:
            new._last, new._age = self._last.spanning(tuning.horizon), self._age
        self.__dict__.update(new.__dict__)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle and copy as what it was made of; the copy starts afresh."""
        return type(self), (self.tuning, self.limits)

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
        n, n_states = sequence.n, 4 + sequence.n
        x, u_previous = checked_vector("x", x, n_states), checked_vector("u_previous", u_previous, n)
        horizon = self.tuning.horizon
        wanted = checked_array("reference.states", reference.states, (horizon, n_states))
        feed_forward = checked_array("reference.inputs", reference.inputs, (horizon, n))
        if self._first is not None and _another_robot(self._first, sequence[0]):
            self.reset()
        if self._terminal_weight is None or self._workspace is None:
            first = models if isinstance(models, LinearModel) else models[0]
            self.prepare(first)
            self._first = first
        assert self._terminal_weight is not None
        assert self._workspace is not None
        self._workspace.require(sequence)
        window = Reference(wanted, feed_forward)
        qp = assemble(x, sequence, window, u_previous, self.tuning, self.limits, self._terminal_weight)
        return self.decide(qp, x, sequence, window, u_previous, pose_limits, began, models)

    def decide(
        self,
        qp: QuadraticProgram,
        x: np.ndarray,
        models: LinearModels,
        reference: Reference,
        u_previous: np.ndarray,
        pose_limits: LinearLimits | None,
        began: float,
        told: LinearModel | Sequence[LinearModel] | None = None,
    ) -> Plan:
        """`solve` from the assembled QP on: `prepare` was called, and the arguments are right.

        Assembling ``began`` at that time of `time.perf_counter`; ``told`` are the models as the caller has them.
        """
        assert self._workspace is not None
        n = len(u_previous)
        hessian, gradient, _ = qp.sizes.tolist()
        if not self._continues(self.limits, hessian, gradient):
            self._forget()
        warm = None if self._last is None or self._problem is None else _shifted(self._last.inputs).reshape(-1)
        self._problem = self.limits, hessian, gradient
        updated = time.perf_counter()
        status, fallback = "solved", None
        try:
            answer = self._workspace.solve(qp, x, models, pose_limits, self.limits, warm)
        except InfeasibleError as error:
            if self.tuning.fallback == "raise":
                raise
            status, fallback = error.status, "softened"
            try:
                answer = self._workspace.soften(qp, x, models, pose_limits)
            except InfeasibleError as again:
                return self.fall_back(f"{status}; softened: {again.status}", x, reference, u_previous)
        if answer.slack and fallback is None:
            status, fallback = f"cannot keep {', '.join(answer.slack)}", "softened"
        solved = time.perf_counter()
        inputs, states = answer.inputs.reshape(-1, n), answer.states
        if not answer.kept:
            # OSQP keeps limits to its tolerance and within its horizon, this keeps them exactly and ever after.
            first_rates = self.limits.kept(inputs[0], u_previous, x[4:], models.dt)
            if states is None or inputs[0].tolist() != first_rates.tolist():
                inputs[0] = first_rates
                states = self._workspace.check.states(x, models, inputs)
        self._age = 0
        solution = answer.solution
        self._last = Plan.found({
            "inputs": inputs, "states": states, "models": models.copy() if told is None else told, "status": status,
            "fallback": fallback, "active": answer.active, "slack": answer.slack, "iterations": solution.iterations,
            "primal_residual": solution.primal_residual, "dual_residual": solution.dual_residual,
            "update_time": updated - began, "solve_time": solved - updated, "solver_time": solution.run_time,
        })  # fmt: skip
        return self._last

    def _continues(self, limits: Limits, hessian: float, gradient: float) -> bool:
        """Whether the last solution is a start for a problem of these sizes; NaN continues nothing."""
        if self._problem is None:
            return True
        before, last_hessian, last_gradient = self._problem
        if not (limits is before and hessian <= _JUMP * last_hessian <= _JUMP**2 * hessian):
            return False
        if last_gradient <= _JUMP * gradient:
            return True
        slight = _SLIGHT * hessian * (limits.rate if limits.rate < np.inf else 1.0 / time_unit(self._dt))
        return gradient < slight and last_gradient <= _JUMP * slight  # not if it is NaN

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
            inputs[0] = lqr_rates(self._gain, x, reference, self._dt)
        else:
            fallback = "hold"
        inputs[0] = wanted = self.limits.kept(asked := inputs[0].copy(), u_previous, x[4:], self._dt)
        if fallback == "shifted_plan":
            inputs[-1] = self.limits.slowed(inputs[-2] if len(inputs) > 1 else inputs[0])
        else:
            for k in range(1, len(inputs)):
                inputs[k] = self.limits.slowed(inputs[k - 1])
        self._age += 1
        models, states = None, None
        if self._last is not None and self._last.models is not None and np.isfinite(x).all():
            assert self._workspace is not None
            models = self._last.models
            states = self._workspace.check.states(x, model_sequence(models, self.tuning.horizon), inputs)
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
    stage = np.diag([position] * 2 + [velocity] * 2 + [angle] * (n_states - 4)) / position
    a, b = model.A * units / units[:, None], model.B / units[:, None] / model.dt
    r = tuning.input_weight / (position * model.dt**2) * np.eye(n)
    # SciPy itself, as python-control would call it: that one takes seconds to import.
    cost = solve_discrete_are(a, b, stage, r, s=np.zeros((n_states, n)))
    gain = np.linalg.solve(b.T @ cost @ b + r, b.T @ cost @ a)
    return np.asarray(gain / units / model.dt), np.asarray(position * cost / np.outer(units, units))


def lqr_rates(gain: np.ndarray, x: np.ndarray, reference: Reference, dt: float) -> np.ndarray:
    """Rates of the LQR about where the reference is now, one period before its first state, shape (n,) [rad/s]."""
    wanted = reference.states[0].copy()
    wanted[:2] -= dt * wanted[2:4]
    wanted[4:] -= dt * reference.inputs[0]
    return np.asarray(reference.inputs[0] - gain @ (x - wanted))


def _another_robot(one: LinearModel, other: LinearModel) -> bool:
    """Whether two models differ by more than poses of one robot do."""
    sizes = ((float(np.abs(m.A[:4, :4]).max()), float(np.abs(m.B[:4]).max())) for m in (one, other))
    return any(not a / _POSES <= b <= a * _POSES for a, b in zip(*sizes, strict=True))


def _shifted(inputs: np.ndarray) -> np.ndarray:
    return np.concatenate((inputs[1:], inputs[-1:]))
