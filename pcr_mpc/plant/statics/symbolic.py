"""The robot as a symbolic differential-algebraic equation, for those who optimise over it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ...buffered import graph_cache
from ...errors import checked_array
from ..robot import Robot
from ..rods.closed_form.elastica import beyond_limit
from ..rods.closed_form.pendulum import pendulum
from ..rods.method import closed_form_method
from ..rods.physics import require_plain
from .equilibrium import Equilibrium
from .solver import RodSolver


@graph_cache(maxsize=16)
def symbolic_dynamics(robot: Robot, hands: tuple[float, ...]) -> Any:
    """Equations of motion with the rods' unknowns as algebraic variables: closed form, nothing is iterated.

    The rods' unknowns are z = [log tip_angle, lambda] of each rod in turn (see `elastica`); where the residual is
    zero, the acceleration is that of `Plant` with ``method = "closed_form"``.

    Parameters
    ----------
    robot : Robot
    hands : tuple of {+1, -1}, length n
        The side to which each rod turns at its tip; it changes only through a straight rod.

    Returns
    -------
    casadi.Function
        (p (2) [m], v (2) [m/s], q (n) [rad], z (2n), f_ext (2) [N]) -> (acceleration (2) [m/s^2],
        residual (2n) = (tip of the rod - p) / L, beyond (n): 1 where a rod is past its limit of stability with
        the tip held, else 0).
    """
    n = robot.n_rods
    p, v, f_ext = ca.SX.sym("p", 2), ca.SX.sym("v", 2), ca.SX.sym("f_ext", 2)
    q, z = ca.SX.sym("q", n), ca.SX.sym("z", 2 * n)
    force, residual, _, beyond = _rods(robot, hands, p, q, z, "symbolic_dynamics")
    acceleration = (f_ext - force - robot.drag * v) / robot.tip_mass
    return ca.Function(
        "dynamics",
        [p, v, q, z, f_ext],
        [acceleration, residual, beyond],
        ["p", "v", "q", "z", "f_ext"],
        ["acceleration", "residual", "beyond"],
        {"cse": True},
    )


@graph_cache(maxsize=16)
def symbolic_statics(robot: Robot, hands: tuple[float, ...], stiffness: bool = False) -> Any:
    """What the rods carry, with their unknowns as in `symbolic_dynamics`.

    Returns
    -------
    casadi.Function
        (p (2) [m], q (n) [rad], z (2n)) -> (F (2) [N], residual (2n), motor torques (n) [N m]), and if ``stiffness``
        then K (2, 2) [N/m], by implicit differentiation.
    """
    n = robot.n_rods
    p, q, z = ca.SX.sym("p", 2), ca.SX.sym("q", n), ca.SX.sym("z", 2 * n)
    force, residual, torque, _ = _rods(robot, hands, p, q, z, "symbolic_statics")
    found = [force, residual, torque]
    if stiffness:
        k = ca.SX(2, 2)
        for i, rod in enumerate(robot.rods):
            own = slice(2 * i, 2 * i + 2)
            # The rod's tip follows p: d residual/dz dz/dp = 1/L.
            k += ca.jacobian(force, z[own]) @ ca.solve(ca.jacobian(residual[own], z[own]), ca.SX.eye(2)) / rod.length
        found.append(k)
    return ca.Function("statics", [p, q, z], found, {"cse": True})


def _rods(robot: Robot, hands: tuple[float, ...], p: Any, q: Any, z: Any, what: str) -> tuple[Any, Any, Any, Any]:
    """Expressions of force, residual, motor torques, and whether rods are past their limit."""
    require_plain(robot, what)
    n = robot.n_rods
    if len(hands) != n or any(abs(hand) != 1.0 for hand in hands):
        raise ValueError(f"hands is {hands}, expected +1 or -1 for each of {n} rods")
    force, residuals, torques, beyond = ca.SX(2, 1), [], [], []
    for i, (rod, hand) in enumerate(zip(robot.rods, hands, strict=True)):
        unknowns = z[2 * i : 2 * i + 2]
        load = unknowns[1]
        delta, rate, chord = pendulum(unknowns[0], load)
        # In the frame of the force, which is psi away from the world, the tip is (chord, -hand rate) / load.
        psi = q[i] + hand * delta
        along, across = ca.vertcat(ca.cos(psi), ca.sin(psi)), hand * ca.vertcat(-ca.sin(psi), ca.cos(psi))
        tip = (chord * along - rate * across) / load
        residual = ca.DM(rod.base) / rod.length + tip - p / rod.length
        residuals.append(residual)
        force += rod.bending_stiffness / rod.length**2 * load**2 * along
        torques.append(-rod.bending_stiffness / rod.length * hand * load * rate)
        beyond.append(beyond_limit(hand * ca.det(ca.jacobian(residual, unknowns)), unknowns))
    return force, ca.vertcat(*residuals), ca.vertcat(*torques), ca.vertcat(*beyond)


def rod_unknowns(robot: Robot, pose: Equilibrium) -> tuple[tuple[float, ...], Callable[..., np.ndarray]]:
    """Hands of the rods in a pose, and a function that solves for their unknowns along a path that starts near it.

    Returns
    -------
    hands : tuple of float, length n
        As `symbolic_dynamics` wants them.
    along : callable
        (p (K, 2) [m], q (K, n) [rad]) -> z (K, 2n). It follows the branch from ``pose`` to the first point and from
        each to the next, on which no rod turns to its other side, and remembers nothing; raises `UnreachableError`,
        `UnstableError` or `ConvergenceError` where that is not possible.
    """
    solver = RodSolver(robot, closed_form_method())
    solver.start(pose.p, pose.q, pose.nodes)
    hands = tuple(solver.state.unknowns[2].tolist())

    def along(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        count = len(p)
        p, q = checked_array("p", p, (count, 2)), checked_array("q", q, (count, robot.n_rods))
        solver.start(pose.p, pose.q, pose.nodes)
        found = np.empty((count, 2 * robot.n_rods))
        for k in range(count):
            robot.require_reachable(p[k])
            solver.move(p[k], q[k])
            found[k] = solver.state.unknowns[:2].ravel(order="F")
        return found

    return hands, along
