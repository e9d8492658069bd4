"""The mass matrix of the whole robot: its tip, and the rods whose shapes are slaves of (p, q) (see `inertia`)."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np

from ...buffered import BufferedFunction, graph_cache
from ...errors import ConvergenceError
from ...frozen import read_only
from ..robot import Robot
from ..rods.method import RodMethod, inlined
from ..rods.numbers import Kind

MassMatrix = tuple[np.ndarray, np.ndarray]  # M (2 + n, 2 + n) and d vec(M) / d(p, q), shape ((2 + n)^2, 2 + n)


def tip_mass(robot: Robot) -> MassMatrix:
    """Mass matrix of rods without mass."""
    n = robot.n_rods
    return read_only(np.diag([robot.tip_mass] * 2 + [0.0] * n)), read_only(np.zeros(((2 + n) ** 2, 2 + n)))


class CondensedMass:
    """Mass matrix at given unknowns of the rods.

    Parameters
    ----------
    robot : Robot
    method : RodMethod
        Whose unknowns they are.
    """

    def __init__(self, robot: Robot, method: RodMethod) -> None:
        kind = Kind(robot.n_rods, method.layout)
        self._graph = BufferedFunction(robot_mass(kind, method))
        self._graph.inputs[2][:] = kind.pack(robot)

    def __call__(self, unknowns: np.ndarray, q: np.ndarray, payload: float = 0.0) -> MassMatrix:
        """M and its slopes for w = [v, q'], in equilibrium, with what the tip carries [kg].

        Raises
        ------
        ConvergenceError
            They are not finite.
        """
        graph = self._graph
        graph.inputs[0][:], graph.inputs[1][:] = unknowns, q
        graph()
        mass, slopes = (output.copy() for output in graph.outputs)
        mass[0, 0] += payload
        mass[1, 1] += payload
        if not math.isfinite(slopes.sum()):
            raise ConvergenceError(
                f"the inertia of the rods at q = {q} rad has no finite derivative: a rod is straight and pushed; "
                "keep away from this pose",
                residual=math.nan,
                iterations=0,
                last=graph.inputs[0].copy(),
            )
        return read_only(mass), read_only(slopes)


@graph_cache(maxsize=16)
def robot_mass(kind: Kind, method: RodMethod) -> Any:
    """`mass_calls` as one list of instructions, if that is not too long."""
    return inlined(mass_calls(kind, method), method.mass())


@graph_cache(maxsize=16)
def mass_calls(kind: Kind, method: RodMethod) -> Any:
    """Graph of the mass matrix.

    Returns
    -------
    casadi.Function
        (unknowns (u, n), q (n), numbers) -> M (2 + n, 2 + n) in [kg, kg m, kg m^2] for w = [v, q'], and
        d vec(M) / d(p, q), shape ((2 + n)^2, 2 + n).
    """
    n, of_rod, vector = kind.n_rods, method.mass(), ca.MX.sym("numbers", kind.size)
    numbers = kind.unpack(vector)
    unknowns, q = ca.MX.sym("unknowns", of_rod.size1_in(0), n), ca.MX.sym("q", n)
    mass, slopes = ca.MX(2 + n, 2 + n), ca.MX((2 + n) ** 2, 2 + n)
    mass[0, 0] = mass[1, 1] = numbers.tip_mass
    for i, rod in enumerate(numbers.rods):
        rod_matrix, rod_slopes = of_rod(unknowns[:, i], q[i], *rod.physics)
        units = ca.vertcat(1, 1, rod.length)
        scale = rod.line_density * rod.length * units @ units.T
        rod_slopes = ca.diag(ca.vec(scale)) @ rod_slopes @ ca.diag(ca.vertcat(1 / rod.length, 1 / rod.length, 1))
        own = [0, 1, 2 + i]
        places = [row + (2 + n) * column for column in own for row in own]
        mass[own, own] += scale * rod_matrix
        slopes[places, own] += rod_slopes
    return ca.Function("robot_mass", [unknowns, q, vector], [ca.densify(mass), ca.densify(slopes)])
