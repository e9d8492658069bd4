"""Where a robot can hold its tip: the part of its workspace that stable motion connects with a pose."""

from __future__ import annotations

import itertools
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from .. import interrupt
from ..errors import PCRError, UnreachableError, UnstableError
from ..plant.robot import Robot
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.free_tip import inverse_statics

SITES = 260  # of the lattice within reach, about
_NEAREST = 0.995  # of a rod's length to which it is stretched at most

Site = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Reach:
    """The tips of a square lattice that a robot holds in one working mode, its motors within their stops.

    Attributes
    ----------
    spacing : float
        Of the lattice [m].
    within : int
        Its tips to which all rods reach.
    poses : list of Equilibrium
        Those that are held, F = 0.
    ends : dict
        Why there is no more: "stops", "fold", "motors lose a direction" -> ways that ended so.
    """

    spacing: float
    within: int
    poses: list[Equilibrium]
    ends: dict[str, int]

    @property
    def tips(self) -> np.ndarray:
        """Shape (K, 2) [m]."""
        return np.array([eq.p for eq in self.poses]).reshape(-1, 2)


def explore(start: Equilibrium, sites: int = SITES) -> Reach:
    """Go from a pose to its neighbours on a lattice, and on from these, each time along its branch."""
    robot = start.robot
    lattice = tips_within(robot, sites)
    first = min(lattice, key=lambda site: float(np.hypot(*(lattice[site] - start.p))))
    held: dict[Site, Equilibrium] = {}
    ends: Counter[str] = Counter()
    try:
        held[first] = inverse_statics(robot, lattice[first], guess=start)
    except PCRError as error:
        ends[_reason(error)] += 1
    waiting = deque(held)
    while waiting:
        interrupt.check()
        site = waiting.popleft()
        for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            other = site[0] + step[0], site[1] + step[1]
            if other in held or other not in lattice:
                continue
            try:
                held[other] = inverse_statics(robot, lattice[other], guess=held[site])
                waiting.append(other)
            except PCRError as error:
                ends[_reason(error)] += 1
    return Reach(_spacing(lattice), len(lattice), list(held.values()), dict(ends))


def tips_within(robot: Robot, sites: int) -> dict[Site, np.ndarray]:
    """Tips of a square lattice to which all rods reach, about so many: site -> tip [m]."""
    low = (robot.bases - robot.lengths[:, None]).max(axis=0)
    high = (robot.bases + robot.lengths[:, None]).min(axis=0)
    middle = (low + high) / 2
    # The share of the box that is within reach, by a first lattice.
    count = 24
    for _ in range(2):
        spacing = float((high - low).max()) / count
        at = range(-count, count + 1)
        found = {
            site: middle + spacing * np.array(site)
            for site in itertools.product(at, at)
            if min(robot.slacks(middle + spacing * np.array(site))) >= 1 - _NEAREST
        }
        count = max(4, round(count * (sites / max(len(found), 1)) ** 0.5))
    return found


def _spacing(lattice: dict[Site, np.ndarray]) -> float:
    (one, at), (other, there) = itertools.islice(lattice.items(), 2)
    return float(np.hypot(*(at - there)) / np.hypot(one[0] - other[0], one[1] - other[1]))


def _reason(error: PCRError) -> str:
    if isinstance(error, UnreachableError):
        return "stops"
    return "fold" if isinstance(error, UnstableError) else "motors lose a direction"
