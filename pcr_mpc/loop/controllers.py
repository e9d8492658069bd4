"""Controllers as the closed loop sees them: measured state in, motor rates out."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..control.mpc import LinearMPC, Plan
from ..control.observer import DisturbanceObserver
from ..control.qp import Reference
from ..control.tuning import Limits, Tuning
from ..errors import PCRError
from ..linearisation.linear_model import LinearModel
from ..linearisation.linearise import linearise
from ..plant.dynamics import Plant
from ..plant.equilibrium import Equilibrium
from ..plant.free_tip import inverse_statics
from ..plant.robot import Robot
from .scene import Scene
from .target import MotorTarget


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
    """The linear MPC on a model of its own.

    Parameters
    ----------
    scene : Scene
        Reference, period, delay, sensors and limits; not its loads.
    tuning : Tuning
    robot : Robot, optional
        What the controller believes the robot to be; by default the scene's.
    """

    def __init__(self, scene: Scene, tuning: Tuning, robot: Robot | None = None) -> None:
        if scene.trajectory is None:
            raise ValueError(f"scene {scene.name} has no reference to track")
        self.name = tuning.name
        self.robot = robot or scene.robot
        self.mpc = LinearMPC(tuning, motor_limits(scene.robot, scene.period))
        self.observer: DisturbanceObserver | None = None
        self._scene, self._tuning = scene, tuning
        self._delay = scene.delay if tuning.model.predict_delay else 0
        self._model = self._make_model()
        # One model for each period of the plan: in the next period it is needed next to where it is now.
        along = tuning.model.linearise == "along_plan"
        self._along = deque(self._make_model() for _ in range(tuning.horizon - 1)) if along else None
        self._target = MotorTarget(self.robot)
        self._on_the_way: deque[np.ndarray] = deque()
        self._u = np.zeros(self.robot.n_rods)
        self._plan: Plan | None = None

    def start(self, pose: Equilibrium) -> None:
        """See `Controller`; solves the inverse dynamics of the whole reference."""
        horizon = self._tuning.horizon + self._delay
        self._states, self._inputs, self._forces = feed_forward(self._scene, self.robot, pose, horizon)
        x = np.concatenate([pose.p, np.zeros(2), pose.q])
        model = self._make_model()
        model.reset(x, pose)
        resting = linearise(model, x, np.zeros(self.robot.n_rods), self._scene.period)
        # One throw-away step pays for building graphs and workspaces before the clock runs.
        self._restart(x, pose, resting)
        self.step(0, x)
        self._restart(x, pose, resting)

    def _restart(self, x: np.ndarray, pose: Equilibrium, resting: LinearModel) -> None:
        """Forget everything: the robot rests in ``pose``, about which ``resting`` is the linear model."""
        self.mpc.reset()
        self.mpc.prepare(resting)
        if self._tuning.observer is not None:
            sensors = self._scene.tip_noise, self._scene.angle_step
            self.observer = DisturbanceObserver(self._tuning.observer, *sensors, resting)
            self.observer.start(x)
        for plant in (self._model, *(self._along or ())):
            plant.reset(x, pose)
        self._target.start(pose)
        self._predicts = resting
        self._on_the_way = deque([np.zeros(self.robot.n_rods)] * self._delay)
        self._u = np.zeros(self.robot.n_rods)
        self._plan = None

    def step(self, k: int, x: np.ndarray) -> Decision:
        """See `Controller`; a measurement that is not finite is bridged by the prediction."""
        period, observer = self._scene.period, self.observer
        force = np.zeros(2)
        if observer is not None:
            if np.isfinite(x[:2]).all() and np.isfinite(x[4:]).all():
                observer.correct(x[:2], x[4:])
            x, force = observer.x, observer.force
        began = time.perf_counter()
        failure, now, ahead = "", None, x
        models: LinearModel | list[LinearModel] | None = None
        try:
            for u in self._on_the_way:
                model = linearise(self._model, ahead, u, period, force)
                now = now or model
                ahead = model(ahead, u)
            models = self._linearise(ahead, k, force)
        except (PCRError, ValueError) as error:
            if self._tuning.fallback == "raise":
                raise
            failure = f"no linear model: {error}"
        linearised = time.perf_counter() - began
        window = self._window(k + self._delay, force)
        if models is None:
            plan = self.mpc.fall_back(failure, ahead, window, self._u)
        else:
            plan = self.mpc.solve(ahead, models, window, self._u)
        self._u, self._plan = plan.inputs[0], plan
        self._on_the_way.append(self._u)
        arriving = self._on_the_way.popleft()
        if models is not None:
            self._predicts = now or (models if isinstance(models, LinearModel) else models[0])
        if observer is not None:
            observer.predict(self._predicts, arriving)
        return Decision(plan.inputs[0], plan, linearised)

    def _linearise(self, x: np.ndarray, k: int, force: np.ndarray) -> LinearModel | list[LinearModel]:
        here = linearise(self._model, x, self._u, self._scene.period, force)
        if self._along is None:
            return here
        # The last plan, one period on; at the start the reference.
        if self._plan is None or self._plan.models is None or not np.isfinite(self._plan.x).all():
            path = self._states[k + self._delay + 1 :]
        else:
            path = np.vstack([self._plan.states[2:], self._states[k + self._delay + self._tuning.horizon]])
        models = [
            linearise(plant, at, self._u, self._scene.period, force)
            for plant, at in zip(self._along, path, strict=False)
        ]
        self._along.rotate(-1)
        return [here, *models]

    def _window(self, k: int, force: np.ndarray) -> Reference:
        """Reference over the horizon from period k on, its angles moved to carry the unknown force."""
        horizon = self._tuning.horizon
        states = self._states[k + 1 : k + 1 + horizon]
        if self.observer is not None:
            end = states[-1]
            states = states.copy()
            states[:, 4:] += self._target.shift(end[:2], end[4:], self._forces[k + horizon] + force)
        return Reference(states, self._inputs[k : k + horizon])

    def _make_model(self) -> Plant:
        model = self._tuning.model
        return Plant(
            self.robot, method=model.method, segments=model.segments, steps=model.steps, scheme=model.scheme,
            inertia=model.inertia,
        )  # fmt: skip


def motor_limits(robot: Robot, period: float) -> Limits:
    """Limits of the robot's motors as the controller needs them."""
    lower, upper = robot.angle_limits.T
    return Limits(robot.rate_limit, robot.acceleration_limit * period, lower.copy(), upper.copy())


def feed_forward(
    scene: Scene, robot: Robot, pose: Equilibrium, horizon: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inverse dynamics of the reference at every period, and one horizon beyond the end.

    The motor angles are those at which the rods carry F = -m a - c v on the reference; the rates lead from
    each to the next.

    Returns
    -------
    states : ndarray, shape (K, 4 + n)
    inputs : ndarray, shape (K - 1, n)
    forces : ndarray, shape (K, 2)
        That the rods carry [N].

    Raises
    ------
    PCRError
        The reference leaves the workspace; the message says when.
    """
    assert scene.trajectory is not None
    t = scene.period * np.arange(scene.n_periods + horizon + 1)
    samples = scene.trajectory(t)
    states, forces = np.empty((len(t), 4 + robot.n_rods)), np.empty((len(t), 2))
    eq = pose
    for k in range(len(t)):
        p, v, a = samples[k]
        forces[k] = -robot.tip_mass * a - robot.drag * v
        try:
            eq = inverse_statics(robot, p, forces[k], guess=eq)
        except PCRError as error:
            raise type(error)(f"reference at t = {t[k]:.3f} s: {error}", **error.details) from None
        states[k] = np.concatenate([p, v, eq.q])
    return states, np.diff(states[:, 4:], axis=0) / scene.period, forces


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
