"""The ways to solve a rod, seen from the solver alike: graphs, and what their unknowns mean."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ...buffered import graph_cache
from ...compiled import fastest
from .closed_form import elastica, inertia
from .closed_form.chart import HeldShape
from .equations import Layout, RodPhysics, aligned_steps, sample_rod
from .numbers import Kind
from .shooting import inertia as shooting_inertia
from .shooting import multiple_shooting

# Graphs up to this size are inlined into the graph of the whole robot; larger ones are called by it.
_INLINED_INSTRUCTIONS = 4000


@dataclass(frozen=True)
class Shooting:
    """Discretisation of the rods by shooting.

    Attributes
    ----------
    segments : int
        N, shooting segments per rod.
    steps : int
        Runge-Kutta steps per segment.
    scheme : {"rk4", "rk8"}
        Runge-Kutta scheme.
    """

    segments: int = 8
    steps: int = 1
    scheme: str = "rk8"


class RodGraphs(NamedTuple):
    """Graphs by which a rod is solved.

    Attributes
    ----------
    newton, residual : casadi.Function
        See `multiple_shooting.rod_newton`.
    retract : casadi.Function
        (unknowns, change) -> unknowns: how a step is taken.
    apart : casadi.Function
        (unknowns, unknowns) -> how far two shapes are apart, in numbers of order one: a warm start may not change much.
    """

    newton: Any
    residual: Any
    retract: Any
    apart: Any


@dataclass(frozen=True, eq=False)
class RodMethod:
    """One way to solve a rod: its graphs, and how its unknowns relate to shapes.

    Attributes
    ----------
    name : str
    newton, residual, retract, apart : casadi.Function
        `RodGraphs` of the warm step.
    any_pull : RodGraphs
        Of all other rungs: for rods however taut, where those of the warm step do not know them.
    chord : casadi.Function or None
        (unknowns, pose, tangent) -> change: a cheap iteration with derivatives that are there, if there is one.
    tolerance : float
        Residual at which a rod counts as solved: rounding.
    settling : int
        Newton iterations that bring a rod to the tolerance from nearby, derivatives included.
    following : float
        Residual that will do from one time step of a simulation to the next.
    from_shape : callable
        (shape, clamp angle) -> unknowns: a cold start.
    from_nodes : callable
        (nodes (4, N), physics) -> list of unknowns: starts from an equilibrium or a guess, to be tried in this order.
    to_nodes : callable
        (unknowns, clamp angle, wanted number N) -> nodes (4, N); the shooting methods keep their own number.
    mass : callable
        () -> casadi.Function, the condensed inertia of a rod (see `inertia.rod_mass`); built when it is wanted.
    layout : Layout or None
        Of what its graphs take as a third argument. None: they are of plain rods, and take none.
    by_calls : callable or None
        () -> ``newton`` and ``residual`` in a form that a C compiler is done with sooner, with the same numbers; None:
        they are short as they are.
    """

    name: str
    newton: Any
    residual: Any
    retract: Any
    apart: Any
    any_pull: RodGraphs
    chord: Any
    tolerance: float
    settling: int
    following: float
    from_shape: Callable[[HeldShape, float], np.ndarray]
    from_nodes: Callable[[np.ndarray, RodPhysics | None], list[np.ndarray]]
    to_nodes: Callable[[np.ndarray, float, int], np.ndarray]
    mass: Callable[[], Any]
    layout: Layout | None = None
    by_calls: Callable[[], tuple[Any, Any]] | None = None


def _by_segment(unknowns: np.ndarray, _angle: float, _count: int) -> np.ndarray:
    return unknowns.reshape((4, -1), order="F").copy()


# By the name of a method, for those who have unknowns and no graphs.
TO_NODES: dict[str, Callable[[np.ndarray, float, int], np.ndarray]] = {
    "closed_form": elastica.nodes,
    "multiple_shooting": _by_segment,
    "single_shooting": _by_segment,
}


@graph_cache()
def shooting_method(shooting: Shooting, layout: Layout | None) -> RodMethod:
    """Multiple shooting, paper sec. 4, for rods of any layout; the unknowns are the nodes."""
    n = shooting.segments
    steps = aligned_steps(layout, n, shooting.steps)
    newton, residual = multiple_shooting.rod_newton(n, steps, shooting.scheme, layout)
    start, change = ca.SX.sym("start", 4 * n), ca.SX.sym("change", 4 * n)

    def from_nodes(nodes: np.ndarray, of_rod: RodPhysics | None) -> list[np.ndarray]:
        same = nodes.shape[1] == n
        return [(nodes if same else sample_rod(nodes, n + 1, of_rod)[2:, :n]).ravel(order="F")]

    retract = ca.Function("retraction", [start, change], [start + change])
    apart = ca.Function("apart", [start, change], [ca.norm_inf((start - change)[0::4])])
    return RodMethod(
        name="multiple_shooting",
        newton=newton,
        residual=residual,
        retract=retract,
        apart=apart,
        any_pull=RodGraphs(newton, residual, retract, apart),
        chord=None,
        # Relative to the load; on taut rods the equations have a condition of 1e8.
        tolerance=1e-10,
        settling=2,
        following=1e-10,
        from_shape=lambda shape, angle: shape.nodes(n, angle).ravel(order="F"),
        from_nodes=from_nodes,
        to_nodes=TO_NODES["multiple_shooting"],
        mass=lambda: shooting_inertia.rod_mass(n, steps, shooting.scheme, layout),
        layout=layout,
        by_calls=lambda: multiple_shooting.rod_newton(n, steps, shooting.scheme, layout, inline=False),
    )


@graph_cache()
def closed_form_method() -> RodMethod:
    """Elliptic functions: exact for the uniform, straight, weightless rods that a `Robot` describes."""
    newton, residual = elastica.rod_newton()
    return RodMethod(
        name="closed_form",
        newton=newton,
        residual=residual,
        retract=elastica.retraction(),
        apart=elastica.apart(),
        any_pull=RodGraphs(
            *elastica.rod_newton(any_pull=True), elastica.retraction(any_pull=True), elastica.apart(any_pull=True)
        ),
        chord=elastica.rod_chord(),
        tolerance=1e-13,
        settling=3,
        following=1e-11,
        from_shape=lambda shape, _: np.array([shape.log_tip_angle, shape.load, shape.hand]),
        from_nodes=lambda nodes, _: [elastica.from_nodes(nodes), elastica.from_base(nodes)],
        to_nodes=TO_NODES["closed_form"],
        mass=inertia.rod_mass,
    )


@graph_cache(maxsize=16)
def warm_step(kind: Kind, method: RodMethod, iterations: int) -> Any:
    """`warm_calls` as one list of instructions, if that is not too long: a fifth faster, and slow to compile."""
    return inlined(warm_calls(kind, method, iterations), method.newton)


@graph_cache(maxsize=16)
def warm_calls(kind: Kind, method: RodMethod, iterations: int) -> Any:
    """Tangent predictor, a fixed number of Newton iterations and the verdict, for the whole robot in one graph.

    Nothing is decided in here: the caller reads the verdict, and keeps the result or takes the slow way. After a
    single iteration comes one with the same derivatives, where the method has that: without it, every other step of a
    brisk motion misses the tolerance by a digit, and costs a second iteration.

    Returns
    -------
    casadi.Function
        ([p, q] (2 + n), start, numbers) -> record, verdict, result, each a vector in one piece, for copying many
        small arrays costs as much as the arithmetic. The record of a pose holds, column by column, unknowns (u, n),
        tangents (u, 3n), poses (3, n), loads (3, n), load_tangents (3, 3n), scalars (5, n), of which the first three
        are the start of the next (see `RobotState`). Verdict (5) = [largest residual, largest residual where the
        derivatives were taken, largest change of an unknown of the branch beyond the prediction, number of conjugate
        points, drift of the invariant]; result (6 + 2n) = force (2) [N], K (2, 2) [N/m], G (2, n) [N/rad].
    """
    n, width = kind.n_rods, method.newton.size1_in(0)
    vector = ca.MX.sym("numbers", kind.size)
    target, start_record = ca.MX.sym("target", 2 + n), ca.MX.sym("start", (4 * width + 3) * n)
    p, q = target[:2], target[2:]
    blocks = ca.vertsplit(start_record, [0, width * n, 4 * width * n, (4 * width + 3) * n])
    unknowns, tangents, poses = (
        ca.reshape(block, -1, columns) for block, columns in zip(blocks, (n, 3 * n, n), strict=True)
    )
    columns: dict[str, list[Any]] = {name: [] for name in ("u", "t", "pose", "loads", "load_t", "scalars")}
    residuals, roughest, changes = [], [], []
    force, k, g = ca.MX(2, 1), ca.MX(2, 2), []
    for i, rod in enumerate(kind.unpack(vector).rods):
        known = rod.physics
        pose = ca.vertcat((p - rod.base) / rod.length, q[i])
        start = tangents[:, 3 * i : 3 * i + 3]
        u = predicted = method.retract(unknowns[:, i], start @ (pose - poses[:, i]))
        for _ in range(iterations):
            step, tangent, _, load_tangent, scalars = method.newton(u, pose, *known)
            u = method.retract(u, step)
        if iterations == 1 and method.chord is not None:
            u = method.retract(u, method.chord(u, pose, tangent))
        residual, loads = method.residual(u, pose, *known)
        for name, value in zip(columns, (u, tangent, pose, loads, load_tangent, scalars), strict=True):
            columns[name].append(value)
        residuals.append(residual)
        roughest.append(scalars[0])
        changes.append(method.apart(u, predicted))
        unit = rod.bending_stiffness / rod.length**2
        force += unit * loads[:2]
        k += unit / rod.length * load_tangent[:2, :2]
        g.append(unit * load_tangent[:2, 2])
    conjugate_points = sum(scalars[3] for scalars in columns["scalars"])
    # Sums, not maxima, of what may be NaN: fmax would drop it.
    drift = sum(ca.fabs(scalars[4]) for scalars in columns["scalars"])
    verdict = ca.vertcat(sum(residuals), sum(roughest), sum(changes), conjugate_points, drift)
    record = ca.vertcat(*(ca.vec(ca.horzcat(*found)) for found in columns.values()))
    result = ca.vertcat(force, ca.vec(k), ca.vec(ca.horzcat(*g)))
    return ca.Function("warm_step", [target, start_record, vector], [record, verdict, result])


@graph_cache(maxsize=16)
def for_compiler(method: RodMethod) -> RodMethod:
    """Return the same method with the graphs that a C compiler should be given."""
    if method.by_calls is None:
        return method
    newton, residual = method.by_calls()
    return replace(method, newton=newton, residual=residual, by_calls=None)


@graph_cache(maxsize=16)
def by_machine_code(method: RodMethod) -> RodMethod:
    """Return the same method with what a rod costs as machine code: one function, whoever calls it how often."""
    method = for_compiler(method)
    return replace(method, newton=fastest(method.newton), residual=fastest(method.residual))


def enough_nodes(loads: np.ndarray, least: int) -> int:
    """Nodes at most 4 / lambda apart, so that integrating between them is stable on taut rods; a power of two."""
    load = math.sqrt(float(np.hypot(*loads[:2]).max()))
    return max(least, 1 << max(0, math.ceil(math.log2(max(load, 1.0) / 4.0))))


def inlined(function: Any, of_rod: Any) -> Any:
    """Inline the graph of a rod into that of a robot that calls it, if it is small."""
    return function.expand(function.name(), {"cse": True}) if is_short(of_rod) else function


def is_short(of_rod: Any) -> bool:
    """Whether the graph of a rod is small enough to be inlined into others."""
    return bool(of_rod.is_a("SXFunction")) and bool(of_rod.n_instructions() <= _INLINED_INSTRUCTIONS)
