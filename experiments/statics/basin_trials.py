"""Poses of each class, starts near them, and what each method makes of these."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm import tqdm

from pcr_mpc import (
    Equilibrium,
    PCRError,
    Robot,
    UnstableError,
    all_equilibria,
    assess_stability,
    solve_statics,
)
from pcr_mpc.plant.rods.closed_form import elastica
from pcr_mpc.plant.rods.closed_form.chart import critical_load
from pcr_mpc.plant.rods.equations import sample_rod

Row = dict[str, Any]
STEPS = 16  # of order 8 along a rod, at least one a segment
METHODS: dict[str, dict[str, Any]] = {
    "single": {"method": "single_shooting", "segments": 1, "steps": STEPS},
    **{
        f"N = {n}": {"method": "multiple_shooting", "segments": n, "steps": max(1, STEPS // n)}
        for n in (1, 2, 4, 8, 16, 32)
    },
    "closed form": {"method": "closed_form"},
}
CLOSED_FORM_NODES = 8  # from which it takes its start
SAME_FORCE = 1e-4  # relative
RESOLVED = 1e-6  # drift of the invariant that `solve_statics` wants
FOLLOWED = 0.01  # step in which the right branch is followed [L]


@dataclass(frozen=True)
class Plan:
    """How much to measure.

    Attributes
    ----------
    poses : int
        Of each class.
    seeds : int
        Perturbations, and directions, a pose.
    sigmas : tuple of float
        Sizes of the perturbation, in natural units.
    distances : tuple of float
        Of the moved tip, ascending, in rod lengths.
    methods : tuple of str
        Out of `METHODS`.
    """

    poses: int = 8
    seeds: int = 1
    sigmas: tuple[float, ...] = tuple(np.geomspace(1e-3, 3.0, 9).tolist())
    distances: tuple[float, ...] = tuple(np.geomspace(1e-4, 0.3, 9).tolist())
    methods: tuple[str, ...] = tuple(METHODS)


def _gentle(rng: np.random.Generator) -> tuple[float, float]:
    return float(np.log(np.pi * rng.uniform(0.3, 0.7))), rng.uniform(0.8, 1.6)


def _bent(rng: np.random.Generator) -> tuple[float, float]:
    log_tip_angle = float(np.log(rng.uniform(0.3, 2.2)))
    return log_tip_angle, critical_load(log_tip_angle) * rng.uniform(0.4, 0.75)


def _taut(rng: np.random.Generator) -> tuple[float, float]:
    # The separatrix, tan(delta/4) = tan(tip_angle/4) cosh(u), through a wanted angle at the base.
    base_angle, load = rng.uniform(0.4, 1.5), rng.uniform(6.0, 16.0)
    return float(np.log(4 * np.tan(base_angle / 4)) - np.logaddexp(load, -load) + np.log(2.0)), load


def _near_fold(rng: np.random.Generator) -> tuple[float, float]:
    log_tip_angle = float(np.log(rng.uniform(0.5, 2.6)))
    return log_tip_angle, critical_load(log_tip_angle) * (1 - rng.uniform(0.003, 0.03))


def _near_buckling(rng: np.random.Generator) -> tuple[float, float]:
    # A tip angle of pi is the straight rod in compression, which buckles at lambda = 4.4934.
    return float(np.log(np.pi - rng.uniform(0.1, 0.4))), 4.4934 * rng.uniform(0.98, 1.02)


def _turning(eq: Equilibrium) -> float:
    return min(float(np.ptp(sample_rod(nodes, 33)[2])) for nodes in eq.nodes)


def _stretches(eq: Equilibrium) -> np.ndarray:
    return np.asarray(np.linalg.norm(eq.p - eq.robot.bases, axis=1) / eq.robot.lengths)


def _bows_both_ways(eq: Equilibrium) -> bool:
    return len(all_equilibria(eq.robot, p=eq.p, q=eq.q)) >= 4


# How to draw (log tip_angle, lambda) of a rod, and what the robot's pose must fulfil.
CLASSES: dict[str, tuple[Callable[[np.random.Generator], tuple[float, float]], Callable[[Equilibrium], bool]]] = {
    "gentle": (_gentle, lambda eq: eq.stable),
    "bent": (_bent, lambda eq: eq.stable and _turning(eq) > 2.0),
    "taut": (_taut, lambda eq: eq.stable and float(_stretches(eq).min()) > 0.9),
    "near fold": (_near_fold, lambda eq: not eq.unstable_rods),
    "near buckling": (_near_buckling, lambda eq: not eq.unstable_rods and _bows_both_ways(eq)),
}


def find_poses(robot: Robot, name: str, count: int) -> list[Equilibrium]:
    """Poses of one class, solved by the closed form.

    Rods of the class are drawn one by one and put together: the tip is where the circles of their reaches meet,
    to the left of the line from motor 0 to motor 1. Poses beyond the motors' limits are drawn again.
    """
    draw, fits = CLASSES[name]
    rng = np.random.default_rng(list(CLASSES).index(name))
    (first, second), lower = robot.bases, robot.angle_limits[:, 0]
    apart = float(np.linalg.norm(second - first))
    along = (second - first) / apart
    found: list[Equilibrium] = []
    while len(found) < count:
        rods = [np.array([*draw(rng), rng.choice([-1.0, 1.0])]) for _ in range(2)]
        tips = np.array([sample_rod(elastica.nodes(rod, 0.0, 8), 2)[:2, -1] for rod in rods])
        reach = np.linalg.norm(tips, axis=1) * robot.lengths
        abscissa = (apart**2 + reach[0] ** 2 - reach[1] ** 2) / (2 * apart)
        if abs(abscissa) >= reach[0]:
            continue
        p = first + abscissa * along + np.sqrt(reach[0] ** 2 - abscissa**2) * np.array([-along[1], along[0]])
        chords = p - robot.bases
        q = np.arctan2(chords[:, 1], chords[:, 0]) - np.arctan2(tips[:, 1], tips[:, 0])
        q = lower + (q - lower) % (2 * np.pi)
        if (q > robot.angle_limits[:, 1]).any():
            continue
        nodes = np.stack([elastica.nodes(rod, angle, 8) for rod, angle in zip(rods, q, strict=True)])
        eq = solve_statics(robot, p, q, guess=nodes)
        if fits(eq):
            found.append(eq)
    return found


def describe_pose(eq: Equilibrium) -> Row:
    """What basins_poses.csv says of a pose."""
    stability = assess_stability(eq)
    per_rod: dict[str, Any] = {
        "q": eq.q,
        "lambda": [float(elastica.from_nodes(nodes)[1]) for nodes in eq.nodes],
        "margin": stability.rod_margins,
        "stretch": _stretches(eq),
    }
    row: Row = {"p_x": eq.p[0], "p_y": eq.p[1]}
    row |= {f"{name}_{i}": value for name, values in per_rod.items() for i, value in enumerate(values)}
    return row | {"smallest_stiffness": stability.stiffness_eigenvalues[0], "mode": eq.mode, "stable": eq.stable}


def n_nodes(method: str) -> int:
    """Nodes a rod from which a method starts."""
    return int(METHODS[method].get("segments", CLOSED_FORM_NODES))


def nodes_of(eq: Equilibrium, count: int) -> np.ndarray:
    """Exact nodal states of a pose at s = j L / count, shape (n, 4, count)."""
    return np.stack(
        [elastica.nodes(elastica.from_nodes(nodes), angle, count) for nodes, angle in zip(eq.nodes, eq.q, strict=True)]
    )


def disturbance(eq: Equilibrium, seed: list[int]) -> Callable[[int], np.ndarray]:
    """Random smooth functions of the arc length, one for every state of every rod, of variance one everywhere.

    Returns
    -------
    callable
        Number of nodes -> values there in the units of the states, shape (n, 4, number): always the same functions.
    """
    coefficients = np.random.default_rng(seed).normal(size=(eq.robot.n_rods, 4, 5))
    force = np.maximum(np.hypot(eq.nodes[:, 1, 0], eq.nodes[:, 2, 0]), 1.0)
    moment = np.maximum(np.abs(eq.nodes[:, 3]).max(axis=1), 1.0)
    units = np.stack([np.ones_like(force), force, force, moment], axis=1)

    def values(count: int) -> np.ndarray:
        s = np.pi * np.arange(count) / count
        waves = np.stack([np.ones_like(s), np.cos(s), np.sin(s), np.cos(2 * s), np.sin(2 * s)]) / np.sqrt(3.0)
        return np.asarray(units[:, :, None] * (coefficients @ waves))

    return values


def trial(right: Equilibrium, method: str, nodes: np.ndarray) -> Row:
    """Solve once from ``nodes`` at the pose of ``right``, and say what came of it."""
    row: Row = {"outcome": "failed", "force_error": "", "iterations": "", "drift": "", "error": "", "message": ""}
    try:
        eq = solve_statics(right.robot, right.p, right.q, guess=nodes, **METHODS[method])
    except PCRError as error:
        return row | {"error": type(error).__name__, "message": str(error)}
    units = right.robot.stiffnesses / right.robot.lengths**2
    sizes = np.maximum(np.linalg.norm(right.rod_forces, axis=1), units)
    force_error = float((np.linalg.norm(eq.rod_forces - right.rod_forces, axis=1) / sizes).max())
    row |= {"force_error": force_error, "iterations": eq.iterations, "drift": eq.drift}
    if not eq.drift <= RESOLVED:
        message = f"converged, but the invariant drifts by {eq.drift:.1e}: the steps do not resolve this rod"
        return row | {"error": "Unresolved", "message": message}
    if force_error <= SAME_FORCE:
        return row | {"outcome": "same"}
    return row | {"outcome": "unstable" if eq.unstable_rods else "other"}


def perturbed_trials(eq: Equilibrium, plan: Plan, seed: list[int]) -> Iterator[Row]:
    """Trials from the perturbed nodes of ``eq`` itself."""
    values = disturbance(eq, seed)
    # Without perturbation all seeds are alike.
    sizes = (0.0, *plan.sigmas) if seed[-1] == 0 else plan.sigmas
    for method in plan.methods:
        exact, change = nodes_of(eq, n_nodes(method)), values(n_nodes(method))
        for size in sizes:
            yield {"method": method, "size": size, **trial(eq, method, exact + size * change)}


def moved_trials(eq: Equilibrium, plan: Plan, seed: list[int]) -> Iterator[Row]:
    """Trials from the exact nodes of ``eq``, for tips further and further away in a random direction."""
    angle = np.random.default_rng(seed).uniform(0.0, 2 * np.pi)
    direction = eq.robot.lengths.min() * np.array([np.cos(angle), np.sin(angle)])
    guesses = {method: nodes_of(eq, n_nodes(method)) for method in plan.methods}
    right, done, end = eq, 0.0, Row()
    for distance in plan.distances:
        if not end:
            try:
                right = _follow(eq, right, direction, done, distance)
            except PCRError as error:
                end = {"outcome": "branch ends", "error": type(error).__name__, "message": str(error)}
        done = distance
        for method in plan.methods:
            yield {"method": method, "size": distance, **(end or trial(right, method, guesses[method]))}


def _follow(start: Equilibrium, last: Equilibrium, direction: np.ndarray, done: float, distance: float) -> Equilibrium:
    """Follow the branch of ``start`` from the pose ``last``, at distance ``done``, to ``distance``."""
    n_steps = int(np.ceil((distance - done) / FOLLOWED))
    for at in np.linspace(done, distance, n_steps + 1)[1:]:
        last = solve_statics(start.robot, start.p + at * direction, start.q, guess=last)
        if last.unstable_rods:
            raise UnstableError(
                f"rods {last.unstable_rods} have passed their limit of stability at p = {last.p} m; "
                "the branch ended before",
                rod=last.unstable_rods,
            )
    return last


STUDIES = {"perturbed nodes": perturbed_trials, "moved tip": moved_trials}


def measure(robot: Robot, plan: Plan) -> tuple[list[Row], list[Row]]:
    """Rows of basins_trials.csv and of basins_poses.csv."""
    trials: list[Row] = []
    poses: list[Row] = []
    with tqdm(total=len(CLASSES) * plan.poses * plan.seeds * len(STUDIES), unit="guess") as bar:
        for c, name in enumerate(CLASSES):
            bar.set_description(name)
            for i, eq in enumerate(find_poses(robot, name, plan.poses)):
                poses.append({"class": name, "pose": i, **describe_pose(eq)})
                for seed in range(plan.seeds):
                    for study, run in STUDIES.items():
                        case = {"study": study, "class": name, "pose": i, "seed": seed}
                        trials += [{**case, **row} for row in run(eq, plan, [c, i, seed])]
                        bar.update()
    return trials, poses
