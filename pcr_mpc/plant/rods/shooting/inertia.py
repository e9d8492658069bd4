"""Condensed inertia of rods solved by shooting: what `inertia` does for the closed form, for rods of any kind.

With y = [x, y, theta, n_x, n_y, m] along a rod and pose = [tip relative to the base, clamp angle], the mass matrix

    M_ab = int r_a . r_b ds,    d M_ab / d pose_c = int r_ac . r_b + r_a . r_bc ds

takes the first and second derivatives y_a, y_ab of the shape in the pose. They obey the linearised rod equations,

    y_a' = f_y y_a,    y_ab' = f_y y_ab + f_yy[y_a, y_b],

with the ends held as the pose says, by the implicit function theorem: the sweep that solves a Newton step (see
`multiple_shooting.Sweep`) gives their values at the nodes, once with moved ends and once with what f_yy leaves as gaps
between the segments. Between the nodes they are integrated by the scheme of the rod itself, which makes them the
derivatives of the discrete rod to rounding, and the integrals are those of the same scheme.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ....buffered import graph_cache
from ..equations import Layout, propagation, rod_ode, runge_kutta
from .multiple_shooting import Sweep

_PAIRS = [[a, b] for b in range(3) for a in range(b + 1)]  # of poses, as columns of second derivatives


@graph_cache()
def rod_mass(segments: int, steps: int, scheme: str, layout: Layout | None = None) -> Any:
    """Graph of one rod of unit length and unit line density.

    It calls the same small graphs for all segments: written out, a C compiler takes minutes for it (see `compiled`).

    Parameters
    ----------
    segments, steps, scheme, layout
        As of `multiple_shooting.rod_newton`.

    Returns
    -------
    casadi.Function
        (nodes (4N) of an equilibrium, clamp angle), with a layout also the rod's numbers -> inertia M (3, 3) in
        (v, q'), and d vec(M) / d(p, q) (9, 3).
    """
    flat, angle = ca.MX.sym("nodes", 4 * segments), ca.MX.sym("angle")
    physics = ca.MX.sym("physics", layout.size if layout else 0)
    starts = ca.reshape(ca.vertcat(angle, flat[1:]), 4, segments)
    at = ca.DM(np.arange(segments) / segments).T
    known = [] if layout is None else [at, ca.repmat(physics, 1, segments)]
    jacobian, alone, integrals = (graph.map(segments) for graph in _segment(1.0 / segments, steps, scheme, layout))
    first_sweep, second_sweep = _sweeps(segments)
    jacobians = jacobian(starts, *known)
    firsts = first_sweep(jacobians)
    seconds = second_sweep(jacobians, alone(starts, firsts, *known))
    together = ca.repmat(ca.DM.eye(3), segments, 1)  # the sum over blocks that stand side by side
    mass, products = (pieces @ together for pieces in integrals(starts, firsts, seconds, *known))

    column = {pair: k for k, (a, b) in enumerate(_PAIRS) for pair in ((a, b), (b, a))}
    slopes = [
        [products[column[a, c], b] + products[column[b, c], a] for c in range(3)] for b in range(3) for a in range(3)
    ]
    arguments = [flat, angle, physics] if layout else [flat, angle]
    return ca.Function("rod_mass", arguments, [mass, ca.vertcat(*(ca.horzcat(*row) for row in slopes))])


@graph_cache()
def _sweeps(segments: int) -> tuple[Any, Any]:
    """Graphs of what joins the segments, whose Jacobians stand side by side as all else does.

    Returns
    -------
    first : casadi.Function
        Jacobians (6, 4N) -> y_a at the starts of the segments (6, 3N).
    second : casadi.Function
        (Jacobians, gaps (6, 6N)) -> y_ab at the starts (6, 6N).
    """
    jacobians, gaps = ca.SX.sym("jacobians", 6, 4 * segments), ca.SX.sym("gaps", 6, 6 * segments)
    sweep, nothing = Sweep(ca.horzsplit(jacobians, 4)), [ca.SX(6, 3)] * segments
    firsts = sweep.solve(ca.diagcat(0, 0, 1), ca.diagcat(1, 1, 0), nothing)
    seconds = sweep.solve(ca.SX(3, 6), ca.SX(3, 6), ca.horzsplit(gaps, 6))
    return (
        ca.Function("first_sweep", [jacobians], [ca.densify(ca.horzcat(*firsts))], {"cse": True}),
        ca.Function("second_sweep", [jacobians, gaps], [ca.densify(ca.horzcat(*seconds))], {"cse": True}),
    )


@graph_cache()
def _segment(h: float, steps: int, scheme: str, layout: Layout | None) -> tuple[Any, Any, Any]:
    """Graphs of a segment of length h from z = [theta, n_x, n_y, m] on; with a layout also of s and the rod's numbers.

    Returns
    -------
    jacobian : casadi.Function
        z -> derivatives of y at the end (6, 4) in z.
    alone : casadi.Function
        (z, y_a (6, 3)) -> y_ab at the end (6, 6) if it is zero at the start.
    integrals : casadi.Function
        (z, y_a (6, 3), y_ab (6, 6)) -> int r_a . r_b (3, 3), int r_ab . r_c (6, 3).
    """
    z, first, second = ca.SX.sym("z", 4), ca.SX.sym("first", 6, 3), ca.SX.sym("second", 6, 6)
    s, physics = ca.SX.sym("s"), ca.SX.sym("physics", layout.size if layout else 0)

    def slope(state: Any, here: Any) -> Any:
        y, first, second, *_ = _split(state)
        symbol = ca.SX.sym("y", 6)
        rates = rod_ode(ca.vertcat(symbol, 0), here)[:6]
        jacobian = ca.jacobian(rates, symbol)
        directions, others = ca.SX.sym("a", 6), ca.SX.sym("b", 6)
        bend = ca.jtimes(ca.jtimes(rates, symbol, directions), symbol, others)
        both = ca.vertcat(directions, others)
        bends = ca.horzcat(*(ca.substitute(bend, both, ca.vec(first[:, pair])) for pair in _PAIRS))
        rates, jacobian, bends = ca.substitute([rates, jacobian, bends], [symbol], [y])
        positions = first[:2, :]
        return ca.vertcat(
            rates,
            ca.vec(jacobian @ first),
            ca.vec(jacobian @ second + bends),
            ca.vec(positions.T @ positions),
            ca.vec(second[:2, :].T @ positions),
        )

    def end(second: Any) -> list[Any]:
        start = ca.vertcat(0, 0, z, ca.vec(first), ca.vec(second), ca.SX(9 + 18, 1))
        return [ca.densify(part) for part in _split(runge_kutta(slope, start, h, steps, scheme, layout, s, physics))]

    known = [s, physics] if layout else []
    of_rod = propagation(steps, scheme, layout)(z, h, *known)
    _, _, alone, *_ = end(ca.SX(6, 6))
    *_, mass, products = end(second)
    return (
        ca.Function("jacobian", [z, *known], [ca.densify(ca.jacobian(of_rod[:6], z))], {"cse": True}),
        ca.Function("alone", [z, first, *known], [alone], {"cse": True}),
        ca.Function("integrals", [z, first, second, *known], [mass, products], {"cse": True}),
    )


def _split(state: Any) -> list[Any]:
    shapes, blocks, at = [(6, 1), (6, 3), (6, 6), (3, 3), (6, 3)], [], 0
    for rows, columns in shapes:
        blocks.append(ca.reshape(state[at : at + rows * columns], rows, columns))
        at += rows * columns
    return blocks
