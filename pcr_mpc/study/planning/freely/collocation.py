"""The fastest motion through way-points as a nonlinear program: direct collocation of the equations of motion.

Unknowns are the states x = [p, v, q, u] at the ends of intervals, the motors' changes of rate, constant in each, the
tip's accelerations a and the rods' own unknowns z at its Gauss points, and the lengths of time between way-points. The
motors are exact integrators; p and v are integrals of a (see `transcribe` of the nonlinear MPC).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ....buffered import BUILDING
from ....control.nonlinear.collocation import gauss_tableau
from ....errors import InfeasibleError
from ....plant.rods.closed_form.chart import LEAST_CRITICAL_LOAD
from ....plant.statics.symbolic import symbolic_statics
from ..along_path.timing import Problem

NODES = gauss_tableau(3)[2]
_POINTS = len(NODES)
_IPOPT: dict[str, Any] = {"print_level": 0, "sb": "yes", "tol": 1e-7, "mu_strategy": "adaptive", "max_iter": 200}
_LENGTH, _SPEED, _ACCELERATION, _JERK = 0.1, 0.5, 10.0, 500.0  # units, so that unknowns are of order one
_SHORTEST = 1e-4  # s, of the time from one way-point to the next


@dataclass(frozen=True, eq=False)
class Collocated:
    """A motion in K intervals.

    Attributes
    ----------
    states : ndarray, shape (K + 1, 4 + 2n)
        [p, v, q, u] at their ends.
    changes : ndarray, shape (K, n)
        Of the motors' rates [rad/s^2].
    accelerations : ndarray, shape (K, s, 2)
        Of the tip at the Gauss points [m/s^2].
    unknowns : ndarray, shape (K, s, 2n)
        Of the rods there.
    spans : ndarray
        From way-point to way-point [s].
    counts : ndarray of int
        Intervals of each.
    iterations : int
    """

    states: np.ndarray
    changes: np.ndarray
    accelerations: np.ndarray
    unknowns: np.ndarray
    spans: np.ndarray
    counts: np.ndarray
    iterations: int = 0

    @property
    def steps(self) -> np.ndarray:
        """Lengths of the intervals, shape (K,) [s]."""
        return np.repeat(self.spans / self.counts, self.counts)


def solved(
    start: Collocated,
    problem: Problem,
    hands: tuple[float, ...],
    points: np.ndarray,
    allowed: float,
    kinds: frozenset[str],
) -> Collocated:
    """Solve the program from a motion.

    Parameters
    ----------
    start : Collocated
        Its first state is kept, and where it passes the way-points.
    problem : Problem
        Robot, carrier and limits; its course is not looked at.
    hands : tuple of float
        Of the rods, see `symbolic_statics`.
    points : ndarray, shape (W, 2)
        Way-points [m].
    allowed : float
        Share of the limits that may be used.
    kinds : frozenset of str
        Limits that are kept, besides those on the motors' angles and rates and on the tip's region.

    Raises
    ------
    InfeasibleError
        It was not solved.
    """
    limits, n, count = problem.limits, problem.pose.robot.n_rods, len(start.changes)
    interval, upper = _interval(problem, hands, kinds)
    # A limit that is far is no unit.
    rate, change = (min(limit, float(np.abs(of).max())) for limit, of in (
        (limits.rate, start.states[:, 4 + n :]), (limits.acceleration, start.changes)))  # fmt: skip
    units = np.concatenate([np.full(2, _LENGTH), np.full(2, _SPEED), np.ones(n), np.full(n, rate)])
    of_points = np.tile(np.concatenate([np.full(2, _ACCELERATION), np.ones(2 * n)]), _POINTS)
    symbols = {
        "states": ca.MX.sym("states", 4 + 2 * n, count + 1),
        "changes": ca.MX.sym("changes", n, count),
        "inside": ca.MX.sym("inside", len(of_points), count),
        "spans": ca.MX.sym("spans", len(start.spans)),
        "last": ca.MX.sym("last", 2 * n),
    }
    x = ca.repmat(ca.DM(units), 1, count + 1) * symbols["states"]
    inside = ca.repmat(ca.DM(of_points), 1, count) * symbols["inside"]
    steps = [ca.repmat(symbols["spans"][j] / int(c), 1, int(c)) for j, c in enumerate(start.counts)]
    after, zero, shares = interval.map(count)(x[:, :-1], change * symbols["changes"], inside,
                                              ca.horzcat(*steps))  # fmt: skip
    gaps = (after - x[:, 1:]) / ca.repmat(ca.DM(units), 1, count)
    # At the end the rods carry the tip's rest, by unknowns of their own.
    force, residual, _ = symbolic_statics(problem.pose.robot, hands)(x[:2, -1], x[4 : 4 + n, -1], symbols["last"])
    rest = ca.vertcat((problem.carrier.weight - force) / _force(problem), residual)
    equations = ca.vertcat(ca.vec(gaps), ca.vec(zero), rest)
    g = ca.vertcat(equations, ca.vec(shares))

    guess = [start.states / units, start.changes / change,
             np.concatenate([start.accelerations, start.unknowns], axis=2).reshape(count, -1) / of_points,
             start.spans, start.unknowns[-1, -1]]  # fmt: skip
    low, high = _state_bounds(problem, count, allowed)
    first = np.concatenate([start.states[0, :2], np.zeros(2), start.states[0, 4 : 4 + n], np.zeros(n)])
    low[0] = high[0] = first
    low[-1, 2:4] = high[-1, 2:4] = low[-1, 4 + n :] = high[-1, 4 + n :] = 0.0
    for k, point in zip(np.cumsum(start.counts), points[1:], strict=True):
        low[k, :2] = high[k, :2] = point
    jump, free = np.full((count, n), allowed * limits.acceleration / change), np.full((count, len(of_points)), np.inf)
    endless = np.full(2 * n, np.inf)
    lower = [low / units, -jump, -free, np.full(len(start.spans), _SHORTEST), -endless]
    most = [high / units, jump, free, np.full(len(start.spans), np.inf), endless]
    program = {"x": ca.vertcat(*map(ca.vec, symbols.values())), "f": ca.sum1(symbols["spans"]), "g": g}
    with BUILDING:
        options: dict[str, Any] = {"ipopt": _IPOPT, "print_time": False, "show_eval_warnings": False}
        solver = ca.nlpsol("way_points", "ipopt", program, options)
    bounded = np.tile(allowed * upper, count)
    found = solver(
        x0=_row(guess),
        lbx=_row(lower),
        ubx=_row(most),
        lbg=np.concatenate([np.zeros(equations.numel()), np.full(bounded.size, -np.inf)]),
        ubg=np.concatenate([np.zeros(equations.numel()), bounded]),
    )
    stats = solver.stats()
    if not stats["success"]:
        raise InfeasibleError(
            f"the path between the way-points was not found: IPOPT ended with {stats['return_status']} after "
            f"{stats['iter_count']} iterations; take more or fewer cells, or plan the given path (without free)",
            status=stats["return_status"],
            limit=None,
        )
    x_end = np.split(found["x"].full().ravel(), np.cumsum([part.size for part in guess])[:-1])
    points_inside = (x_end[2].reshape(count, -1) * of_points).reshape(count, _POINTS, -1)
    return Collocated(
        x_end[0].reshape(count + 1, -1) * units,
        x_end[1].reshape(count, n) * change,
        points_inside[:, :, :2],
        points_inside[:, :, 2:],
        x_end[3],
        start.counts,
        start.iterations + int(stats["iter_count"]),
    )


def _weights(part: float, order: int) -> np.ndarray:
    """Of what is known at the Gauss points, in the derivative of its parabola at a part of the interval, (s,)."""
    powers = np.array([[1.0, part, part**2], [0.0, 1.0, 2.0 * part]])[order]
    return np.asarray(np.linalg.solve(np.vander(NODES, increasing=True).T, powers))


def _force(problem: Problem) -> float:
    """A unit of forces [N]."""
    return max(_ACCELERATION * problem.carrier.mass, 1e-2 * problem.pose.robot.force_scale)


def _row(parts: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([part.ravel() for part in parts])


def _state_bounds(problem: Problem, count: int, allowed: float) -> tuple[np.ndarray, np.ndarray]:
    """Of the states at the ends of intervals, shape (K + 1, 4 + 2n); between the ends a motion may bulge."""
    limits, robot = problem.limits, problem.pose.robot
    high = np.full((count + 1, 4 + 2 * robot.n_rods), np.inf)
    low = -high
    (least, most), left = robot.angle_limits.T, (1.0 - allowed) / 2.0
    low[:, 4 : 4 + robot.n_rods], high[:, 4 : 4 + robot.n_rods] = _narrowed(least, most, left)
    high[:, 4 + robot.n_rods :] = allowed * limits.rate
    low[:, 4 + robot.n_rods :] = -allowed * limits.rate
    if limits.tip_lower is not None and limits.tip_upper is not None:
        low[:, :2], high[:, :2] = _narrowed(np.asarray(limits.tip_lower), np.asarray(limits.tip_upper), left)
    return low, high


def _narrowed(low: np.ndarray, high: np.ndarray, left: float) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of which a share is left on either side; what is open on one side has no width to take it from."""
    room = left * np.where(np.isfinite(high - low), high - low, 0.0)
    return low + room, high - room


def _interval(problem: Problem, hands: tuple[float, ...], kinds: frozenset[str]) -> tuple[Any, np.ndarray]:
    """(x, change, [a, z] at the points, step) -> (x at the end, what is zero, shares), and bounds of the shares."""
    robot, carrier, limits = problem.pose.robot, problem.carrier, problem.limits
    n, statics = robot.n_rods, symbolic_statics(robot, hands, "stiffness" in kinds)
    inner, end, nodes = gauss_tableau(_POINTS)
    twice, twice_end = inner @ inner, end @ inner
    x, change, step = ca.SX.sym("x", 4 + 2 * n), ca.SX.sym("change", n), ca.SX.sym("step")
    inside = ca.SX.sym("inside", (2 + 2 * n) * _POINTS)
    at_points = ca.reshape(inside, 2 + 2 * n, _POINTS)
    a, z = at_points[:2, :], at_points[2:, :]
    p, v, q, u = ca.vertsplit(x, [0, 2, 4, 4 + n, 4 + 2 * n])
    zero, shares, upper = [], [], []
    for j, c in enumerate(nodes):
        here, speed = p + step * c * v + step**2 * (a @ twice[j]), v + step * (a @ inner[j])
        turned = q + step * c * u + (step * c) ** 2 / 2 * change
        force, residual, torque, *stiffness = statics(here, turned, z[:, j])
        missing = carrier.weight - force - robot.drag * speed - carrier.mass * a[:, j]
        zero += [missing / _force(problem), residual]
        if "motor torque" in kinds:
            shares += [torque / limits.torque, -torque / limits.torque]
            upper += [1.0] * (2 * n)
        for kind, vector, limit in (
            ("tip speed", speed, limits.tip_speed),
            ("tip acceleration", a[:, j], limits.tip_acceleration),
        ):
            if kind in kinds:
                shares.append(ca.sumsqr(vector) / limit**2)
                upper.append(1.0)
        if "stiffness" in kinds:
            # K - least is positive definite: its determinant and its trace are.
            rest = stiffness[0] / limits.stiffness - ca.SX.eye(2)
            shares += [1.0 - ca.det(rest), 1.0 - ca.trace(rest)]
            upper += [1.0, 1.0]
        if "rod margin" in kinds:
            for i in range(n):
                shares.append(z[2 * i + 1, j] / ((1.0 - limits.rod_margin) * _critical(z[2 * i, j])))
                upper.append(1.0)
    # Between the points acceleration is a parabola, which may be largest at an end; jerk is a line, which is.
    for part in (0.0, 1.0):
        for kind, weights, limit in (
            ("tip acceleration", _weights(part, 0), limits.tip_acceleration),
            ("tip jerk", _weights(part, 1) / step, limits.tip_jerk),
        ):
            if kind in kinds:
                shares.append(ca.sumsqr(a @ weights) / limit**2)
                upper.append(1.0)
    after = ca.vertcat(p + step * v + step**2 * (a @ twice_end), v + step * (a @ end),
                       q + step * u + step**2 / 2 * change, u + step * change)  # fmt: skip
    outputs = [after, ca.vertcat(*zero), ca.vertcat(*shares)]
    return ca.Function("interval", [x, change, inside, step], outputs, {"cse": True}), np.array(upper)


def _critical(log_tip_angle: Any) -> Any:
    """Least that lambda_c can be, by up to a third: a bound that is safe, of rods that are taut exact."""
    return ca.fmax(LEAST_CRITICAL_LOAD, 2.0 * (math.log(8.0) - log_tip_angle) - 0.55)
