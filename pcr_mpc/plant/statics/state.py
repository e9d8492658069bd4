"""What a rod solver remembers of its last pose."""

from __future__ import annotations

import math
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from ..robot import Robot
from ..rods.state import RUNGS, RodState

_BESIDES = 3 + 3 + 9 + 5  # entries of a record for each rod besides those that go with its unknowns


class Columns(NamedTuple):
    """A record taken apart (see `warm_calls`): views, with the rods as columns."""

    unknowns: np.ndarray  # (u, n)
    tangents: np.ndarray  # (u, 3n)
    poses: np.ndarray  # (3, n)
    loads: np.ndarray  # (3, n)
    load_tangents: np.ndarray  # (3, 3n)
    scalars: np.ndarray  # (5, n)


def record_size(width: int, n_rods: int) -> int:
    """Entries of a record of rods with ``width`` unknowns each."""
    return (4 * width + _BESIDES) * n_rods


def columns(record: np.ndarray, n_rods: int) -> Columns:
    """Take a record apart."""
    n, width = n_rods, (len(record) // n_rods - _BESIDES) // 4
    ends = list(accumulate((width * n, 3 * width * n, 3 * n, 3 * n, 9 * n, 5 * n), initial=0))
    rows = (width, width, 3, 3, 3, 5)
    return Columns(
        *(record[i:j].reshape(count, -1, order="F") for i, j, count in zip(ends[:-1], ends[1:], rows, strict=True))
    )


class RobotState:
    """All rods as columns, in the one piece of memory that the graph of a warm step takes and gives (`warm_step`).

    Parameters
    ----------
    robot : Robot
    record : ndarray
        Of a pose that was solved; it is copied.
    """

    def __init__(self, robot: Robot, record: np.ndarray) -> None:
        n = robot.n_rods
        self._record = record.copy()
        found = columns(self._record, n)
        self.unknowns, self.tangents, self.poses, self.loads, self.load_tangents, self.scalars = found
        self.start = self._record[: -(3 + 9 + 5) * n]
        self._units, self._lengths = robot.stiffnesses / robot.lengths**2, robot.lengths
        self.recall(self._record)

    @classmethod
    def of_rods(cls, robot: Robot, rods: list[RodState]) -> RobotState:
        """Put rods that were solved one by one together."""
        blocks = [
            np.stack([rod.unknowns for rod in rods], axis=1),
            np.concatenate([rod.tangent for rod in rods], axis=1),
            np.stack([rod.pose for rod in rods], axis=1),
            np.stack([rod.loads for rod in rods], axis=1),
            np.concatenate([rod.load_tangent for rod in rods], axis=1),
            np.stack([rod.scalars for rod in rods], axis=1),
        ]
        state = cls(robot, np.concatenate([block.ravel(order="F") for block in blocks]))
        state.residual = math.hypot(*(rod.residual for rod in rods))
        state.iterations = max(rod.iterations for rod in rods)
        state.rung = max((rod.rung for rod in rods), key=RUNGS.index)
        state.drift = float(np.abs(state.scalars[4]).sum())
        return state

    def _result(self, loads: np.ndarray, moves: np.ndarray) -> np.ndarray:
        """F, K and G as `warm_calls` gives them."""
        units = self._units
        k = np.einsum("ijk,j->ik", moves[:, :, :2], units / self._lengths)
        return np.concatenate([loads[:2] @ units, k.ravel(order="F"), (moves[:, :, 2] * units).ravel("F")])

    def _keep(self, result: np.ndarray) -> None:
        # The views are read-only because what they show is.
        result.flags.writeable = False
        self.result = result
        self.force = result[:2]
        self.k, self.g = result[2:6].reshape(2, 2, order="F"), result[6:].reshape(2, -1, order="F")

    def take(self, record: np.ndarray, result: np.ndarray, drift: float, residual: float, iterations: int) -> None:
        """Copy the results of `warm_step`, which found no conjugate point."""
        self._record[:] = record
        self._keep(result.copy())
        self.residual, self.drift = residual, drift
        self.iterations = iterations
        self.rung = "warm"
        self.unstable_rods: tuple[int, ...] = ()

    @property
    def record(self) -> np.ndarray:
        """All of it in one piece; valid until the next change."""
        return self._record

    def recall(self, record: np.ndarray) -> None:
        """Go back to a pose whose ``record`` was copied; it was solved."""
        n = len(self._units)
        moves = record[-(9 + 5) * n : -5 * n].reshape(3, -1, order="F")[:2].reshape(2, -1, 3)
        loads = record[-(3 + 9 + 5) * n : -(9 + 5) * n].reshape(3, -1, order="F")
        self.take(record, self._result(loads, moves), drift=0.0, residual=0.0, iterations=0)
        self.unstable_rods = tuple(i for i, count in enumerate(record[3 - 5 * n :: 5].tolist()) if count)

    def rods(self) -> list[RodState]:
        """Split into rods."""
        return [
            RodState(
                self.poses[:, i].copy(),
                self.unknowns[:, i].copy(),
                self.tangents[:, 3 * i : 3 * i + 3].copy(),
                self.loads[:, i].copy(),
                self.load_tangents[:, 3 * i : 3 * i + 3].copy(),
                self.scalars[:, i].copy(),
                self.residual,
                self.iterations,
                self.rung,
            )
            for i in range(self.poses.shape[1])
        ]
