"""The solvers of a linear MPC: which of them is asked, with how many iterations, and what the answer cost."""

from __future__ import annotations

import math
import time

import numpy as np

from ...buffered import BufferedFunction
from ...compiled import fastest
from ...errors import InfeasibleError
from ...linearisation.linear_limits import LinearLimits
from ...linearisation.linear_model import LinearModel, LinearModels
from ..motor_limits import Limits
from ..tuning import Tuning, time_unit
from .checked import Solution
from .condensing import checking
from .daqp_solver import DAQPSolver
from .limited import Limited, LimitedQP, active_of
from .osqp_solver import QPSolver
from .program import QuadraticProgram, constraint_matrix, motor_bounds

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
        self._unlimited = False  # no limit has shaped the last plan
        self._spent, self._inside = 0, 0.0  # iterations and seconds of the solver in this control step
        self.check = Check(tuning.horizon, self.n, compiled=tuning.model.compiled)

    def limited(self, kinds: tuple[str, ...]) -> LimitedQP:
        """Solver for limits of these kinds, made once."""
        if kinds not in self._limited:
            self._limited[kinds] = LimitedQP(self._tuning, self.n, self.dt, kinds, reach=self._reach)
        return self._limited[kinds]

    def reset(self) -> None:
        """Start afresh."""
        self._limits_matter = self._unlimited = False
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
        its multipliers are those of the rates' rows, the others being zero. First of all comes the optimum without
        limits, of which the same is true and which takes no solver. While other limits than those on the rates shape
        the plans, the whole is solved at once.
        """
        self._spent, self._inside = 0, 0.0
        if not self._limits_matter:
            check, rate, solver = self.check.loaded(qp, x, models, limits), self._rate, self._rates_only
            if qp.free is not None and qp.sound and (found := self._without_limits(check, qp, pose_limits)):
                return found
            at, y, problem, start = check.rates, check.y, check.problem, warm
            if rate != 1.0:
                at, y, problem = np.empty_like(at), np.empty_like(y), check.scaled(rate)
                start = None if warm is None else warm / rate
            try:
                spent, inside = solver.answer(problem, start, at, y, sound=qp.sound, afresh=self._unlimited)
                self._unlimited = False
                if rate != 1.0:
                    check.rates[:], check.y[:] = rate * at, y / rate
                else:
                    at, y = at.copy(), y.copy()
                primal, dual, broken, of_rates, of_changes, kept = check()
                solution = Solution(at, y, spent, inside, primal / rate, rate * dual)
                solver.judge(solution)
            except InfeasibleError as error:
                self._count(error)
            else:
                states, inputs = check.states(), at
                if rate != 1.0:
                    inputs = check.rates.copy()
                    solution = solution._replace(x=inputs, y=check.y.copy())
                if _broken(broken, states, pose_limits) <= self._tuning.tolerance * rate * self.dt:
                    active: tuple[str, ...] = ()
                    if of_rates or of_changes:
                        active = active_of({_RATES[0]: rate * of_rates, _RATES[1]: rate * of_changes})
                    return Limited(inputs, states, kept > 0.0, {}, active, solution)
                self._spent, self._inside, warm = spent, inside, inputs
        return self._solve_whole(qp, x, models, pose_limits, warm, soft_angles=False)

    def _without_limits(self, check: Loaded, qp: QuadraticProgram, pose_limits: LinearLimits | None) -> Limited | None:
        """The optimum without limits, if it keeps them all, to the last bit."""
        assert qp.free is not None
        inputs, y, began = check.rates, check.y, time.perf_counter()
        inputs[:], y[:] = qp.free, 0.0
        primal, dual, broken, _, _, kept = check()
        spent = time.perf_counter() - began
        # As accurate as a solver's answer must be, for |q| is at most that much greater than its largest entry. What
        # is NaN is not kept.
        tolerance = self._tuning.tolerance * (time_unit(self.dt) + float(qp.sizes[1]) / math.sqrt(len(inputs)))
        if kept <= 0.0 or primal > 0.0 or broken > 0.0 or not dual <= tolerance:
            return None
        states = check.states()
        if _broken(broken, states, pose_limits) > 0.0:
            return None
        self._unlimited = True
        # One iteration, as an active-set method counts it.
        solution = Solution(inputs.copy(), y.copy(), 1, spent, primal, self._rate * dual)
        return Limited(solution.x, states, True, {}, (), solution)

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
        solution = answer.solution._replace(iterations=self._spent, run_time=self._inside)
        return answer._replace(solution=solution)

    def _count(self, error: InfeasibleError) -> None:
        self._spent += error.details.get("iterations", 0)
        self._inside += error.details.get("run_time", 0.0)


def _broken(angles: float, states: np.ndarray, limits: LinearLimits | None) -> float:
    """By how much states exceed the limits of a pose, or ``angles`` those of the motors."""
    if limits is None:
        return angles
    rows = states[1:] @ limits.C.T
    return max(angles, float((limits.lower - rows).max()), float((rows - limits.upper).max()))


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
        self._loaded: dict[int, Loaded] = {}

    def loaded(self, qp: QuadraticProgram, x: np.ndarray, models: LinearModels, limits: Limits) -> Loaded:
        """Take over a problem whose answers are to be judged; one model or N of them."""
        loaded = self._for(models)
        loaded.load(qp, x, models, limits)
        return loaded

    def states(self, x: np.ndarray, models: LinearModels, inputs: np.ndarray) -> np.ndarray:
        """States at the ends of the periods, x first, shape (N + 1, 4 + n); one model or N of them."""
        return self._for(models).predict(x, models, inputs)

    def _for(self, models: LinearModels) -> Loaded:
        count = models.columns.shape[1]
        if count not in self._loaded:
            graph = fastest(checking(self._horizon, self._n, count), self._compiled)
            self._loaded[count] = Loaded(BufferedFunction(graph))
        return self._loaded[count]


class Loaded:
    """The graph of a `Check` and its memory, in which a problem lies as long as no other is loaded.

    Attributes
    ----------
    problem : tuple of ndarray
        P, q, and the bounds of rates and changes.
    rates, y : ndarray
        Where an answer is to be written: inputs, and multipliers of rates and changes.
    """

    def __init__(self, graph: BufferedFunction) -> None:
        self._graph = graph
        self._models, self._x, *parts, self._bounds, self._dt, self._clear, rates, self.y = graph.inputs
        self._parts = p, q, lower, upper = parts
        self._block = graph.memory_in[: sum(view.size for view in (self._models, self._x, *parts))]
        self.rates: np.ndarray = rates.T.reshape(-1)
        self._states, self._numbers = graph.outputs[0].T, graph.outputs[1]
        self._limits: Limits | None = None
        self.problem = p, q, lower[: len(self.y)], upper[: len(self.y)]

    def load(self, qp: QuadraticProgram, x: np.ndarray, models: LinearModels, limits: Limits) -> None:
        """Take over a problem, in one copy where it is one block."""
        if qp.block is None:
            self._load_models(x, models)
            for part, value in zip(self._parts, (qp.P, qp.q, qp.l, qp.u), strict=True):
                part[:] = value
        else:
            self._block[:] = qp.block
        if limits is not self._limits:
            self._limits, self._bounds[:], self._clear[:] = limits, motor_bounds(limits), limits.clear
            self._dt[:] = models.dt

    def scaled(self, rate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The problem for rates in this unit [rad/s]."""
        p, q, lower, upper = self.problem
        return rate**2 * p, rate * q, lower / rate, upper / rate

    def _load_models(self, x: np.ndarray, models: LinearModels) -> None:
        self._models.reshape(models.columns.shape, order="F")[:] = models.columns
        self._x[:], self._dt[:] = x, models.dt

    def __call__(self) -> list[float]:
        """Residuals of rows and gradient, excess of an angle [rad], the largest multipliers of rates and of changes,
        and 1 if the first rates keep the limits as they are, of the answer to the problem that was loaded."""
        self._graph()
        found: list[float] = self._numbers.tolist()
        return found

    def states(self) -> np.ndarray:
        """States of the last answer at the ends of the periods, x first, shape (N + 1, 4 + n)."""
        return self._states.copy()

    def predict(self, x: np.ndarray, models: LinearModels, inputs: np.ndarray) -> np.ndarray:
        """States to which other inputs lead from x."""
        self._load_models(x, models)
        self.rates[:] = inputs.ravel()
        self._graph()
        return self.states()
