"""Linear closed loops about poses along a scene's reference."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...control.laws import Law
from ...control.tuning import Tuning
from ...errors import MarginsError, PCRError
from ...linearisation.linear_model import LinearModel
from ...linearisation.linearise import linearise
from ...loop.demand.feed_forward import InverseDynamics, feed_forward
from ...loop.hardware.camera import IDEAL as IDEAL_CAMERA
from ...loop.parts.assembled import make_law, make_model, make_observer, motor_limits, pull
from ...loop.scene.scene import Scene
from ...plant.motion.followed_rods import DERIVATIVE_ACCURACY
from ...plant.motion.plant import Plant
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from .linear_controller import Believed, Feedback, feedback_of, linear_controller
from .linear_loop import LinearLoop
from .linear_plant import Sampled, linear_plant

LINEAR_LAWS = ("linear_mpc", "lqr", "pd")


@dataclass(frozen=True, eq=False)
class PoseOfReference:
    """Where a reference is at a time, and what the controller does there.

    Attributes
    ----------
    t : float
        [s].
    x : ndarray, shape (4 + n,)
        State of the reference.
    pose : Equilibrium
        Of the rods of the robot that moves.
    payload : float
        [kg].
    controllers : tuple of Sampled
        In the periods from one picture to the next.
    """

    t: float
    x: np.ndarray
    pose: Equilibrium
    payload: float
    controllers: tuple[Sampled, ...]


class LinearLoops:
    """The linear closed loops of a scene with a tuning, for the robot as it is believed to be or for another one.

    Parameters
    ----------
    scene : Scene
    tuning : Tuning, optional
        Instead of the scene's own.
    poses : int
        How many, at equal times.
    reference : InverseDynamics, optional
        Of the scene's reference, if they are known already: most of what it costs.

    Attributes
    ----------
    scene : Scene
        With the tuning, and its period.
    poses : list of PoseOfReference

    Raises
    ------
    MarginsError
        There is nothing to analyse: no reference, or a law that is not linear or has no feedback; or the reference
        passes poses without a linear model; or camera or observer are none that the linear loop knows.
    """

    def __init__(
        self, scene: Scene, tuning: Tuning | None = None, *, poses: int = 24,
        reference: InverseDynamics | None = None,
    ) -> None:  # fmt: skip
        tuning = tuning or scene.tuning
        if scene.trajectory is None or tuning is None:
            raise MarginsError(
                f"scene {scene.name} has no reference, so that no loop is closed: the motors stay where they are; give "
                "it a [reference] and a control.tuning"
            )
        if tuning.law not in LINEAR_LAWS:
            why = {"nonlinear_mpc": "is no linear law, and has no gain", "feed_forward": "measures nothing"}
            raise MarginsError(
                f"tuning {tuning.name}, law {tuning.law}: it {why[tuning.law]}; laws with margins are "
                f"{', '.join(LINEAR_LAWS)}"
            )
        if why_not := _not_linear(scene, tuning):
            raise MarginsError(
                f"scene {scene.name} with tuning {tuning.name}: {why_not}, which the linear loop does not know; "
                "measure_delay_margin measures how much further delay it bears"
            )
        self.scene = scene = scene.tuned(tuning)
        self.tuning = tuning
        try:
            self.poses = self._along(poses, reference)
        except (PCRError, ValueError) as error:
            raise MarginsError(
                f"scene {scene.name} with tuning {tuning.name}: no linear loop along the reference: {error}"
            ) from error

    def _along(self, count: int, reference: InverseDynamics | None) -> list[PoseOfReference]:
        scene, tuning = self.scene, self.tuning
        robot, period, start = scene.robot, scene.period, scene.start()
        n = robot.n_rods
        known = scene if tuning.model.payload else replace(scene, payload=None)
        reference = reference or feed_forward(known, robot, start, 0, tuning.model.inertia)
        model, target, real = make_model(robot, tuning.model), Plant(robot), self._plant(robot)
        rest = np.concatenate([start.p, np.zeros(2), start.q])
        for plant in (model, target, real):
            plant.reset(rest, start)
        resting = linearise(model, rest, np.zeros(n), period)
        limits, observer = motor_limits(robot, period), make_observer(scene, tuning, resting)
        law: Law = make_law(scene, tuning, robot, limits, start, lambda p, q, force: q)
        law.prepare(resting)
        delay = scene.delay if tuning.model.predict_delay else 0
        age = tuning.observer.latency / period if tuning.observer else 0.0
        every = (scene.camera or IDEAL_CAMERA).every
        found = []
        for k in sorted({round(k) for k in np.linspace(0, scene.n_periods - 1, count).tolist()}):
            x, t = reference.states[k], k * period
            payload = float(scene.carried(np.array([t]))[0])
            if tuning.model.payload and scene.payload is not None:
                model.carry(payload, x)  # or put it down again
            there: LinearModel = linearise(model, x, np.zeros(n), period)
            _, stiffness, by_angle = target.force_and_jacobians(x[:2], x[4:], DERIVATIVE_ACCURACY)
            believed = Believed(there, stiffness.copy(), by_angle.copy(), None if observer is None else observer.gain,
                                delay, pull(tuning.model, period), age)  # fmt: skip
            feedback: Feedback = feedback_of(law, believed, limits, resting)
            phases = tuple(linear_controller(believed, feedback, seen=not phase) for phase in range(every))
            found.append(PoseOfReference(t, x.copy(), real.equilibrium(x), payload, phases))
        return found

    def _plant(self, robot: Robot) -> Plant:
        settings = self.scene.plant
        if settings.inertia == "full":  # modes of the rods, above what a controller reaches
            settings = replace(settings, inertia="condensed", integrator="rk4")
        return settings.make(robot)

    def at(self, pose: PoseOfReference, robot: Robot | None = None) -> LinearLoop:
        """The loop about a pose; of another robot, which the controller does not know."""
        scene = self.scene
        plant = self._plant(robot or scene.robot)
        plant.reset(pose.x, pose.pose)
        if pose.payload and scene.plant.payload == "carried":
            plant.carry(pose.payload, pose.x)
        lag = 0.0 if scene.motors is None or scene.plant.motors == "ideal" else scene.motors.time_constant
        return LinearLoop(
            pose.t, pose.x[:2].copy(), linear_plant(plant, pose.x), pose.controllers, scene.period,
            scene.delay * scene.period + scene.untold_delay, lag, (scene.camera or IDEAL_CAMERA).latency,
        )  # fmt: skip

    def all(self) -> list[LinearLoop]:
        """The loops about all poses."""
        return [self.at(pose) for pose in self.poses]


def _not_linear(scene: Scene, tuning: Tuning) -> str:
    """What of a loop has no place in a linear one that repeats; empty if there is nothing."""
    camera, observer = scene.camera, tuning.observer
    if camera is not None and camera.lost:
        return f"the camera loses {100 * camera.lost:g} % of its pictures, nobody knows which"
    if observer is not None and observer.adapts:
        return f"its observer adapts {', '.join(observer.adapts)}"
    return ""


def scaled(robot: Robot, *, stiffness: float = 1.0, mass: float = 1.0) -> Robot:
    """Return a robot whose EI of all rods and whose tip mass are so many times larger.

    Its motors have as much more torque, so that they hold the same poses.
    """
    rods = tuple(replace(rod, bending_stiffness=stiffness * rod.bending_stiffness) for rod in robot.rods)
    return replace(robot, rods=rods, tip_mass=mass * robot.tip_mass,
                   torque_limit=stiffness * robot.torque_limit)  # fmt: skip


def scaled_scene(scene: Scene, *, stiffness: float = 1.0, mass: float = 1.0) -> Scene:
    """Return a scene of such a robot: what its poses may take in torque is scaled too."""
    limits = scene.pose_limits
    if limits.torque is not None:
        limits = replace(limits, torque=stiffness * limits.torque)
    return replace(scene, robot=scaled(scene.robot, stiffness=stiffness, mass=mass), pose_limits=limits)
