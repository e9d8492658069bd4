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
from ..rods.closed_form.inertia import along, by_pose_of_tip, point_at, seen_along_force, turned
from ..rods.numbers import Kind
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
    log_tip_angle, load, hand = ca.vertsplit(unknowns)
    base = point_at(log_tip_angle, load, any_pull=True)
    tip = along(base, None, 0.0, load)
    mean = [ca.SX(2, 1)] * len(tip)
    for x, share in zip(*np.polynomial.legendre.leggauss(_POINTS), strict=True):
        sigma = (1 - x) / 2
        there = along(base, point_at(log_tip_angle, load * sigma, any_pull=True), sigma, load)
        mean = [so_far + share / 2 * part for so_far, part in zip(mean, there, strict=True)]
    view = seen_along_force(hand * angle + base.delta, hand)
    e = view[:2, :2] @ down
    # U = -e . mean, where e turns back as psi grows; (a, l, psi) follow (p, q).
    whole = by_pose_of_tip(tip[0], tip[1], tip[2], ca.vertcat(base.delta_a, base.delta_u))
    seen = whole.T @ ca.vertcat(-ca.dot(e, mean[1]), -ca.dot(e, mean[2]), ca.dot(turned(e), mean[0]))
    # Second derivatives of U less (p, q) times its slopes: how (a, l, psi) bend over (p, q) drops out.
    both = [
        ca.vertcat(ca.dot(e, m) + ca.dot(seen[:2], t), ca.dot(turned(e), m) + ca.dot(turned(seen[:2]), t))
        for m, t in zip(mean, tip, strict=True)
    ]
    aa, al, ll = (
        seen[2] * slope - part[0]
        for slope, part in zip((base.delta_aa, base.delta_au, base.delta_uu), both[3:], strict=True)
    )
    bent = ca.vertcat(
        ca.horzcat(aa, al, both[1][1]), ca.horzcat(al, ll, both[2][1]), ca.horzcat(both[1][1], both[2][1], both[0][0])
    )
    along_force = whole @ view
    results = [-ca.dot(e, mean[0]), view.T @ seen, along_force.T @ bent @ along_force]
    arguments, options = [unknowns, angle, down], {"cse": True}
    return (
        ca.Function("rod_weight", arguments, [ca.densify(r) for r in results[:2]], options),
        ca.Function("rod_weight_slope", arguments, [ca.densify(results[2])], options),
    )


@graph_cache(maxsize=16)
def robot_weight(kind: Kind) -> tuple[Any, Any]:
    """Graphs of plain rods: (unknowns (3, n), q (n), numbers) -> U_g [J], dU_g/d(p, q) (2 + n); second derivatives."""
    n = kind.n_rods
    # Rods as calls: twice as quick to compile as one list of instructions.
    unknowns, q, vector = ca.MX.sym("unknowns", 3, n), ca.MX.sym("q", n), ca.MX.sym("numbers", kind.size)
    numbers = kind.unpack(vector)
    energy, slope, curvature = ca.MX(0), ca.MX(ca.DM.zeros(2 + n)), ca.MX(ca.DM.zeros(2 + n, 2 + n))
    first, second = _rod_weight()
    for i, rod in enumerate(numbers.rods):
        known = unknowns[:, i], q[i], rod.line_density * rod.length * numbers.gravity
        own = ca.DM.eye(2 + n)[[0, 1, 2 + i], :]
        by_pose = ca.diag(ca.vertcat(1 / rod.length, 1 / rod.length, 1)) @ own
        of_rod, slope_of_rod = first(*known)
        energy += rod.length * of_rod
        slope += rod.length * by_pose.T @ slope_of_rod
        curvature += rod.length * by_pose.T @ second(*known) @ by_pose
    return (
        ca.Function("weight", [unknowns, q, vector], [energy, ca.densify(slope)]),
        ca.Function("weight_slope", [unknowns, q, vector], [ca.densify(curvature)]),
    )
