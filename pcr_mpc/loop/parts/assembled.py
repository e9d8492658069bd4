"""What a scene's controller is put together from, each part as scene and tuning want it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ...control.laws import LQR, PD, FeedForward, Law
from ...control.motor_limits import Limits
from ...control.mpc import LinearMPC
from ...control.nonlinear.nonlinear_mpc import NonlinearMPC
from ...control.observer import DisturbanceObserver
from ...control.qp.program import motor_bounds, stage_weights
from ...control.tuning import Model, Tuning
from ...errors import ModelError
from ...linearisation.linear_model import LinearModel
from ...linearisation.linearise import linearise
from ...plant.motion.plant import Plant
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.held_tip import default_method
from ...plant.statics.symbolic import rod_unknowns, symbolic_dynamics
from ..hardware.past import PastEstimates
from ..scene.scene import Scene
from .foresight import Foresight
from .foresight_graph import Places
from .gate import Gate

# In which an angle that was commanded and is not measured counts as lost [s]: many times what motors lag.
_FORGETTING = 2.0
_SLOW = 0.01  # of the greatest rate: from slower motions no lag is learnt


def motor_limits(robot: Robot, period: float) -> Limits:
    """Limits of the robot's motors as the controller needs them."""
    lower, upper = robot.angle_limits.T
    return Limits(robot.rate_limit, robot.acceleration_limit * period, lower.copy(), upper.copy())


def make_model(robot: Robot, model: Model) -> Plant:
    """Plant that is linearised.

    Raises
    ------
    ModelError
        The tuning names a method that does not hold for the robot's rods.
    """
    # Weight alone has its share in the closed form too, by the first order.
    method = default_method(robot.weightless())
    if model.method == "closed_form" != method:
        raise ModelError(
            f"[model] method of the tuning is 'closed_form', which is for uniform, straight, inextensible rods, and "
            f"{robot.weightless().needs_shooting}; leave method out of [model], and what the rods need is taken, or "
            f"set it to {method!r}",
            key="model.method",
        )
    return Plant(
        robot, method=model.method or method, segments=model.segments, steps=model.steps, scheme=model.scheme,
        inertia=model.inertia, compiled=model.compiled,
    )  # fmt: skip


def resting_state(pose: Equilibrium) -> np.ndarray:
    """State of a robot that rests in ``pose``, shape (4 + n,)."""
    return np.concatenate([pose.p, np.zeros(2), pose.q])


def resting_model(robot: Robot, model: Model, pose: Equilibrium, period: float) -> LinearModel:
    """Linear model about a pose in which the robot rests."""
    plant, x = make_model(robot, model), resting_state(pose)
    plant.reset(x, pose)
    return linearise(plant, x, np.zeros(robot.n_rods), period)


def make_gate(scene: Scene, tuning: Tuning, robot: Robot, limits: Limits) -> Gate:
    """Gate for the scene's sensors."""
    return Gate(robot, limits, scene.period, tip_noise(scene, tuning), scene.angle_step, scene.wrapped,
                1 if scene.camera is None else scene.camera.every)  # fmt: skip


def tip_noise(scene: Scene, tuning: Tuning) -> float:
    """Standard deviation of the measured tip position that a controller reckons with [m]."""
    return max(scene.tip_noise, tuning.observer.tip_noise if tuning.observer else 0.0)


def make_observer(scene: Scene, tuning: Tuning, resting: LinearModel) -> DisturbanceObserver | None:
    """Observer, if the tuning wants one; ``resting`` is the linear model about the start."""
    if tuning.observer is None:
        return None
    every = 1 if scene.camera is None else scene.camera.every
    return DisturbanceObserver(tuning.observer, scene.tip_noise, scene.angle_step, resting, every)


def make_past(tuning: Tuning, period: float) -> PastEstimates | None:
    """Past estimates, if the tuning says that measured tips are late."""
    if tuning.observer is None or tuning.observer.latency <= 0.0:
        return None
    return PastEstimates(tuning.observer.latency / period, period)


def make_law(
    scene: Scene,
    tuning: Tuning,
    robot: Robot,
    limits: Limits,
    pose: Equilibrium,
    inverse: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
) -> Law:
    """Control law, for a robot that starts in ``pose``; ``inverse`` is what `PD` asks."""
    if tuning.law == "linear_mpc":
        return LinearMPC(tuning, limits)
    if tuning.law == "nonlinear_mpc":
        if scene.payload is not None:
            raise ValueError("the nonlinear MPC knows no payload; set [model] payload = false in its tuning")
        hands, algebraic = rod_unknowns(robot, pose)
        return NonlinearMPC(tuning, limits, symbolic_dynamics(robot, hands), algebraic)
    if tuning.law == "lqr":
        return LQR(tuning, limits)
    if tuning.law == "pd":
        return PD(tuning, limits, inverse)
    return FeedForward(tuning, limits)


def make_foresight(tuning: Tuning, law: Law, robot: Robot, delay: int, period: float) -> Foresight:
    """Graph that looks ahead ``delay`` periods and a horizon, the law's QP included."""
    models = tuning.horizon if tuning.model.linearise == "along_plan" else 1
    places = Places(delay, models, tuning.horizon)
    condense = law.condensing(robot.n_rods, models) if isinstance(law, LinearMPC) else None
    model = make_model(robot, tuning.model)
    target = Plant(robot, compiled=tuning.model.compiled)
    return Foresight(
        model, target, places, period, condense, commanded=tuning.model.angles == "commanded",
        compiled=tuning.model.compiled,
    )  # fmt: skip


def graph_of(tuning: Tuning) -> tuple[object, ...]:
    """What of a tuning that graph is made of."""
    weighed = tuning.velocity_weight > 0, tuning.angle_weight > 0
    return tuning.model, tuning.horizon, tuning.law, *weighed


def write_constants(
    foresight: Foresight, tuning: Tuning, law: Law, limits: Limits, observer: DisturbanceObserver | None
) -> None:
    """Write into the graph what does not change from step to step, and let the observer live in it."""
    given = foresight.inputs
    if isinstance(law, LinearMPC):
        given["weights"][:] = stage_weights(tuning)
        given["bounds"][:] = motor_bounds(limits)
        given["terminal"][:] = law.terminal
    if observer is not None:
        given["gain"][:], given["half_step"][:] = observer.gain, observer.half_step
        observer.live_in(given["estimate"])
    else:
        given["gain"][:], given["half_step"][:], given["estimate"][-2:] = 0.0, 0.0, 0.0
    given["carries"][:] = observer is not None
    given["pull"][:] = pull(tuning.model, float(given["dt"][0]))
    slow = _SLOW * min(limits.rate, 1.0 / float(given["dt"][0]))
    given["prior"][:] = slow**2 * np.array([tuning.model.motor_lag, 1.0])


def pull(model: Model, period: float) -> float:
    """Share by which measured angles pull in a period those that are planned from; 1: these are the measured ones."""
    return 1.0 if model.angles == "measured" else -math.expm1(-period / _FORGETTING)
