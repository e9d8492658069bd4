"""The first rung of the ladder: tangent predictor and one or two Newton iterations, all rods in one graph."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...buffered import BufferedFunction
from ...compiled import has_compiler
from ..robot import Robot
from ..rods.follower import BRANCH_CHANGE
from ..rods.method import RodMethod, by_machine_code, warm_step
from ..rods.numbers import Kind
from .equilibrium import Equilibrium
from .state import record_size

# Residual beyond which another iteration is not worth trying.
ROUGH = 1e-4


class Climbed(NamedTuple):
    """Pose [p, q], record and result are those of the graph, and valid until the next climb (see `warm_calls`)."""

    pose: np.ndarray
    record: np.ndarray
    result: np.ndarray
    residual: float
    drift: float
    iterations: int


class FirstRung:
    """Solves all rods of a robot from a record of them nearby.

    Parameters
    ----------
    robot : Robot
    method : RodMethod
    compiled : bool
        Whether each rod is machine code where there is a compiler.
    """

    def __init__(self, robot: Robot, method: RodMethod, *, compiled: bool = False) -> None:
        self.robot, self.method, self._compiled = robot, method, compiled
        self._kind = Kind(robot.n_rods, method.layout)
        self._graphs = {iterations: self._graph(iterations) for iterations in (1, 2)}
        self._start_size = len(self._graphs[1][-1])
        self._record_size = record_size(method.newton.size1_in(0), robot.n_rods)

    def _graph(self, iterations: int) -> tuple[BufferedFunction, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Graph, and of its inputs the pose, the tip and the angles in it, and the start."""
        method = by_machine_code(self.method) if self._compiled and has_compiler() else self.method
        graph = BufferedFunction(warm_step(self._kind, method, iterations))
        pose, start, numbers = graph.inputs
        numbers[:] = self._kind.pack(self.robot)
        return graph, pose, pose[:2], pose[2:], start

    def knows(self, guess: Equilibrium) -> bool:
        """Whether an equilibrium has a record that the graphs can start from."""
        record = guess.record
        return record is not None and guess.method == self.method.name and len(record) == self._record_size

    def climb(self, record: np.ndarray, p: np.ndarray, q: np.ndarray, derivatives: float | None) -> Climbed | None:
        """Go from a record to (p, q), with derivatives as in `RodSolver.move`; None: the rods do not follow so."""
        # Where rough derivatives will do, one Newton iteration usually does.
        rough = derivatives is not None and derivatives >= ROUGH
        return self._climb(record, p, q, 1 if rough else 2, derivatives)

    def _climb(
        self, record: np.ndarray, p: np.ndarray, q: np.ndarray, first: int, derivatives: float | None
    ) -> Climbed | None:
        """Go a second time from where the first led if that was close but not enough."""
        solved = self.method.tolerance if derivatives is None else self.method.following
        changed, done = 0.0, 0
        for iterations in (first, 1):
            graph, pose, tip, angles, start = self._graphs[iterations]
            tip[:], angles[:], start[:] = p, q, record[: self._start_size]
            graph()
            record, verdict, result = graph.outputs
            residual, at_derivatives, change, conjugate_points, drift = verdict.tolist()
            changed += change
            done += iterations
            # Written so that NaN is a failure.
            if not (residual <= ROUGH and changed <= BRANCH_CHANGE and not conjugate_points):
                return None
            if residual <= solved and at_derivatives <= (solved if derivatives is None else derivatives):
                return Climbed(pose, record, result, residual, drift, done)
        return None

    def near(self, guess: Equilibrium, p: np.ndarray, q: np.ndarray) -> Equilibrium | None:
        """Solve at (p, q), to rounding, from an equilibrium that it knows; None if the rods do not follow so."""
        record, iterations = guess.record, self.method.settling
        assert record is not None
        if iterations not in self._graphs:
            self._graphs[iterations] = self._graph(iterations)
        found = self._climb(record, p, q, iterations, None)
        return None if found is None else self.equilibrium(found)

    def equilibrium(self, found: Climbed) -> Equilibrium:
        """Keep what was found."""
        pose, record, result, residual, drift, iterations = found
        return Equilibrium.of_record(
            pose.copy(),
            record.copy(),
            result.copy(),
            {
                "robot": self.robot,
                "method": self.method.name,
                "residual_norm": residual,
                "iterations": iterations,
                "rung": "warm",
                "drift": drift,
                "unstable_rods": (),
            },
        )
