"""A motion and the places at which its forces were taken, rods included."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ...buffered import BufferedFunction, graph_cache, per_thread
from ...errors import UnstableError
from ..statics.equilibrium import Equilibrium
from .integrators import INTEGRATORS
from .mass_matrix import MassMatrix
from .plant import Plant
from .rollout import STEPS_AT_ONCE, said_of
from .step_graph import CORRECTIONS, SOLVES, StepModel, limits, trail_graph


def moved_on_a_trail(
    plant: Plant, start: np.ndarray, inputs: np.ndarray, f_ext: np.ndarray, guess: Equilibrium | None
) -> tuple[np.ndarray, np.ndarray]:
    """Move a robot, up to a thousand steps in one call where two Newton iterations bring its rods along.

    Returns
    -------
    x : ndarray, shape (T + 1, 4 + n)
        States.
    trails : ndarray, shape (T, 1 + solves, 2 + n + unknowns)
        Of every step the places [p, q, unknowns of the rods] of its forces, that at its start first.

    Raises
    ------
    UnreachableError, ConvergenceError, UnstableError
        See `sensitivities`.
    """
    with said_of(plant, 0, 0, start):
        plant.reset(start, guess)
        memory = plant.memory(start)
    assert plant.step_model is not None
    for corrections in CORRECTIONS:
        found = _at_once(plant.step_model, corrections, memory, start, np.hstack([inputs, f_ext]), plant.numbers)
        if found is not None:
            return found
    return _by_hand(plant, start, inputs, f_ext, guess)


def _at_once(
    model: StepModel,
    corrections: int,
    memory: np.ndarray,
    start: np.ndarray,
    given: np.ndarray,
    numbers: np.ndarray,
) -> tuple[np.ndarray, np.ndarray] | None:
    """As `moved_on_a_trail`; None where the rods did not follow."""
    n, most = model.kind.n_rods, np.array(limits(model))
    unknowns = model.method.newton.size1_in(0) * n
    x, trails = (
        np.empty((len(given) + 1, len(start))),
        np.empty((len(given), 1 + SOLVES[model.integrator], 2 + n + unknowns)),
    )
    x[0], here = start, np.concatenate([start[:2], start[4:], memory[:unknowns]])
    for first in range(0, len(given), STEPS_AT_ONCE):
        block = slice(first, min(len(given), first + STEPS_AT_ONCE))
        steps = block.stop - first
        graph = _many_steps(model, corrections, steps)
        from_memory, from_x, told, of_robot = graph.inputs
        from_memory[:], from_x[:], told.T.reshape(steps, -1)[:], of_robot[:] = memory, x[first], given[block], numbers
        graph()
        memories, states, verdicts, places = (out.T.reshape(steps, -1) for out in graph.outputs)
        if not ((verdicts <= most).all() and np.isfinite(states).all()):
            return None
        x[first + 1 : block.stop + 1], memory = states, memories[-1].copy()
        trails[block, 1:] = places.reshape(steps, SOLVES[model.integrator], -1)
        trails[first, 0], trails[first + 1 : block.stop, 0] = here, trails[first : block.stop - 1, -1]
        here = trails[block.stop - 1, -1]
    return x, trails


@per_thread(maxsize=8)
def _many_steps(model: StepModel, corrections: int, steps: int) -> BufferedFunction:
    return BufferedFunction(_many_steps_graph(model, corrections, steps))


@graph_cache(maxsize=8)
def _many_steps_graph(model: StepModel, corrections: int, steps: int) -> Any:
    step = trail_graph(model, corrections)
    if steps == 1:
        return step
    memory, x, given, numbers = (ca.MX.sym(step.name_in(i), *step.size_in(i)) for i in range(4))
    told = ca.MX.sym("told", given.size1(), steps)
    many = step.mapaccum("steps", steps, 2, {})
    return ca.Function("steps", [memory, x, told, numbers], many(memory, x, told, ca.repmat(numbers, 1, steps)))


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


def _by_hand(
    plant: Plant, start: np.ndarray, inputs: np.ndarray, f_ext: np.ndarray, guess: Equilibrium | None
) -> tuple[np.ndarray, np.ndarray]:
    """As `moved_on_a_trail`, step by step."""
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
    return x, np.stack(trails)
