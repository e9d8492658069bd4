"""Strain of the rods about a pose, linear in the state, where it comes near what the material bears."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ..buffered import BufferedFunction, graph_cache
from ..plant.motion.plant import Plant
from ..plant.robot import Robot
from ..plant.rods.equations import Layout, RodPhysics, aligned_steps, interpolated, propagation, unpacked
from ..plant.rods.numbers import Kind
from ..plant.rods.physics import robot_physics
from ..plant.rods.strain import largest_strain, quarter_period, strain_points
from ..plant.statics.state import RobotState
from .linear_limits import Rows

_WATCHED = 0.8  # of a limit: a controller looks a horizon ahead
_BETWEEN_NODES = 0.9  # of the largest strain that one of the nodes of a rod has, at least
_STEPS = 4  # Runge-Kutta steps from a node to the point of the largest strain


class StrainWatch:
    """Rows for the largest strain of each rod, by implicit differentiation.

    In closed form the largest moment is at the base, or it is 2 lambda k EI/L within the rod, and goes from one to
    the other without a kink (see `largest_moment`). Where rods are solved by shooting, the point of the largest strain
    is found, and the rod propagated to it from the node before: to first order the point itself may stay.

    Parameters
    ----------
    limits : ndarray, shape (n,)
        Infinite for rods that are not watched.
    plant : Plant
        Whose rods are asked.
    """

    def __init__(self, limits: np.ndarray, plant: Plant) -> None:
        self._robot: Robot = plant.robot
        self._rods = [(i, float(limits[i])) for i in np.flatnonzero(np.isfinite(limits)).tolist()]
        physics = None if plant.method == "closed_form" else robot_physics(plant.robot)
        self._physics: tuple[RodPhysics, ...] | None = physics
        self._at_nodes: dict[int, BufferedFunction] = {}
        self._ratios = [rod.thickness_ratio or math.nan for rod in plant.robot.rods]
        self._far = [(i, self._ratios[i], _WATCHED * limit) for i, limit in self._rods]

    @property
    def count(self) -> int:
        """Rows: one for each rod that is watched."""
        return len(self._rods)

    def far(self, loads: list[float]) -> bool:
        """Whether no rod in closed form with these loads (see `elastica`) can be near its limit: |m| <= 2 lambda."""
        return all(2.0 * loads[i] * ratio < watched for i, ratio, watched in self._far)

    def rows(self, x: np.ndarray, state: RobotState) -> Rows | None:
        """C, lower, upper and scale as of `LinearLimits`; None if no strain is near its limit."""
        of_rod = self._closed_form if self._physics is None else self._by_shooting
        found = [of_rod(i, limit, state) for i, limit in self._rods]
        if not any(share > _WATCHED for share, _ in found):
            return None
        rows, upper = np.zeros((len(found), len(x))), np.empty(len(found))
        for row, ((i, _), (share, slope)) in enumerate(zip(self._rods, found, strict=True)):
            rows[row, :2], rows[row, 4 + i] = slope[:2] / self._robot.lengths[i], slope[2]
            upper[row] = 1.0 - share + float(rows[row] @ x)
        return rows, np.full(len(found), -np.inf), upper, np.array([limit for _, limit in self._rods])

    def _closed_form(self, i: int, limit: float, state: RobotState) -> tuple[float, np.ndarray]:
        """Share of the limit, and its derivative by the rod's pose (3)."""
        log_tip_angle, load, _ = state.unknowns[:, i].tolist()
        unit = self._ratios[i] / limit
        if load > quarter_period(log_tip_angle):
            half = math.exp(log_tip_angle) / 2
            k, slope = math.cos(half), -half * math.sin(half)
            moves = state.tangents[:2, 3 * i : 3 * i + 3]
            return unit * 2.0 * k * load, unit * 2.0 * (slope * load * moves[0] + k * moves[1])
        m = float(state.loads[2, i])
        return unit * abs(m), math.copysign(unit, m) * state.load_tangents[2, 3 * i : 3 * i + 3]

    def _by_shooting(self, i: int, limit: float, state: RobotState) -> tuple[float, np.ndarray]:
        assert self._physics is not None
        physics = self._physics[i]
        nodes = state.unknowns[:, i].reshape((4, -1), order="F")
        count, values = nodes.shape[1], physics.values
        ratio = self._ratios[i]
        if i not in self._at_nodes:
            self._at_nodes[i] = graph = BufferedFunction(_node_graph(physics.layout, count))
            graph.inputs[1][:], graph.inputs[2][:] = values, ratio
        graph = self._at_nodes[i]
        graph.inputs[0][:] = nodes
        graph()
        coarse = float(graph.outputs[0][0])
        if coarse < _BETWEEN_NODES * _WATCHED * limit:
            return coarse / limit, np.zeros(3)
        evaluate = _strain_graph(physics.layout, aligned_steps(physics.layout, count, _STEPS))
        s, _ = largest_strain(self._robot.rods[i], nodes, physics)
        j = min(int(s * count), count - 1)
        value, slope = evaluate(nodes[:, j], s - j / count, j / count, values, ratio)
        moves = state.tangents[4 * j : 4 * j + 4, 3 * i : 3 * i + 3]
        return float(value) / limit, slope.full().ravel() @ moves / limit


@graph_cache(maxsize=16)
def _strain_graph(layout: Layout, steps: int) -> Any:
    """Graph (node (4), arc length from it, its s, physics, half thickness over L) -> strain there, its gradient."""
    z, h, s = ca.SX.sym("z", 4), ca.SX.sym("h"), ca.SX.sym("s")
    physics, ratio = ca.SX.sym("physics", layout.size), ca.SX.sym("ratio")
    there = propagation(steps, "rk8", layout)(z, h, s, physics)[2:6]
    strain = _strain(layout, physics, there, s + h, ratio)
    return ca.Function("strain", [z, h, s, physics, ratio], [strain, ca.gradient(strain, z)], {"cse": True})


@graph_cache(maxsize=16)
def _node_graph(layout: Layout, count: int) -> Any:
    """Graph (nodes (4, count), physics, half thickness over L) -> largest strain at a node."""
    nodes, physics, ratio = ca.SX.sym("nodes", 4, count), ca.SX.sym("physics", layout.size), ca.SX.sym("ratio")
    found = [_strain(layout, physics, nodes[:, j], j / count, ratio) for j in range(count)]
    return ca.Function("strains", [nodes, physics, ratio], [ca.norm_inf(ca.vertcat(*found))], {"cse": True})


@dataclass(frozen=True)
class StrainGraphs:
    """What `StrainWatch` does for rods that are shot, as graphs, for a caller without Python.

    Attributes
    ----------
    nodes : casadi.Function
        (nodes of all rods, rod after rod, numbers of the robot, half thickness over length (n)) -> largest strain at a
        node (n), numbers of each rod (s, n) as its graphs take them.
    along : casadi.Function
        (nodes (4, N), numbers of the rod, half thickness over length) -> strain at evenly spaced points, ends included.
    there : casadi.Function
        (node (4), arc length from it, its s, numbers of the rod, half thickness over length) -> strain, its gradient.
    points, intervals : int
        Pieces between the points of ``along``, and between knots of the rods' properties.
    """

    nodes: Any
    along: Any
    there: Any
    points: int
    intervals: int


def strain_graphs(kind: Kind, count: int) -> StrainGraphs:
    """Build the graphs for robots of a kind whose rods have ``count`` nodes each."""
    layout, n = kind.layout, kind.n_rods
    assert layout is not None
    unknowns, vector, ratios = ca.MX.sym("unknowns", 4 * count, n), ca.MX.sym("numbers", kind.size), ca.MX.sym("r", n)
    physics = [ca.vertcat(*rod.physics) for rod in kind.unpack(vector).rods]
    at_node = _node_graph(layout, count)
    coarse = [at_node(ca.reshape(unknowns[:, i], 4, count), physics[i], ratios[i]) for i in range(n)]
    results = [ca.vertcat(*coarse), ca.horzcat(*physics)]
    points = strain_points(layout)
    s = np.linspace(0.0, 1.0, points + 1)
    piece = np.minimum((s * count).astype(int), count - 1)
    steps = aligned_steps(layout, count, max(4, 32 // count))
    nodes, of_rod, ratio = ca.MX.sym("nodes", 4, count), ca.MX.sym("physics", layout.size), ca.MX.sym("ratio")
    one = _strain_graph(layout, steps)
    arguments = (nodes[:, piece.tolist()], ca.DM(s - piece / count).T, ca.DM(piece / count).T,
                 ca.repmat(of_rod, 1, points + 1), ca.repmat(ratio, 1, points + 1))  # fmt: skip
    along = one.map(points + 1)(*arguments)[0]
    return StrainGraphs(
        nodes=ca.Function("strain_nodes", [unknowns, vector, ratios], results),
        along=ca.Function("strain_along", [nodes, of_rod, ratio], [along.T]),
        there=_strain_graph(layout, aligned_steps(layout, count, _STEPS)),
        points=points,
        intervals=max(1, layout.intervals),
    )


def _strain(layout: Layout, physics: Any, state: Any, s: Any, ratio: Any) -> Any:
    """Strain of the outer fibre at s, where the rod's state is [theta, n_x, n_y, m]."""
    theta, n_x, n_y, m = ca.vertsplit(state)
    _, compliance, _, factors = unpacked(layout, physics)
    bend = m if factors is None else m / interpolated(factors, s)
    return ca.fabs(compliance * (n_x * ca.cos(theta) + n_y * ca.sin(theta))) + ratio * ca.fabs(bend)
