"""A whole step of the plant in one call, for as long as one or two Newton iterations after the prediction will do."""

from __future__ import annotations

import math
from operator import le

import numpy as np

from ...buffered import BufferedFunction
from ..statics.first_rung import ROUGH
from ..statics.solver import RodSolver
from .step_graph import CORRECTIONS, SOLVES, StepModel, limits, step_function


class QuickStep:
    """`step_graph` with a memory of its last pose, which its solver need not know before somebody asks.

    Parameters
    ----------
    model : StepModel
    solver : RodSolver
        Of the same rods.
    numbers : ndarray
        Of the robot, as ``model.kind`` packs them.
    compiled : bool
        Whether the step is machine code.
    """

    def __init__(self, model: StepModel, solver: RodSolver, numbers: np.ndarray, *, compiled: bool) -> None:
        self.model, self._solver, self._compiled = model, solver, compiled
        self._limits = limits(model)
        self._solves = SOLVES[model.integrator]
        self._n, self._numbers = model.kind.n_rods, numbers
        # Two for each number of corrections, so that a step that fails leaves the last pose whole.
        self._graphs = {CORRECTIONS[0]: self._pair(CORRECTIONS[0])}
        self._last = self._graphs[CORRECTIONS[0]][0]
        self._known = True  # to the solver

    def _pair(self, corrections: int) -> tuple[BufferedFunction, BufferedFunction]:
        function = step_function(self.model, corrections, details=True, compiled=self._compiled)
        pair = BufferedFunction(function), BufferedFunction(function)
        for graph in pair:
            graph.inputs[3][:] = self._numbers
        return pair

    def of(self, numbers: np.ndarray) -> None:
        """Go on with the numbers of another robot of this kind."""
        self._numbers = numbers
        for pair in self._graphs.values():
            for graph in pair:
                graph.inputs[3][:] = numbers

    def load(self, memory: np.ndarray) -> None:
        """Start from the solver's pose, whose memory this is."""
        self._last.outputs[0][:] = memory
        self._known = True

    def __call__(self, x: np.ndarray, u: np.ndarray, f_ext: np.ndarray) -> np.ndarray | None:
        """Advance by one step, or return None where the slow way must be taken.

        The result is valid until the call after the next.
        """
        n = self._n
        for corrections in CORRECTIONS:
            if corrections not in self._graphs:
                self._graphs[corrections] = self._pair(corrections)
            one, other = self._graphs[corrections]
            graph = other if one is self._last else one
            memory, start, given, _ = graph.inputs
            memory[:], start[:], given[:n], given[n:] = self._last.outputs[0], x, u, f_ext
            graph()
            verdict = graph.outputs[2].tolist()
            # Where M has no finite derivative, only the state shows it.
            if all(map(le, verdict, self._limits)) and all(map(math.isfinite, graph.outputs[1].tolist())):
                self._last, self._known = graph, False
                self._solver.rungs["warm"] += self._solves
                return graph.outputs[1]
            if not verdict[0] <= ROUGH:
                break  # lost, not just unfinished
        return None

    def hand_over(self) -> None:
        """Tell the solver of the last pose."""
        if not self._known:
            verdict, record, result = self._last.outputs[2:]
            self._solver.adopt(record, result, drift=float(verdict[4]), residual=float(verdict[0]))
            self._known = True
