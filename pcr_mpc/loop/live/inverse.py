"""Motor angles for the next rows of a reference, found while the robot moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ...buffered import BufferedFunction, graph_cache
from ...compiled import fastest
from ...errors import PCRError
from ...linearisation.model_graph import force_graph, sizes
from ...plant.motion.plant import Plant
from ...plant.motion.step_graph import LARGEST_DRIFT, StepModel
from ...plant.robot import Robot
from ...plant.rods.follower import BRANCH_CHANGE
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.free_tip import inverse_statics
from ...plant.statics.many_poses.along import least_motion

# Rows in one call of a graph: each size is built once.
BLOCK = 8
_SIZES = (BLOCK, 1)
_ITERATIONS = 2  # of the motor angles, each with one of the rods
_SOLVED = 1e-8  # residuals of the rods, and of the force over sum EI/L^2


@dataclass(frozen=True, eq=False)
class Row:
    """One point of a reference: where the motors must be, and what the rods are like there.

    Attributes
    ----------
    p : ndarray, shape (2,)
        Tip [m].
    q : ndarray, shape (n,)
        Motor angles [rad].
    force : ndarray, shape (2,)
        F that the rods carry [N].
    stiffness : ndarray, shape (2, 2)
        K [N/m].
    coupling : ndarray, shape (2, n)
        G [N/rad].
    record : ndarray
        Of the rods (see `warm_calls`).
    """

    p: np.ndarray
    q: np.ndarray
    force: np.ndarray
    stiffness: np.ndarray
    coupling: np.ndarray
    record: np.ndarray

    @property
    def levers(self) -> np.ndarray:
        """How the motors turn with the tip at a given force, shape (n, 2) [rad/m]."""
        return np.asarray(-np.linalg.pinv(self.coupling) @ self.stiffness)


class OnlineInverse:
    """Inverse statics row by row, each warm from the one before: many rows in one call of a graph.

    What the graph does not bring along is solved by `inverse_statics`, which takes its time, or says why not.

    Parameters
    ----------
    robot : Robot
        As the controller believes it to be.
    compiled : bool
        Whether to run as machine code where there is a compiler.
    """

    def __init__(self, robot: Robot, *, compiled: bool = False) -> None:
        self._robot, self._compiled = robot, compiled
        self._plant = Plant(robot)
        assert self._plant.step_model is not None
        self._model = self._plant.step_model
        self._memory = sizes(self._model).memory
        self._graphs: dict[int, BufferedFunction] = {}
        self._scale = robot.force_scale

    def prepare(self) -> None:
        """Build the graphs."""
        for size in _SIZES:
            self._graph(size)

    def at(self, pose: Equilibrium) -> Row:
        """The row that is a pose."""
        x = np.concatenate([pose.p, np.zeros(2), pose.q])
        self._plant.reset(x, pose)
        force, k, g = self._plant.force_and_jacobians(pose.p, pose.q)
        return Row(pose.p, pose.q, force.copy(), k.copy(), g.copy(), self._plant.record.copy())

    def pose(self, row: Row) -> Equilibrium:
        """The pose that is a row."""
        self._plant.recall(row.record)
        return self._plant.equilibrium(np.concatenate([row.p, np.zeros(2), row.q]))

    def rows(self, last: Row, p: np.ndarray, forces: np.ndarray) -> tuple[list[Row], PCRError | None]:
        """Follow the branch of ``last`` along tips p, shape (K, 2), at which the rods carry ``forces`` [N].

        The tip's own weight is added to the forces. Returns the rows up to the first that cannot be had, and why not.
        """
        found: list[Row] = []
        while len(found) < len(p):
            left = len(p) - len(found)
            size = next(size for size in _SIZES if size <= left)
            some = slice(len(found), len(found) + size)
            good = self._call(last, p[some], forces[some], size)
            found += good
            last = found[-1] if found else last
            if len(good) < size:
                at = len(found)
                try:
                    last = self._alone(last, p[at], forces[at])
                except PCRError as error:
                    return found, error
                found.append(last)
        return found, None

    def _call(self, last: Row, p: np.ndarray, forces: np.ndarray, size: int) -> list[Row]:
        """Rows that the graph brings along, up to the first that it does not."""
        graph = self._graph(size)
        start, wanted, numbers = graph.inputs
        memory, n = self._memory, self._robot.n_rods
        slopes = last.stiffness.ravel(order="F"), last.coupling.ravel(order="F")
        start[:] = np.concatenate([last.p, last.q, last.force, *slopes, last.record[:memory]])
        wanted = wanted.reshape(4, size, order="F")
        wanted[:2], wanted[2:] = p.T, (forces + self._robot.tip_weight).T
        numbers[:] = self._plant.numbers
        graph()
        ends, record, good = (out.reshape(-1, size, order="F").T for out in graph.outputs[1:])
        q, (lower, upper) = ends[:, 2 : 2 + n], self._robot.angle_limits.T
        fit = (good[:, 0] > 0) & (q >= lower).all(axis=1) & (q <= upper).all(axis=1)
        count = size if fit.all() else int(fit.argmin())
        ends, record = ends[:count].copy(), record[:count].copy()
        return [
            Row(end[:2], end[2 : 2 + n], end[2 + n : 4 + n], end[4 + n : 8 + n].reshape(2, 2, order="F"),
                end[8 + n :].reshape(2, n, order="F"), of_rods)
            for end, of_rods in zip(ends, record, strict=True)
        ]  # fmt: skip

    def _alone(self, last: Row, p: np.ndarray, force: np.ndarray) -> Row:
        return self.at(inverse_statics(self._robot, p, force, guess=self.pose(last)))

    def _graph(self, size: int) -> BufferedFunction:
        if size not in self._graphs:
            graph = _rows_graph(self._model, self._robot.force_scale, size)
            self._graphs[size] = BufferedFunction(fastest(graph, self._compiled))
        return self._graphs[size]


@graph_cache(maxsize=16)
def _rows_graph(model: StepModel, scale: float, count: int) -> Any:
    """([end, memory], [p, F] (4, K), numbers) -> last start, ends, records and whether each is good, K columns.

    An end is [p, q, F, K, G]: by its slopes the motors are turned ahead, and then by Newton's method, with the least
    motion, until the rods carry F.
    """
    n, size = model.kind.n_rods, sizes(model)
    start, wanted = ca.MX.sym("start", 8 + 3 * n + size.memory), ca.MX.sym("wanted", 4)
    numbers = ca.MX.sym("numbers", model.kind.size)
    p0, q, f0, k, g, memory = ca.vertsplit(start, [0, 2, 2 + n, 4 + n, 8 + n, 8 + 3 * n, start.numel()])
    k, g = ca.reshape(k, 2, 2), ca.reshape(g, 2, n)
    p, force = wanted[:2], wanted[2:]
    q += least_motion(g, force - f0 - k @ (p - p0))
    rods = force_graph(model, 1)
    for _ in range(_ITERATIONS):
        record, _, found, _, g = rods(ca.vertcat(p, q), memory, numbers)
        q, memory = q + least_motion(g, force - found), record[: size.memory]
    record, verdict, found, k, g = rods(ca.vertcat(p, q), memory, numbers)
    softest = (k[0, 0] + k[1, 1]) / 2 - ca.sqrt(((k[0, 0] - k[1, 1]) / 2) ** 2 + k[0, 1] ** 2)
    limits = ca.DM([_SOLVED, _SOLVED, BRANCH_CHANGE, 0.0, LARGEST_DRIFT])
    good = ca.logic_and(ca.mmin(verdict <= limits), ca.norm_inf(force - found) <= _SOLVED * scale)
    good = ca.logic_and(good, softest > 0)
    end = ca.vertcat(p, q, found, ca.vec(k), ca.vec(g))
    row = ca.Function("row", [start, wanted, numbers], [ca.vertcat(end, record[: size.memory]), end, record, good])
    if count == 1:
        return row
    many = row.mapaccum("rows", count, 1, {})
    all_wanted = ca.MX.sym("wanted", 4, count)
    outputs = many(start, all_wanted, ca.repmat(numbers, 1, count))
    return ca.Function("rows", [start, all_wanted, numbers], [outputs[0][:, -1], *outputs[1:]])
