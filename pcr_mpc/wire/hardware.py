"""What stands between a plant in real time and the packets: sensors, motors and delays of a scene, as `simulate` has
them."""

from __future__ import annotations

from collections import deque

import numpy as np

from ..loop.hardware.camera import IDEAL, Pictures
from ..loop.parts.assembled import resting_state
from ..loop.run.drive import drive_of
from ..loop.run.untold_delay import UntoldDelay
from ..loop.scene.scene import Scene
from .packet import Measurement


class Hardware:
    """A scene's plant with what is late about it.

    Parameters
    ----------
    scene : Scene

    Attributes
    ----------
    dt : float
        Step of the plant [s].
    steps : int
        Of the plant, in the scene.
    states : ndarray, shape (steps + 1, 4 + n)
        So far.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._plant, pose = scene, scene.make_plant(), scene.start()
        self.dt, x, n = self._plant.dt, resting_state(pose), scene.robot.n_rods
        self._per = round(scene.period / self.dt)
        self.steps = scene.n_periods * self._per
        self._noise = np.random.default_rng(0)
        self._later = UntoldDelay(scene.untold_delay, self.dt, n)
        self._drive = drive_of(scene, self.dt, pose)
        self._pictures = None if scene.camera in (None, IDEAL) else Pictures(scene.camera, self.dt, 0)
        carried = scene.carried(self.dt * np.arange(self.steps)) * (scene.plant.payload == "carried")
        self._payloads = {int(k): float(carried[k]) for k in np.flatnonzero(np.diff(carried, prepend=0.0))}
        self._coming: deque[tuple[float, np.ndarray]] = deque()
        self._u = np.zeros(n)
        self._done = 0
        self.states = np.empty((self.steps + 1, 4 + n))
        self.states[0] = x
        self._plant.reset(x, pose)
        self._plant.step(x, self._u)  # pays for building graphs before the clock runs
        self._plant.reset(x, pose)

    def measured(self, k: int) -> Measurement:
        """What the sensors say at the start of period k."""
        scene, x = self._scene, self.states[self._done]
        p, q = x[:2].copy(), x[4:] if self._drive is None else self._drive.angles(x)
        if self._pictures is not None:
            p = self._pictures.tip(k, self.states[: self._done + 1])
        if scene.tip_noise:
            p = p + self._noise.normal(0.0, scene.tip_noise, 2)
        if scene.angle_step:
            q = scene.angle_step * np.round(q / scene.angle_step)
        if scene.wrapped:
            q = q - 2 * np.pi * np.ceil(q / (2 * np.pi) - 0.5)
        return Measurement(k, k * scene.period, p, q)

    def told(self, u: np.ndarray, at: float, since: float) -> None:
        """Take in rates that come at a time [steps], and answer what was measured ``since`` [steps].

        They act when they come, or by the scene's delay after the measurement, whichever is later.

        Parameters
        ----------
        u : ndarray, shape (n,)
            [rad/s].
        at, since : float
            Of the plant's steps; not before what has been done.
        """
        before = self._coming[-1][0] if self._coming else 0.0
        self._coming.append((max(at, since + self._scene.delay * self._per, before), u))

    def _turning(self) -> np.ndarray:
        """Mean rates over the step that comes next: every motor turns by what it must, whenever a command acts."""
        if not self._coming or self._coming[0][0] >= self._done + 1:
            return self._u
        mean, last = np.zeros(len(self._u)), float(self._done)
        while self._coming and self._coming[0][0] < self._done + 1:
            at, u = self._coming.popleft()
            mean = mean + (max(at, last) - last) * self._u
            last, self._u = max(at, last), u
        # A command that acts from the beginning on is the rates, to the last bit.
        return self._u if last == self._done else mean + (self._done + 1 - last) * self._u

    def step(self) -> None:
        """Advance the plant; errors as `Plant.step`."""
        x, u = self.states[self._done], self._later(self._turning())
        if self._done in self._payloads:
            x = self._plant.carry(self._payloads[self._done], x)
        if self._drive is not None:
            u = self._drive.turn(x, u)
        self.states[self._done + 1] = self._plant.step(x, u, self._scene.force)
        self._done += 1
