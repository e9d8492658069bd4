"""The rod in closed form: Jacobi elliptic functions, exact for a uniform weightless rod.

A rod with a moment-free tip is half a swing of the pendulum delta'' = sin(delta), u = lambda * (distance from
the tip), released at rest at the tip from delta = tip_angle (see `chart`). With k' = sin(tip_angle / 2) and
k = cos(tip_angle / 2),

    sin(delta/2) = k' nd(u),    cos(delta/2) = k cd(u),    delta' = int sin(delta) du = 2 k k' sd(u),
    int cos(delta) du = u - 2 D(u),    D = E(am u) - k^2 sn(u) cd(u),

so (log tip_angle, lambda) gives the tip, the force and the moment explicitly, and statics is a 2 x 2 Newton
iteration per rod. The logarithm is the variable because a taut rod has tip_angle of the order of exp(-lambda).
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ....buffered import graph_cache
from ..equations import sample_rod
from .pendulum import Swing, beyond_numbers, pendulum, swing, swing_with_slopes

_COARSE = 100.0  # load from which residuals are weighed down
_SWEEP = 60  # points along the rod at which conjugate points are looked for
_GENTLE = 2.0  # load below which steps are taken in the components of the force
_LEAST_LOAD = 1e-3  # of nodes that are a guess
TAUT = 8.0  # load from which a stable rod is taut: its tip is straight to exp(-8)
# Angles below this, taken from nodes, are not trusted.
_ROUNDING = 1e-5


def _tip(found: Swing, load: Any) -> Any:
    """Tip seen from the clamp, of a left-handed rod."""
    along, across = found.cos * found.c + found.sin * found.rate, found.sin * found.c - found.cos * found.rate
    return ca.vertcat(along, across) / load


def _energy(log_tip_angle: Any, found: Swing, load: Any) -> Any:
    return load**2 * ca.cos(ca.exp(log_tip_angle)) - load * found.c


def beyond_limit(determinant: Any, unknowns: Any) -> Any:
    """Whether a rod with its tip held is past its limit of stability, by the determinant of its tip's Jacobian."""
    # It is negative on the stable sheet, and its first zero is the limit. It turns negative again at the second
    # zero, which lies beyond this line for every tip angle.
    return ca.logic_or(determinant >= 0, unknowns[1] > 2 * (np.log(8.0) - unknowns[0]) + 5)


@graph_cache()
def tip_map() -> Any:
    """Graph [log tip_angle, lambda] -> tip (2), its Jacobian (2, 2), energy, for a left-handed rod."""
    unknowns = ca.SX.sym("unknowns", 2)
    found, _ = swing(unknowns[0], unknowns[1], any_pull=True)
    tip, energy = _tip(found, unknowns[1]), _energy(unknowns[0], found, unknowns[1])
    return ca.Function("tip_map", [unknowns], [tip, ca.jacobian(tip, unknowns), energy], {"cse": True})


@graph_cache()
def tip_determinant() -> Any:
    """Graph (log tip_angle, lambda) -> the determinant of the tip's Jacobian in them; not for any pull."""
    log_tip_angle, load = ca.SX.sym("log_tip_angle"), ca.SX.sym("load")
    found, slopes = swing_with_slopes(log_tip_angle, load)
    jacobian = _tip_moves(found, slopes, load)
    determinant = jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]
    return ca.Function("determinant", [log_tip_angle, load], [determinant], {"cse": True})


def _tip_moves(found: Swing, slopes: Any, load: Any) -> Any:
    """Jacobian (2, 2) of the tip in log tip_angle and lambda."""
    tip, quarter = _tip(found, load), ca.DM([[0, -1], [1, 0]])  # turn
    outward = ca.vertcat(ca.horzcat(found.cos, found.sin), ca.horzcat(found.sin, -found.cos))
    return quarter @ tip @ slopes[0, :] + ca.horzcat(
        outward @ ca.vertcat(slopes[2, 0], slopes[1, 0]), ca.DM([1, 0]) - tip
    ) / load  # fmt: skip


@graph_cache()
def rod_newton(*, any_pull: bool = False) -> tuple[Any, Any]:
    """Build the graphs of one rod; same arguments and results as `multiple_shooting.rod_newton`.

    The unknowns are [log tip_angle, lambda, hand], of which the hand (+1 turns left at the tip, -1 is the
    mirror image) takes no step: it changes only through a straight rod.
    """
    unknowns, pose = ca.SX.sym("unknowns", 3), ca.SX.sym("pose", 3)
    load, hand = unknowns[1], unknowns[2]
    if any_pull:
        found, _ = swing(unknowns[0], load, any_pull=True)
        slopes = ca.jacobian(ca.vertcat(*pendulum(unknowns[0], load, any_pull=True)), unknowns[:2])
    else:
        found, slopes = swing_with_slopes(unknowns[0], load)
    tip, energy = _tip(found, load), _energy(unknowns[0], found, load)
    cos, sin = ca.cos(pose[2]), ca.sin(pose[2])
    # The target is seen from the clamp, mirrored for the right hand.
    target = ca.vertcat(ca.horzcat(cos, sin), hand * ca.horzcat(-sin, cos)) @ pose[:2]
    # The force is at the angle psi = pose[2] + hand delta.
    force = load**2 * ca.vertcat(cos * found.cos - hand * sin * found.sin, sin * found.cos + hand * cos * found.sin)
    loads = ca.vertcat(force, hand * load * found.rate)

    residual = tip - target
    quarter = ca.DM([[0, -1], [1, 0]])  # turn
    jacobian = _tip_moves(found, slopes, load)
    determinant = jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]
    inverse = ca.vertcat(
        ca.horzcat(jacobian[1, 1], -jacobian[0, 1]), ca.horzcat(-jacobian[1, 0], jacobian[0, 0])
    ) / determinant  # fmt: skip
    step = -(inverse @ residual)
    # Implicit function theorem: the unknowns follow the target.
    moves = inverse @ ca.jacobian(target, pose)
    psi_moves = hand * slopes[0, :] @ moves + ca.DM([[0, 0, 1]])
    load_moves = ca.vertcat(
        quarter @ force @ psi_moves + 2 / load * force @ moves[1, :],
        hand * (load * slopes[1, :] @ moves + found.rate * moves[1, :]),
    )
    norm = ca.norm_2(residual)
    if any_pull:
        # The last digit of log tip_angle turns a taut rod by more than the last digit of its tip.
        norm /= ca.fmax(1, load / _COARSE)
    scalars = ca.vertcat(norm, ca.norm_2(step), energy, beyond_limit(determinant, unknowns), 0)
    results = [ca.vertcat(step, 0), ca.vertcat(moves, ca.SX(1, 3)), loads, load_moves, scalars]
    options = {"cse": True}
    newton = ca.Function("rod_newton", [unknowns, pose], [ca.densify(r) for r in results], options)
    return newton, ca.Function("rod_residual", [unknowns, pose], [norm, loads], options)


@graph_cache()
def rod_chord() -> Any:
    """Build (unknowns (3), pose (3), tangent (3, 3)) -> change of the unknowns: a Newton step with old derivatives.

    It costs a quarter of `rod_newton`, and leaves the third power of an error where that left the second.
    """
    unknowns, pose, tangent = ca.SX.sym("unknowns", 3), ca.SX.sym("pose", 3), ca.SX.sym("tangent", 3, 3)
    hand = unknowns[2]
    tip = _tip(swing(unknowns[0], unknowns[1], any_pull=False)[0], unknowns[1])
    cos, sin = ca.cos(pose[2]), ca.sin(pose[2])
    reached = ca.vertcat(cos * tip[0] - sin * hand * tip[1], sin * tip[0] + cos * hand * tip[1])
    return ca.Function("rod_chord", [unknowns, pose, tangent], [tangent[:, :2] @ (pose[:2] - reached)], {"cse": True})


@graph_cache()
def rod_curvature(*, inline: bool = True) -> Any:
    """Graph (unknowns (3), pose (3)) -> third derivatives of the energy that hold a tip coordinate twice.

    Shape (4, 3): column j is the derivative of [d n_x/dx, d n_y/dx, d n_x/dy, d n_y/dy] by pose j, along the branch.
    Unless it is ``inline``, a third of the instructions are called three times.
    """
    if not inline:
        return _curvature_by_calls()
    unknowns, pose = ca.SX.sym("unknowns", 3), ca.SX.sym("pose", 3)
    newton, _ = rod_newton()
    _, moves, _, load_moves, _ = newton(unknowns, pose)
    stiffness = ca.vec(load_moves[:2, :2])
    directions = ca.vertcat(moves, ca.SX.eye(3))
    both = ca.vertcat(unknowns, pose)
    columns = ca.jtimes(stiffness, both, directions)
    return ca.Function("rod_curvature", [unknowns, pose], [columns], {"cse": True})


def _curvature_by_calls() -> Any:
    unknowns, pose = ca.MX.sym("unknowns", 3), ca.MX.sym("pose", 3)
    newton, _ = rod_newton()
    found = newton(unknowns, pose)
    moves, along = found[1], newton.forward(1)
    columns = [
        along(unknowns, pose, *found, moves[:, j], ca.DM.eye(3)[:, j])[3][:2, :2] for j in range(3)
    ]  # fmt: skip
    return ca.Function("rod_curvature", [unknowns, pose], [ca.horzcat(*map(ca.vec, columns))])


@graph_cache()
def _pendulums(count: int) -> Any:
    log_tip_angle, u = ca.SX.sym("log_tip_angle"), ca.SX.sym("u")
    return ca.Function("pendulum", [log_tip_angle, u], list(pendulum(log_tip_angle, u, any_pull=True)[:2])).map(count)


def nodes(unknowns: np.ndarray, angle: float, n_nodes: int) -> np.ndarray:
    """States [theta, n_x, n_y, m] at s = j/n_nodes, shape (4, n_nodes), normalised."""
    log_tip_angle, load, hand = unknowns
    u = load * (1.0 - np.arange(n_nodes) / n_nodes)
    delta, rate = (result.full().ravel() for result in _pendulums(n_nodes)(log_tip_angle, u[None]))
    psi = angle + hand * delta[0]
    force = load**2 * np.array([[np.cos(psi)], [np.sin(psi)]])
    return np.vstack([angle + hand * (delta[0] - delta), np.repeat(force, n_nodes, axis=1), hand * load * rate])


@graph_cache()
def retraction(*, any_pull: bool = False) -> Any:
    """Graph (unknowns, change) -> unknowns: how a step of Newton's method or a prediction is taken.

    On gently loaded rods (log tip_angle, lambda) are bad polar coordinates of the tip force, which swings about zero
    as a nearly straight rod is pulled and pushed; there the step goes straight on in its components along and across
    the tip's tangent. On taut rods the tip is all but linear in 1/lambda and in log tip_angle + lambda, which is the
    angle at the clamp; there, with ``any_pull``, the step goes straight on in these, the load growing to its tenfold
    at most.
    """
    unknowns, change = ca.SX.sym("unknowns", 3), ca.SX.sym("change", 3)
    tip_angle, load, hand = ca.exp(unknowns[0]), unknowns[1], unknowns[2]
    along, across = load**2 * ca.cos(tip_angle), hand * load**2 * ca.sin(tip_angle)
    turn = tip_angle * change[0]
    along += 2 * load * ca.cos(tip_angle) * change[1] - hand * across * turn
    across += hand * (2 * load * ca.sin(tip_angle) * change[1] + load**2 * ca.cos(tip_angle) * turn)
    gentle = ca.vertcat(
        ca.log(ca.atan2(ca.fabs(across), along)), ca.sqrt(ca.sqrt(along**2 + across**2)), ca.if_else(across < 0, -1, 1)
    )
    straight_on = unknowns + change
    if any_pull:
        pulled = load / ca.fmax(1 - change[1] / load, 0.1)
        taut = ca.vertcat(unknowns[0] + change[0] + change[1] - (pulled - load), pulled, hand)
        straight_on = ca.if_else(load < TAUT, straight_on, taut)
    taken = ca.if_else(load < _GENTLE, gentle, straight_on)
    return ca.Function("retraction", [unknowns, change], [taken], {"cse": True})


@graph_cache()
def apart(*, any_pull: bool = False) -> Any:
    """Graph (unknowns, unknowns) -> how far two shapes are apart, in numbers of order one: see `retraction`."""
    one, other = ca.SX.sym("one", 3), ca.SX.sym("other", 3)
    change, load = one - other, ca.fmax(one[1], TAUT)
    if any_pull:
        clamp = change[0] + (1 - TAUT / load) * change[1]
        distance = ca.norm_inf(ca.vertcat(clamp, TAUT / load * change[1], change[2]))
    else:
        # Where the graphs are wrong nothing is near.
        distance = ca.norm_inf(change) + beyond_numbers(one[0])
    return ca.Function("apart", [one, other], [distance], {"cse": True})


@graph_cache()
def _determinants() -> Any:
    unknowns = ca.SX.sym("unknowns", 2)
    jacobian = tip_map()(unknowns)[1]
    return ca.Function("beyond", [unknowns], [ca.det(jacobian) >= 0]).map(_SWEEP)


def conjugate_points(unknowns: np.ndarray) -> int:
    """Unstable directions of a rod with its tip held: the zeros of the determinant between tip and base.

    The part of a rod within s of its tip is a rod with the same tip angle and the load lambda s.
    """
    # No zero lies before the quarter period K(k), where on a taut rod the determinant is all rounding.
    first = max(5.7, np.log(8.0) - unknowns[0])
    if unknowns[1] <= first:
        return 0
    columns = np.stack([np.full(_SWEEP, unknowns[0]), np.linspace(first, unknowns[1], _SWEEP)])
    beyond = _determinants()(columns).full().ravel()
    return int(np.count_nonzero(np.diff(beyond)))


def from_nodes(states: np.ndarray) -> np.ndarray:
    """Unknowns near given nodal states, shape (4, N); exact only as a start for Newton's method."""
    load = max(float(np.sqrt(np.hypot(*states[1:3, 0]))), _LEAST_LOAD)
    psi = np.arctan2(states[2, 0], states[1, 0])
    theta = np.append(states[0], sample_rod(states, 2)[2, -1])
    delta = np.angle(np.exp(1j * (psi - theta)))
    u = load * np.append(1 - np.arange(states.shape[1]) / states.shape[1], 0.0)
    if abs(delta[-1]) > _ROUNDING:
        return np.array([np.log(abs(delta[-1])), load, np.sign(delta[-1])])
    # A taut rod: delta is all rounding at the tip. From the last node where it is not, the rod is on the
    # separatrix, tan(delta/4) = tan(tip_angle/4) cosh(u), and turns the same way all along.
    above = np.flatnonzero(np.abs(delta[:-1]) > _ROUNDING)
    j = int(above[-1]) if above.size else 0
    hand = 1.0 if states[3, j] >= 0 else -1.0
    size = max(float(hand * delta[j]) % (2 * np.pi), 1e-12)
    log_cosh = np.logaddexp(u[j], -u[j]) - np.log(2.0)
    return np.array([np.log(4.0 * np.tan(size / 4.0)) - log_cosh, load, hand])


def from_base(states: np.ndarray) -> np.ndarray:
    """Unknowns near given nodal states by the loads at the base alone: where the tip of a taut rod is all noise."""
    load = max(float(np.sqrt(np.hypot(*states[1:3, 0]))), _LEAST_LOAD)
    hand = 1.0 if states[3, 0] >= 0 else -1.0
    delta = float(hand * (np.arctan2(states[2, 0], states[1, 0]) - states[0, 0])) % (2 * np.pi)
    # The pendulum's energy gives the tip angle, unless that is so small that the pendulum is on the separatrix.
    cos_tip = (states[3, 0] / load) ** 2 / 2 + np.cos(delta)
    if abs(cos_tip) < 0.99:
        return np.array([np.log(np.arccos(cos_tip)), load, hand])
    return np.array(
        [np.log(4.0 * np.tan(max(delta, 1e-12) / 4.0)) - np.logaddexp(load, -load) + np.log(2.0), load, hand]
    )
