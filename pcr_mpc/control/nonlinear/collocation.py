"""The nonlinear MPC problem as an NLP: Gauss collocation of the exact equations of motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ...buffered import building
from ...frozen import Frozen
from ..motor_limits import Limits
from ..tuning import Tuning, time_unit


@dataclass(frozen=True, eq=False)
class Transcription(Frozen):
    """NLP of one horizon; it is the same for every control step, but for its parameters.

    The unknowns are, period after period, one row of [u (n), (acceleration (2), z (2n)) at each Gauss point, state
    at the end (4 + n)]; the constraints one row of [(acceleration (2), statics (2n)) at each Gauss point, state at the
    end (4 + n), change of rate (n)], all of them equations except the last n. Both are counted in the problem's own
    units of length and time, lest a tolerance mean something else on a smaller robot; the parameters are in SI units.

    Attributes
    ----------
    problem : dict
        x, p, f, g for `casadi.nlpsol`; p = [x (4 + n), f_ext (2), u_previous (n), reference states (N (4 + n)),
        reference inputs (N n), terminal weight ((4 + n)^2)].
    verdict : casadi.Function
        (x, p, multipliers of g) -> (g, gradient of the Lagrangian without bounds, rods past their limit of stability).
    lower, upper : ndarray, shape (N, width)
        Bounds of the unknowns.
    g_lower, g_upper : ndarray, shape (N, height)
        Bounds of the constraints.
    nodes : ndarray, shape (s,)
        Gauss points in (0, 1).
    units : ndarray, shape (width,)
        Of the unknowns, in SI units.
    """

    problem: dict[str, Any]
    verdict: Any
    lower: np.ndarray
    upper: np.ndarray
    g_lower: np.ndarray
    g_upper: np.ndarray
    nodes: np.ndarray
    units: np.ndarray


def gauss_tableau(points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Runge-Kutta coefficients A (s, s), b (s,), c (s,) of Gauss collocation, of order 2s."""
    c = (np.polynomial.legendre.leggauss(points)[0] + 1.0) / 2.0
    powers = np.arange(1, points + 1)
    from_values = np.linalg.inv(np.vander(c, increasing=True))
    return (c[:, None] ** powers / powers) @ from_values, (1.0 / powers) @ from_values, c


@building
def transcribe(
    dynamics: Any, tuning: Tuning, limits: Limits, dt: float, points: int, length: float = 1.0
) -> Transcription:
    """Write the MPC problem of `build_qp` for nonlinear dynamics.

    The unknowns of the collocation are the accelerations at its points, of which positions and velocities are
    integrals: Nystroem's form, with one equation fewer for each. The motors are exact integrators.

    Parameters
    ----------
    dynamics : casadi.Function
        (p (2), v (2), q (n), z (m), f_ext (2)) -> (acceleration (2), residual (m), instability (any)).
    tuning : Tuning
        Horizon and weights.
    limits : Limits
    dt : float
        Control period [s].
    points : int
        Gauss points in a period, s; the order is 2s.
    length : float
        Unit of lengths [m]; the unit of time is that of `time_unit`.
    """
    n, n_z = dynamics.size1_in("q"), dynamics.size1_in("z")
    n_states, horizon = 4 + n, tuning.horizon
    integral, end, nodes = gauss_tableau(points)
    twice, twice_end = integral @ integral, end @ integral

    x0, f_ext, previous = ca.SX.sym("x0", n_states), ca.SX.sym("f_ext", 2), ca.SX.sym("previous", n)
    states, inputs = ca.SX.sym("states", n_states, horizon), ca.SX.sym("inputs", n, horizon)
    terminal = ca.SX.sym("terminal", n_states, n_states)
    stage = [tuning.position_weight] * 2 + [tuning.velocity_weight] * 2 + [tuning.angle_weight] * n

    unknowns, constraints, unstable, cost = [], [], [], ca.SX(1, 1)
    x, last = x0, previous
    for k in range(horizon):
        p, v, q = x[:2], x[2:4], x[4:]
        u, at_points = ca.SX.sym(f"u{k}", n), ca.SX.sym(f"points{k}", 2 + n_z, points)
        after = ca.SX.sym(f"x{k + 1}", n_states)
        a, z = at_points[:2, :], at_points[2:, :]
        for j, c in enumerate(nodes):
            acceleration, residual, beyond = dynamics(
                p + dt * c * v + dt**2 * (a @ twice[j]), v + dt * (a @ integral[j]), q + dt * c * u, z[:, j], f_ext
            )
            constraints += [acceleration - a[:, j], residual]
            unstable.append(beyond)
        moved = ca.vertcat(p + dt * v + dt**2 * (a @ twice_end), v + dt * (a @ end), q + dt * u)
        constraints += [after - moved, u - last]
        unknowns += [u, ca.vec(at_points), after]
        error, effort = after - states[:, k], u - inputs[:, k]
        weight = terminal if k == horizon - 1 else ca.diag(stage)
        cost += (ca.bilin(weight, error, error) + tuning.input_weight * ca.sumsqr(effort)) / 2
        x, last = after, u

    w, g = ca.vertcat(*unknowns), ca.vertcat(*constraints)
    p = ca.vertcat(x0, f_ext, previous, ca.vec(states), ca.vec(inputs), ca.vec(terminal))
    time = time_unit(dt)
    of_state = np.concatenate([np.full(2, length), np.full(2, length / time), np.ones(n)])
    of_point, of_rates = np.concatenate([np.full(2, length / time**2), np.ones(n_z)]), np.full(n, 1.0 / time)
    units = np.concatenate([of_rates, *[of_point] * points, of_state])
    g_units = np.concatenate([*[of_point] * points, of_state, of_rates])
    si = ca.Function("si", [w, p], [cost, g, ca.sum1(ca.vertcat(*unstable))])
    w = ca.SX.sym("w", w.numel())
    cost, g, count = si(np.tile(units, horizon) * w, p)
    g = g / np.tile(g_units, horizon)
    multipliers = ca.SX.sym("multipliers", g.numel())
    slope = ca.gradient(cost + ca.dot(multipliers, g), w)
    free = np.full(points * (2 + n_z), np.inf)
    fixed, change = np.zeros(points * (2 + n_z) + n_states), np.full(n, limits.rate_change)
    lower = np.concatenate([np.full(n, -limits.rate), -free, np.full(4, -np.inf), limits.angle_lower])
    upper = np.concatenate([np.full(n, limits.rate), free, np.full(4, np.inf), limits.angle_upper])
    return Transcription(
        problem={"x": w, "p": p, "f": cost, "g": g},
        verdict=ca.Function("verdict", [w, p, multipliers], [g, slope, count]),
        lower=np.tile(lower / units, (horizon, 1)),
        upper=np.tile(upper / units, (horizon, 1)),
        g_lower=np.tile(np.concatenate([fixed, -change]) / g_units, (horizon, 1)),
        g_upper=np.tile(np.concatenate([fixed, change]) / g_units, (horizon, 1)),
        nodes=nodes,
        units=units,
    )
