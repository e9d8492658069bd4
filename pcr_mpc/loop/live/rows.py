"""Rows of a reference that is made while the robot moves: solved a little ahead of the present."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import PCRError
from ...plant.motion.plant import Plant
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ..scene.settings import Payload
from .inverse import BLOCK, OnlineInverse, Row
from .motions import Motion, Pursuit

_LOOK_AHEAD = 0.25  # s, beyond the controller's horizon: there is time to brake before what cannot be had
_LOOK_AHEAD_OF_JOG, _LOOK_AHEAD_OF_PURSUIT = 0.08, 0.03  # s; a pursuit may be made anew in every period
QUICKNESS = 0.3  # poles of a pursuit, times the period


@dataclass(frozen=True)
class Asked:
    """What a reference is asked to be for.

    Attributes
    ----------
    robot : Robot
    period : float
        [s].
    delay, horizon : int
        Periods until a decision acts, and that a controller looks ahead from there.
    inertia : str
        Of the rods in its model.
    payload : Payload or None
        That the tip picks up.
    compiled : bool
    """

    robot: Robot
    period: float
    delay: int
    horizon: int
    inertia: str
    payload: Payload | None
    compiled: bool

    @property
    def rows(self) -> int:
        """That a controller reads from any period on."""
        return self.delay + self.horizon + 2

    def carried(self, k: int, count: int) -> np.ndarray:
        """Payload in ``count`` periods from k on [kg]."""
        t = self.period * (k + np.arange(count))
        return np.zeros(count) if self.payload is None else self.payload.carried(t)


class Rows:
    """Target, motor angles and forces from the present on, along a motion that may be exchanged.

    Parameters
    ----------
    asked : Asked

    Attributes
    ----------
    first : int
        Period of the first row.
    """

    def __init__(self, asked: Asked) -> None:
        self.asked = asked
        robot = asked.robot
        self._inverse = OnlineInverse(robot, compiled=asked.compiled)
        self._inverse.prepare()
        self._mass = Plant(robot, inertia=asked.inertia) if asked.inertia != "none" else None
        self._inertia_at: tuple[Row, np.ndarray, np.ndarray] | None = None
        self.first = 0  # period of the first row
        self._rows: list[Row] = []
        self._samples = np.empty((0, 3, 2))
        self._states = np.empty((0, 4 + robot.n_rods))
        self._forces = np.empty((0, 2))
        self._motion: Motion = self._still((0.0, 0.0), 0)
        self._point: tuple[int, np.ndarray, np.ndarray] | None = None
        self._refused = ""  # the point that was refused last
        self._blocked_in: int | None = None  # the period in which the target could not go on, last

    def state(self, k: int) -> np.ndarray:
        """Target in period k: position [m], velocity, acceleration, shape (3, 2)."""
        return np.array(self._samples[k - self.first])

    def window(self, k: int, delay: int) -> np.ndarray:
        """See `Track`; call `advance` first."""
        i, horizon = k + delay - self.first, self.asked.horizon
        states = self._states[i : i + horizon + 1]
        rates = (states[1:, 4:] - states[:-1, 4:]) / self.asked.period
        return np.hstack([states[1:], rates, self._forces[i + 1 : i + 1 + horizon]])

    @property
    def block(self) -> int:
        """Rows that are made at once as that costs less; where the rods' inertia is reckoned with, it does not."""
        return 1 if self._mass is not None else BLOCK

    @property
    def carries(self) -> bool:
        """Whether the tip ever carries anything."""
        return self.asked.payload is not None

    def payloads(self, k: int, count: int) -> np.ndarray:
        """That the tip carries from period k on."""
        return self.asked.carried(k, count)

    def pose(self, k: int) -> Equilibrium:
        """Pose of the target in period k."""
        return self._inverse.pose(self._rows[k - self.first])

    def _at(self, pose: Equilibrium) -> Row:
        """The row that is a pose, from which the others are followed."""
        if self._mass is not None:
            self._mass.reset(np.concatenate([pose.p, np.zeros(2), pose.q]), pose)
        return self._inverse.at(pose)

    def _still(self, point: Any, k: int) -> Pursuit:
        return Pursuit(self.asked.period, tuple(point), (0.0, 0.0), k, QUICKNESS / self.asked.period, 1.0, 1.0, 1.0)

    def _ahead(self, motion: Motion) -> int:
        look = _LOOK_AHEAD
        if isinstance(motion, Pursuit):
            look = _LOOK_AHEAD_OF_JOG if motion.point is None else _LOOK_AHEAD_OF_PURSUIT
        return int(self.asked.rows + math.ceil(look / self.asked.period))

    def _remake(self, motion: Motion, k: int) -> None:
        """Let another motion take effect from period k on; raise, and leave all as it was, if it cannot be had."""
        kept = self._rows, self._samples, self._states, self._forces, self._motion
        count = k - self.first + 1
        self._rows, self._motion = self._rows[:count], motion
        self._samples, self._states, self._forces = (
            each[:count] for each in (self._samples, self._states, self._forces)
        )
        error = self._extend(self._ahead(motion) - 1)
        if error is not None:
            self._rows, self._samples, self._states, self._forces, self._motion = kept
            raise error

    def _require(self, k: int) -> None:
        error = self._extend(self._ahead(self._motion) - len(self._rows))
        if error is not None:
            raise error

    def _extend(self, count: int) -> PCRError | None:
        """Add so many rows; return why there are fewer, if there are."""
        if count <= 0:
            return None
        last, k = self._rows[-1], self.first + len(self._rows) - 1
        samples = self._motion.ahead(self._samples[-1], k, count)
        if self._mass is None:
            forces = self._force(samples, k + 1, last)
            rows, error = self._inverse.rows(last, samples[:, 0], forces)
        else:
            rows, error, found = [], None, []
            for j in range(count):  # the rods' inertia is that of the row before
                found.append(self._force(samples[j : j + 1], k + 1 + j, last))
                more, error = self._inverse.rows(last, samples[j : j + 1, 0], found[-1])
                if error is not None:
                    break
                last = more[0]
                rows.append(last)
            forces = np.vstack(found)
        done = len(rows)
        if done:
            q = np.array([row.q for row in rows])
            velocities = self._velocities(samples[:done], rows)
            self._rows = self._rows + rows
            self._samples = np.concatenate([self._samples, samples[:done]])
            self._states = np.vstack([self._states, np.hstack([samples[:done, 0], velocities, q])])
            self._forces = np.vstack([self._forces, forces[:done]])
        return error

    def _freeze(self) -> None:
        """Stay at the last row that there is."""
        self._samples = self._samples.copy()
        self._samples[-1, 1:] = 0.0
        self._motion = self._still(self._rows[-1].p, self.first + len(self._rows) - 1)
        missing = self._ahead(self._motion) - len(self._rows)
        if missing > 0:
            self._rows = self._rows + [self._rows[-1]] * missing
            self._samples, self._states, self._forces = (
                np.concatenate([each, np.repeat(each[-1:], missing, axis=0)])
                for each in (self._samples, self._states, self._forces)
            )

    def _force(self, samples: np.ndarray, k: int, row: Row) -> np.ndarray:
        """Force that the rods carry at samples from period k on, shape (K, 2) [N], beside the tip's own weight."""
        robot = self.asked.robot
        v, a = samples[:, 1], samples[:, 2]
        carried = self.asked.carried(k, len(samples))[:, None]
        forces = carried * (np.array(robot.gravity) - a) - robot.tip_mass * a - robot.drag * v
        if self._mass is not None:
            own, coupled = self._inertia(row)
            # The motors turn with the tip as at rest; terms of second order in the velocities are left out.
            forces -= a @ (own + coupled).T - robot.tip_mass * a
        return np.asarray(forces)

    def _inertia(self, row: Row) -> tuple[np.ndarray, np.ndarray]:
        """M_pp, and M_pq dq/dp, at a row."""
        assert self._mass is not None
        if self._inertia_at is None or self._inertia_at[0] is not row:
            self._mass.recall(row.record)
            mass = self._mass.mass(row.p, row.q)[0]
            self._inertia_at = row, mass[:2, :2], mass[:2, 2:] @ row.levers
        return self._inertia_at[1:]

    def _velocities(self, samples: np.ndarray, rows: list[Row]) -> np.ndarray:
        """Velocities of the state: the momentum over M_pp (see `Plant`)."""
        if self._mass is None:
            return samples[:, 1]
        found = samples[:, 1].copy()
        for velocity, row in zip(found, rows, strict=True):
            own, coupled = self._inertia(row)
            velocity += np.linalg.solve(own, coupled @ velocity)
        return found
