"""From the plant to the linear model."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca

from ..buffered import BufferedFunction, graph_cache, per_thread
from ..errors import checked_number, checked_vector
from ..plant.motion.followed_rods import DERIVATIVE_ACCURACY
from ..plant.motion.plant import Plant
from .linear_model import LinearModel

# Taylor order and squarings of the matrix exponential: better than 1e-9 up to K dt^2/m and (c dt/m)^2 of 1000.
_TAYLOR_ORDER, _SQUARINGS = 8, 6
STIFFEST = 1e3


def linearise(plant: Plant, x: Any, u: Any, dt: float, f_ext: Any = (0.0, 0.0)) -> LinearModel:
    """Linear model of the plant about a state, which need not be in balance.

    The rods' force is replaced by F + K dp + G dq with K = dF/dp, G = dF/dq from implicit differentiation
    of the statics; the resulting affine system m p'' + c p' = -F - K dp - G dq + m g + f_ext, q' = u is
    discretised exactly for inputs held over dt (matrix exponential, not an integrator's step).

    Where the plant's rods have inertia, M_pp stands for m, and its change with the pose times the acceleration
    at x goes into K and G. The rates act through M_pq as impulses at both ends of the period (see `Plant`), which
    makes the tip move with v - M_pp^-1 M_pq u. Products of velocities, dT/dp - M_pp' v and the change of
    M_pp^-1 M_pq u with the pose, are those at x and u; left out is how they change with both. What is left of the
    error is then that of rods without mass, the curvature of F: 1e-7 m in 10 ms on the default robot at 0.3 m/s
    and 2 rad/s. On steel wires of 9 % of the moving mass, a figure of eight is tracked eight times better for it.

    Parameters
    ----------
    plant : Plant
        Follows its branch to x.
    x : array_like, shape (4 + n,)
        State [m, m/s, rad].
    u : array_like, shape (n,)
        Input [rad/s]. Without inertia of the rods the plant is affine in u, and the model does not depend on it.
    dt : float
        Period of the model [s], usually the control period.
    f_ext : array_like, shape (2,)
        External force besides the tip's weight that the model assumes [N].

    Raises
    ------
    UnreachableError, ConvergenceError, UnstableError
        As `Plant.step`.
    ValueError
        dt is not a positive number, or so long that K dt^2/m or (c dt/m)^2 exceeds 1000; or the model overflows.
    """
    x = checked_vector("x", x, plant.n_states)
    u = checked_vector("u", u, plant.robot.n_rods)
    f_ext = checked_vector("f_ext", f_ext, 2)
    dt = checked_number("dt", dt, above=0.0)
    force, k, g = plant.force_and_jacobians(x[:2], x[4:], DERIVATIVE_ACCURACY)
    inertia, slopes = plant.mass(x[:2], x[4:])
    mass, drag = plant.robot.tip_mass, plant.robot.drag
    stiffness, damping = max(map(abs, k.ravel().tolist())) * dt * dt / mass, drag * dt / mass
    if not (stiffness <= STIFFEST and damping * damping <= STIFFEST):
        raise ValueError(
            f"dt = {dt} s is too long for the stiffness at p = {x[:2]} m or for the drag: K dt^2/m is {stiffness:.3g} "
            f"and (c dt/m)^2 is {damping * damping:.3g}, at most {STIFFEST:g}; shorten the period or keep away from "
            "taut rods"
        )
    function = _buffered(plant.robot.n_rods, plant.inertia == "none")
    function.inputs[0][:] = k
    function.inputs[1][:] = g
    function.inputs[2][:] = force - f_ext - plant.tip_weight
    function.inputs[3][:] = x
    function.inputs[4][:] = drag, dt
    function.inputs[5][:], function.inputs[6][:], function.inputs[7][:] = inertia, slopes, u
    function()
    packed = function.outputs[0].copy()
    n = plant.n_states
    a, c = packed[: n * n].reshape(n, n, order="F"), packed[n * n : n * (n + 1)]
    b, e = packed[n * (n + 1) : -2 * n].reshape(n, -1, order="F"), packed[-2 * n :].reshape(n, 2, order="F")
    if not all(map(math.isfinite, c.tolist())):
        raise ValueError(f"the linear model at x = {x} with external force {f_ext} N is not finite")
    return LinearModel(a, b, c, e, dt, f_ext.copy())


@per_thread(maxsize=32)
def _buffered(n: int, point: bool) -> BufferedFunction:
    return BufferedFunction(discretisation(n, point=point))


@graph_cache(maxsize=32)
def discretisation(n: int, *, point: bool = False) -> Any:
    """Exact discretisation as one graph: (K, G, F - F_ext, x, [c, dt], M, d vec(M) / d(p, q), u) -> [A, c, B,
    E], column by column in one vector.

    ``point``: M is that of a point mass, M[0, 0] times the identity, and fixed. Then all is made of powers of K, in a
    third of the operations.
    """
    k, g, force = ca.SX.sym("K", 2, 2), ca.SX.sym("G", 2, n), ca.SX.sym("F", 2)
    x, parameters = ca.SX.sym("x", 4 + n), ca.SX.sym("parameters", 2)
    mass, slopes = ca.SX.sym("M", 2 + n, 2 + n), ca.SX.sym("dM", (2 + n) ** 2, 2 + n)
    rates = ca.SX.sym("rates", n)
    drag, dt = ca.vertsplit(parameters)
    p, v, q = x[:2], x[2:4], x[4:]

    inverse, coupling, k_effective, g_effective = ca.SX.eye(2) / mass[0, 0], ca.SX(2, n), k, g
    if not point:
        inverse = ca.inv(mass[:2, :2])
        coupling = inverse @ mass[:2, 2:]
        acceleration = -inverse @ (force + drag * v)
        by_pose = ca.horzcat(*(ca.reshape(slopes[:, j], 2 + n, 2 + n)[:2, :2] @ acceleration for j in range(2 + n)))
        k_effective, g_effective = k + by_pose[:, :2], g + by_pose[:, 2:]

    # In y = [dp, dv dt] and tau = t/dt the motion is dy/dtau = a y + [0, w0 + w1 tau], where the force at the
    # start gives w0 and the motors' rates w1; every entry is dimensionless. With phi_1 = int exp(a s) ds and
    # phi_2 = int (1 - s) exp(a s) ds over [0, 1], y(1) = exp(a) y(0) + phi_1 [0, w0] + phi_2 [0, w1].
    scale = dt * dt * inverse
    exponential, phi_1, phi_2 = (_of_point if point else _of_mass)(scale @ k_effective, dt * drag * inverse)

    units = ca.vertcat(1, 1, 1 / dt, 1 / dt)
    by_angle = -phi_1 @ scale @ g_effective
    by_rate = -dt * phi_2 @ scale @ g_effective
    top = ca.diag(units) @ exponential @ ca.diag(1 / units)
    # The tip's own velocity while the motors turn is the state's less `coupling` u.
    impulses = ca.vertcat(ca.SX(2, n), coupling) - top[:, 2:] @ coupling
    a_matrix = ca.vertcat(ca.horzcat(top, ca.diag(units) @ by_angle), ca.horzcat(ca.SX(n, 4), ca.SX.eye(n)))
    b_matrix = ca.vertcat(ca.diag(units) @ by_rate + impulses, dt * ca.SX.eye(n))
    # About x: y = x - x0, so that the constant is what is left after A x0.
    state = ca.vertcat(0, 0, dt * v)
    moved = exponential @ state - dt * dt * (phi_1 @ (inverse @ force))
    if not point:
        push, drift = _centrifugal(mass, slopes, v, rates, inverse, coupling)
        moved += dt * dt * (phi_1 @ (inverse @ push - drift) + ca.vertcat(0, 0, drift))
    c_vector = ca.vertcat(p + moved[:2], moved[2:] / dt, q) - a_matrix @ x
    e_matrix = ca.vertcat(ca.diag(units) @ phi_1 @ scale, ca.SX(n, 2))
    results = [ca.vertcat(ca.vec(a_matrix), c_vector, ca.vec(b_matrix), ca.vec(e_matrix))]
    arguments = [k, g, force, x, parameters, mass, slopes, rates]
    return ca.Function("discretise", arguments, results, {"cse": True})


def _centrifugal(mass: Any, slopes: Any, v: Any, rates: Any, inverse: Any, coupling: Any) -> tuple[Any, Any]:
    """What moving rods do to the tip: dT/dp - M_pp' v [N], and (M_pp^-1 M_pq)' u [m/s^2], at rates u."""
    size = mass.size1()
    w = ca.vertcat(v - coupling @ rates, rates)
    by_tip = ca.vertcat(*(ca.bilin(ca.reshape(slopes[:, j], size, size), w, w) / 2 for j in range(2)))
    change = ca.reshape(slopes @ w, size, size)[:2, :]
    return by_tip - change[:, :2] @ v, inverse @ ((change[:, 2:] - change[:, :2] @ coupling) @ rates)


def _of_mass(stiffness: Any, damping: Any) -> tuple[Any, Any, Any]:
    """exp(a), and of phi_1 and phi_2 the force's columns, for a = [[0, I], [-stiffness, -damping]]."""
    a = ca.vertcat(ca.horzcat(ca.SX(2, 2), ca.SX.eye(2)), ca.horzcat(-stiffness, -damping))
    # Taylor series over a fraction of the period, then doubled.
    fraction = 1.0 / 2**_SQUARINGS
    power = ca.SX.eye(4)
    exponential, phi_1, phi_2 = power, fraction * power[:, 2:], fraction**2 / 2 * power[:, 2:]
    for order in range(1, _TAYLOR_ORDER + 1):
        power = (fraction / order) * ca.mtimes(a, power)
        exponential += power
        phi_1 += fraction / (order + 1) * power[:, 2:]
        phi_2 += fraction**2 / ((order + 1) * (order + 2)) * power[:, 2:]
    for _ in range(_SQUARINGS):
        phi_2 = ca.mtimes(exponential, phi_2) + fraction * phi_1 + phi_2
        phi_1 = ca.mtimes(exponential, phi_1) + phi_1
        exponential = ca.mtimes(exponential, exponential)
        fraction *= 2
    return exponential, phi_1, phi_2


def _of_point(stiffness: Any, damping: Any) -> tuple[Any, Any, Any]:
    """`_of_mass` where the damping is a multiple d of the identity.

    Then exp(a tau) = [[A, B], [-S B, A - d B]] with A = I - S int B, and all blocks are x I + y S, for by
    Cayley and Hamilton S^2 = trace S - det I: two numbers each.
    """
    s, d = stiffness, damping[0, 0]
    trace, determinant = s[0, 0] + s[1, 1], s[0, 0] * s[1, 1] - s[0, 1] * s[1, 0]

    def times(one: Any, other: Any) -> Any:
        square = one[1] * other[1]
        return ca.vertcat(
            one[0] * other[0] - determinant * square, one[0] * other[1] + one[1] * other[0] + trace * square
        )

    def by_s(one: Any) -> Any:
        return ca.vertcat(-determinant * one[1], one[0] + trace * one[1])

    # The columns of a^k [0, I] are [t, b], and their series B, its integral and the integral of that.
    fraction = 1.0 / 2**_SQUARINGS
    t, b = ca.SX(2, 1), ca.SX([1, 0])
    block, once, twice, factor = ca.SX(2, 1), ca.SX(2, 1), ca.SX(2, 1), 1.0
    for order in range(1, _TAYLOR_ORDER + 1):
        t, b = b, -by_s(t) - d * b
        factor *= fraction / order
        block += factor * t
        once += factor * fraction / (order + 1) * t
        twice += factor * fraction**2 / ((order + 1) * (order + 2)) * t
    for _ in range(_SQUARINGS):
        a = ca.SX([1, 0]) - by_s(once)
        twice = twice + fraction * once + times(a, twice) + times(block, once)
        once = once + times(a, once) + times(block, block)
        block = times(block, 2 * a - d * block)
        fraction *= 2
    a = ca.SX([1, 0]) - by_s(once)

    def matrix(one: Any) -> Any:
        return one[0] * ca.SX.eye(2) + one[1] * s

    moves = matrix(block)
    exponential = ca.vertcat(
        ca.horzcat(matrix(a), moves), ca.horzcat(-matrix(by_s(block)), matrix(a - d * block))
    )  # fmt: skip
    return exponential, ca.vertcat(matrix(once), moves), ca.vertcat(matrix(twice), matrix(once))
