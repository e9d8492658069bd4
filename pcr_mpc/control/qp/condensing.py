"""From linear models and a reference to the QP in the inputs alone, and from its solution to states and residuals.

A model is one column [vec(A), c, vec(B), vec(E)] (see `LinearModel`). With S_k = dx_k/dU and the adjoint
L_k = Q S_k + A_k' L_(k+1), L_N = T S_N, row block k of the Hessian is B_k' L_(k+1): as many small products as there are
blocks, where the sum over all periods of every block would take a horizon times more.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from ...buffered import graph_cache

# Graphs up to this many periods become one list of instructions; longer ones stay matrices, which are built at once.
_UNROLLED = 12
# Beyond it are the solvers' infinities.
_LARGEST = 1e30


def _split(column: Any, ends: list[int]) -> list[Any]:
    found: list[Any] = ca.vertsplit(column, ends)
    return found


class _Models:
    """Models of all periods, taken from their columns; the motors are exact integrators, which prunes the graph."""

    def __init__(self, packed: Any, horizon: int, n: int, dt: Any) -> None:
        n_states = 4 + n
        single = packed.size2() == 1
        ends = [0, n_states**2, n_states * (n_states + 1), n_states * (n_states + 1 + n)]
        self.a: list[Any] = []
        self.b: list[Any] = []
        self.c: list[Any] = []
        for k in range(1 if single else horizon):
            a, c, b, _ = _split(packed[:, k], [*ends, packed.size1()])
            a, b = ca.reshape(a, n_states, n_states)[:4, :], ca.reshape(b, n_states, n)[:4, :]
            self.a.append(ca.vertcat(a, ca.horzcat(ca.DM(n, 4), ca.DM.eye(n))))
            self.b.append(ca.vertcat(b, dt * ca.DM.eye(n)))
            self.c.append(ca.vertcat(c[:4], ca.DM(n, 1)))
        if single:
            self.a, self.b, self.c = self.a * horizon, self.b * horizon, self.c * horizon


@graph_cache(maxsize=32)
def condensing(
    horizon: int, n: int, models: int, *, velocity: bool, angle: bool, inline: bool = True
) -> Any:  # fmt: skip
    """Graph of the QP data of `build_qp`.

    Parameters
    ----------
    models : int
        1, for the whole horizon, or the horizon.
    velocity, angle : bool
        Whether they have a weight.
    inline : bool
        Make one list of instructions of it, if it is not too long: four times as fast, and twice as much code.

    Returns
    -------
    casadi.Function
        (models (size, 1 or N), x (4 + n), states (4 + n, N), inputs (n, N), u_previous (n), weights (4), T,
        bounds (n, 4), dt) -> P as `QuadraticProgram` holds it, q, l, u, the optimum without limits, and [|P|, |q|, 1 if
        all is finite and no bounds cross, else 0].
    """
    n_states = 4 + n
    packed = ca.MX.sym("models", n_states * (n_states + 1 + n + 2), models)
    x, states, inputs = (
        ca.MX.sym("x", n_states),
        ca.MX.sym("states", n_states, horizon),
        ca.MX.sym("inputs", n, horizon),
    )
    previous, weights = ca.MX.sym("previous", n), ca.MX.sym("weights", 4)
    terminal, bounds, dt = ca.MX.sym("terminal", n_states, n_states), ca.MX.sym("bounds", n, 4), ca.MX.sym("dt")
    model = _Models(packed, horizon, n, dt)
    # A weight of zero is left out of the graph, not multiplied.
    used = [weights[0], weights[1] if velocity else ca.DM(1, 1), weights[2] if angle else ca.DM(1, 1)]
    stage = ca.diag(ca.vertcat(used[0], used[0], used[1], used[1], *[used[2]] * n))

    # Response to the inputs so far and, in the last column, the free response less the reference.
    free, responses = x, [ca.DM(n_states, 0)]
    misses = []
    for k in range(horizon):
        free = model.a[k] @ free + model.c[k]
        misses.append(free - states[:, k])
        responses.append(ca.horzcat(model.a[k] @ responses[k], model.b[k]))
    rows: list[Any] = []
    gradient: list[Any] = []
    adjoint = terminal @ ca.horzcat(responses[horizon], misses[-1])
    for k in range(horizon - 1, -1, -1):
        block = model.b[k].T @ adjoint
        rows.insert(0, block[:, :-1])
        gradient.insert(0, block[:, -1] - weights[3] * inputs[:, k])
        if k:
            # Later inputs have no say in x_k: what is left is the Hessian's lower triangle.
            earlier = ca.horzcat(adjoint[:, : n * k], adjoint[:, -1])
            adjoint = stage @ ca.horzcat(responses[k], misses[k - 1]) + model.a[k].T @ earlier
    triangle = []
    for k, row in enumerate(rows):
        for i in range(n):
            j = n * k + i
            triangle += [row[i, :j].T, row[i, j] + weights[3]]

    rate, change, lower, upper = ca.horzsplit(bounds)
    first = ca.vertcat(previous, ca.DM.zeros(n * (horizon - 1), 1))
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
    p, q, l, u = (ca.vertcat(*parts) for parts in (triangle, gradient, l_all, u_all))  # noqa: E741
    free_inputs = without_limits(p, q, unrolled=horizon <= _UNROLLED)
    sizes = ca.norm_2(p), ca.norm_2(q)
    # So written that NaN is not sound.
    sound = ca.logic_and(ca.mmin(u - l) >= 0, ca.norm_inf(ca.vertcat(l, u)) < _LARGEST)
    for size in sizes:
        sound = ca.logic_and(sound, size < _LARGEST)
    results = [p, q, l, u, free_inputs, ca.vertcat(*sizes, sound)]
    arguments = [packed, x, states, inputs, previous, weights, terminal, bounds, dt]
    graph = ca.Function("condense", arguments, [ca.densify(result) for result in results])
    return graph.expand("condense", {"cse": True}) if inline and horizon <= _UNROLLED else graph


def without_limits(triangle: Any, q: Any, *, unrolled: bool) -> Any:
    """Expression of the U that minimises 1/2 U'PU + q'U.

    By Cholesky, column after column, where it is to be ``unrolled``: then half of each symmetric rest falls away, as it
    is not used, and U is NaN where P is not positive definite. By CasADi's LDL' else.
    """
    size = q.numel()
    rest, right = ca.triu2symm(ca.MX(ca.Sparsity.upper(size), triangle)), -q
    if not unrolled:
        return ca.solve(rest, right, "ldl", {"preordering": False})
    factor = []
    for _ in range(size - 1):
        column = rest[:, 0] / ca.sqrt(rest[0, 0])
        diagonal, below = column[0], column[1:]
        head = right[0] / diagonal
        factor.append((diagonal, below, head))
        rest, right = rest[1:, 1:] - below @ below.T, right[1:] - below * head
    found = right / ca.sqrt(rest) / ca.sqrt(rest)  # NaN, as all others, of what is negative
    for diagonal, below, head in reversed(factor):
        found = ca.vertcat((head - below.T @ found) / diagonal, found)
    return found


@graph_cache(maxsize=32)
def checking(horizon: int, n: int, models: int, *, inline: bool = True) -> Any:
    """Graph of what a solution of the QP leads to, and of how good it is; ``inline`` as of `condensing`.

    Returns
    -------
    casadi.Function
        (models (size, 1 or N), x (4 + n), P, q, l, u, bounds (n, 4), dt, clear [rad/s], inputs (n, N), multipliers of
        rates and changes (2 N n)) -> states (4 + n, N + 1), [largest violation of the rows of rates and changes,
        largest entry of P U + q + A'y, largest excess of an angle over its limits [rad], largest multipliers of rates
        and of changes, 1 if the first rates keep the limits as they are and no stop is nearer than ``clear`` dt].
    """
    n_states, size = 4 + n, horizon * n
    packed = ca.MX.sym("models", n_states * (n_states + 1 + n + 2), models)
    x, inputs, y = ca.MX.sym("x", n_states), ca.MX.sym("inputs", n, horizon), ca.MX.sym("y", 2 * size)
    upper_triangle, q = ca.MX.sym("P", size * (size + 1) // 2), ca.MX.sym("q", size)
    lower, upper = ca.MX.sym("l", 3 * size), ca.MX.sym("u", 3 * size)
    bounds, dt, clear = ca.MX.sym("bounds", n, 4), ca.MX.sym("dt"), ca.MX.sym("clear")
    model = _Models(packed, horizon, n, dt)
    states = [x]
    for k in range(horizon):
        states.append(model.a[k] @ states[k] + model.b[k] @ inputs[:, k] + model.c[k])
    angles = ca.horzcat(*states[1:])[4:, :]
    excess = ca.fmax(ca.mmax(bounds[:, 2] - angles), ca.mmax(angles - bounds[:, 3]))
    u = ca.vec(inputs)
    rows = ca.vertcat(u, u - ca.vertcat(ca.DM.zeros(n), u[:-n]))
    primal = ca.fmax(ca.mmax(ca.vertcat(lower[: 2 * size] - rows, rows - upper[: 2 * size])), 0)
    of_rates, of_changes = y[:size], y[size:]
    pull = of_rates + of_changes - ca.vertcat(of_changes[n:], ca.DM.zeros(n))
    hessian = ca.MX(ca.Sparsity.upper(size), upper_triangle)
    dual = ca.norm_inf(ca.triu2symm(hessian) @ u + q + pull)
    # The first rows of rates, changes and angles; so written that NaN keeps nothing.
    first = [slice(k * size, k * size + n) for k in range(3)]
    kept = ca.vertcat(*(row for at in first[:2] for row in (lower[at] <= u[:n], u[:n] <= upper[at])),
                      lower[first[2]] <= -clear, upper[first[2]] >= clear)  # fmt: skip
    numbers = primal, dual, excess, ca.norm_inf(of_rates), ca.norm_inf(of_changes), ca.mmin(kept)
    arguments = [packed, x, upper_triangle, q, lower, upper, bounds, dt, clear, inputs, y]
    graph = ca.Function("check", arguments, [ca.horzcat(*states), ca.vertcat(*numbers)])
    return graph.expand("check", {"cse": True}) if inline and horizon <= _UNROLLED else graph
