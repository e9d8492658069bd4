"""The robot as it is, and all that hands can do to it: plant, motors, sensors, a spring at the tip."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from ...errors import PCRError
from ...loop.hardware.camera import IDEAL, Pictures
from ...loop.run.drive import drive_of
from ...loop.run.untold_delay import UntoldDelay
from ...loop.scene.scene import Scene
from ...loop.scene.settings import PlantSettings
from ...plant.motion.plant import Plant
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.free_tip import inverse_statics
from ...plant.statics.solver import Snap

_STRONGEST = 50.0  # force of the spring at most, in sum EI/L^2
_DAMPING = 0.4  # of the tip on the spring
_NEARER = (1.0, 0.8, 0.6, 0.45)  # shares of the way from the motors to the start, where a mode is looked for
_HAND = 0.04  # s, time constant with which a motor follows the hand that turns it


class Rig:
    """A plant with its motors and sensors, which anybody may pull at.

    Parameters
    ----------
    scene : Scene
        Whose robot, plant, sensors and motors it has.
    pose : Equilibrium
        In which it starts.
    velocity : ndarray, shape (2,)
        Of the tip at the start [m/s].
    seed : int
        Of the measurement noise.

    Attributes
    ----------
    x : ndarray, shape (4 + n,)
        State [m, m/s, rad].
    plant : Plant
        Rods that lose their shape snap, where that can be followed (see `snapping`).
    stiffness, dashpot : float
        Of the spring that pulls the tip [N/m], [N s/m].
    pull : ndarray, shape (2,), or None
        Where the spring's other end is [m].
    force : ndarray, shape (2,)
        Of the spring in the last step [N].
    hand : (int, float) or None
        Motor that a hand turns, and the angle to which it does [rad].
    applied : ndarray, shape (n,)
        Motor rates of the last step [rad/s].
    """

    def __init__(self, scene: Scene, pose: Equilibrium, velocity: np.ndarray, seed: int = 0) -> None:
        self.scene, self.dt = scene, scene.plant.dt
        self.plant: Plant = snapping(scene).make(scene.robot)
        n = scene.robot.n_rods
        self.x = np.concatenate([pose.p, velocity, pose.q])
        self.plant.reset(self.x, pose)
        self._snapped = 0
        self.stiffness = max(float(pose.stiffness_eigenvalues[1]), scene.robot.force_scale / scene.robot.lengths.min())
        self.dashpot = 2.0 * _DAMPING * math.sqrt(2.0 * self.stiffness * scene.robot.tip_mass)
        self._strongest = _STRONGEST * scene.robot.force_scale
        self.pull: np.ndarray | None = None
        self.hand: tuple[int, float] | None = None
        self.force, self.applied = np.zeros(2), np.zeros(n)
        self._noise, self._seed = np.random.default_rng(seed), seed
        self._on_the_way = deque([np.zeros(n)] * scene.delay)
        self._arrived = np.zeros(n)
        self._fit(pose)

    def _fit(self, pose: Equilibrium) -> None:
        scene = self.scene
        self._later = UntoldDelay(scene.untold_delay, self.dt, scene.robot.n_rods)
        self._drive = drive_of(scene, self.dt, pose)
        self._pictures = None if scene.camera in (None, IDEAL) else Pictures(scene.camera, self.dt, self._seed)
        back = 0.0 if scene.camera is None else scene.camera.latency
        self._past: deque[np.ndarray] = deque([self.x], maxlen=math.ceil(back / self.dt) + 2)

    def refit(self, scene: Scene, pose: Equilibrium) -> None:
        """Take other motors and sensors where the robot stands in ``pose``; commands on the way are lost."""
        if scene.robot != self.scene.robot or scene.plant != self.scene.plant:
            payload = self.plant.payload
            self.plant = snapping(scene).make(scene.robot)
            self.plant.reset(self.x, pose)
            self._snapped = 0
            if payload:
                self.plant.carry(payload, self.x)
        self.scene, self.dt = scene, scene.plant.dt
        self._on_the_way = deque([np.zeros(scene.robot.n_rods)] * scene.delay)
        self._arrived = np.zeros(scene.robot.n_rods)
        self._fit(pose)

    def put(self, pose: Equilibrium) -> None:
        """Put the robot to rest in a pose, whatever it was at."""
        payload = self.plant.payload
        self.x = np.concatenate([pose.p, np.zeros(2), pose.q])
        self.plant.reset(self.x, pose)
        self._snapped = 0
        if payload:
            self.x = self.plant.carry(payload, self.x)
        self.pull, self.hand = None, None
        self.force = np.zeros(2)
        self._fit(pose)

    def carry(self, payload: float) -> None:
        """Let the tip carry a payload [kg] from now on."""
        if payload != self.plant.payload:
            self.x = self.plant.carry(payload, self.x)

    def measure(self, k: int) -> np.ndarray:
        """State as the sensors tell it in period k, shape (4 + n,); a tip that is not seen is NaN."""
        scene, measured = self.scene, self.x.copy()
        if self._drive is not None:
            measured[4:] = self._drive.angles(self.x)
        if self._pictures is not None:
            measured[:2] = self._pictures.tip(k, np.array(self._past))
        if scene.tip_noise:
            measured[:2] += self._noise.normal(0.0, scene.tip_noise, 2)
        if scene.angle_step:
            measured[4:] = scene.angle_step * np.round(measured[4:] / scene.angle_step)
        if scene.wrapped:
            measured[4:] -= 2 * np.pi * np.ceil(measured[4:] / (2 * np.pi) - 0.5)
        return measured

    def command(self, u: np.ndarray) -> None:
        """Take the motor rates that were decided on for a period [rad/s]; they arrive the scene's delay later."""
        self._on_the_way.append(u)
        self._arrived = self._on_the_way.popleft()

    def step(self) -> list[Snap]:
        """Advance by one step of the plant; return the snaps in it; errors as `Plant.step`."""
        u = self._later(self._arrived)
        if self._drive is not None:
            u = self._drive.turn(self.x, u)
        if self.hand is not None:
            i, angle = self.hand
            limit = self.scene.robot.rate_limit
            u = np.zeros(len(u))
            u[i] = min(max((angle - self.x[4 + i]) / _HAND, -limit), limit)
        self.force = self._spring()
        self.x = self.plant.step(self.x, u, self.force + np.array(self.scene.force))
        self.applied = u
        self._past.append(self.x)
        known, self._snapped = self._snapped, len(self.plant.snaps)
        return self.plant.snaps[known:]

    def _spring(self) -> np.ndarray:
        if self.pull is None:
            return np.zeros(2)
        force = self.stiffness * (self.pull - self.x[:2])
        size = float(np.hypot(*force))
        if size > self._strongest:
            force *= self._strongest / size
        # What damps is not cut: a tip that flies is caught.
        return np.asarray(force - self.dashpot * self.x[2:4])

    def equilibrium(self) -> Equilibrium:
        """Everything about the rods as they are."""
        return self.plant.equilibrium(self.x)


def snapping(scene: Scene) -> PlantSettings:
    """The plant of a scene whose rods snap where that can be followed; elsewhere it fails there."""
    robot = scene.robot.plain() if scene.plant.rods == "plain" else scene.robot
    return replace(scene.plant, on_snap="raise" if robot.needs_shooting else "jump")


def pose_of_mode(scene: Scene, mode: str) -> Equilibrium:
    """The pose of a working mode at the scene's start, or nearer to the motors."""
    start, middle = scene.start().p, scene.robot.bases.mean(axis=0)
    failure: PCRError | None = None
    for share in _NEARER:
        try:
            return inverse_statics(scene.robot, middle + share * (start - middle), mode=mode)
        except PCRError as error:
            failure = failure or error
    assert failure is not None
    raise failure
