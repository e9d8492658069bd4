"""Controllers as the closed loop sees them: measured state in, motor rates out."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..control.mpc import LinearMPC, Plan
from ..control.qp import Reference
from ..control.tuning import Limits, Tuning
from ..errors import PCRError
from ..linearisation.linearise import linearise
from ..plant.dynamics import Plant
from ..plant.equilibrium import Equilibrium
from ..plant.free_tip import inverse_statics
from ..plant.robot import Robot
from .scene import Scene


@dataclass(frozen=True, eq=False)
class Decision:
    """What a controller decided, and what it cost.

    Attributes
    ----------
    u : ndarray, shape (n,)
        Motor rates [rad/s].
    plan : Plan or None
        Of an MPC.
    linearise_time : float
        [s].
    """

    u: np.ndarray
    plan: Plan | None = None
    linearise_time: float = 0.0


class Controller(Protocol):
    """What `simulate` needs."""

    name: str

    def start(self, pose: Equilibrium) -> None:
        """Get ready: the robot rests in ``pose``."""

    def step(self, k: int, x: np.ndarray) -> Decision:
        """Decide on period k from the measured state."""


class HoldMotors:
    """No control: the motors stay where they are."""

    name = "none"

    def __init__(self, n_rods: int) -> None:
        self._u = np.zeros(n_rods)

    def start(self, pose: Equilibrium) -> None:
        """See `Controller`."""

    def step(self, k: int, x: np.ndarray) -> Decision:
        """See `Controller`."""
        return Decision(self._u)


class TrackingMPC:
    """The linear MPC on a model of its own, linearised at every measured state.

    Parameters
    ----------
    scene : Scene
        Reference, period and limits.
    tuning : Tuning
    robot : Robot, optional
        What the controller believes the robot to be; by default the scene's.
    """

    def __init__(self, scene: Scene, tuning: Tuning, robot: Robot | None = None) -> None:
        if scene.trajectory is None:
            raise ValueError(f"scene {scene.name} has no reference to track")
        self.name = tuning.name
        self.robot = robot or scene.robot
        self._scene = scene
        self._period = scene.period
        model = tuning.model
        self._model = Plant(
            self.robot, method=model.method, segments=model.segments, steps=model.steps, scheme=model.scheme
        )
        self.mpc = LinearMPC(tuning, motor_limits(scene.robot, scene.period))
        self._states = self._inputs = np.empty((0, 0))
        self._u = np.zeros(self.robot.n_rods)

    def start(self, pose: Equilibrium) -> None:
        """See `Controller`; solves the inverse dynamics of the whole reference."""
        self._states, self._inputs = feed_forward(self._scene, self.robot, pose, self.mpc.tuning.horizon)
        x = np.concatenate([pose.p, np.zeros(2), pose.q])
        self._model.reset(x, pose)
        # One throw-away step pays for building graphs and workspaces before the clock runs.
        self._u = np.zeros(self.robot.n_rods)
        self.step(0, x)
        self.mpc.reset()
        self.mpc.prepare(linearise(self._model, x, np.zeros(self.robot.n_rods), self._period))
        self._model.reset(x, pose)
        self._u = np.zeros(self.robot.n_rods)

    def step(self, k: int, x: np.ndarray) -> Decision:
        """See `Controller`."""
        began = time.perf_counter()
        model = linearise(self._model, x, self._u, self._period)
        linearised = time.perf_counter() - began
        horizon = self.mpc.tuning.horizon
        window = Reference(self._states[k + 1 : k + 1 + horizon], self._inputs[k : k + horizon])
        plan = self.mpc.solve(x, model, window, self._u)
        self._u = plan.inputs[0]
        return Decision(plan.inputs[0], plan, linearised)


def motor_limits(robot: Robot, period: float) -> Limits:
    """Limits of the robot's motors as the controller needs them."""
    lower, upper = robot.angle_limits.T
    return Limits(robot.rate_limit, robot.acceleration_limit * period, lower.copy(), upper.copy())


def feed_forward(scene: Scene, robot: Robot, pose: Equilibrium, horizon: int) -> tuple[np.ndarray, np.ndarray]:
    """Inverse dynamics of the reference at every period, and one horizon beyond the end.

    The motor angles are those at which the rods carry F = -m a - c v on the reference; the rates lead from
    each to the next.

    Returns
    -------
    states : ndarray, shape (K, 4 + n)
    inputs : ndarray, shape (K - 1, n)

    Raises
    ------
    PCRError
        The reference leaves the workspace; the message says when.
    """
    assert scene.trajectory is not None
    t = scene.period * np.arange(scene.n_periods + horizon + 1)
    samples = scene.trajectory(t)
    states = np.empty((len(t), 4 + robot.n_rods))
    eq = pose
    for k in range(len(t)):
        p, v, a = samples[k]
        try:
            eq = inverse_statics(robot, p, -robot.tip_mass * a - robot.drag * v, guess=eq)
        except PCRError as error:
            raise type(error)(f"reference at t = {t[k]:.3f} s: {error}", **error.details) from None
        states[k] = np.concatenate([p, v, eq.q])
    return states, np.diff(states[:, 4:], axis=0) / scene.period


def make_controller(scene: Scene, tuning: Tuning | None = None, robot: Robot | None = None) -> Controller:
    """Build the controller of a scene: the MPC, or none where there is nothing to track.

    Parameters
    ----------
    tuning : Tuning, optional
        Instead of the scene's own.
    robot : Robot, optional
        What the controller believes the robot to be.
    """
    tuning = tuning or scene.tuning
    if scene.trajectory is None or tuning is None:
        return HoldMotors(scene.robot.n_rods)
    return TrackingMPC(scene, tuning, robot)
