"""Exact derivatives of an open-loop motion in its start and in the robot's numbers.

The rods of every force in a step are solved beforehand. About their solution u at z = [pose, what else the rod is], the
implicit function theorem gives R_u du + R_z dz = 0: a Newton step's own derivative in z, for R is zero there. The graph
of a step gets u and loads in that form, to first order, and CasADi differentiates the rest; no iteration is
differentiated, on whose start the solution does not depend. Steps are joined by the chain rule.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ...buffered import BufferedFunction, graph_cache
from ...errors import UnstableError
from ...frozen import Frozen
from ..rods.method import RodMethod
from ..rods.numbers import Kind
from ..statics.equilibrium import Equilibrium
from .integrators import INTEGRATORS
from .mass_matrix import MassMatrix, robot_mass
from .plant import Plant
from .rollout import checked_motion, said_of
from .step_graph import SOLVES, Motion, StepModel


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
    names : tuple of str
        Of the K numbers (see `Kind`, which has their units).
    """

    t: np.ndarray
    x: np.ndarray
    dx_dx0: np.ndarray
    dx_dnumbers: np.ndarray
    names: tuple[str, ...]


def sensitivities(
    plant: Plant, x0: Any, inputs: Any, f_ext: Any = (0.0, 0.0), *, guess: Equilibrium | None = None
) -> Sensitivities:
    """Move a robot through a sequence of inputs, and differentiate its states in the start and in its numbers.

    The derivatives are those of the discrete motion, to rounding and to the tolerance of the statics. The start is held
    when numbers change, and so are inputs and f_ext. Where a motor just reaches its stop or its limit of rate, there is
    no derivative, and what is given lies between those of both sides. A number on which the motion does not depend has
    the derivative zero: the stops of motors that do not reach them; gravity as far as it pulls on rods whose weight the
    plant leaves out, as by default where gravity is zero (with ``weight="condensed"`` it does not).

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
    x, trails = _moved(plant, start, inputs, f_ext, guess)

    size, numbers = plant.n_states, plant.numbers
    both = size + len(numbers)
    derivatives = np.empty((len(x), size, both))
    derivatives[0] = np.eye(size, both)
    kept = _begun(model, start, numbers, trails[0][0])
    graph = BufferedFunction(_step_slopes(model))
    variables, given, held, trail = graph.inputs
    variables[size : size + len(kept[0])], variables[-len(numbers) :], held[:] = kept[0], numbers, numbers
    for k, places in enumerate(trails):
        variables[:size], given[:], trail[:] = x[k], np.concatenate([inputs[k], f_ext[k]]), places.T
        graph()
        slopes = graph.outputs[0]
        derivatives[k + 1] = slopes[:, :size] @ derivatives[k] + slopes[:, size : -len(numbers)] @ kept[1]
        derivatives[k + 1, :, size:] += slopes[:, -len(numbers) :]
    t = plant.dt * np.arange(len(x))
    return Sensitivities(t, x, derivatives[:, :, :size].copy(), derivatives[:, :, size:].copy(), model.kind.names)


class _Watched:
    """A plant as the integrators see it, that notes where it has been: [p, q, unknowns] of every call."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self.robot, self.dt = plant.robot, plant.dt
        self.places: list[np.ndarray] = []

    def force_and_mass(self, p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, MassMatrix]:
        unknowns = self._plant.rods(p, q).unknowns
        self.places.append(np.concatenate([p, q, unknowns.ravel(order="F")]))
        return self._plant.force_and_mass(p, q)

    def mass(self, p: np.ndarray, q: np.ndarray) -> MassMatrix:
        return self.force_and_mass(p, q)[1]


def _moved(
    plant: Plant, start: np.ndarray, inputs: np.ndarray, f_ext: np.ndarray, guess: Equilibrium | None
) -> tuple[np.ndarray, list[np.ndarray]]:
    """States, and of every step the places of its forces, that at its start first."""
    x, trails = np.empty((len(inputs) + 1, len(start))), []
    x[0] = start
    with said_of(plant, 0, 0, start):
        plant.reset(start, guess)
    advance = INTEGRATORS[plant.integrator](plant.robot.n_rods)
    for k, (u, force) in enumerate(zip(inputs, f_ext, strict=True)):
        watched = _Watched(plant)
        with said_of(plant, 0, k, x[k]):
            rates = plant.robot.motor_rates(u, x[k, 4:], plant.dt)
            x[k + 1] = advance(watched, x[k], rates, force + plant.tip_weight)
            if plant.snaps:
                snap = plant.snaps[0]
                raise UnstableError(
                    f"rod {snap.rod} snapped at p = {snap.p} m: the motion has no derivative there; end it before",
                    rod=snap.rod,
                )
        # RK4 asks for the mass at the start before it asks for the force there.
        trails.append(np.stack(watched.places[-1 - SOLVES[plant.integrator] :]))
    return x, trails


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
    """Build ([x, kept, numbers], [u, f_ext], numbers, trail) -> derivatives of the next x in the first argument."""
    n = model.kind.n_rods
    kept, size, width = _widths(model)
    variables, given = ca.MX.sym("variables", 4 + n + kept + size), ca.MX.sym("given", n + 2)
    held, trail = ca.MX.sym("held", size), ca.MX.sym("trail", width, 1 + SOLVES[model.integrator])
    x, mass, vector = ca.vertsplit(variables, [0, 4 + n, 4 + n + kept, 4 + n + kept + size])
    motion = _SolvedMotion(trail, held, model, vector, given[:n], x[4:], given[n:])
    if kept:
        motion.mass = ca.reshape(mass, 2 + n, 2 + n), motion.mass[1]
    motion.move(x[:2], x[4:])
    slopes = ca.jacobian(motion.advance(x), variables)
    return ca.Function("step_slopes", [variables, given, held, trail], [ca.densify(slopes)])


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
