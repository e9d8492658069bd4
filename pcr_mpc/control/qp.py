"""The MPC problem as a QP in the inputs alone: min 1/2 U'PU + q'U subject to l <= A U <= u."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp

from ..buffered import BufferedFunction, graph_cache, per_thread
from ..errors import checked_array, checked_vector
from ..frozen import read_only
from ..linearisation.linear_model import LinearModel
from .long_horizon import condense
from .tuning import Limits, Tuning

# A graph for a longer horizon takes longer to build (N^3: 11 s at 40, 6 min at 200) and to evaluate than products do.
LONGEST_GRAPH = 24


@dataclass(frozen=True, eq=False)
class Reference:
    """What to track over the horizon.

    Attributes
    ----------
    states : ndarray, shape (N, 4 + n)
        Wanted [p, v, q] at the end of each period.
    inputs : ndarray, shape (N, n)
        Feed-forward motor rates in each period [rad/s].
    forces : ndarray, shape (N, 2), optional
        That the rods carry at the end of each period [N]; the linear MPC has no use for them.
    """

    states: np.ndarray
    inputs: np.ndarray
    forces: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """QP data; U = [u_0, .., u_{N-1}].

    Attributes
    ----------
    P : ndarray, shape (Nn (Nn + 1) / 2,)
        Upper triangle of the Hessian, column by column.
    q : ndarray, shape (Nn,)
    A : scipy.sparse.csc_matrix, shape (3 N n, N n)
        Rows: rates, changes of rate, and sums of rates, which are the turned angles over dt: all in rad/s, and the
        same for every QP (see `constraint_matrix`).
    l, u : ndarray, shape (3 N n,)
        Bounds.
    """

    P: np.ndarray
    q: np.ndarray
    A: sp.csc_matrix
    l: np.ndarray  # noqa: E741  OSQP's name
    u: np.ndarray


def build_qp(
    x: np.ndarray,
    models: LinearModel | Sequence[LinearModel],
    reference: Reference,
    u_previous: np.ndarray,
    tuning: Tuning,
    limits: Limits,
    terminal_weight: np.ndarray,
) -> QuadraticProgram:
    """Assemble the QP of one control step.

    Minimises 1/2 sum_k |x_k - xr_k|^2_Q + 1/2 |x_N - xr_N|^2_T + 1/2 sum_k |u_k - ur_k|^2_R over the affine
    model, with the states eliminated.

    Parameters
    ----------
    x : ndarray, shape (4 + n,)
        Current state.
    models : LinearModel or sequence of N
        One model for the whole horizon, or one for each period.
    reference : Reference
    u_previous : ndarray, shape (n,)
        Input of the last period, from which the change of rate counts [rad/s].
    terminal_weight : ndarray, shape (4 + n, 4 + n)
        T, for instance the cost-to-go of the LQR.
    """
    sequence = model_sequence(models, tuning.horizon)
    n_states, n = sequence[0].B.shape
    if any(model.dt != sequence[0].dt for model in sequence):
        raise ValueError("models have different periods dt")
    x, u_previous = checked_vector("x", x, n_states), checked_vector("u_previous", u_previous, n)
    wanted = checked_array("reference.states", reference.states, (tuning.horizon, n_states))
    feed_forward = checked_array("reference.inputs", reference.inputs, (tuning.horizon, n))
    terminal_weight = checked_array("terminal_weight", terminal_weight, (n_states, n_states))
    if len(limits.angle_lower) != n:
        raise ValueError(f"limits are for {len(limits.angle_lower)} motors, the model has {n}")
    return assemble(x, sequence, Reference(wanted, feed_forward), u_previous, tuning, limits, terminal_weight)


def assemble(
    x: np.ndarray,
    models: Sequence[LinearModel],
    reference: Reference,
    u_previous: np.ndarray,
    tuning: Tuning,
    limits: Limits,
    terminal_weight: np.ndarray,
) -> QuadraticProgram:
    """`build_qp` for arguments that are known to be right; one model or N of them."""
    n_states, n = models[0].B.shape
    if tuning.horizon > LONGEST_GRAPH:
        p, q, lower, upper = condense(
            x, models, reference.states, reference.inputs, u_previous, tuning, limits, terminal_weight
        )
        return QuadraticProgram(p, q, constraint_matrix(tuning.horizon, n), lower, upper)
    single = len(models) == 1
    function = _condensing(tuning.horizon, n, single, tuning.velocity_weight > 0, tuning.angle_weight > 0)
    a, b, c, start, states, inputs, previous, weights, terminal, bounds, dt = function.inputs
    for k, model in enumerate(models):
        a[:, k * n_states : (k + 1) * n_states] = model.A
        b[:, k * n : (k + 1) * n] = model.B
        c[k * n_states : (k + 1) * n_states] = model.c
    start[:] = x
    states.reshape((n_states, -1), order="F")[:] = reference.states.T
    inputs.reshape((n, -1), order="F")[:] = reference.inputs.T
    previous[:] = u_previous
    weights[:] = tuning.position_weight, tuning.velocity_weight, tuning.angle_weight, tuning.input_weight
    terminal[:] = terminal_weight
    bounds[:, 0] = limits.rate
    bounds[:, 1] = limits.rate_change
    bounds[:, 2] = limits.angle_lower
    bounds[:, 3] = limits.angle_upper
    dt[0] = models[0].dt
    function()
    p, q, lower, upper = function.outputs
    return QuadraticProgram(p.copy(), q.copy(), constraint_matrix(tuning.horizon, n),
                            lower.copy(), upper.copy())  # fmt: skip


class Rollout:
    """Predicts the states of a plan: one graph for a whole horizon.

    Parameters
    ----------
    horizon, n : int
        Control periods, motors.
    """

    def __init__(self, horizon: int, n: int) -> None:
        self._n_states, self._n = 4 + n, n
        self._functions = {single: BufferedFunction(_rollout(horizon, n, single)) for single in (True, False)}

    def __call__(self, x: np.ndarray, models: Sequence[LinearModel], inputs: np.ndarray) -> np.ndarray:
        """States at the ends of the periods, x first, shape (N + 1, 4 + n); one model or N of them."""
        function = self._functions[len(models) == 1]
        a, b, c, start, u = function.inputs
        for k, model in enumerate(models):
            a[:, k * self._n_states : (k + 1) * self._n_states] = model.A
            b[:, k * self._n : (k + 1) * self._n] = model.B
            c[k * self._n_states : (k + 1) * self._n_states] = model.c
        start[:] = x
        u.reshape(-1)[:] = inputs.reshape(-1)
        function()
        return function.outputs[0].reshape((self._n_states, -1), order="F").T.copy()


@graph_cache(maxsize=32)
def _rollout(horizon: int, n: int, single: bool) -> Any:
    n_states, count = 4 + n, 1 if single else horizon
    a, b = ca.SX.sym("A", n_states, count * n_states), ca.SX.sym("B", n_states, count * n)
    c, x, u = ca.SX.sym("c", count * n_states), ca.SX.sym("x", n_states), ca.SX.sym("u", horizon * n)
    states = [x]
    for k in range(horizon):
        i = 0 if single else k
        rows, columns = slice(i * n_states, (i + 1) * n_states), slice(i * n, (i + 1) * n)
        states.append(a[:, rows] @ states[-1] + b[:, columns] @ u[k * n : (k + 1) * n] + c[rows])
    return ca.Function("rollout", [a, b, c, x, u], [ca.vertcat(*states)])


@lru_cache(maxsize=16)
def constraint_matrix(horizon: int, n: int) -> sp.csc_matrix:
    """Rows of the rates, of their changes, and of their sums (angles over dt), shape (3 N n, N n)."""
    each = sp.identity(n)
    rates = sp.identity(horizon * n)
    changes = sp.kron(sp.diags([1.0, -1.0], [0, -1], shape=(horizon, horizon)), each)
    angles = sp.kron(np.tril(np.ones((horizon, horizon))), each)
    matrix = sp.csc_matrix(sp.vstack([rates, changes, angles]))
    matrix.sort_indices()
    read_only(matrix.data)  # shared by all QPs of this size
    return matrix


def model_sequence(models: LinearModel | Sequence[LinearModel], horizon: int) -> Sequence[LinearModel]:
    """One model as a list, or the models of all periods; ValueError if their number or shapes are wrong."""
    sequence: Sequence[LinearModel] = [models] if isinstance(models, LinearModel) else models
    if not isinstance(models, LinearModel) and len(sequence) != horizon:
        raise ValueError(f"models has {len(sequence)} entries, expected 1 or the horizon {horizon}")
    n = sequence[0].B.shape[-1]
    for model in sequence:
        shapes = model.A.shape, model.B.shape, model.c.shape
        if shapes != ((4 + n, 4 + n), (4 + n, n), (4 + n,)):
            raise ValueError(f"A, B, c of a model have shapes {shapes}, expected those of {n} motors")
    return sequence


@per_thread(maxsize=32)
def _condensing(horizon: int, n: int, single: bool, velocity: bool, angle: bool) -> BufferedFunction:
    return BufferedFunction(_condensing_graph(horizon, n, single, velocity, angle))


@graph_cache(maxsize=32)
def _condensing_graph(horizon: int, n: int, single: bool, velocity: bool, angle: bool) -> Any:
    """Linear models, state and reference to (P, q, l, u) in one graph."""
    n_states = 4 + n
    count = 1 if single else horizon
    a_all, b_all, c_all = (
        ca.SX.sym(name, *shape)
        for name, shape in (
            ("A", (n_states, count * n_states)),
            ("B", (n_states, count * n)),
            ("c", (count * n_states, 1)),
        )
    )
    x = ca.SX.sym("x", n_states)
    states, inputs = ca.SX.sym("states", n_states, horizon), ca.SX.sym("inputs", n, horizon)
    previous, weights = ca.SX.sym("previous", n), ca.SX.sym("weights", 4)
    terminal, bounds, dt = (
        ca.SX.sym("terminal", n_states, n_states),
        ca.SX.sym("bounds", n, 4),
        ca.SX.sym("dt"),
    )

    def part(block: Any, k: int, width: int) -> Any:
        k = 0 if single else k
        return block[:, k * width : (k + 1) * width]

    a, b, c = [], [], []
    for k in range(horizon):
        # The motors are exact integrators: writing their rows as constants prunes the graph.
        mine = part(a_all, k, n_states)
        a.append(ca.vertcat(mine[:4, :], ca.horzcat(ca.SX(n, 4), ca.SX.eye(n))))
        b.append(ca.vertcat(part(b_all, k, n)[:4, :], dt * ca.SX.eye(n)))
        c.append(ca.vertcat(c_all[(0 if single else k) * n_states :][:4], ca.SX(n, 1)))
    # A weight of zero is left out of the graph, not multiplied.
    used = [weights[0], weights[1] if velocity else ca.SX(1, 1), weights[2] if angle else ca.SX(1, 1)]
    stage = ca.diag(ca.vertcat(used[0], used[0], used[1], used[1], *[used[2]] * n))

    # Free response (no input) and, backwards, the gradient of its cost: the adjoint.
    free = [x]
    for k in range(horizon):
        free.append(a[k] @ free[k] + c[k])
    adjoint = [terminal @ (free[-1] - states[:, -1])]
    for k in range(horizon - 1, 0, -1):
        adjoint.insert(0, stage @ (free[k] - states[:, k - 1]) + a[k].T @ adjoint[0])
    gradient = ca.vertcat(*(b[k].T @ adjoint[k] - weights[3] * inputs[:, k] for k in range(horizon)))

    responses: dict[tuple[int, int], Any] = {}

    def response(k: int, i: int) -> Any:
        """dx_k / du_i; with one model it depends on k - i alone."""
        key = (k - i, 0) if single else (k, i)
        if key not in responses:
            responses[key] = b[i] if k == i + 1 else a[k - 1] @ response(k - 1, i)
        return responses[key]

    # Block (i, j) of the Hessian is the sum over k > j of (dx_k/du_i)' Q_k (dx_k/du_j). With one model the terms
    # before the last period are those of block (i + 1, j + 1) and one more.
    blocks = [[ca.SX(n, n) for _ in range(horizon)] for _ in range(horizon)]
    ends: dict[tuple[int, int], Any] = {}
    for j in range(horizon - 1, -1, -1):
        last = terminal @ response(horizon, j)
        weighted = {k: stage @ response(k, j) for k in range(j + 1, horizon)}
        for i in range(j + 1):
            if not single:
                blocks[i][j] = sum((response(k, i).T @ w for k, w in weighted.items()), ca.SX(n, n))
            elif j < horizon - 1:
                blocks[i][j] = blocks[i + 1][j + 1] + response(horizon - 1, i).T @ weighted[horizon - 1]
            ends[i, j] = blocks[i][j] + response(horizon, i).T @ last
    hessian = ca.vertcat(
        *(ca.horzcat(*(ends.get((i, j), ca.SX(n, n)) for j in range(horizon))) for i in range(horizon))
    )
    hessian += weights[3] * ca.SX.eye(horizon * n)
    upper_triangle = ca.vertcat(*(hessian[: j + 1, j] for j in range(horizon * n)))

    rate, change, lower, upper = (bounds[:, i] for i in range(4))
    first = ca.vertcat(previous, ca.SX(n * (horizon - 1), 1))
    l_all = [
        -ca.repmat(rate, horizon, 1),
        first - ca.repmat(change, horizon, 1),
        ca.repmat((lower - x[4:]) / dt, horizon, 1),
    ]
    u_all = [
        ca.repmat(rate, horizon, 1),
        first + ca.repmat(change, horizon, 1),
        ca.repmat((upper - x[4:]) / dt, horizon, 1),
    ]
    return ca.Function(
        "condense",
        [a_all, b_all, c_all, x, states, inputs, previous, weights, terminal, bounds, dt],
        [upper_triangle, gradient, ca.vertcat(*l_all), ca.vertcat(*u_all)],
        {"cse": True},
    )
