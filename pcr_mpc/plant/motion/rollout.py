"""Open-loop motion of one robot or of many, without Python between the steps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ...buffered import BufferedFunction, graph_cache, per_thread
from ...errors import PCRError, checked_array, checked_integer
from ...frozen import Frozen
from ..robot import Robot
from ..statics.equilibrium import Equilibrium
from .plant import Plant
from .step_graph import CORRECTIONS, StepModel, limits, step_function

# Steps in one call: more of them make nothing faster.
STEPS_AT_ONCE = 1000
# Robots times steps in one call: a few hundred bytes each, which stay.
_MOST_STEPS = 20_000


@dataclass(frozen=True, eq=False)
class Rollout(Frozen):
    """Motion of one robot, or of R robots: then every array has an axis of R in front.

    Attributes
    ----------
    t : ndarray, shape (T + 1,)
        [s]; one for all.
    x : ndarray, shape (T + 1, 4 + n)
        States, the start first.
    residual : ndarray, shape (T,)
        Of the statics at the end of each step, added up over the rods [rod lengths, or as the method has it].
    stepped : tuple of int
        Robots (0 where there is one) whose rods two Newton iterations a step did not bring along, so that `Plant.step`
        moved them, from the start.
    """

    t: np.ndarray
    x: np.ndarray
    residual: np.ndarray
    stepped: tuple[int, ...]


def rollout(
    plant: Plant,
    x0: Any,
    inputs: Any,
    f_ext: Any = (0.0, 0.0),
    *,
    guess: Equilibrium | None = None,
    robots: Sequence[Robot] | None = None,
    threads: int = 1,
) -> Rollout:
    """Move robots through sequences of inputs that are known in advance, up to a thousand steps in one call.

    The result is that of `Plant.step` from ``plant.reset(x0, guess)`` on, to the tolerance of the statics; errors are
    those of `Plant.step`, too. The plant is used for that: it loses a payload, and ends wherever that left it.

    Parameters
    ----------
    plant : Plant
        Robot, method, integrator and dt; not by single shooting, and not with inertia "full".
    x0 : array_like, shape (4 + n,) or (R, 4 + n)
        State at the start [m, m/s, rad], one for all robots or one each.
    inputs : array_like, shape (T, n) or (R, T, n)
        Motor rates, held over a step [rad/s], for all or for each.
    f_ext : array_like, shape (2,), (T, 2) or (R, T, 2)
        External force on the tips besides their weight [N].
    guess : Equilibrium, optional
        On whose branch the rods start; None: on that of least energy.
    robots : sequence of R Robot, optional
        Robots that differ from the plant's, and from each other, in their numbers only (see `Kind`), each moved as
        ``plant.of(robot)`` would move it. None: all are the plant's.
    threads : int
        Of the machine to work in; robots are shared out among them.

    Raises
    ------
    UnreachableError, ConvergenceError, UnstableError
        The rods of a robot could not follow; the exception carries which ``robot``, at which ``step``, and its
        ``state`` at the start of that.
    ValueError
        A plant that has no such graph, a robot of another kind, or an argument that is not finite or of the wrong
        shape.
    """
    if plant.step_model is None:
        raise ValueError(f"method {plant.method!r} with inertia {plant.inertia!r} has no rollout; use Plant.step")
    threads = checked_integer("threads", threads)
    starts, inputs, f_ext, many = checked_motion(plant, x0, inputs, f_ext, robots)
    count, steps = inputs.shape[:2]
    plants = [plant] * count if robots is None else [_alike(plant, i, robot) for i, robot in enumerate(robots)]
    x, residual = np.empty((count, steps + 1, plant.n_states)), np.empty((count, steps))
    memories = _memories(plants, starts, guess)
    numbers = np.stack([one.numbers for one in plants])  # after the resets, which take a payload away
    at_once = max(1, _MOST_STEPS // min(steps, STEPS_AT_ONCE))
    done = np.zeros(count, dtype=bool)
    for corrections in CORRECTIONS:
        left = np.flatnonzero(~done)
        for first in range(0, len(left), at_once):
            some = left[first : first + at_once]
            given = np.concatenate([inputs[some], f_ext[some]], axis=2)
            settings = corrections, plant.compiled, threads
            x[some], residual[some], done[some] = _moved(
                plant.step_model, settings, memories[some], starts[some], given, numbers[some]
            )
    stepped = np.flatnonzero(~done).tolist()
    for i in stepped:
        x[i], residual[i] = _stepped(plants[i], i, starts[i], inputs[i], f_ext[i], guess)
    t = plant.dt * np.arange(steps + 1)
    return Rollout(t, x if many else x[0], residual if many else residual[0], tuple(stepped))


def checked_motion(
    plant: Plant, x0: Any, inputs: Any, f_ext: Any, different: Sequence[Robot] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
    """Arguments with all their axes, and whether there is one of robots."""
    x0, inputs, f_ext = np.asarray(x0), np.asarray(inputs), np.asarray(f_ext)
    n, many = plant.robot.n_rods, x0.ndim == 2 or inputs.ndim == 3 or f_ext.ndim == 3 or different is not None
    steps = inputs.shape[-2] if inputs.ndim in (2, 3) else 1
    robots = next((a.shape[0] for a, ndim in ((x0, 2), (inputs, 3), (f_ext, 3)) if a.ndim == ndim), 1)
    robots = robots if different is None else len(different)
    if not steps or not robots:
        raise ValueError(f"inputs has shape {inputs.shape}, expected at least one step and one robot")
    x0 = checked_array("x0", x0, (*((robots,) if x0.ndim == 2 else ()), plant.n_states))
    inputs = checked_array("inputs", inputs, (*((robots,) if inputs.ndim == 3 else ()), steps, n))
    lead = {2: (steps,), 3: (robots, steps)}.get(f_ext.ndim, ())
    f_ext = checked_array("f_ext", f_ext, (*lead, 2))
    return (
        np.broadcast_to(x0, (robots, plant.n_states)),
        np.broadcast_to(inputs, (robots, steps, n)),
        np.broadcast_to(f_ext, (robots, steps, 2)),
        many,
    )


def _alike(plant: Plant, index: int, robot: Robot) -> Plant:
    """Plant of another robot of the same kind."""
    if not isinstance(robot, Robot):
        raise TypeError(f"robots[{index}] is a {type(robot).__name__}, expected a Robot")
    other = plant.of(robot)
    if other.step_model != plant.step_model:
        raise ValueError(
            f"robots[{index}] ({robot.name}) is of another kind than {plant.robot.name}: {_described(other)}, expected "
            f"{_described(plant)}; name a method and a weight that do for both, or give it a rollout of its own"
        )
    return other


def _described(plant: Plant) -> str:
    layout = plant.step_model and plant.step_model.kind.layout
    return f"{plant.robot.n_rods} rods, method {plant.method!r}, layout {layout}, weight {plant.weight!r}"


def _memories(plants: list[Plant], starts: np.ndarray, guess: Equilibrium | None) -> np.ndarray:
    """What the graphs start from; robots that are and start alike share it."""
    found: dict[tuple[Plant, bytes], np.ndarray] = {}
    for i, (plant, x) in enumerate(zip(plants, starts, strict=True)):
        if (plant, x.tobytes()) not in found:
            with said_of(plant, i, 0, x):
                plant.reset(x, guess)
                found[plant, x.tobytes()] = plant.memory(x)
    return np.stack([found[plant, x.tobytes()] for plant, x in zip(plants, starts, strict=True)])


def _moved(
    model: StepModel,
    settings: tuple[int, bool, int],
    memories: np.ndarray,
    starts: np.ndarray,
    given: np.ndarray,
    numbers: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States, residuals, and which robots kept to their branch all the way."""
    robots, steps = given.shape[:2]
    x, verdicts = np.empty((robots, steps + 1, starts.shape[1])), np.empty((robots, steps, 5))
    x[:, 0] = starts
    for first in range(0, steps, STEPS_AT_ONCE):
        block = slice(first, min(steps, first + STEPS_AT_ONCE))
        length = block.stop - first
        graph = _many_steps(model, length, robots, *settings)
        # CasADi puts robots and steps side by side, column by column: rows of these views.
        memory, start, told, of_robots = (place.T.reshape(robots, -1) for place in graph.inputs)
        results = [place.T.reshape(robots, length, -1) for place in graph.outputs]
        memory[:], start[:], told[:] = memories, x[:, first], given[:, block].reshape(robots, -1)
        of_robots[:] = numbers
        graph()
        memories = results[0][:, -1].copy()
        x[:, first + 1 : block.stop + 1], verdicts[:, block] = results[1:]
    good = np.all(verdicts <= limits(model), axis=(1, 2)) & np.isfinite(x).all(axis=(1, 2))
    return x, verdicts[:, :, 0], np.asarray(good)


@per_thread(maxsize=8)
def _many_steps(
    model: StepModel, steps: int, robots: int, corrections: int, compiled: bool, threads: int
) -> BufferedFunction:
    return BufferedFunction(_many_steps_graph(model, steps, robots, corrections, compiled, threads))


@graph_cache(maxsize=8)
def _many_steps_graph(model: StepModel, steps: int, robots: int, corrections: int, compiled: bool, threads: int) -> Any:
    step = step_function(model, corrections, details=False, compiled=compiled)
    many = step.mapaccum("steps", steps, 2, {})
    memory, x, given, numbers = (ca.MX.sym(step.name_in(i), *step.size_in(i)) for i in range(4))
    told = ca.MX.sym("told", given.size1(), steps)
    graph = ca.Function("steps", [memory, x, told, numbers], many(memory, x, told, ca.repmat(numbers, 1, steps)))
    if robots > 1:
        graph = graph.map(robots, "thread", threads) if threads > 1 else graph.map(robots, "serial")
    return graph


def _stepped(
    plant: Plant, robot: int, start: np.ndarray, inputs: np.ndarray, f_ext: np.ndarray, guess: Equilibrium | None
) -> tuple[np.ndarray, np.ndarray]:
    """States and residuals of one robot by `Plant.step`."""
    x, residual = np.empty((len(inputs) + 1, len(start))), np.empty(len(inputs))
    x[0] = start
    with said_of(plant, robot, 0, start):
        plant.reset(start, guess)
    for step in range(len(inputs)):
        with said_of(plant, robot, step, x[step]):
            x[step + 1] = plant.step(x[step], inputs[step], f_ext[step])
        residual[step] = plant.residual
    return x, residual


@contextmanager
def said_of(plant: Plant, robot: int, step: int, x: np.ndarray) -> Iterator[None]:
    """Errors say which robot it was, and when."""
    try:
        yield
    except PCRError as error:
        error.details |= {"robot": robot, "step": step, "state": x.copy()}
        error.add_note(f"robot {robot} ({plant.robot.name}), step {step}, t = {step * plant.dt:.6g} s of a rollout")
        raise
