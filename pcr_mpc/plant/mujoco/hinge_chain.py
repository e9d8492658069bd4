"""Rods as chains of rigid links with springs in their hinges: what engines for rigid bodies can simulate.

A rod of length L becomes N links of length L/N. The hinges between them have the stiffness N EI/L and rest at the angle
kappa0 L/N, with EI and kappa0 of where they are. The clamp lies half a link before the middle of the first one, so its
spring is twice as stiff; with that the chain's error falls as 1/N^2, with equal springs only as 1/N.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import ConvergenceError
from ..robot import Robot
from ..rods.equations import RodPhysics, sample_rod, unpacked
from ..rods.physics import robot_physics
from ..statics.equilibrium import Equilibrium

_MOST_ITERATIONS = 30
_TOLERANCE = 1e-12  # rad


@dataclass(frozen=True, eq=False)
class ChainState:
    """Links' angles from world x and their rates, shape (n, N) each, base first [rad], [rad/s]."""

    angles: np.ndarray
    rates: np.ndarray


@dataclass(frozen=True, eq=False)
class Hinges:
    """The hinges of a rod in N links, base first.

    Attributes
    ----------
    stiffness : ndarray, shape (N,)
        [N m/rad].
    rest : ndarray, shape (N,)
        Angle between a link and the one before it, or the clamp, at which a hinge is at rest [rad].
    """

    stiffness: np.ndarray
    rest: np.ndarray


def hinges(robot: Robot, links: int) -> list[Hinges]:
    """Hinges of each rod."""
    physics = robot_physics(robot) or (None,) * robot.n_rods
    chains = [_hinges(of_rod, links) for of_rod in physics]
    units = robot.stiffnesses / robot.lengths
    return [Hinges(unit * of.stiffness, of.rest) for unit, of in zip(units, chains, strict=True)]


def _hinges(physics: RodPhysics | None, links: int) -> Hinges:
    """Of a rod of unit length and stiffness."""
    # Each stands for the rod up to the middles of its links.
    where, share = np.arange(links) / links, np.full(links, 1.0 / links)
    where[0], share[0] = 0.25 / links, 0.5 / links
    if physics is None:
        return Hinges(1.0 / share, np.zeros(links))
    _, _, curvature, stiffness = unpacked(physics.layout, physics.values)
    kappa, f = (
        np.ones(links) if values is None else np.interp(where, np.linspace(0.0, 1.0, len(values)), values)
        for values in (curvature, stiffness)
    )
    return Hinges(f / share, kappa * share)


def settled_chains(pose: Equilibrium, v: np.ndarray, links: int) -> ChainState:
    """Equilibrium of the chains near that of the rods, with the tip at the same place; motors at rest.

    The chains hold the tip a little differently from the rods: what is in balance with one is not quite with the other.

    Parameters
    ----------
    pose : Equilibrium
        Of the rods; its shape is the first guess.
    v : ndarray, shape (2,)
        Velocity of the tip [m/s], with which the links move as their equilibrium does.
    links : int
        N, per rod.

    Raises
    ------
    ConvergenceError
        The chains have no equilibrium near by: use more links.
    """
    robot = pose.robot
    states = [
        _settled(nodes, of_rod, (pose.p - rod.base) / rod.length, angle, v / rod.length, links)
        for rod, nodes, of_rod, angle in zip(robot.rods, pose.nodes, pose.physics, pose.q, strict=True)
    ]
    angles, rates = (np.stack(arrays) for arrays in zip(*states, strict=True))
    return ChainState(angles, rates)


def _settled(
    nodes: np.ndarray, physics: RodPhysics | None, tip: np.ndarray, motor: float, v: np.ndarray, links: int
) -> tuple[np.ndarray, np.ndarray]:
    """Angles and rates of one chain of unit length and stiffness, its tip (2,) held.

    Newton's method on the energy's gradient and the tip's place, for the angles and the force on the tip.
    """
    weight = np.zeros(2) if physics is None else physics.values[:2]
    angles, force = sample_rod(nodes, 2 * links + 1, physics)[2, 1::2].copy(), nodes[1:3, 0] - weight
    of_links = _hinges(physics, links)
    springs = np.append(of_links.stiffness, 0.0)
    stiffness = np.diag(springs[:-1] + springs[1:]) - np.diag(springs[1:-1], 1) - np.diag(springs[1:-1], -1)
    moments = springs * np.append(of_links.rest, 0.0)
    moments[0] += springs[0] * motor
    at_rest = moments[:-1] - np.append(moments[1:-1], 0.0)
    # A link carries the weight of the links beyond it and of half of itself.
    carried = weight[:, None] * (1.0 - (np.arange(links) + 0.5) / links)
    system = np.zeros((links + 2, links + 2))
    size = np.inf
    # Written so that NaN goes on, and fails.
    for _ in range(_MOST_ITERATIONS):
        along = np.stack([np.cos(angles), np.sin(angles)]) / links
        across = np.stack([-along[1], along[0]])
        pull = force[:, None] + carried
        system[:-2, :-2] = stiffness + np.diag((pull * along).sum(axis=0))
        system[:-2, -2:], system[-2:, :-2] = -across.T, across
        gradient = stiffness @ angles - at_rest - (pull * across).sum(axis=0)
        change = np.linalg.solve(system, np.concatenate([-gradient, tip - along.sum(axis=1)]))
        angles, force = angles + change[:-2], force + change[-2:]
        size = float(np.abs(change[:-2]).max())
        if size < _TOLERANCE:
            return angles, np.linalg.solve(system, np.concatenate([np.zeros(links), v]))[:-2]
    raise ConvergenceError(
        f"a chain of {links} links did not settle: last change {size:.1e} rad after {_MOST_ITERATIONS} iterations; "
        "use more links",
        residual=size,
        iterations=_MOST_ITERATIONS,
        last=angles,
    )
