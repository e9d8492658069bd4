"""Motion: error of the tip within a second of free motion against the wall time of a simulated second.

The two releases of `rod_inertia`, motors at rest. Every rung of the ladder of inertia with every integrator and a range
of time steps; MuJoCo's hinge chains and PyElastica's rods; and the paper's text read literally, semi-implicit Euler
with massless rods. The error is the largest distance from rods of distributed mass in strain modes at any millisecond
(at any step, where that is longer). How well these are known themselves - what two modes fewer and twice the step
change - is the row "yardstick", and nobody can be seen to be better.

Times are of blocks of 10 ms, scaled to a second; in one call, of the call. The loop over segments of the literal
reading is timed over a few steps only; its error is that of the same equations integrated all at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.util import find_spec

import numpy as np

from experiments.charts.points import Key, Row, times
from experiments.charts.release import FINEST, MODES, error_of, failed, succeeded, swing, yardstick
from experiments.charts.statics import LITERAL, LITERAL_AT_ONCE
from experiments.motion.rod_inertia import RELEASES, STEP, start
from experiments.peers.literal_reading import LiteralReading, Solution
from pcr_mpc import PCRError, Plant, Robot
from pcr_mpc.loop.run.simulated_plant import SimulatedPlant
from pcr_mpc.plant.motion.rollout import rollout

YARDSTICK, MUJOCO, ELASTICA = "yardstick", "MuJoCo", "PyElastica"
_REPEATS = 5  # of a release in one call
_EVALUATIONS = {"semi_implicit_euler": 1, "velocity_verlet": 1, "rk4": 4, "gauss": 1}


@dataclass(frozen=True)
class Plan:
    """How much to measure.

    Attributes
    ----------
    duration : float
        Of a release [s].
    steps : tuple of (str, tuple of float)
        Integrators and their time steps [s].
    inertias : tuple of str
        With these integrators.
    in_one_call : tuple of (str, float)
        Integrators and steps with which a whole release is one call of `rollout`, interpreted and compiled.
    full : tuple of (int, float)
        Modes and step [s] of rods with distributed mass.
    links : tuple of int
        Of MuJoCo's chains, extrapolated, at 1 ms.
    alone : tuple of (str, int, float)
        MuJoCo's integrator, links and step [s], as it comes.
    elements : tuple of (int, float)
        Of a rod in PyElastica, and the radius of its section [m].
    literal_steps : int
        That the loop over segments is timed for.
    """

    duration: float = 1.0
    steps: tuple[tuple[str, tuple[float, ...]], ...] = (
        ("semi_implicit_euler", (1e-4, 2.5e-4, 5e-4, 1e-3, 2e-3, 5e-3)),
        ("velocity_verlet", (1e-4, 2.5e-4, 5e-4, 1e-3, 2e-3, 5e-3)),
        ("rk4", (5e-4, 1e-3, 2e-3, 5e-3, 1e-2)),
    )
    inertias: tuple[str, ...] = ("none", "constant", "condensed")
    in_one_call: tuple[tuple[str, float], ...] = (("velocity_verlet", 1e-3), ("rk4", 1e-3), ("rk4", 5e-3))
    full: tuple[tuple[int, float], ...] = ((6, 1e-3), (8, 1e-3), (8, 2e-3), (10, 1e-3), (12, 1e-3), (12, 2e-3))
    links: tuple[int, ...] = (10, 20, 40, 80)
    alone: tuple[tuple[str, int, float], ...] = (
        ("discrete", 20, 5e-5), ("discrete", 40, 5e-5), ("discrete", 40, 2e-4),
        ("implicitfast", 10, 1e-4), ("implicitfast", 20, 5e-5), ("implicitfast", 40, 2e-5), ("implicitfast", 40, 1e-5),
    )  # fmt: skip
    elements: tuple[tuple[int, float], ...] = ((20, 4e-3), (40, 2.5e-3))
    literal_steps: int = 40


QUICK = Plan(
    0.1, (("semi_implicit_euler", (1e-3,)), ("velocity_verlet", (1e-3,)), ("rk4", (1e-3, 2e-3))),
    in_one_call=(("rk4", 2e-3),), full=((8, 1e-3),),
    links=(10, 40), alone=(("implicitfast", 40, 2e-5),), elements=((20, 4e-3),), literal_steps=3,
)  # fmt: skip


def points(robot: Robot, plan: Plan) -> dict[Key, Callable[[], Row]]:
    """Points of the chart, and how to measure each."""
    found: dict[Key, Callable[[], Row]] = {}
    for release in RELEASES:
        at = partial(_measured, robot, release, plan.duration)
        found[release, YARDSTICK, f"{MODES} modes, {1e3 * FINEST:g} ms"] = partial(
            _yardstick, robot, release, plan.duration
        )
        for inertia in plan.inertias:
            for integrator, steps in plan.steps:
                for dt in steps:
                    plant = partial(Plant, robot, inertia=inertia, integrator=integrator, dt=dt)
                    found[release, inertia, f"{integrator}, {1e3 * dt:g} ms"] = partial(at, plant)
            for integrator, dt in plan.in_one_call:
                for how in ("in one call", "in one call, compiled"):
                    plant = partial(Plant, robot, inertia=inertia, integrator=integrator, dt=dt, compiled="," in how)
                    key = release, inertia, f"{integrator}, {1e3 * dt:g} ms, {how}"
                    found[key] = partial(_in_one_call, robot, release, plan.duration, plant)
        for modes, dt in plan.full:
            plant = partial(Plant, robot, inertia="full", modes=modes, integrator="gauss", dt=dt)
            found[release, "full", f"{modes} modes, gauss, {1e3 * dt:g} ms"] = partial(at, plant)
        for method in ("multiple_shooting", "single_shooting"):
            plant = partial(Plant, robot, method=method, dt=STEP)
            found[release, f"none, {method.replace('_', ' ')}", "semi_implicit_euler, 1 ms"] = partial(at, plant)
        found |= _peers(robot, release, plan)
        literal = partial(_literal, robot, release, plan.duration)
        found[release, LITERAL_AT_ONCE, "N = 8, 4 x rk4, 1 ms"] = literal
        found[release, LITERAL, "N = 8, 4 x rk4, 1 ms"] = partial(literal, plan.literal_steps)
    return found


def _peers(robot: Robot, release: str, plan: Plan) -> dict[Key, Callable[[], Row]]:
    """Other engines, if they are installed (extras ``mujoco`` and ``peers``)."""
    found: dict[Key, Callable[[], Row]] = {}
    if find_spec("mujoco"):
        from pcr_mpc.plant.mujoco.plant import MuJoCoPlant

        for links in plan.links:
            plant = partial(MuJoCoPlant, robot, links=links, dt=STEP)
            key = release, MUJOCO, f"{links} links, discrete, 2 x 0.5 ms extrapolated"
            found[key] = partial(_measured, robot, release, plan.duration, plant)
        for integrator, links, dt in plan.alone:
            key = release, MUJOCO, f"{links} links, {integrator}, {1e3 * dt:g} ms"
            found[key] = partial(_engine_alone, robot, release, plan.duration, integrator, links, dt)
    if find_spec("elastica"):
        for elements, radius in plan.elements:
            key = release, ELASTICA, f"{elements} elements, radius {1e3 * radius:g} mm"
            found[key] = partial(_elastica, robot, release, plan.duration, elements, radius)
    return found


def _yardstick(robot: Robot, release: str, duration: float) -> Row:
    _, unknown, seconds = yardstick(robot, release, duration)
    return succeeded(robot, release, duration, unknown, "what two modes fewer and twice the step change", **seconds)


def _measured(robot: Robot, release: str, duration: float, make: partial[SimulatedPlant]) -> Row:
    pose, x = start(robot, release)
    ours = make.func is Plant
    try:
        plant = make()
        tips, seconds = swing(plant, pose, x, duration)
    except PCRError as failure:
        return failed(failure, ours=ours)
    error = error_of(robot, release, duration, tips, plant.dt)
    evaluations = (len(tips) - 1) * (_EVALUATIONS[plant.integrator] if isinstance(plant, Plant) else 6)
    return succeeded(robot, release, duration, error, **times(seconds), ours=ours, evaluations=evaluations)


def _in_one_call(robot: Robot, release: str, duration: float, make: partial[Plant]) -> Row:
    pose, x = start(robot, release)
    plant, seconds = make(), []
    motors = np.zeros((round(duration / plant.dt), robot.n_rods))
    try:
        rollout(plant, x, motors, guess=pose)  # builds the graph
        for _ in range(_REPEATS):
            began = time.perf_counter()
            tips = rollout(plant, x, motors, guess=pose).x[:, :2]
            seconds.append((time.perf_counter() - began) / duration)
    except PCRError as failure:
        return failed(failure, ours=True)
    error = error_of(robot, release, duration, tips, plant.dt)
    evaluations = len(motors) * _EVALUATIONS[plant.integrator]
    return succeeded(robot, release, duration, error, **times(seconds), evaluations=evaluations)


def _engine_alone(robot: Robot, release: str, duration: float, integrator: str, links: int, dt: float) -> Row:
    import mujoco

    from experiments.motion.mujoco_agreement import engine_alone

    complaints = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)  # a blow-up is a row, not a file in the working directory
    try:
        tips, spent = engine_alone(robot, release, links, dt, integrator, duration)
    except PCRError as failure:
        return failed(failure, ours=False)
    finally:
        mujoco.set_mju_user_warning(complaints)
    error = error_of(robot, release, duration, tips, STEP)
    return succeeded(
        robot, release, duration, error, **times([spent / duration]), ours=False, evaluations=duration / dt
    )


def _elastica(robot: Robot, release: str, duration: float, elements: int, radius: float) -> Row:
    from experiments.peers.pyelastica_release import release_tip

    release_tip(robot, release, elements, radius, STEP)  # compiles
    tips, spent = release_tip(robot, release, elements, radius, duration)
    error = error_of(robot, release, duration, tips, STEP)
    return succeeded(robot, release, duration, error, **times([spent / duration]), ours=False)


def _literal(robot: Robot, release: str, duration: float, steps: int | None = None) -> Row:
    tips, seconds, evaluations = _literal_at_once(robot, release, duration)
    error = error_of(robot, release, duration, tips, STEP)
    remark = ""
    if steps is not None:
        walk = _walk(LiteralReading(robot), robot, release)
        next(walk)
        spent = []
        for _ in range(steps):
            began = time.perf_counter()
            next(walk)
            spent.append((time.perf_counter() - began) / STEP)
        seconds = np.array(spent)
        remark = f"extrapolated from {steps} steps; the error is that of the same equations at once"
    return succeeded(
        robot, release, duration, error, remark, **times(seconds), ours=False, iterations=1, evaluations=evaluations
    )


@lru_cache(maxsize=2)
def _literal_at_once(robot: Robot, release: str, duration: float) -> tuple[np.ndarray, np.ndarray, int]:
    tips, seconds, evaluations = [], [], 0
    walk = _walk(LiteralReading(robot, at_once=True), robot, release)
    tips.append(next(walk)[0][:2])
    for _ in range(round(duration / STEP)):
        began = time.perf_counter()
        x, solution = next(walk)
        seconds.append((time.perf_counter() - began) / STEP)
        tips.append(x[:2])
        evaluations += solution.evaluations
    return np.array(tips), np.array(seconds), evaluations


def _walk(literal: LiteralReading, robot: Robot, release: str) -> Iterator[tuple[np.ndarray, Solution]]:
    """States and solutions of the literal reading, step by step."""
    pose, x = start(robot, release)
    solution = literal.solve(x[:2], x[4:], literal.guess(pose))
    while True:
        yield x, solution
        x, solution = literal.step(x, np.zeros(robot.n_rods), solution, STEP)
