"""Poses at which the statics are timed, each with a start close by and the answer to 1e-13."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.statics.basin_trials import CLASSES as BASINS
from experiments.statics.basin_trials import find_poses
from pcr_mpc import Equilibrium, PCRError, Robot, UnreachableError, distance_to_fold, solve_statics
from pcr_mpc.plant.rods.closed_form import elastica
from tests.rods import taylor_rod

# gentle, bent and taut as in `basins`. near fold: a gentle or bent pose moved in a random direction of tip and motors
# to this part of the way to where an eigenvalue of K passes zero or a rod reaches its limit.
CLASSES = ("gentle", "bent", "taut", "near fold")
ALMOST = 0.98
_REACH, _TURN = 0.5, 2.0  # of that way at most, in rod lengths and [rad]
# What the tip and the motors do in a millisecond of a brisk motion: 0.3 m/s and 2 rad/s.
TIP_STEP, MOTOR_STEP = 3e-4, 2e-3
# Of the unknowns in the last step of the reference: what it leaves is the square of it.
_SMALL = 1e-7


@dataclass(frozen=True, eq=False)
class Pose:
    """A task: from a neighbour to the pose.

    Attributes
    ----------
    name : str
        Class.
    target : Equilibrium
        By the closed form; its p and q are what is to be solved, its rod forces give the unit of errors.
    neighbour : Equilibrium
        A millisecond of motion away, in a random direction: the guess.
    force, k, g : ndarray
        F (2,), K (2, 2) and G (2, n) in extended precision, rounded to doubles.
    """

    name: str
    target: Equilibrium
    neighbour: Equilibrium
    force: np.ndarray
    k: np.ndarray
    g: np.ndarray


def make_poses(robot: Robot, count: int) -> list[Pose]:
    """Stable poses, ``count`` of each class."""
    found: list[tuple[str, Equilibrium, Equilibrium]] = []
    for name in CLASSES:
        rng = np.random.default_rng(CLASSES.index(name))
        targets = find_poses(robot, name, count) if name in BASINS and name != "near fold" else _folding(robot, count)
        found += [(name, target, _neighbour(target, rng)) for target in targets]
    answers = reference(robot, [target for _, target, _ in found])
    return [Pose(*task, *answer) for task, answer in zip(found, answers, strict=True)]


def reference(robot: Robot, equilibria: list[Equilibrium]) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """F, K and G of each equilibrium by Taylor series in extended precision (see ``tests/rods/taylor_rod.py``)."""
    newton, _ = elastica.rod_newton()
    n, count = robot.n_rods, len(equilibria)
    starts, poses = np.empty((3, n, count)), np.empty((3, n, count))
    for j, eq in enumerate(equilibria):
        for i, rod in enumerate(robot.rods):
            poses[:, i, j] = *((eq.p - rod.base) / rod.length), eq.q[i]
            start = elastica.from_nodes(eq.nodes[i])
            for _ in range(3):
                start += newton(start, poses[:, i, j])[0].full().ravel()
            starts[:, i, j] = start
    loads, tangents, change = taylor_rod.solve(*starts.reshape(3, -1), poses.reshape(3, -1))
    if not change.max() <= _SMALL:
        raise PCRError(f"the reference is not converged: its last step was {float(change.max()):.1e}, wanted {_SMALL}")
    loads, tangents = loads.reshape(3, n, count), tangents.reshape(3, 3, n, count)
    units = robot.stiffnesses / robot.lengths**2
    force = np.einsum("kij,i->jk", loads[:2], units)
    k = np.einsum("klij,i->jkl", tangents[:2, :2], units / robot.lengths)
    g = np.einsum("kij,i->jki", tangents[:2, 2], units)
    return [(force[j].astype(float), k[j].astype(float), g[j].astype(float)) for j in range(count)]


def _folding(robot: Robot, count: int) -> list[Equilibrium]:
    rng = np.random.default_rng(len(CLASSES))
    starts = find_poses(robot, "gentle", count) + find_poses(robot, "bent", count)
    found: list[Equilibrium] = []
    while len(found) < count:
        start = starts[rng.integers(len(starts))]
        tip, motors = rng.normal(size=2), rng.normal(size=robot.n_rods)
        p = start.p + _REACH * robot.lengths.min() * tip / np.linalg.norm(tip)
        q = start.q + _TURN * motors / np.linalg.norm(motors)
        part = distance_to_fold(start, p, q)
        if part == 1.0:
            continue
        part *= ALMOST
        # In steps, so that the branch of the start is followed.
        eq = start
        try:
            for at in np.linspace(0.0, part, 50)[1:]:
                eq = solve_statics(robot, start.p + at * (p - start.p), start.q + at * (q - start.q), guess=eq)
        except PCRError:
            continue  # the way ended at the edge of the reach
        if eq.stable and eq.stiffness_eigenvalues[0] < 0.5 * start.stiffness_eigenvalues[0]:
            found.append(eq)
    return found


def _neighbour(target: Equilibrium, rng: np.random.Generator) -> Equilibrium:
    while True:
        tip, motors = rng.normal(size=2), rng.normal(size=target.robot.n_rods)
        p = target.p + TIP_STEP * tip / np.linalg.norm(tip)
        q = target.q + MOTOR_STEP * motors / np.linalg.norm(motors)
        try:
            return solve_statics(target.robot, p, q, guess=target)
        except UnreachableError:
            continue  # on the far side of a taut rod
