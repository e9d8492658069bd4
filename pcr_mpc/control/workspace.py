"""The solvers of a linear MPC: which of them is asked, with how many iterations, and what the answer cost."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..buffered import BufferedFunction
from ..compiled import fastest
from ..errors import InfeasibleError
from ..linearisation.linear_limits import LinearLimits
from ..linearisation.linear_model import LinearModel, LinearModels
from .condensing import checking
from .daqp_solver import DAQPSolver
from .limited_qp import Limited, LimitedQP, active_of
from .osqp_solver import QPSolver
from .qp import QuadraticProgram, constraint_matrix, motor_bounds
from .qp_solver import Solution
from .tuning import Limits, Tuning, time_unit

_RATES = ("rate", "rate change")
_FEWEST_ITERATIONS = 10  # with which a solver is tried at all


class Workspace:
    """Solvers for the QPs of one controller: one knows the limits on the rates alone, the others all of them.

    Parameters
    ----------
    tuning : Tuning
    model : LinearModel
        Of the robot and the period that it is for.
    """

    def __init__(self, tuning: Tuning, model: LinearModel) -> None:
        self.n, self.dt, self._reach = model.B.shape[1], model.dt, model.reach
        self._tuning = tuning
        rates = constraint_matrix(tuning.horizon, self.n)[: 2 * tuning.horizon * self.n].tocsc()
        solver = DAQPSolver if tuning.solver == "daqp" else QPSolver
        self._rate = 1.0 / time_unit(self.dt)  # unit of the rates that the solver sees
        self._rates_only = solver(rates, tuning.tolerance, tuning.max_iterations)
        self._limited: dict[tuple[str, ...], LimitedQP] = {}
        self._limits_matter = False  # in the last plan, beside those on the rates
        self._spent, self._inside = 0, 0.0  # iterations and seconds of the solver in this control step
        self.check = Check(tuning.horizon, self.n, compiled=tuning.model.compiled)

    def limited(self, kinds: tuple[str, ...]) -> LimitedQP:
        """Solver for limits of these kinds, made once."""
        if kinds not in self._limited:
            self._limited[kinds] = LimitedQP(self._tuning, self.n, self.dt, kinds, reach=self._reach)
        return self._limited[kinds]

    def reset(self) -> None:
        """Start afresh."""
        self._limits_matter = False
        self._rates_only.reset()
        for solver in self._limited.values():
            solver.reset()

    def require(self, models: LinearModels) -> None:
        """Raise if the models are for another robot or period."""
        if (models.n, models.dt) != (self.n, self.dt):
            raise ValueError(
                f"model has {models.n} motors and dt = {models.dt} s, but this controller was built for "
                f"{self.n} and {self.dt} s; make a new one"
            )

    def solve(
        self,
        qp: QuadraticProgram,
        x: np.ndarray,
        models: LinearModels,
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
            n_rates, rate = self._rates_only.m, self._rate
            try:
                lower, upper = qp.l[:n_rates] / rate, qp.u[:n_rates] / rate
                self._rates_only.update(rate**2 * qp.P, rate * qp.q, lower, upper, sound=qp.sizes[2] > 0.0)
                if warm is not None:
                    self._rates_only.warm_start(warm / rate)
                found = self._rates_only.solve(certified=False)
            except InfeasibleError as error:
                self._count(error)
            else:
                inputs, y = rate * found.x, found.y / rate
                states, primal, dual, broken, *pulls = self.check(x, models, inputs, y, qp, limits)
                solution = Solution(inputs, y, found.iterations, found.run_time, primal / rate, rate * dual)
                if pose_limits is not None:
                    rows = states[1:] @ pose_limits.C.T
                    broken = max(
                        broken, float((pose_limits.lower - rows).max()), float((rows - pose_limits.upper).max())
                    )
                if broken <= self._tuning.tolerance * self._rate * self.dt:
                    active = active_of({kind: rate * pull for kind, pull in zip(_RATES, pulls, strict=True)})
                    return Limited(inputs, states, {}, active, solution)
                self._spent, self._inside, warm = solution.iterations, solution.run_time, inputs
        return self._solve_whole(qp, x, models, pose_limits, warm, soft_angles=False)

    def soften(
        self, qp: QuadraticProgram, x: np.ndarray, models: LinearModels, pose_limits: LinearLimits | None
    ) -> Limited:
        """Solve with the angle limits softened too, with the iterations that `solve` has left."""
        return self._solve_whole(qp, x, models, pose_limits, None, soft_angles=True)

    def _solve_whole(
        self,
        qp: QuadraticProgram,
        x: np.ndarray,
        models: LinearModels,
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
        self._limits_matter = not set(answer.active) <= {*_RATES}
        solution = replace(answer.solution, iterations=self._spent, run_time=self._inside)
        return replace(answer, solution=solution)

    def _count(self, error: InfeasibleError) -> None:
        self._spent += error.details.get("iterations", 0)
        self._inside += error.details.get("run_time", 0.0)


class Check:
    """What inputs lead to, and how good they are as a solution (see `checking`).

    Parameters
    ----------
    horizon, n : int
        Control periods, motors.
    compiled : bool
        Whether to run as machine code where there is a compiler.
    """

    def __init__(self, horizon: int, n: int, *, compiled: bool = False) -> None:
        self._horizon, self._n, self._compiled = horizon, n, compiled
        self._graphs: dict[int, BufferedFunction] = {}
        self._limits: Limits | None = None

    def __call__(
        self, x: np.ndarray, models: LinearModels, inputs: np.ndarray, multipliers: np.ndarray, qp: QuadraticProgram,
        limits: Limits,
    ) -> tuple[Any, ...]:  # fmt: skip
        """States, shape (N + 1, 4 + n), residuals of rows and gradient, excess of an angle [rad], and the
        largest multipliers of rates and of changes."""
        graph = self._graph(len(models))
        _, _, _, y, p, q, lower, upper, bounds, _ = graph.inputs
        y[:], p[:], q[:], lower[:], upper[:] = multipliers, qp.P, qp.q, qp.l, qp.u
        if limits is not self._limits:
            self._limits, self._bounds = limits, motor_bounds(limits)
        bounds[:] = self._bounds
        states = self.states(x, models, inputs)
        return states, *graph.outputs[1].tolist()

    def states(self, x: np.ndarray, models: LinearModels, inputs: np.ndarray) -> np.ndarray:
        """States at the ends of the periods, x first, shape (N + 1, 4 + n); one model or N of them."""
        graph = self._graph(len(models))
        columns, start, rates = graph.inputs[:3]
        columns.reshape(models.columns.shape, order="F")[:] = models.columns
        start[:] = x
        rates.reshape((self._n, -1), order="F")[:] = inputs.reshape((-1, self._n)).T
        graph.inputs[-1][:] = models.dt
        graph()
        return graph.outputs[0].T.copy()

    def _graph(self, models: int) -> BufferedFunction:
        if models not in self._graphs:
            graph = fastest(checking(self._horizon, self._n, models), self._compiled)
            self._graphs[models] = BufferedFunction(graph)
        return self._graphs[models]
