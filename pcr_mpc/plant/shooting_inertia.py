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

from functools import lru_cache
from typing import Any

import casadi as ca

from .multiple_shooting import Sweep
from .rod import Layout, propagation, rod_ode, runge_kutta

_PAIRS = [[a, b] for b in range(3) for a in range(b + 1)]  # of poses, as columns of second derivatives


@lru_cache
def rod_mass(segments: int, steps: int, scheme: str, layout: Layout | None = None) -> Any:
    """Graph of one rod of unit length and unit line density.

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
    h = 1.0 / segments
    flat, angle = ca.SX.sym("nodes", 4 * segments), ca.SX.sym("angle")
    physics = ca.SX.sym("physics", layout.size if layout else 0)
    starts = [flat[4 * j : 4 * j + 4] for j in range(segments)]
    starts[0] = ca.vertcat(angle, flat[1:4])
    known = [() if layout is None else (j * h, physics) for j in range(segments)]
    ends = [propagation(steps, scheme, layout)(z, h, *more) for z, more in zip(starts, known, strict=True)]
    sweep, nothing = Sweep(ends, starts), [ca.SX(6, 3)] * segments
    firsts = sweep.solve(ca.diagcat(0, 0, 1), ca.diagcat(1, 1, 0), nothing)
    along = _variations(steps, scheme, layout)
    alone = [along(z, first, ca.SX(6, 6), h, *more)[0] for z, first, more in zip(starts, firsts, known, strict=True)]
    seconds = sweep.solve(ca.SX(3, 6), ca.SX(3, 6), alone)
    mass, products = ca.SX(3, 3), ca.SX(6, 3)
    for z, first, second, more in zip(starts, firsts, seconds, known, strict=True):
        _, of_mass, of_products = along(z, first, second, h, *more)
        mass += of_mass
        products += of_products

    column = {pair: k for k, (a, b) in enumerate(_PAIRS) for pair in ((a, b), (b, a))}
    slopes = [
        [products[column[a, c], b] + products[column[b, c], a] for c in range(3)] for b in range(3) for a in range(3)
    ]
    arguments = [flat, angle, physics] if layout else [flat, angle]
    results = [ca.densify(mass), ca.densify(ca.vertcat(*(ca.horzcat(*row) for row in slopes)))]
    return ca.Function("rod_mass", arguments, results, {"cse": True})


@lru_cache
def _variations(steps: int, scheme: str, layout: Layout | None) -> Any:
    """Graph (z (4), y_a (6, 3), y_ab (6, 6), h[, s, physics]) -> y_ab at the end, int r_a . r_b, int r_ab . r_c."""
    z, first, second = ca.SX.sym("z", 4), ca.SX.sym("first", 6, 3), ca.SX.sym("second", 6, 6)
    h, s, physics = ca.SX.sym("h"), ca.SX.sym("s"), ca.SX.sym("physics", layout.size if layout else 0)

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
        moved = jacobian @ second + bends
        positions = first[:2, :]
        return ca.vertcat(
            rates,
            ca.vec(jacobian @ first),
            ca.vec(moved),
            ca.vec(positions.T @ positions),
            ca.vec(second[:2, :].T @ positions),
        )

    start = ca.vertcat(0, 0, z, ca.vec(first), ca.vec(second), ca.SX(9 + 18, 1))
    end = runge_kutta(slope, start, h, steps, scheme, layout, s, physics)
    _, _, seconds, mass, products = _split(end)
    arguments = [z, first, second, h, s, physics] if layout else [z, first, second, h]
    return ca.Function("variations", arguments, [seconds, mass, products], {"cse": True})


def _split(state: Any) -> list[Any]:
    shapes, blocks, at = [(6, 1), (6, 3), (6, 6), (3, 3), (6, 3)], [], 0
    for rows, columns in shapes:
        blocks.append(ca.reshape(state[at : at + rows * columns], rows, columns))
        at += rows * columns
    return blocks
