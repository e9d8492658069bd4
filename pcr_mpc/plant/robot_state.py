"""What a rod solver remembers of its last pose."""

from __future__ import annotations

import math

import numpy as np

from .robot import Robot
from .rod_state import RUNGS, RodState


class RobotState:
    """All rods as columns, in the one piece of memory that the graph of a warm step takes and gives (`warm_step`)."""

    def __init__(self, robot: Robot, rods: list[RodState]) -> None:
        n, width = len(rods), len(rods[0].unknowns)
        shapes = ((width, n), (width, 3 * n), (3, n), (3, n), (3, 3 * n), (5, n))
        ends = np.cumsum([rows * columns for rows, columns in shapes]).tolist()
        self._record = np.empty(ends[-1])
        self.start = self._record[: ends[2]]
        self.unknowns, self.tangents, self.poses, self.loads, self.load_tangents, self.scalars = (
            self._record[end - rows * columns : end].reshape(rows, columns, order="F")
            for end, (rows, columns) in zip(ends, shapes, strict=True)
        )
        self.unknowns[:] = np.stack([rod.unknowns for rod in rods], axis=1)
        self.tangents[:] = np.concatenate([rod.tangent for rod in rods], axis=1)
        self.poses[:] = np.stack([rod.pose for rod in rods], axis=1)
        self.loads[:] = np.stack([rod.loads for rod in rods], axis=1)
        self.load_tangents[:] = np.concatenate([rod.load_tangent for rod in rods], axis=1)
        self.scalars[:] = np.stack([rod.scalars for rod in rods], axis=1)
        self.residual = math.hypot(*(rod.residual for rod in rods))
        self.iterations = max(rod.iterations for rod in rods)
        self.rung = max((rod.rung for rod in rods), key=RUNGS.index)
        self.drift = float(np.abs(self.scalars[4]).sum())
        self.unstable_rods = tuple(i for i, count in enumerate(self.scalars[3].tolist()) if count)
        self._units, self._lengths = robot.stiffnesses / robot.lengths**2, robot.lengths
        self._keep(self._result(self.loads, self.load_tangents[:2].reshape(2, -1, 3)))

    def _result(self, loads: np.ndarray, moves: np.ndarray) -> np.ndarray:
        """F, K and G as `warm_calls` gives them."""
        units = self._units
        k = np.einsum("ijk,j->ik", moves[:, :, :2], units / self._lengths)
        return np.concatenate([loads[:2] @ units, k.ravel(order="F"), (moves[:, :, 2] * units).ravel("F")])

    def _keep(self, result: np.ndarray) -> None:
        # The views are read-only because what they show is.
        result.flags.writeable = False
        self.force = result[:2]
        self.k, self.g = result[2:6].reshape(2, 2, order="F"), result[6:].reshape(2, -1, order="F")

    def take(self, record: np.ndarray, result: np.ndarray, drift: float, residual: float, iterations: int) -> None:
        """Copy the results of `warm_step`, which found no conjugate point."""
        self._record[:] = record
        self._keep(result.copy())
        self.residual, self.drift = residual, drift
        self.iterations = iterations
        self.rung = "warm"
        self.unstable_rods = ()

    @property
    def record(self) -> np.ndarray:
        """All of it in one piece; valid until the next change."""
        return self._record

    def recall(self, record: np.ndarray) -> None:
        """Go back to a pose whose ``record`` was copied; it was solved, and stable."""
        n = len(self._units)
        moves = record[-(9 + 5) * n : -5 * n].reshape(3, -1, order="F")[:2].reshape(2, -1, 3)
        loads = record[-(3 + 9 + 5) * n : -(9 + 5) * n].reshape(3, -1, order="F")
        self.take(record, self._result(loads, moves), drift=0.0, residual=0.0, iterations=0)

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
