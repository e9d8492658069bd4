"""The rods' weight without a state or a shape of its own: its potential at the weightless shape.

To first order in mu g the shape of a rod does not matter for its energy, because at (p, q) it is stationary. With r the
centreline of the weightless rod, the weight therefore adds

    U_g(p, q) = -sum_i mu_i int g . (r_i(s; p, q) - b_i) ds

to U, dU_g/dp to F and dU_g/dq to the motors' torques, and what is left out is of second order in mu g L^3/EI. The
centreline is that of the closed form (see `elastica`), its unknowns follow (p, q) by the implicit function theorem.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from ...buffered import BufferedFunction, graph_cache
from ..robot import Robot
from ..rods.numbers import Kind
from ..rods.pendulum import pendulum
from .equilibrium import Equilibrium

WEIGHTS = ("none", "condensed", "exact")
_POINTS = 8  # of Gauss and Legendre along a rod


class CondensedWeight:
    """Potential of the rods' weight and its derivatives in w = [p, q], at given unknowns of the closed form.

    Parameters
    ----------
    robot : Robot
    """

    def __init__(self, robot: Robot) -> None:
        kind = Kind(robot.n_rods)
        self._first, self._second = (BufferedFunction(graph) for graph in robot_weight(kind))
        self._first.inputs[2][:] = self._second.inputs[2][:] = kind.pack(robot)

    def first(self, unknowns: np.ndarray, q: np.ndarray) -> tuple[float, np.ndarray]:
        """U_g [J] and dU_g/d(p, q), shape (2 + n,) [N, N m]."""
        energy, slope = self._evaluate(self._first, unknowns, q)
        return float(energy[0]), slope.copy()

    def second(self, unknowns: np.ndarray, q: np.ndarray) -> np.ndarray:
        """d2U_g/d(p, q)2, shape (2 + n, 2 + n) [N/m, N/rad, N m/rad]."""
        return np.asarray(self._evaluate(self._second, unknowns, q)[0].copy())

    def added(self, eq: Equilibrium, unknowns: np.ndarray) -> Equilibrium:
        """Return an equilibrium of weightless rods with the weight in everything but their shape."""
        energy, slope = self.first(unknowns, eq.q)
        curvature = self.second(unknowns, eq.q)
        return replace(
            eq,
            force=eq.force + slope[:2],
            dforce_dp=eq.dforce_dp + curvature[:2, :2],
            dforce_dq=eq.dforce_dq + curvature[:2, 2:],
            motor_torque=eq.motor_torque + slope[2:],
            dtorque_dq=eq.dtorque_dq + np.diag(curvature)[2:],
            energy=eq.energy + energy,
        )

    @staticmethod
    def _evaluate(graph: BufferedFunction, unknowns: np.ndarray, q: np.ndarray) -> list[np.ndarray]:
        graph.inputs[0][:], graph.inputs[1][:] = unknowns, q
        graph()
        return graph.outputs


@graph_cache()
def _rod_weight() -> tuple[Any, Any]:
    """Graphs of one rod of unit length and unit weight.

    Returns
    -------
    first : casadi.Function
        ([log tip_angle, lambda, hand], clamp angle, direction of gravity (2)) -> U_g, dU_g / d(p, q) (3).
    second : casadi.Function
        Same arguments -> d2U_g / d(p, q)2 (3, 3).
    """
    unknowns, angle, down = ca.SX.sym("unknowns", 3), ca.SX.sym("angle"), ca.SX.sym("down", 2)
    moving, hand, pose = unknowns[:2], unknowns[2], ca.SX.sym("pose", 3)
    load = unknowns[1]
    delta, rate, c = pendulum(unknowns[0], load, any_pull=True)
    cos, sin = ca.cos(delta), ca.sin(delta)

    def seen_from_clamp(along: Any, across: Any) -> Any:
        return ca.vertcat(cos * along + sin * across, sin * along - cos * across) / load

    mean = ca.SX(2, 1)
    for x, weight in zip(*np.polynomial.legendre.leggauss(_POINTS), strict=True):
        _, rate_there, c_there = pendulum(unknowns[0], load * (1 - x) / 2, any_pull=True)
        mean += weight / 2 * seen_from_clamp(c - c_there, rate - rate_there)
    turn = ca.vertcat(
        ca.horzcat(ca.cos(pose[2]), ca.sin(pose[2])), hand * ca.horzcat(-ca.sin(pose[2]), ca.cos(pose[2]))
    )
    energy = -ca.dot(turn @ down, mean)
    # The unknowns keep the tip, seen from the clamp, where the pose puts it.
    missed = seen_from_clamp(c, rate) - turn @ pose[:2]
    moves = -ca.solve(ca.jacobian(missed, moving), ca.jacobian(missed, pose))
    slope = (ca.jacobian(energy, moving) @ moves + ca.jacobian(energy, pose)).T
    curvature = ca.jacobian(slope, moving) @ moves + ca.jacobian(slope, pose)
    tip = turn.T @ seen_from_clamp(c, rate)  # turn is orthogonal
    results = ca.substitute([energy, slope, curvature], [pose], [ca.vertcat(tip, angle)])
    results = ca.substitute(results, [pose], [ca.vertcat(tip, angle)])  # turn in the tip holds the angle
    arguments, options = [unknowns, angle, down], {"cse": True}
    return (
        ca.Function("rod_weight", arguments, [ca.densify(r) for r in results[:2]], options),
        ca.Function("rod_weight_slope", arguments, [ca.densify(results[2])], options),
    )


@graph_cache(maxsize=16)
def robot_weight(kind: Kind) -> tuple[Any, Any]:
    """Graphs of plain rods: (unknowns (3, n), q (n), numbers) -> U_g [J], dU_g/d(p, q) (2 + n); second derivatives."""
    n = kind.n_rods
    unknowns, q, vector = ca.SX.sym("unknowns", 3, n), ca.SX.sym("q", n), ca.SX.sym("numbers", kind.size)
    numbers = kind.unpack(vector)
    energy, slope, curvature = ca.SX(1, 1), ca.SX(2 + n, 1), ca.SX(2 + n, 2 + n)
    first, second = _rod_weight()
    for i, rod in enumerate(numbers.rods):
        known = unknowns[:, i], q[i], rod.line_density * rod.length * numbers.gravity
        by_pose = ca.diag(ca.vertcat(1 / rod.length, 1 / rod.length, 1))
        own = [0, 1, 2 + i]
        of_rod, slope_of_rod = first(*known)
        energy += rod.length * of_rod
        slope[own] += rod.length * by_pose @ slope_of_rod
        curvature[own, own] += rod.length * by_pose @ second(*known) @ by_pose
    options = {"cse": True}
    return (
        ca.Function("weight", [unknowns, q, vector], [energy, ca.densify(slope)], options),
        ca.Function("weight_slope", [unknowns, q, vector], [ca.densify(curvature)], options),
    )
