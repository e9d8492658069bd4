"""Nonlinear model-predictive control: predict with the exact equations of motion, solve an NLP by IPOPT."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np

from ...errors import InfeasibleError, PCRError, checked_array, checked_vector
from ...frozen import set_once
from ...linearisation.linear_limits import LinearLimits
from ...linearisation.linear_model import LinearModel
from ..motor_limits import Limits
from ..mpc import terminal_weight
from ..plan import Plan
from ..qp.program import Reference, model_sequence
from ..tuning import Tuning
from .collocation import Transcription, transcribe
from .nlp_solver import NLPSolution, NLPSolver, Point

# Multiplier from which a limit counts as active; those of limits that are far are of the order of IPOPT's tolerance.
_ACTIVE = 1e-4


@set_once(
    "call retune, which lets all of it take effect", "tuning", limits="make a new one: they are part of its problem"
)
class NonlinearMPC:
    """Tracks a reference with the exact nonlinear model and hard limits on the motors.

    The problem is that of `LinearMPC`, same weights, terminal weight and limits, with Gauss collocation of the
    nonlinear model in place of the linear one: the yardstick for linear controllers. The last solution, one period on,
    is where the next solve starts; `reset` forgets it. Where IPOPT does not succeed, the last plan moved on by one
    period answers, as long as it lasts, else the motors are brought to rest. (With ``fallback = "raise"`` in the
    tuning only a solution counts.)

    Parameters
    ----------
    tuning : Tuning
        Horizon and weights; its solver settings are OSQP's.
    limits : Limits
    dynamics : casadi.Function
        Equations of motion with algebraic unknowns z, in SI units: (p (2), v (2), q (n), z (m), f_ext (2)) ->
        (acceleration (2), residual (m), instability (any)). A plan in which an instability is positive is not taken.
    algebraic : callable
        (p (K, 2), q (K, n)) -> z (K, m) along a path: where a solve without a last solution starts.
    points : int
        Gauss points in a control period; the order of the collocation is twice that.
    max_iterations : int
        After which IPOPT gives up.
    """

    def __init__(
        self,
        tuning: Tuning,
        limits: Limits,
        dynamics: Any,
        algebraic: Callable[[np.ndarray, np.ndarray], np.ndarray],
        *,
        points: int = 3,
        max_iterations: int = 100,
    ) -> None:
        self.tuning = tuning
        self.limits = limits
        self._dynamics, self._algebraic = dynamics, algebraic
        self._points, self._max_iterations = points, max_iterations
        self._n = dynamics.size1_in("q")
        self._dt = 1.0  # of any model; until there is one, motors are only brought to rest
        self._nlp: Transcription | None = None
        self._terminal_weight: np.ndarray | None = None
        self.reset()

    def reset(self) -> None:
        """Start afresh: the same calls then give the same plans."""
        self._last: Plan | None = None
        self._age = math.inf  # periods since a plan was solved
        self._point: Point | None = None
        self._terminal_weight = None
        self._prepared: LinearModel | None = None

    def retune(self, tuning: Tuning) -> None:
        """Let another tuning take effect, all of it, between two steps; the last rates remain, for a fall-back."""
        new = NonlinearMPC(tuning, self.limits, self._dynamics, self._algebraic, points=self._points,
                           max_iterations=self._max_iterations)  # fmt: skip
        if self._prepared is not None:
            new.prepare(self._prepared)
        if self._last is not None:
            new._last, new._age = self._last.spanning(tuning.horizon), self._age
        self.__dict__.update(new.__dict__)

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "NonlinearMPC holds a function, and can be neither pickled nor copied: pickle its controller instead"
        )

    def prepare(self, model: LinearModel, combinations: Sequence[tuple[str, ...]] = ()) -> None:
        """Take the terminal weight from ``model`` and build the NLP; else the first `solve` does it."""
        self._terminal_weight, self._prepared = terminal_weight(model, self.tuning), model
        if self._nlp is None:
            self._dt = model.dt
            self._nlp = transcribe(self._dynamics, self.tuning, self.limits, model.dt, self._points, model.reach)
            self._units = self._nlp.units
            self._solver = NLPSolver(self._nlp, self._max_iterations)

    def solve(
        self,
        x: np.ndarray,
        models: LinearModel | Sequence[LinearModel],
        reference: Reference,
        u_previous: np.ndarray,
        pose_limits: LinearLimits | None = None,
    ) -> Plan:
        """Plan the motor rates over the horizon.

        The plan's ``models`` is the first linear model, moved to agree with the prediction of the first period: an
        observer that used it as it is would take the linearisation's error for a force.

        Parameters
        ----------
        x : ndarray, shape (4 + n,)
            Current state.
        models : LinearModel or sequence of N
            The first one says which external force is known; on the first call after a reset it also sets the
            terminal weight.
        reference : Reference
            Over the horizon.
        u_previous : ndarray, shape (n,)
            Rates applied in the last period [rad/s].
        pose_limits : LinearLimits, optional
            Ignored: it plans within the motors' limits, and its plans may not pass a rod's limit of stability.

        Raises
        ------
        InfeasibleError
            The NLP was not solved, and the tuning asks to raise.
        PCRError
            There is no start to solve from, and the tuning asks to raise.
        ValueError
            Names an argument that is not finite or of the wrong shape; the controller is as it was before.
        """
        began = time.perf_counter()
        horizon, n, n_states = self.tuning.horizon, self._n, 4 + self._n
        model = model_sequence(models, horizon)[0]
        x, u_previous = checked_vector("x", x, n_states), checked_vector("u_previous", u_previous, n)
        wanted = checked_array("reference.states", reference.states, (horizon, n_states))
        feed_forward = checked_array("reference.inputs", reference.inputs, (horizon, n))
        force = checked_vector("model.force", model.force, 2)
        if self._terminal_weight is None or self._nlp is None:
            self.prepare(model)
        assert self._terminal_weight is not None
        if model.dt != self._dt:
            raise ValueError(
                f"model has dt = {model.dt} s, but this controller was built for {self._dt} s; make a new one"
            )
        weight = self._terminal_weight.ravel(order="F")
        parameters = np.concatenate([x, force, u_previous, wanted.ravel(), feed_forward.ravel(), weight])
        updated = began
        try:
            solution = self._continued(parameters)
            if solution is None:
                start = self._start(x, reference)
                updated = time.perf_counter()
                solution = self._solver.solve(parameters, start)
        except PCRError as error:
            self._point = None
            if self.tuning.fallback == "raise":
                raise
            first = error if self._refused is None else self._refused
            status = first.status if isinstance(first, InfeasibleError) else f"no start: {first}"
            return self.fall_back(status, x, reference, u_previous)
        self._point, self._age = solution.point, 0
        rows = self._units * solution.point.unknowns
        inputs, predicted = rows[:, :n].copy(), np.vstack([x, rows[:, -n_states:]])
        inputs[0] = self.limits.kept(inputs[0], u_previous, x[4:], self._dt)
        agreeing = replace(model, c=model.c + predicted[1] - model(x, inputs[0]))
        times = updated - began, time.perf_counter() - updated
        return self._remember(inputs, predicted, agreeing, "solved", None, solution, times)

    def _continued(self, parameters: np.ndarray) -> NLPSolution | None:
        """Solve from the last solution; None where it leads nowhere, for it must not spoil this one."""
        self._refused: InfeasibleError | None = None
        if self._point is not None:
            try:
                return self._solver.solve(parameters, self._point.shifted())
            except InfeasibleError as error:
                self._refused = error
        return None

    def fall_back(self, status: str, x: np.ndarray, reference: Reference, u_previous: np.ndarray) -> Plan:
        """Answer without a solution: because there is none, or no model or no measurement.

        Parameters
        ----------
        status : str
            What went wrong.
        x, reference, u_previous
            As for `solve`; x may be NaN.
        """
        horizon, n = self.tuning.horizon, self._n
        inputs, predicted = np.zeros((horizon, n)), np.full((horizon + 1, 4 + n), np.nan)
        fallback, planned = "hold", 1
        if self._last is not None and self._age < horizon - 1:
            fallback, planned = "shifted_plan", horizon - 1
            inputs[:-1] = self._last.inputs[1:]
            if self._last.states is not None:
                predicted[:-1] = self._last.states[1:]
        inputs[0] = self.limits.kept(inputs[0], u_previous, x[4:], self._dt)
        for k in range(planned, horizon):
            inputs[k] = self.limits.slowed(inputs[k - 1])
        self._age += 1
        models = None if self._last is None else self._last.models
        predicted[0] = x
        return self._remember(inputs, predicted, models, status, fallback, None, (0.0, 0.0))

    def _remember(
        self,
        inputs: np.ndarray,
        predicted: np.ndarray,
        models: LinearModel | Sequence[LinearModel] | None,
        status: str,
        fallback: str | None,
        solution: NLPSolution | None,
        times: tuple[float, float],
    ) -> Plan:
        self._last = Plan(
            inputs=inputs,
            states=predicted if np.isfinite(predicted).all() else None,
            models=models,
            status=status,
            fallback=fallback,
            active=self._active(solution.point) if solution else (),
            iterations=solution.iterations if solution else 0,
            primal_residual=solution.primal_residual if solution else np.nan,
            dual_residual=solution.dual_residual if solution else np.nan,
            update_time=times[0],
            solve_time=times[1],
            solver_time=times[1],
        )
        return self._last

    def _active(self, point: Point) -> tuple[str, ...]:
        """Kinds of limits with a multiplier."""
        n = self._n
        multipliers = {
            "rate": point.of_bounds[:, :n],
            "rate change": point.of_constraints[:, -n:],
            "angle": point.of_bounds[:, -n:],
        }
        return tuple(kind for kind, of in multipliers.items() if np.abs(of).max() > _ACTIVE)

    def _start(self, x: np.ndarray, reference: Reference) -> Point:
        """The reference, its algebraic unknowns solved for along it, and no multipliers."""
        assert self._nlp is not None
        horizon, n = self.tuning.horizon, self._n
        ends = np.vstack([x, reference.states])
        fraction = self._nlp.nodes[:, None]
        inside = ends[:-1, None] + fraction * (ends[1:] - ends[:-1])[:, None]
        path = inside.reshape(-1, 4 + n)
        z = self._algebraic(path[:, :2], path[:, 4:]).reshape(horizon, self._points, -1)
        acceleration = np.repeat(np.diff(ends[:, 2:4], axis=0)[:, None] / self._dt, self._points, axis=1)
        at_points = np.concatenate([acceleration, z], axis=2).reshape(horizon, -1)
        unknowns = np.hstack([reference.inputs, at_points, reference.states])
        return Point(unknowns / self._units, np.zeros_like(unknowns), np.zeros_like(self._nlp.g_lower))
