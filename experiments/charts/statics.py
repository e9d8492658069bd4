"""Statics: error of F against the time of one solve, for every method, and what K and G cost on top.

Every solve starts as one in a simulation does: from the equilibrium a millisecond of motion away, found by the same
method, which a `Plant` would have solved last (`statics_poses`). Errors are relative to the rods' forces, for in
balance those cancel. A solve that raises, or that is more than 1 % off (another shape, or steps that do not resolve
the rod), is a failure; the other figures are of the successes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from experiments.charts.points import Key, Row, times
from experiments.charts.statics_poses import CLASSES, Pose, make_poses
from experiments.peers.literal_reading import LiteralReading
from pcr_mpc import Equilibrium, PCRError, Robot
from pcr_mpc.plant.statics.held_tip import checked_shooting, make_solver
from pcr_mpc.plant.statics.single_shooting import SingleShooting
from pcr_mpc.plant.statics.solver import RodSolver

DERIVATIVES = "bent: F, K and G"
LITERAL, LITERAL_AT_ONCE = "literal reading", "literal reading, at once"
LOST = 1e-2
_REPEATS = 3  # of a solve; the median counts
_PREDICTOR = 1e-2  # accuracy of derivatives that only predict the next pose, as in `Plant`
# Steps of central differences in tip [L] and angle [rad]: the best for an F known to 1e-12, and to 1e-6.
_FINE, _COARSE = 1e-5, 1e-4


@dataclass(frozen=True)
class Plan:
    """How much to measure.

    Attributes
    ----------
    poses : int
        Of each class.
    segments, steps : tuple of int
        Of multiple shooting; all pairs.
    rk8_steps : tuple of int
        Of order 8 in a segment.
    single_steps : tuple of int
        RK4 steps of single shooting along a rod.
    literal : tuple of (int, int)
        Segments and steps of the literal reading, with all segments at once.
    literal_poses : int
        Poses of each class for the literal reading, which takes up to seconds for one.
    """

    poses: int = 52
    segments: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    steps: tuple[int, ...] = (1, 2, 4, 8, 16)
    rk8_steps: tuple[int, ...] = (1, 2, 4)
    single_steps: tuple[int, ...] = (8, 16, 32, 64, 128)
    literal: tuple[tuple[int, int], ...] = ((1, 32), (2, 16), (4, 8), (8, 1), (8, 4), (8, 8), (16, 4))
    literal_poses: int = 10


QUICK = Plan(3, (2, 8), (1, 4), (1,), (32,), ((1, 32), (8, 4)), 1)


@dataclass
class Answer:
    """Of one solve: F, with K and G if asked for, and what it took."""

    force: np.ndarray
    k: np.ndarray | None = None
    g: np.ndarray | None = None
    iterations: int = 0
    evaluations: int = 0


Solve = Callable[[], Answer]
# A method gets ready at the neighbour of a pose, and returns the solve that is timed.
Method = Callable[[Pose], Solve]


def keys(plan: Plan) -> list[Key]:
    """Points of the chart."""
    shooting = [f"N = {n}, {s} x rk4" for n in plan.segments for s in plan.steps]
    shooting += [f"N = {n}, {s} x rk8" for n in plan.segments for s in plan.rk8_steps]
    methods = [("closed form", "exact")]
    methods += [("multiple shooting", settings) for settings in shooting]
    methods += [("single shooting, SciPy", f"N = 1, {s} x rk4") for s in plan.single_steps]
    methods += [(LITERAL_AT_ONCE, f"N = {n}, {s} x rk4") for n, s in plan.literal]
    methods += [(LITERAL, "N = 8, 4 x rk4")]
    found = [(case, *method) for method in methods for case in CLASSES]
    for name, settings in (
        ("closed form", "exact"),
        ("multiple shooting", "N = 8, 1 x rk8"),
        (LITERAL_AT_ONCE, "N = 8, 4 x rk4"),
    ):
        ways = ("differences",) if name == LITERAL_AT_ONCE else ("F alone", "implicit", "differences")
        found += [(DERIVATIVES, name, f"{settings}, {way}") for way in ways]
    return found


@lru_cache(maxsize=1)
def poses(robot: Robot, count: int) -> list[Pose]:
    """Poses of all classes."""
    return make_poses(robot, count)


def measure(robot: Robot, plan: Plan, key: Key, clock: Callable[[], float] = time.perf_counter) -> Row:
    """One point: all poses of the case by one method."""
    case, name, settings = key
    chosen = [pose for pose in poses(robot, plan.poses) if pose.name == case.split(":")[0]]
    if name.startswith(LITERAL):
        chosen = chosen[: plan.literal_poses]
    method = make_method(robot, name, settings)
    repeats = 1 if name.startswith(LITERAL) else _REPEATS
    errors, seconds, iterations, evaluations, messages = [], [], [], [], []
    for number, pose in enumerate(chosen):
        try:
            if number == 0 and repeats > 1:
                method(pose)()  # warms up
            answer, spent = _timed(method, pose, repeats, clock)
        except PCRError as failure:
            messages.append(f"{type(failure).__name__}: {failure}")
            continue
        unit = float(np.linalg.norm(pose.target.rod_forces))
        off = float(np.linalg.norm(answer.force - pose.force)) / unit
        if not off <= LOST:
            messages.append(f"F is off by {off:.1e} of the rods' forces")
            continue
        if case == DERIVATIVES and answer.k is not None and answer.g is not None:
            pairs = (answer.k, pose.k), (answer.g, pose.g)
            off = max(float(np.abs(found - right).max() / np.abs(right).max()) for found, right in pairs)
        errors.append(off)
        seconds.append(spent)
        iterations.append(answer.iterations)
        evaluations.append(answer.evaluations)
    row: Row = {"ours": not name.startswith(LITERAL), "success": len(errors), "attempts": len(chosen)} | times(seconds)
    if errors:
        # Errors of zero happen, and have no place on a logarithmic axis.
        row |= {"error": max(float(np.median(errors)), 1e-17), "error_max": max(*errors, 1e-17)}
        row |= {"iterations": float(np.median(iterations)), "evaluations": float(np.median(evaluations))}
    return row | {"remark": messages[0] if messages else ""}


def make_method(robot: Robot, name: str, settings: str) -> Method:
    """Build a method from its name and its settings, "N = 8, 4 x rk4", with a way to K and G or without."""
    words = settings.replace(",", "").split()
    differences = words[-1] == "differences"
    if name.startswith(LITERAL):
        literal = LiteralReading(robot, int(words[2]), int(words[3]), at_once=name == LITERAL_AT_ONCE)
        return _literal_differences(literal) if differences else _literal(literal)
    if name == "closed form":
        shooting, kind = checked_shooting(8, 1, "rk8"), "closed_form"
    else:
        shooting = checked_shooting(int(words[2]), int(words[3]), words[5])
        kind = "multiple_shooting" if name == "multiple shooting" else "single_shooting"
    solver = make_solver(robot, kind, shooting)
    if differences:
        assert isinstance(solver, RodSolver)
        return _differences(solver)
    return _ours(solver, None if words[-1] == "implicit" else _PREDICTOR)


def _timed(method: Method, pose: Pose, repeats: int, clock: Callable[[], float]) -> tuple[Answer, float]:
    seconds = []
    for _ in range(repeats):
        solve = method(pose)
        began = clock()
        answer = solve()
        seconds.append(clock() - began)
    return answer, float(np.median(seconds))


def _ours(solver: RodSolver | SingleShooting, accuracy: float | None) -> Method:
    """Follow the branch as `Plant` does; to rounding and with K and G if no accuracy is given for them."""

    def ready(pose: Pose) -> Solve:
        target, neighbour = pose.target, pose.neighbour
        solver.start(neighbour.p, neighbour.q, neighbour.nodes)

        def solve() -> Answer:
            solver.move(target.p, target.q, derivatives=accuracy)
            answer = Answer(solver.force(), *(solver.jacobians() if accuracy is None else ()))
            answer.iterations = (
                solver.state.iterations if isinstance(solver, RodSolver) else _solution(solver, pose).iterations
            )
            # A Newton iteration is an evaluation, and the verdict one more; SciPy counts evaluations only.
            answer.evaluations = answer.iterations + isinstance(solver, RodSolver)
            return answer

        return solve

    return ready


def _solution(solver: SingleShooting, pose: Pose) -> Equilibrium:
    return solver.equilibrium(pose.target.p, pose.target.q)


def _differences(solver: RodSolver) -> Method:
    """F, and its central differences for K and G, each solve warm from the one before."""

    def ready(pose: Pose) -> Solve:
        solver.start(pose.neighbour.p, pose.neighbour.q, pose.neighbour.nodes)
        length = float(pose.target.robot.lengths.min())
        taken: list[int] = []

        def force(p: np.ndarray, q: np.ndarray) -> np.ndarray:
            solver.move(p, q, derivatives=_PREDICTOR)
            taken.append(solver.state.iterations)
            return np.array(solver.force())

        def solve() -> Answer:
            at = force(pose.target.p, pose.target.q)
            k, g = _central(force, pose, _FINE * length, _FINE)
            return Answer(at, k, g, sum(taken), sum(taken) + len(taken))

        return solve

    return ready


def _literal(literal: LiteralReading) -> Method:
    def ready(pose: Pose) -> Solve:
        guess = literal.guess(pose.neighbour)

        def solve() -> Answer:
            found = literal.solve(pose.target.p, pose.target.q, guess)
            return Answer(found.force, None, None, found.iterations, found.evaluations)

        return solve

    return ready


def _literal_differences(literal: LiteralReading) -> Method:
    def ready(pose: Pose) -> Solve:
        guess = literal.guess(pose.neighbour)
        length = float(pose.target.robot.lengths.min())

        def solve() -> Answer:
            at = literal.solve(pose.target.p, pose.target.q, guess)

            found = [at]

            def force(p: np.ndarray, q: np.ndarray) -> np.ndarray:
                found.append(literal.solve(p, q, at.unknowns))
                return found[-1].force

            k, g = _central(force, pose, _COARSE * length, _COARSE)
            return Answer(at.force, k, g, sum(one.iterations for one in found), sum(one.evaluations for one in found))

        return solve

    return ready


def _central(
    force: Callable[[np.ndarray, np.ndarray], np.ndarray], pose: Pose, tip: float, motor: float
) -> tuple[np.ndarray, np.ndarray]:
    p, q = pose.target.p, pose.target.q
    k = [(force(p + e, q) - force(p - e, q)) / (2 * tip) for e in tip * np.eye(2)]
    g = [(force(p, q + e) - force(p, q - e)) / (2 * motor) for e in motor * np.eye(len(q))]
    return np.stack(k, axis=1), np.stack(g, axis=1)
