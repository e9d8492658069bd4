"""Multiple shooting of the rods, paper sec. 4, solved in O(N) by a Riccati sweep.

Unknowns. Rod i has nodes j = 0 .. N-1 at s = j L/N, each with z = [theta, n_x, n_y, m]. The paper counts
8N unknowns for two rods; that closes against its 8N residuals when theta_{i,0} = q_i is prescribed (one
unknown less per rod) and the joint force F, which eq. (13) uses but eq. (9) leaves out, is solved for:
n (4N - 1) + 2 unknowns and as many residuals for n rods.

Sparsity of one rod's Jacobian (N = 4, rows: continuity, position, tip moment; * a dense block)::

             w_0  z_1  z_2  z_3              w = [n_x, n_y, m], since theta_0 = q is prescribed
    gap_1     *   -I
    gap_2          *   -I
    gap_3               *   -I
    position  *    *    *    *                displacements of all segments add up to p - b
    moment                   *                m(L) = 0

and the force balance F = sum n_i(L) appends two rows that only define F. At given (p, q) the rods therefore
do not couple, and each is solved by itself.

The sweep. Let x = [x, y, theta, n_x, n_y, m] be a change of the state at a node, positions included (they
are the sums of the displacements before it). The linearised segments read dx+ = Phi dx + c, and the tip
conditions (position held, no moment) are three equations T dx = r. Substituting from the tip backwards,

    T_j = T_{j+1} Phi_j,     r_j = r_{j+1} - T_{j+1} c_j,

with the rows of [T | r] made orthonormal in T after every segment, gives at the base three equations for
[n_x, n_y, m]_0, and one forward pass gives the Newton step. Forward, each node is projected onto its own
T dx = r: without that and the orthogonalisation, errors grow like exp(lambda) on taut rods, as they do in
plain condensing. The alternative that carries the stiffness of the rod's far part from node to node
(a Riccati recursion) fails too: an inextensible straight tail is infinitely stiff.

The same equations with r = 0 and a moved or turned base are the implicit function theorem: they give every
derivative of the equilibrium from the factorisation of the Newton step. And where the part of T that
belongs to [n_x, n_y, m] changes the sign of its determinant, the rod beyond that node has a non-zero
deflection with both ends held: a conjugate point, and the rod is unstable.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ....buffered import graph_cache
from ...robot import Robot
from ..equations import Layout, interpolated, propagation, unpacked

# A straight tail has determinant 0; with orthonormal rows, less than this is rounding.
_DETERMINANT_ROUNDING = 1e-12


@graph_cache()
def rod_newton(
    segments: int, steps: int, scheme: str, layout: Layout | None = None, *, inline: bool = True
) -> tuple[Any, Any]:
    """Build the graphs of one rod in normalised units.

    Parameters
    ----------
    segments, steps, scheme
        Discretisation.
    layout : Layout, optional
        None: the plain rod. Otherwise both graphs take the rod's numbers (see `RodPhysics`) as a third argument.
    inline : bool
        Make one list of instructions of each, for CasADi's interpreter; else call the same small graph for all
        segments, for a compiler, with the same numbers bit for bit.

    Returns
    -------
    newton : casadi.Function
        (nodes (4N), pose (3)) -> step (4N), tangent (4N, 3), loads (3), load_tangent (3, 3), scalars (5).
        pose = [d_x, d_y, theta_0] is the tip relative to the base and the clamp angle (which replaces
        nodes[0]); step is the Newton step; tangent and load_tangent are the derivatives of the nodes and of
        loads = [n_x, n_y at the tip, m at the base] with respect to the pose; scalars = [residual norm, length of
        the step, energy, number of conjugate points, drift of the `invariant`], where residual and drift are
        relative to the size of the load, and the length weighs nodes alike. The energy is U, with the weight's
        potential counted from the rod's base.
    residual : casadi.Function
        (nodes, pose) -> residual norm, loads.
    """
    n, h = segments, 1.0 / segments
    flat, pose = ca.SX.sym("nodes", 4 * n), ca.SX.sym("pose", 3)
    physics = ca.SX.sym("physics", layout.size if layout else 0)
    z = [flat[4 * j : 4 * j + 4] for j in range(n)]
    z[0] = ca.vertcat(pose[2], flat[1:4])
    arguments = [flat, pose, physics] if layout else [flat, pose]
    options = {"cse": True}
    if inline:
        known = [[j * h, physics] if layout else [] for j in range(n)]
        ends = [propagation(steps, scheme, layout)(node, h, *at) for node, at in zip(z, known, strict=True)]
        jacobians = [ca.jacobian(end[:6], node) for end, node in zip(ends, z, strict=True)]
        newton = ca.Function("rod_newton", arguments, _newton(z, pose, layout, physics, ends, jacobians), options)
        return newton, ca.Function("rod_residual", arguments, _residual(z, pose, layout, physics, ends), options)
    ends = [ca.SX.sym("end", 8 if layout else 7) for _ in range(n)]
    jacobians = [ca.SX.sym("jacobian", 6, 4) for _ in range(n)]
    side_by_side = [*arguments, ca.horzcat(*ends)]
    judged = ca.Function("judge", side_by_side, _residual(z, pose, layout, physics, ends), options)
    side_by_side.append(ca.horzcat(*jacobians))
    closed = ca.Function("close", side_by_side, _newton(z, pose, layout, physics, ends, jacobians), options)

    given = [ca.MX.sym("nodes", 4 * n), ca.MX.sym("pose", 3), *([ca.MX.sym("physics", layout.size)] if layout else [])]
    starts = ca.reshape(ca.vertcat(given[1][2], given[0][1:]), 4, n)
    places = [ca.DM(h * np.arange(n)).T, ca.repmat(given[2], 1, n)] if layout else []
    moved, turned = (graph.map(n) for graph in _segment(h, steps, scheme, layout))
    found = moved(starts, *places)
    newton = ca.Function("rod_newton", given, closed.call([*given, *turned(starts, *places)]))
    return newton, ca.Function("rod_residual", given, judged.call([*given, found]))


@graph_cache()
def _segment(h: float, steps: int, scheme: str, layout: Layout | None) -> tuple[Any, Any]:
    """Graphs of a segment of length h from z on, with a layout also of s and the rod's numbers: its end, and its end
    with the derivatives in z of the first six of it."""
    z, s, physics = ca.SX.sym("z", 4), ca.SX.sym("s"), ca.SX.sym("physics", layout.size if layout else 0)
    known = [s, physics] if layout else []
    end = propagation(steps, scheme, layout)(z, h, *known)
    jacobian = ca.densify(ca.jacobian(end[:6], z))
    return (
        ca.Function("move", [z, *known], [end], {"cse": True}),
        ca.Function("turn", [z, *known], [end, jacobian], {"cse": True}),
    )


def _judged(z: list[Any], pose: Any, ends: list[Any]) -> tuple[list[Any], Any, Any, Any, Any, Any]:
    """Gaps between the segments, misses of position and moment at the tip, size of the load, weights, norm of all."""
    gaps = [end[2:6] - start for end, start in zip(ends, z[1:], strict=False)]
    position = sum(end[:2] for end in ends) - pose[:2]
    moment = ends[-1][5]
    load = 1 + ca.norm_2(z[0][1:3])
    # Angles and positions count as they are: on a taut rod a small miss of the tip is a large error of the force.
    weights = ca.vertcat(1, 1 / load, 1 / load, 1 / ca.sqrt(load))
    norm = ca.norm_2(ca.vertcat(*(weights * gap for gap in gaps), position, weights[3] * moment))
    return gaps, position, moment, load, weights, norm


def _loads(z: list[Any], weight: Any) -> Any:
    # The force at the tip is that at the base less the weight in between, which no change of the pose changes.
    return ca.vertcat(z[0][1:3] - weight, z[0][3])


def _residual(z: list[Any], pose: Any, layout: Layout | None, physics: Any, ends: list[Any]) -> list[Any]:
    """Results of the graph of that name."""
    *_, norm = _judged(z, pose, ends)
    return [norm, _loads(z, physics[:2] if layout else ca.SX(2, 1))]


def _newton(
    z: list[Any], pose: Any, layout: Layout | None, physics: Any, ends: list[Any], jacobians: list[Any]
) -> list[Any]:
    """Results of the graph of that name, from the ends of the segments and their derivatives in the starts z."""
    gaps, position, moment, load, weights, norm = _judged(z, pose, ends)
    sweep = Sweep(jacobians)
    # Column 0 is the Newton step; the others start from a moved or turned base.
    first = ca.DM([[1, 0, 0, 0]])
    steps_at_nodes = [ca.vertcat(0, 0, gap) @ first for gap in gaps]
    changes = sweep.solve(ca.horzcat(ca.SX(3, 1), moved_base()), -ca.vertcat(position, moment) @ first, steps_at_nodes)
    base_loads = changes[0][3:, :]
    moves = ca.vertcat(*(change[2:, :] for change in changes))

    energy, n = sum(end[6] for end in ends), len(z)
    weight = ca.SX(2, 1)
    if layout is None:
        drift = invariant(ends[-1][2:6]) - invariant(z[0])
    else:
        weight = physics[:2]
        # Each piece counts the energy of its weight from where it begins.
        energy -= 1.0 / n * sum(ca.dot(weight, end[:2]) * (n - 1 - j) for j, end in enumerate(ends))
        drift = invariant(ends[-1][2:6], layout, physics, 1.0) - invariant(z[0], layout, physics, 0.0)
        drift += sum(ca.dot(weight, end[:2]) - end[7] for end in ends)
    length = ca.norm_2(ca.repmat(weights, n, 1) * moves[:, 0])
    scalars = ca.vertcat(norm, length, energy, sweep.conjugate_points(), drift / (load + z[0][3] ** 2 / 2))
    results = [moves[:, 0], moves[:, 1:], _loads(z, weight), base_loads[:, 1:], scalars]
    return [ca.densify(result) for result in results]


class Sweep:
    """The linearised equations of one rod, factorised from its tip to its base.

    Parameters
    ----------
    jacobians : list of casadi, shape (6, 4)
        Of [dx, dy, theta, n_x, n_y, m] at the end of each segment (see `rod.propagation`) in [theta, n_x, n_y, m] at
        its start.
    """

    def __init__(self, jacobians: list[Any]) -> None:
        moved = ca.vertcat(ca.SX.eye(2), ca.SX(4, 2))
        self._transitions = [ca.horzcat(moved, jacobian) for jacobian in jacobians]
        # T of every node and of the tip, and what makes the rows of T_{j+1} Phi_j orthonormal.
        self._rows: list[Any] = [ca.vertcat(ca.SX.eye(6)[:2, :], ca.SX.eye(6)[5, :])]
        self._turns: list[Any] = []
        for transition in reversed(self._transitions):
            rows, turn = _orthonormal_rows(self._rows[0] @ transition, ca.SX.eye(3))
            self._rows.insert(0, rows)
            self._turns.insert(0, turn)

    def solve(self, base: Any, at_tip: Any, gaps: list[Any]) -> list[Any]:
        """Solve dx_{j+1} = Phi_j dx_j + c_j, T dx = r at the tip, for several right-hand sides at once.

        Parameters
        ----------
        base : casadi, shape (3, k)
            [x, y, theta] at the base.
        at_tip : casadi, shape (3, k)
            [x, y, m] at the tip.
        gaps : list of casadi, shape (6, k)
            c_j; the last may be left out if it is zero.

        Returns
        -------
        list of casadi, shape (6, k)
            dx at the start of each segment.
        """
        right, gaps = [at_tip], gaps + [ca.SX(6, at_tip.size2())] * (len(self._turns) - len(gaps))
        for row, turn, gap in zip(self._rows[:0:-1], reversed(self._turns), reversed(gaps), strict=True):
            right.insert(0, turn @ (right[0] - row @ gap))
        loads = _solve3(self._rows[0][:, 3:], right[0] - self._rows[0][:, :3] @ base)
        changes = [ca.vertcat(base, loads)]
        for j in range(len(gaps) - 1):
            change = self._transitions[j] @ changes[-1] + gaps[j]
            rows = self._rows[j + 1]
            changes.append(change - rows.T @ (rows @ change - right[j + 1]))
        return changes

    def conjugate_points(self) -> Any:
        """Number of changes of sign along the rod of the part of T that belongs to the loads."""
        count, crossed = ca.SX(0), ca.SX(0)
        for rows in self._rows[-2::-1]:
            negative = _determinant3(rows[:, 3:]) < -_DETERMINANT_ROUNDING
            count += negative != crossed
            crossed = negative
        return count


def moved_base() -> Any:
    """[x, y, theta] of the base, one column for each entry of the pose: moving the tip moves the base the other way."""
    return ca.diagcat(-1, -1, 1)


def invariant(z: Any, layout: Layout | None = None, physics: Any = None, s: float = 0.0) -> Any:
    """m^2/2 + n . t, constant along an exact plain rod; its drift measures the discretisation.

    In general H = m^2/(2 f) + kappa0 m + n.t + c (n.t)^2/2 + w.r, the Hamiltonian of the rod equations with momenta n
    and m, changes only by what f and kappa0 do along the rod. Here without w.r.
    """
    pull = z[1] * ca.cos(z[0]) + z[2] * ca.sin(z[0])
    if layout is None:
        return z[3] ** 2 / 2 + pull
    _, compliance, curvature, stiffness = unpacked(layout, physics)
    f = 1 if stiffness is None else interpolated(stiffness, s)
    return z[3] ** 2 / (2 * f) + interpolated(curvature, s) * z[3] + pull + compliance * pull**2 / 2


def _orthonormal_rows(t: Any, r: Any) -> tuple[Any, Any]:
    """Replace the equations t dx = r (3 x 6) by equivalent ones with orthonormal rows (Gram-Schmidt).

    ``r`` may have several columns.
    """
    rows: list[Any] = []
    for i in range(3):
        row = ca.horzcat(t[i, :], r[i, :])
        for done in rows:
            row -= ca.dot(row[:6], done[:6]) * done
        rows.append(row / ca.norm_2(row[:6]))
    stacked = ca.vertcat(*rows)
    return stacked[:, :6], stacked[:, 6:]


def _determinant3(m: Any) -> Any:
    return ca.dot(m[0, :], ca.cross(m[1, :], m[2, :]))


def _solve3(m: Any, rhs: Any) -> Any:
    """Solve a 3 x 3 system by the cross products of its rows."""
    a, b, c = m[0, :], m[1, :], m[2, :]
    adjugate = ca.vertcat(ca.cross(b, c), ca.cross(c, a), ca.cross(a, b)).T
    return adjugate @ rhs / _determinant3(m)


def robot_residual(robot: Robot, segments: int = 8, steps: int = 1, scheme: str = "rk8") -> Any:
    """Weighted residual R(Y) of the whole robot, paper eq. (15)-(16), in physical units.

    This is the text of the paper; the solver above works on the same equations rod by rod.

    Returns
    -------
    casadi.Function
        (Y, p (2), q (n)) -> R, both of n (4N - 1) + 2 entries. Y holds, rod after rod,
        [n_x, n_y, m] of node 0 and [theta, n_x, n_y, m] of nodes 1 .. N-1 (N, N, N m, rad), then F [N].
        R holds continuity, position (eq. 12), tip moment (eq. 14) per rod, then e_force. Weights: 1/L on
        positions, L^2/EI on forces, L/EI on moments, 1 on angles.

    Notes
    -----
    Sign: with eq. (3), n is the force applied *to* the rod's tip. Eq. (13) as printed, n_1 + n_2 + F = 0,
    then makes F = -dU/dp, and the mass of eq. (7) would be pushed away from equilibrium. Here
    e_force = sum n_i - F, so F = dU/dp is the force that holds the joint, and eq. (7) stands.
    """
    n = robot.n_rods
    y = ca.SX.sym("Y", n * (4 * segments - 1) + 2)
    p, q = ca.SX.sym("p", 2), ca.SX.sym("q", n)
    force = y[-2:]
    residuals: list[Any] = []
    tip_forces = ca.SX(2, 1)
    for i, rod in enumerate(robot.rods):
        length, ei = rod.length, rod.bending_stiffness
        units = ca.DM([1.0, ei / length**2, ei / length**2, ei / length])
        mine = y[i * (4 * segments - 1) : (i + 1) * (4 * segments - 1)]
        nodes = ca.reshape(ca.vertcat(q[i], mine), 4, segments)
        ends = [propagation(steps, scheme)(nodes[:, j] / units, 1.0 / segments) for j in range(segments)]
        for j in range(segments - 1):
            residuals.append(ends[j][2:6] - nodes[:, j + 1] / units)
        residuals.append(ca.DM(rod.base) / length + sum(end[:2] for end in ends) - p / length)
        residuals.append(ends[-1][5])
        tip_forces += ends[-1][3:5] * units[1]
    mean_unit = float(np.mean(robot.stiffnesses / robot.lengths**2))
    residuals.append((tip_forces - force) / mean_unit)
    return ca.Function("robot_residual", [y, p, q], [ca.vertcat(*residuals)])
