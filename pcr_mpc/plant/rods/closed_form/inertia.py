"""Inertia of the rods without a state of its own: the mass matrix that their shapes, slaves of (p, q), carry.

With the rods in equilibrium at every instant, a point of rod i moves with dr/dp v + dr/dq_i q_i', and

    T = m |v|^2 / 2 + sum_i mu_i / 2 int |dr/dp v + dr/dq_i q_i'|^2 ds = w' M(p, q) w / 2,    w = [v, q'].

A rod is the pendulum of `elastica`: delta'' = sin(delta), Y = delta', C = int cos(delta) du, and alpha the tip angle.
Its derivatives in alpha are explicit too, so that a point of the rod costs one evaluation of the elliptic functions.
With W = int Y^2 du / 2 = u cos(alpha) - C,

    delta_alpha = (2 sin(delta) + W Y) / (2 sin(alpha)),    C_alpha = -(u sin(alpha) + Y delta_alpha) / 2,

the first because both sides solve eta'' = cos(delta) eta with eta(0) = 1, eta'(0) = 0, the second because
Y eta' - sin(delta) eta = -sin(alpha) (their Wronskian); second derivatives by differentiating these.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.special import roots_jacobi

from ....buffered import graph_cache
from .pendulum import elliptic, swing

INERTIAS = ("none", "constant", "condensed", "full")
# Points along a rod, beside the tip: 1e-5 of its inertia (1e-3 of the smallest entries) where rods are bent like those
# of the default robot, 1e-2 within per cents of their limit of stability.
_POINTS = 6
# Enough for k > 0.01, that is for all but straight rods pushed along their axis.
_LANDEN_STEPS = 5
# Logarithm of a tip angle beside which what is explicit in it is nothing.
_SMALLEST = -300.0


class Point(NamedTuple):
    """F = (C, -Y) and delta at u with their derivatives in a = log(alpha) and u: tip to point, seen along the force."""

    f: Any
    f_a: Any
    f_u: Any
    f_aa: Any
    f_au: Any
    f_uu: Any
    delta: Any
    delta_a: Any
    delta_u: Any
    delta_aa: Any
    delta_au: Any
    delta_uu: Any


def point_at(log_tip_angle: Any, u: Any, *, any_pull: bool = False) -> Point:
    """Return the point at u.

    Right up to a = -300, and beyond with ``any_pull``; see `pendulum`.
    """
    return Point(*_point(any_pull=any_pull)(log_tip_angle, u))


@graph_cache()
def _point(*, any_pull: bool) -> Any:
    """Graph of `point_at`, which CasADi copies into others faster than Python writes it down again."""
    log_tip_angle, u = ca.SX.sym("log_tip_angle"), ca.SX.sym("u")
    alpha = ca.exp(ca.fmax(log_tip_angle, _SMALLEST) if any_pull else log_tip_angle)
    k, k_prime = ca.cos(alpha / 2), ca.sin(alpha / 2)
    if any_pull:
        (cos, sin, y, c), half = swing(log_tip_angle, u, any_pull=True)
        w = u * ca.cos(alpha) - c
    else:
        sn, cn, dn, d = elliptic(u, k, k_prime, _LANDEN_STEPS)
        half = k_prime / dn, k * cn / dn
        sin, cos = 2 * half[0] * half[1], 1 - 2 * half[0] ** 2
        y, w = 2 * k * sn * half[0], 2 * (d - k_prime**2 * u)
    sin_alpha, cos_alpha = 2 * k * k_prime, 1 - 2 * k_prime**2
    over = alpha / (2 * sin_alpha)
    pull, damp = u * alpha * sin_alpha, 1 - alpha * cos_alpha / sin_alpha
    eta = (2 * sin + w * y) * over
    y_a = (2 * cos * y + y**3 / 2 + w * sin) * over
    w_a = (y * eta - pull) / 2
    eta_a = (2 * cos * eta + w_a * y + w * y_a) * over + damp * eta
    y_aa = ((2 * cos + 1.5 * y**2) * y_a - 2 * sin * eta * y + w_a * sin + w * cos * eta) * over + damp * y_a
    c_aa = -(pull + u * alpha**2 * cos_alpha + y_a * eta + y * eta_a) / 2
    found = Point(
        f=ca.vertcat(u * cos_alpha - w, -y),
        f_a=ca.vertcat(-(pull + y * eta) / 2, -y_a),
        f_u=ca.vertcat(cos, -sin),
        f_aa=ca.vertcat(c_aa, -y_aa),
        f_au=-eta * ca.vertcat(sin, cos),
        f_uu=-y * ca.vertcat(sin, cos),
        delta=2 * ca.atan2(*half),
        delta_a=eta,
        delta_u=y,
        delta_aa=eta_a,
        delta_au=y_a,
        delta_uu=sin,
    )
    return ca.Function("point", [log_tip_angle, u], list(found))


def along(base: Point, point: Point | None, sigma: float, load: Any) -> list[Any]:
    """Base to point, in L, and its derivatives: [g, g_a, g_l, g_aa, g_al, g_ll], l = lambda, u = lambda sigma.

    None: the tip itself.
    """
    zero = ca.SX(2, 1)
    f, f_a, f_u, f_aa, f_au, f_uu = [zero] * 6 if point is None else point[:6]
    g, g_a = (base.f - f) / load, (base.f_a - f_a) / load
    g_l = (base.f_u - sigma * f_u - g) / load
    g_aa = (base.f_aa - f_aa) / load
    g_al = (base.f_au - sigma * f_au - g_a) / load
    return [g, g_a, g_l, g_aa, g_al, (base.f_uu - sigma**2 * f_uu - 2 * g_l) / load]


def _quadrature(n_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances from the tip and weights of the integral along a rod: ``n_points`` and the tip, which costs nothing.

    The integrand, a product of velocities, begins with the square of the distance x from the base. Exact for x^2 times
    polynomials of degree 2 n_points (Gauss-Jacobi-Radau).
    """
    x, weights = roots_jacobi(n_points, 1.0, 2.0)
    x = (1 + x) / 2
    # Of int (1 - x) x^2 f dx = sum w f: divided by (1 - x) x^2; the tip takes what is missing of int x^2 dx.
    weights = weights / 16 / (x**2 * (1 - x))
    return np.append(1 - x, 0.0), np.append(weights, 1 / 3 - weights @ x**2)


def turned(vector: Any) -> Any:
    """Turn to the left by a right angle."""
    return ca.vertcat(-vector[1], vector[0])


def _moments(shape: list[Any]) -> tuple[list[Any], list[list[Any]]]:
    """Products of the velocities that (a', l', psi') give a point, and their derivatives in a and l."""
    g, first = shape[0], shape[1:3]
    second = [[shape[3], shape[4]], [shape[4], shape[5]]]
    pairs = [(0, 0), (0, 1), (1, 1)]
    values = [ca.dot(first[i], first[j]) for i, j in pairs]
    values += [ca.dot(first[i], turned(g)) for i in (0, 1)] + [ca.dot(g, g)]
    slopes = []
    for k in (0, 1):
        slope = [ca.dot(second[i][k], first[j]) + ca.dot(first[i], second[j][k]) for i, j in pairs]
        slope += [ca.dot(second[i][k], turned(g)) + ca.dot(first[i], turned(first[k])) for i in (0, 1)]
        slopes.append([*slope, 2 * ca.dot(g, first[k])])
    return values, slopes


@graph_cache()
def rod_mass() -> Any:
    """Graph of one rod of unit length and unit line density.

    Returns
    -------
    casadi.Function
        ([log tip_angle, lambda, hand], clamp angle) -> inertia M (3, 3) in (v, q'), and d vec(M) / d(p, q) (9, 3).
    """
    unknowns, angle = ca.SX.sym("unknowns", 3), ca.SX.sym("angle")
    log_tip_angle, load, hand = ca.vertsplit(unknowns)
    base = point_at(log_tip_angle, load)
    tip = along(base, None, 0.0, load)
    moments, slopes = ca.SX(6, 1), ca.SX(6, 2)
    for sigma, weight in zip(*_quadrature(_POINTS), strict=True):
        point = point_at(log_tip_angle, load * sigma) if sigma else None
        values, changes = _moments(along(base, point, sigma, load))
        moments += weight * ca.vertcat(*values)
        slopes += weight * ca.horzcat(*(ca.vertcat(*change) for change in changes))

    # Seen along the force, psi = q + delta at the base: (a', l', psi') by (v, q'), so that the tip moves with v.
    known = ca.vertcat(*tip[:3], base.delta_a, base.delta_u)
    z = ca.SX.sym("z", known.numel() + 6)
    at_tip, tip_a, tip_l, psi_y, m = z[0:2], z[2:4], z[4:6], z[6:8], z[8:14]
    whole = by_pose_of_tip(at_tip, tip_a, tip_l, psi_y)
    rates = whole[:2, :]
    mass = _upper(whole.T @ _symmetric(m) @ whole)
    by_y = ca.horzcat(
        ca.jtimes(mass, z, ca.vertcat(tip[1], tip[3], tip[4], base.delta_aa, base.delta_au, slopes[:, 0])),
        ca.jtimes(mass, z, ca.vertcat(tip[2], tip[4], tip[5], base.delta_au, base.delta_uu, slopes[:, 1])),
    )
    # Rates of psi turn the frame: M changes by M J - J M, J the turn by a right angle.
    turn = ca.DM([[0, -1, 0], [1, 0, 0], [0, 0, 0]])
    full = _symmetric(mass)
    by_pose = by_y @ rates + _upper(turn @ full - full @ turn) @ whole[2, :]
    mass, by_pose = ca.substitute([mass, by_pose], [z], [ca.vertcat(known, moments)])

    # To the world; a right-handed rod is the mirror image: y, q and their rates change sign.
    psi = hand * angle + base.delta
    view = seen_along_force(psi, hand)
    by_pose = by_pose @ view
    in_world = [_symmetric(_upper(view.T @ _symmetric(column) @ view)) for column in [mass, *ca.horzsplit(by_pose)]]
    results = [in_world[0], ca.horzcat(*(ca.vec(slope) for slope in in_world[1:]))]
    return ca.Function("rod_mass", [unknowns, angle], [ca.densify(result) for result in results], {"cse": True})


def by_pose_of_tip(at_tip: Any, tip_a: Any, tip_l: Any, psi_y: Any) -> Any:
    """Rates (3, 3) of (a, l, psi) by those of the tip, seen along the force, and of the clamp."""
    jacobian = ca.horzcat(tip_a + psi_y[0] * turned(at_tip), tip_l + psi_y[1] * turned(at_tip))
    determinant = jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]
    inverse = ca.vertcat(
        ca.horzcat(jacobian[1, 1], -jacobian[0, 1]), ca.horzcat(-jacobian[1, 0], jacobian[0, 0])
    ) / determinant  # fmt: skip
    rates = ca.horzcat(inverse, -inverse @ turned(at_tip))
    return ca.vertcat(rates, psi_y.T @ rates + ca.horzcat(0, 0, 1))


def seen_along_force(psi: Any, hand: Any) -> Any:
    """(p, q) from the world (3, 3); a right-handed rod is the mirror image."""
    cos, sin = ca.cos(psi), ca.sin(psi)
    return ca.diagcat(ca.vertcat(ca.horzcat(cos, hand * sin), ca.horzcat(-sin, hand * cos)), hand)


def _upper(matrix: Any) -> Any:
    return ca.vertcat(*(matrix[i, j] for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))))


def _symmetric(m: Any) -> Any:
    return ca.vertcat(ca.horzcat(m[0], m[1], m[3]), ca.horzcat(m[1], m[2], m[4]), ca.horzcat(m[3], m[4], m[5]))
