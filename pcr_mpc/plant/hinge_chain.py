"""Rods as chains of rigid links with springs in their hinges: what engines for rigid bodies can simulate.

A rod of length L becomes N links of length L/N. The hinges between them have the stiffness N EI/L. The clamp lies half
a link before the middle of the first one, so its spring is twice as stiff; with that the chain's error falls as 1/N^2,
with equal springs only as 1/N.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import ConvergenceError
from .equilibrium import Equilibrium
from .rod import sample_rod

_MOST_ITERATIONS = 30
_TOLERANCE = 1e-12  # rad


@dataclass(frozen=True, eq=False)
class ChainState:
    """Links' angles from world x and their rates, shape (n, N) each, base first [rad], [rad/s]."""

    angles: np.ndarray
    rates: np.ndarray


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
        _settled(nodes, (pose.p - rod.base) / rod.length, angle, v / rod.length, links)
        for rod, nodes, angle in zip(robot.rods, pose.nodes, pose.q, strict=True)
    ]
    angles, rates = (np.stack(arrays) for arrays in zip(*states, strict=True))
    return ChainState(angles, rates)


def _settled(
    nodes: np.ndarray, tip: np.ndarray, motor: float, v: np.ndarray, links: int
) -> tuple[np.ndarray, np.ndarray]:
    """Angles and rates of one chain of unit length and stiffness, its tip (2,) held.

    Newton's method on the energy's gradient and the tip's place, for the angles and the force on the tip.
    """
    angles, force = sample_rod(nodes, 2 * links + 1)[2, 1::2].copy(), nodes[1:3, 0].copy()
    springs = np.concatenate([[2.0], np.ones(links - 1), [0.0]]) * links
    stiffness = np.diag(springs[:-1] + springs[1:]) - np.diag(springs[1:-1], 1) - np.diag(springs[1:-1], -1)
    clamp = np.zeros(links)
    clamp[0] = springs[0] * motor
    system = np.zeros((links + 2, links + 2))
    size = np.inf
    # Written so that NaN goes on, and fails.
    for _ in range(_MOST_ITERATIONS):
        along = np.stack([np.cos(angles), np.sin(angles)]) / links
        across = np.stack([-along[1], along[0]])
        system[:-2, :-2] = stiffness + np.diag(force @ along)
        system[:-2, -2:], system[-2:, :-2] = -across.T, across
        gradient = stiffness @ angles - clamp - force @ across
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
