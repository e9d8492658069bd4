"""Exact derivatives of an open-loop motion in its start and in the robot's numbers.

The rods of every force in a step are solved beforehand. About their solution u at z = [pose, what else the rod is], the
implicit function theorem gives R_u du + R_z dz = 0: a Newton step's own derivative in z, for R is zero there. The graph
of a step gets u and loads in that form, to first order, and CasADi differentiates the rest; no iteration is
differentiated, on whose start the solution does not depend. Steps are joined by the chain rule.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ...buffered import BufferedFunction, graph_cache, per_thread
from ...errors import checked_array
from ...frozen import Frozen
from ..rods.method import RodMethod
from ..rods.numbers import Kind
from ..statics.equilibrium import Equilibrium
from .mass_matrix import robot_mass
from .plant import Plant
from .rollout import STEPS_AT_ONCE, checked_motion
from .step_graph import SOLVES, Motion, StepModel
from .trails import moved_on_a_trail


@dataclass(frozen=True, eq=False)
class Sensitivities(Frozen):
    """Motion of a robot and its derivatives.

    Attributes
    ----------
    t : ndarray, shape (T + 1,)
        [s].
    x : ndarray, shape (T + 1, 4 + n)
        States, the start first.
    dx_dx0 : ndarray, shape (T + 1, 4 + n, 4 + n)
        In the state at the start.
    dx_dnumbers : ndarray, shape (T + 1, 4 + n, K)
        In the robot's numbers, in SI units.
    dx_dways : ndarray, shape (T + 1, 4 + n, D)
        Along the ways in which what acts on the robot may change.
    names : tuple of str
        Of the K numbers (see `Kind`, which has their units).
    """

    t: np.ndarray
    x: np.ndarray
    dx_dx0: np.ndarray
    dx_dnumbers: np.ndarray
    dx_dways: np.ndarray
    names: tuple[str, ...]


def sensitivities(
    plant: Plant,
    x0: Any,
    inputs: Any,
    f_ext: Any = (0.0, 0.0),
    *,
    guess: Equilibrium | None = None,
    ways: Any = None,
) -> Sensitivities:
    """Move a robot through a sequence of inputs, and differentiate its states in the start and in its numbers.

    The derivatives are those of the discrete motion, to rounding and to the tolerance of the statics. The start is held
    when numbers change, and so are inputs and f_ext. These may change, too: along each of D ways, such as a force that
    is always there, or commands that come a little later. Where a motor just reaches its stop or its limit of rate,
    there is no derivative, and what is given lies between those of both sides. A number on which the motion does not
    depend has the derivative zero: the stops of motors that do not reach them; gravity as far as it pulls on rods whose
    weight the plant leaves out, as by default where gravity is zero (with ``weight="condensed"`` it does not).

    Parameters
    ----------
    plant : Plant
        As for `rollout`; it loses a payload, and ends wherever the motion left it.
    x0 : array_like, shape (4 + n,)
        State at the start [m, m/s, rad].
    inputs : array_like, shape (T, n)
        Motor rates, held over a step [rad/s].
    f_ext : array_like, shape (2,) or (T, 2)
        External force on the tip besides its weight [N].
    guess : Equilibrium, optional
        On whose branch the rods start; None: on that of least energy.
    ways : array_like, shape (T, n + 2, D), optional
        Derivatives of [inputs, f_ext] of every step in D unknowns. None: there are none.

    Raises
    ------
    UnreachableError, ConvergenceError, UnstableError
        The rods could not follow, or one snapped, where there is no derivative; the exception carries the ``step``,
        and the ``state`` at the start of that.
    ValueError
        A plant that has no graph of a step, or an argument that is not finite or of the wrong shape.
    """
    model = plant.step_model
    if model is None:
        raise ValueError(f"method {plant.method!r} with inertia {plant.inertia!r} has no sensitivities")
    starts, all_inputs, all_forces, many = checked_motion(plant, x0, inputs, f_ext)
    if many:
        raise ValueError("sensitivities are of one robot: x0 and f_ext have two axes at most, inputs have two")
    start, inputs, f_ext = starts[0], all_inputs[0], all_forces[0]
    x, trails = moved_on_a_trail(plant, start, inputs, f_ext, guess)

    size, numbers, steps, n_given = plant.n_states, plant.numbers, len(inputs), plant.robot.n_rods + 2
    if ways is None:
        ways = np.empty((steps, n_given, 0))
    ways = checked_array(
        "ways", ways, (steps, n_given, *np.shape(ways)[2:3]) if np.ndim(ways) == 3 else (steps, n_given, 1)
    )
    both = size + len(numbers)
    derivatives = np.zeros((len(x), size, both + ways.shape[2]))
    derivatives[0] = np.eye(size, derivatives.shape[2])
    kept = _begun(model, start, numbers, trails[0][0])
    slopes = _all_slopes(model, x, np.hstack([inputs, f_ext]), kept[0], numbers, trails)
    of_numbers = slice(size + len(kept[0]), -n_given)
    for k, slope in enumerate(slopes):
        derivatives[k + 1] = slope[:, :size] @ derivatives[k]
        derivatives[k + 1, :, :both] += slope[:, size : size + len(kept[0])] @ kept[1]
        derivatives[k + 1, :, size:both] += slope[:, of_numbers]
        derivatives[k + 1, :, both:] += slope[:, -n_given:] @ ways[k]
    t = plant.dt * np.arange(len(x))
    by_start, by_numbers, by_ways = (part.copy() for part in np.split(derivatives, [size, both], axis=2))
    return Sensitivities(t, x, by_start, by_numbers, by_ways, model.kind.names)


def _all_slopes(
    model: StepModel, x: np.ndarray, given: np.ndarray, kept: np.ndarray, numbers: np.ndarray, trails: np.ndarray
) -> Iterator[np.ndarray]:
    """Derivatives of every step's end in [x, kept, numbers, u, f_ext], shape (4 + n, ...)."""
    held = np.concatenate([kept, numbers])
    for first in range(0, len(given), STEPS_AT_ONCE):
        block = slice(first, min(len(given), first + STEPS_AT_ONCE))
        steps = block.stop - first
        graph = _many_slopes(model, steps)
        variables, of_held, places = (place.T.reshape(steps, -1) for place in graph.inputs)
        variables[:] = np.hstack([x[block], np.tile(held, (steps, 1)), given[block]])
        of_held[:], places[:] = numbers, trails[block].reshape(steps, -1)
        graph()
        yield from graph.outputs[0].T.reshape(steps, -1, x.shape[1]).transpose(0, 2, 1)


@per_thread(maxsize=8)
def _many_slopes(model: StepModel, steps: int) -> BufferedFunction:
    graph = _step_slopes(model)
    return BufferedFunction(graph.map(steps, "serial") if steps > 1 else graph)


def _begun(
    model: StepModel, start: np.ndarray, numbers: np.ndarray, place: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What the motion keeps from its start beside the state, and its derivatives in start and numbers."""
    if model.inertia != "constant":
        return np.empty(0), np.empty((0, len(start) + len(numbers)))
    kept, slopes = _start_slopes(model)(np.concatenate([start, numbers]), numbers, place)
    return kept.full().ravel(), slopes.full()


class _SolvedMotion(Motion):
    """Rods that are solved already, at a trail of places; ``held`` are the numbers with which they are."""

    def __init__(self, trail: Any, held: Any, *args: Any) -> None:
        super().__init__(*args)
        self._held = held if self.model.weight == "exact" else self.model.kind.weightless(held)
        self._places = iter(ca.horzsplit(trail))

    def follow(self, p: Any, q: Any) -> tuple[Any, Any]:
        n, kind = self.n, self.model.kind
        place = next(self._places)
        unknowns = ca.horzsplit(ca.reshape(place[2 + n :], -1, n))
        given, response = _given(kind), _response(self.model.method)
        there = ca.horzsplit(given(place[: 2 + n], self._held))
        here = ca.horzsplit(given(ca.vertcat(p, q), self.of_rods))
        columns, force = [], ca.MX(2, 1)
        for i, rod in enumerate(self.numbers.rods):
            loads, moves, load_moves = response(unknowns[i], there[i])
            change = here[i] - there[i]
            columns.append(unknowns[i] + moves @ change)
            force += rod.bending_stiffness / rod.length**2 * (loads + load_moves @ change)[:2]
        return ca.horzcat(*columns), force


@graph_cache(maxsize=16)
def _given(kind: Kind) -> Any:
    """Build ([p, q], numbers) -> z = [pose, physics] of every rod, normalised, a column each."""
    target, vector = ca.SX.sym("target", 2 + kind.n_rods), ca.SX.sym("numbers", kind.size)
    columns = [
        ca.vertcat((target[:2] - rod.base) / rod.length, target[2 + i], *rod.physics)
        for i, rod in enumerate(kind.unpack(vector).rods)
    ]
    return ca.Function("given", [target, vector], [ca.horzcat(*columns)])


@graph_cache(maxsize=16)
def _response(method: RodMethod) -> Any:
    """Build (unknowns, z) of a solved rod -> loads (3), derivatives of the unknowns in z, and of the loads."""
    size = method.layout.size if method.layout else 0
    unknowns, pose, physics = (
        ca.SX.sym(name, rows) for name, rows in (("u", method.newton.size1_in(0)), ("pose", 3), ("physics", size))
    )
    known = [physics] if size else []
    step, tangent, loads, load_tangent, _ = method.any_pull.newton(unknowns, pose, *known)
    moves = ca.jacobian(step, physics)
    load_moves = ca.jacobian(loads, physics) + ca.jacobian(loads, unknowns) @ moves
    results = [loads, ca.horzcat(tangent, moves), ca.horzcat(load_tangent, load_moves)]
    return ca.Function(
        "response", [unknowns, ca.vertcat(pose, physics)], [ca.densify(r) for r in results], {"cse": True}
    )


def _widths(model: StepModel) -> tuple[int, int, int]:
    """Of what a motion keeps from its start, of the numbers, and of a place."""
    n = model.kind.n_rods
    kept = (2 + n) ** 2 if model.inertia == "constant" else 0
    return kept, model.kind.size, 2 + n + model.method.newton.size1_in(0) * n


@graph_cache(maxsize=16)
def _step_slopes(model: StepModel) -> Any:
    """Build ([x, kept, numbers, u, f_ext], numbers, trail) -> derivatives of the next x in the first argument."""
    n = model.kind.n_rods
    kept, size, width = _widths(model)
    ends = np.cumsum([0, 4 + n, kept, size, n + 2]).tolist()
    variables, held = ca.MX.sym("variables", ends[-1]), ca.MX.sym("held", size)
    trail = ca.MX.sym("trail", width, 1 + SOLVES[model.integrator])
    x, mass, vector, given = ca.vertsplit(variables, ends)
    motion = _SolvedMotion(trail, held, model, vector, given[:n], x[4:], given[n:])
    if kept:
        motion.mass = ca.reshape(mass, 2 + n, 2 + n), motion.mass[1]
    motion.move(x[:2], x[4:])
    slopes = ca.jacobian(motion.advance(x), variables)
    return ca.Function("step_slopes", [variables, held, trail], [ca.densify(slopes)])


@graph_cache(maxsize=16)
def _start_slopes(model: StepModel) -> Any:
    """Build ([x, numbers], numbers, place) -> vec(M) of inertia "constant", its derivatives in the first."""
    n = model.kind.n_rods
    _, size, width = _widths(model)
    variables, held, place = ca.MX.sym("variables", 4 + n + size), ca.MX.sym("held", size), ca.MX.sym("place", width)
    x, vector = ca.vertsplit(variables, [0, 4 + n, 4 + n + size])
    motion = _SolvedMotion(place, held, model, vector, ca.DM.zeros(n), x[4:], ca.DM.zeros(2))
    unknowns, _ = motion.follow(x[:2], x[4:])
    mass = ca.vec(robot_mass(model.kind, model.method)(unknowns, x[4:], motion.of_rods)[0])
    return ca.Function("start_slopes", [variables, held, place], [mass, ca.densify(ca.jacobian(mass, variables))])
