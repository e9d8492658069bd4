"""The motion that numbers predict for the commands of a log, with exact derivatives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...loop.scene.scene import Scene
from ...loop.scene.settings import PlantSettings
from ...plant.motion.plant import Plant
from ...plant.motion.rollout import rollout
from ...plant.motion.sensitivities import sensitivities
from ...plant.motion.step_limit import longest_step
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.held_tip import default_method
from .logs.commands import commands, filled
from .logs.log import Log
from .parameters import Parameters, force_names

# Steps of the model: RK4 at this part of the fastest swing's radian is within a hundredth of a per cent; what is left
# is made up for by the scene's own steps.
_SWING = 0.2


@dataclass(frozen=True)
class Piece:
    """Rows ``first`` to ``last`` of a log, which are predicted from a start of their own at ``first``.

    ``joined`` says whether the next piece goes on where this one ends.
    """

    log: int
    first: int
    last: int
    joined: bool


@dataclass(frozen=True, eq=False)
class Predicted:
    """States of a piece at its rows and their derivatives.

    Attributes
    ----------
    x : ndarray, shape (M, 4 + n)
    by_start : ndarray, shape (M, 4 + n, 4 + n)
    by_free : ndarray, shape (M, 4 + n, F)
        In each free parameter's z.
    by_missing : ndarray, shape (M, 4 + n, B)
        In the missing commands of its log.
    """

    x: np.ndarray
    by_start: np.ndarray
    by_free: np.ndarray
    by_missing: np.ndarray


class Predictor:
    """Predicts pieces of logs of a scene's robot.

    Parameters
    ----------
    scene : Scene
    logs : sequence of Log

    Attributes
    ----------
    pose : Equilibrium
        Of the scene's start: on its branch are the rods.
    omega : float
        Fastest swing of the tip there [rad/s].
    """

    def __init__(self, scene: Scene, logs: Sequence[Log]) -> None:
        self.logs = tuple(logs)
        self.period = scene.period
        self.pose: Equilibrium = scene.start()
        settings = physics(scene)
        self._fine = settings
        plant = settings.make(scene.robot)
        plant.reset(np.concatenate([self.pose.p, np.zeros(2), self.pose.q]), self.pose)
        stiffness = plant.force_and_jacobians(self.pose.p, self.pose.q)[1]
        mass = plant.mass(self.pose.p, self.pose.q)[0][:2, :2]
        self.omega = longest_step("rk4", stiffness, mass, scene.robot.drag)[1]
        self.n = scene.robot.n_rods
        self.substeps = [max(1, math.ceil(self.omega * log.step / _SWING - 1e-9)) for log in self.logs]
        self._filled = [filled(log) for log in self.logs]
        self._unknown = [np.argwhere(np.isnan(log.u)) for log in self.logs]
        self._plants: dict[tuple[int, bool], Plant] = {}
        self._robot = scene.robot
        self._at: dict[Piece, tuple[Any, Predicted]] = {}  # where the last derivatives of each piece were taken

    def missing(self, log: int) -> int:
        """How many commands of a log are missing."""
        return len(self._unknown[log])

    def fine_steps(self, log: int) -> int:
        """Steps of the scene's own plant from row to row."""
        return max(1, round(self.logs[log].step / self._fine.dt))

    def delay(self, log: int, values: dict[str, float]) -> float:
        """Of the commands of a log, in its rows."""
        one = self.logs[log]
        return values["delay"] * self.period / one.step if one.driven_by == "commands" else 0.0

    def states(
        self,
        parameters: Parameters,
        z: np.ndarray,
        missing: Sequence[np.ndarray],
        pieces: Sequence[Piece],
        starts: np.ndarray,
        *,
        fine: bool = False,
    ) -> list[np.ndarray]:
        """States of pieces at their rows, each of shape (M, 4 + n); with ``fine`` in the scene's own steps.

        Raises
        ------
        PCRError
            There is no such robot, or its rods did not follow.
        """
        robot, values = parameters.robot_at(z), parameters.values(z)
        found: list[np.ndarray] = [np.empty(0)] * len(pieces)
        groups: dict[tuple[int, int], list[int]] = {}
        for i, piece in enumerate(pieces):
            groups.setdefault((piece.log, piece.last - piece.first), []).append(i)
        for (log, _), members in groups.items():
            substeps = self.fine_steps(log) if fine else self.substeps[log]
            delay, u = self.delay(log, values), self._commands(log, missing[log])
            rates = [commands(self.logs[log], u, delay, pieces[i].first, pieces[i].last, substeps).rates
                     for i in members]  # fmt: skip
            plant = self._plant(log, fine).of(robot)
            force = np.array([values[name] for name in force_names(log, len(self.logs))])
            moved = rollout(plant, starts[members], np.stack(rates), force, guess=self.pose)
            for i, x in zip(members, moved.x, strict=True):
                found[i] = x[::substeps]
        return found

    def derivatives(
        self, parameters: Parameters, z: np.ndarray, missing: np.ndarray, piece: Piece, start: np.ndarray
    ) -> Predicted:
        """States of a piece and their derivatives; errors as `states`."""
        key = (parameters.values(z), parameters.free, piece, missing.tobytes(), start.tobytes())
        if key != self._at.get(piece, (None, None))[0]:
            self._at[piece] = key, self._derivatives(parameters, z, missing, piece, start)
        return self._at[piece][1]

    def _derivatives(
        self, parameters: Parameters, z: np.ndarray, missing: np.ndarray, piece: Piece, start: np.ndarray
    ) -> Predicted:
        values, log = parameters.values(z), piece.log
        substeps, unknown = self.substeps[log], self._unknown[log]
        delay, u = self.delay(log, values), self._commands(log, missing)
        told = commands(self.logs[log], u, delay, piece.first, piece.last, substeps)
        plant = self._plant(log, False).of(parameters.robot_at(z))
        force = force_names(log, len(self.logs))
        steps = len(told.rates)
        ways = np.zeros((steps, self.n + 2, 3 + len(unknown)))
        if self.logs[log].driven_by == "commands":
            ways[:, : self.n, 0] = told.by_delay * self.period / self.logs[log].step
        ways[:, self.n, 1] = ways[:, self.n + 1, 2] = 1.0
        rows = {int(row): k for k, row in enumerate(self.logs[log].missing)}
        for k, (row, motor) in enumerate(unknown):
            ways[:, motor, 3 + k] = told.by_missing[:, rows[int(row)]]
        found = sensitivities(plant, start, told.rates, [values[name] for name in force], guess=self.pose, ways=ways)
        at = slice(None, None, substeps)
        along = {"delay": 0, force[0]: 1, force[1]: 2}
        by_value = np.zeros((len(found.x[at]), found.x.shape[1], len(parameters.free)))
        for j, one in enumerate(parameters.free):
            if one.name in along:
                by_value[:, :, j] = found.dx_dways[at, :, along[one.name]]
            elif one.name in found.names:
                by_value[:, :, j] = found.dx_dnumbers[at, :, found.names.index(one.name)]
        by_free = by_value @ parameters.gradient(z)
        return Predicted(found.x[at], found.dx_dx0[at], by_free, found.dx_dways[at, :, 3:])

    def _commands(self, log: int, missing: np.ndarray) -> np.ndarray:
        u = self._filled[log]
        if len(missing):
            u = u.copy()
            u[tuple(self._unknown[log].T)] += missing
        return u

    def plant(self, log: int, robot: Robot) -> Plant:
        """Plant with which a log is predicted, of a robot."""
        return self._plant(log, False).of(robot)

    def _plant(self, log: int, fine: bool) -> Plant:
        key = (log, fine)
        if key not in self._plants:
            if fine:
                settings = replace(self._fine, dt=self.logs[log].step / self.fine_steps(log))
            else:
                # Mass of rods as it is at the start has derivatives that take a tenth of the time.
                inertia = "constant" if self._fine.inertia == "condensed" else self._fine.inertia
                step = self.logs[log].step / self.substeps[log]
                settings = replace(self._fine, integrator="rk4", inertia=inertia, dt=step)
            self._plants[key] = settings.make(self._robot)
        return self._plants[key]


def physics(scene: Scene) -> PlantSettings:
    """Plant of a scene, with the nearest that has derivatives where its own has none."""
    plant = scene.plant
    if plant.method == "single_shooting":
        plant = replace(plant, method=default_method(scene.robot), weight=None)
    if plant.inertia == "full":
        plant = replace(plant, inertia="condensed", integrator="rk4")
    return replace(plant, on_snap="raise")
