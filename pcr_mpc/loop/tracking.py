"""The controller of a scene: estimate, linearise, decide by a control law, and say how."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from ..control.laws import LQR, PD, FeedForward, Law
from ..control.mpc import LinearMPC
from ..control.nonlinear_mpc import NonlinearMPC
from ..control.observer import DisturbanceObserver
from ..control.plan import Plan
from ..control.qp import Reference
from ..control.tuning import Limits, Tuning
from ..errors import PCRError, checked_period, measured_vector
from ..frozen import Remade, set_once
from ..linearisation.linear_limits import LinearLimits
from ..linearisation.linear_model import LinearModel
from ..linearisation.linearise import linearise
from ..linearisation.pose_limits import LimitWatch
from ..plant.dynamics import Plant
from ..plant.equilibrium import Equilibrium
from ..plant.robot import Robot
from ..plant.symbolic import rod_unknowns, symbolic_dynamics
from .along_plan import AlongPlan
from .controllers import Controller, Decision, HoldMotors
from .feed_forward import InverseDynamics, feed_forward, held
from .gate import Event, Gate
from .scene import Scene
from .target import MotorTarget


@set_once("make a new controller with it", "robot", tuning="call retune, which lets all of it take effect")
class TrackingController(Remade):
    """A control law behind an observer, a prediction of delays and a target that carries the unknown force.

    A pickled or copied one is made of the same, and begins with `start`.

    Parameters
    ----------
    scene : Scene
        Reference, period, delay, sensors and limits; not its loads.
    tuning : Tuning
        See `retune`.
    robot : Robot, optional
        What the controller believes the robot to be; by default the scene's.
    reference : InverseDynamics, optional
        Inverse dynamics of the scene's reference for that robot, as `feed_forward` finds them, if they are known
        already: most of what a start costs.
    """

    def __init__(
        self, scene: Scene, tuning: Tuning, robot: Robot | None = None, reference: InverseDynamics | None = None
    ) -> None:
        if scene.trajectory is None:
            raise ValueError(f"scene {scene.name} has no reference to track")
        self.tuning: Tuning
        self.robot = robot or scene.robot
        self.observer: DisturbanceObserver | None = None
        self._told, self._known = scene, reference
        self._take(tuning)
        needed = scene.n_periods + tuning.horizon + self._delay
        if reference is not None and len(reference.inputs) < needed:
            raise ValueError(f"reference has {len(reference.inputs)} periods; scene and horizon need {needed}")
        self._model = self._make_model()
        self._along = self._make_along()
        self._watch = LimitWatch(scene.pose_limits, self._model)
        self._limits = motor_limits(scene.robot, scene.period)
        self._gate = self._make_gate()
        self._target = MotorTarget(self.robot)
        self._sent: deque[np.ndarray] = deque(maxlen=scene.delay)
        self._on_the_way: deque[np.ndarray] = deque()
        self._u = np.zeros(self.robot.n_rods)
        self._plan: Plan | None = None
        self._inverse = MotorTarget(self.robot)
        self._law: Law | None = None
        self._end: InverseDynamics | None = None  # the last point of the reference, once it is held

    @property
    def reference(self) -> InverseDynamics:
        """Inverse dynamics of the scene's reference, from `start` on."""
        return self._reference

    def start(self, pose: Equilibrium) -> None:
        """See `Controller`; solves the inverse dynamics of the whole reference, if they are not known."""
        self._pose, self._end = pose, None
        self._invert_dynamics(self._known)
        x = np.concatenate([pose.p, np.zeros(2), pose.q])
        if self._law is None:
            self._law = self._make_law(pose)
        resting = self._rest()
        # One throw-away step pays for building graphs and workspaces before the clock runs.
        self._restart(x, pose, resting)
        self.step(0, x)
        self._restart(x, pose, resting)

    def _restart(self, x: np.ndarray, pose: Equilibrium, resting: LinearModel) -> None:
        """Forget everything: the robot rests in ``pose``, about which ``resting`` is the linear model."""
        assert self._law is not None
        self._law.reset()
        self._law.prepare(resting, self._watch.combinations())
        self.observer = self._make_observer(resting)
        if self.observer is not None:
            self.observer.start(x)
        for part in (self._model, self._watch, self._along):
            if part is not None:
                part.reset(x, pose)
        self._target.start(pose)
        self._inverse.start(pose)
        self._gate.start(pose.q)
        self._reckoned = pose.q  # where the commands so far lead, whatever is measured
        self._predicts, self._seen = resting, (x, np.zeros(self.robot.n_rods))
        self._sent.extend([np.zeros(self.robot.n_rods)] * self._told.delay)
        self._on_the_way = deque([np.zeros(self.robot.n_rods)] * self._delay)
        self._u = np.zeros(self.robot.n_rods)
        self._plan = None

    def retune(self, tuning: Tuning) -> None:
        """Let another tuning take effect, all of it, between two steps.

        Estimates, commands on the way, the branch of the rods and the last rates are kept. What the new tuning needs is
        made here, which may take a second; where it does not work out, the controller is as it was.

        Raises
        ------
        ValueError
            The tuning is for another control period, or for a law that does not fit the scene.
        PCRError
            The new model does not reach the reference or the pose where the robot is now.
        """
        period = self._told.period
        if tuning.period is not None and abs(tuning.period - period) > 1e-9 * period:
            raise ValueError(
                f"{tuning.name} is for a control period of {tuning.period} s, the controller runs at {period} s; "
                "make a new one for scene.tuned(tuning)"
            )
        before = self.__dict__.copy()
        try:
            self._retune(tuning)
        except BaseException:
            self.__dict__.clear()
            self.__dict__.update(before)
            raise
        self._now_made_of(tuning=tuning, reference=None)

    def _retune(self, tuning: Tuning) -> None:
        old, scene = self.tuning, self._scene
        self._take(tuning)
        self._known = None
        model_changed = tuning.model != old.model
        started = self._law is not None
        here = self._expected() if started else np.zeros(0)
        if model_changed:
            pose = self._model.equilibrium(here) if started else None
            self._model = self._make_model()
            self._watch = LimitWatch(self._told.pose_limits, self._model)
            if pose is not None:
                self._model.reset(here, pose)
                self._watch.reset(here, pose)
        if model_changed or tuning.horizon != old.horizon:
            self._along = self._make_along()
            if self._along is not None and started:
                self._along.reset(here, self._model.equilibrium(here))
        if not started:
            return
        needed = self._scene.n_periods + tuning.horizon + self._delay
        same_dynamics = (tuning.model.inertia, self._scene) == (old.model.inertia, scene)
        if not same_dynamics or len(self._reference.inputs) < needed:
            self._invert_dynamics(None)
        resting = self._rest() if model_changed else self._resting
        if model_changed or tuning.observer != old.observer:
            observer, self.observer = self.observer, self._make_observer(resting)
            if self.observer is not None:
                self.observer.start(here)
                if observer is not None:
                    self.observer.force = observer.force.copy()
        if self._delay != len(self._on_the_way):
            self._on_the_way = deque(list(self._sent)[len(self._sent) - self._delay :])
        assert self._law is not None
        if tuning.law == old.law and not model_changed:
            self._law.retune(tuning)
        else:
            self._law = self._make_law(self._pose)
            self._law.prepare(resting, self._watch.combinations())

    def step(self, k: int, x: Any) -> Decision:
        """See `Controller`; what cannot have been measured is bridged by the prediction, and told in an event.

        Parameters
        ----------
        k : int
            Control period; beyond the end of the scene the last point of the reference is held.
        x : array_like, shape (4 + n,)
            Measured state [m, m/s, rad]; what is missing is NaN. With an observer the velocity is not looked at.

        Raises
        ------
        PCRError
            The controller was not started.
        MeasurementError
            The first measurement is in other units, or its angles are wrapped.
        ValueError
            Names the argument: x has another shape, or k is no period.
        """
        if self._law is None:
            raise PCRError(f"controller {self.name} was not started: call start(pose) before the first step")
        k, x = checked_period("k", k), measured_vector("x", x, 4 + self.robot.n_rods)
        x, force, events = self._estimate(k, x)
        observer, estimate = self.observer, x
        began = time.perf_counter()
        failure, now, ahead = "", None, x
        models: LinearModel | list[LinearModel] | None = None
        pose_limits: LinearLimits | None = None
        try:
            for j, u in enumerate(self._on_the_way):
                model = self._model_at(k + j, ahead, u, force)
                now = now or model
                ahead = model(ahead, u)
            models = self._linearise(ahead, k, force)
            pose_limits = self._watch.rows(ahead)
        except (PCRError, ValueError) as error:
            if self.tuning.fallback == "raise":
                raise
            failure, models = f"no linear model: {error}", None
        linearised = time.perf_counter() - began
        window = self._window(k, force)
        if models is None:
            plan = self._law.fall_back(failure, ahead, window, self._u)
        else:
            plan = self._law.solve(ahead, models, window, self._u, pose_limits)
        plan = self._within_stops(plan, ahead)
        self._u, self._plan = plan.inputs[0], plan
        self._sent.append(self._u)
        self._reckoned = self._reckoned + self._scene.period * self._u
        self._on_the_way.append(self._u)
        arriving = self._on_the_way.popleft()
        if now is not None:
            self._predicts = now
        elif models is not None:
            # A plan may know better than the models that it was asked for with.
            better = models if plan.models is None or plan.fallback else plan.models
            self._predicts = better if isinstance(better, LinearModel) else better[0]
        if observer is not None:
            observer.predict(self._predicts, arriving)
        self._seen = x, arriving
        return Decision(plan.inputs[0], plan, linearised, estimate, force, events)

    def _estimate(self, k: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[Event, ...]]:
        """State [m, m/s, rad] and unknown force [N] after what of the measured state is to be believed."""
        observer = self.observer
        expected = self._expected()
        found = self._gate.sift(k, x, expected, observer is None)
        if observer is None:
            velocity = x[2:4] if found.velocity is None else found.velocity
            tip = expected[:4] if found.p is None else np.concatenate([found.p, velocity])
            q = expected[4:] if found.q is None else found.q
            return np.concatenate([tip, q]), np.zeros(2), found.events
        if found.p is not None and found.velocity is not None:
            observer.move(found.p, found.velocity)
        observer.correct(found.p, found.q)
        return observer.x, observer.force, found.events

    def _within_stops(self, plan: Plan, ahead: np.ndarray) -> Plan:
        """The plan, its first rates within the stops for the sum of the commands too: a wrong angle may be measured."""
        first = plan.inputs[0]
        kept = self._limits.kept(first, self._u, ahead[4:], self._scene.period, self._reckoned)
        if kept.tolist() == first.tolist():
            return plan
        active = plan.active if "angle" in plan.active else (*plan.active, "angle")
        return replace(plan, inputs=np.vstack([kept, plan.inputs[1:]]), active=active)

    def _linearise(self, x: np.ndarray, k: int, force: np.ndarray) -> LinearModel | list[LinearModel]:
        here = self._model_at(k + self._delay, x, self._u, force)
        if self._along is None:
            return here
        first = k + self._delay + 1
        # The last plan, one period on; at the start, and beyond the end of a shorter plan, the reference.
        reference, row = self._rows(k, first)
        path = reference.states[row : row + self.tuning.horizon - 1]
        if self._plan is not None and self._plan.states is not None:
            known = self._plan.states[2:]
            path = known if len(known) == len(path) else np.concatenate([known[: len(path)], path[len(known) :]])
        last = len(self._payloads) - 1
        payloads = self._payloads[[min(j, last) for j in range(first, first + len(path))]]
        return [here, *self._along.models(path, self._u, force, payloads)]

    def _model_at(self, k: int, x: np.ndarray, u: np.ndarray, force: np.ndarray) -> LinearModel:
        """Linear model about x, with what the tip carries in period k."""
        payload = float(self._payloads[min(k, len(self._payloads) - 1)])
        if payload != self._model.payload:
            self._model.carry(payload, x)
        return linearise(self._model, x, u, self._scene.period, force)

    def _rows(self, k: int, row: int) -> tuple[InverseDynamics, int]:
        """Where to read the reference's ``row`` in period k: beyond the scene's end its last point is held."""
        last = self._scene.n_periods
        if k < last:
            return self._reference, row
        if self._end is None:
            payload = float(self._payloads[-1])
            self._end = held(self._reference, last, self.robot, self._pose, payload, self.tuning.horizon)
        return self._end, 0

    def _window(self, k: int, force: np.ndarray) -> Reference:
        """Reference over the horizon of a decision in period k, its angles moved to carry the unknown force."""
        horizon = self.tuning.horizon
        reference, row = self._rows(k, k + self._delay)
        states, inputs = reference.states[row + 1 : row + 1 + horizon], reference.inputs[row : row + horizon]
        forces = reference.forces[row + 1 : row + 1 + horizon]
        if self.observer is not None:
            end, lever = states[-1], reference.angles_per_force[row + horizon]
            forces = forces + force
            shift = self._target.small_shift(end[:2], end[4:], lever, force)
            states = states.copy()
            states[:, 4:] += self._target.shift(end[:2], end[4:], forces[-1]) if shift is None else shift
        return Reference(states, inputs, forces)

    def _expected(self) -> np.ndarray:
        """State that is expected at the next step."""
        return self._predicts(*self._seen) if self.observer is None else self.observer.x

    def _take(self, tuning: Tuning) -> None:
        self.__dict__["tuning"], self.name = tuning, tuning.name
        # A payload that the model does not know is one that the scene does not have.
        self._scene = self._told if tuning.model.payload else replace(self._told, payload=None)
        self._delay = self._told.delay if tuning.model.predict_delay else 0

    def _invert_dynamics(self, known: InverseDynamics | None) -> None:
        tail, inertia = self.tuning.horizon + self._delay, self.tuning.model.inertia
        self._reference = known or feed_forward(self._scene, self.robot, self._pose, tail, inertia)
        self._payloads = self._scene.carried(self._scene.period * np.arange(self._scene.n_periods + tail))

    def _rest(self) -> LinearModel:
        """Linear model about the start."""
        model, x = self._make_model(), np.concatenate([self._pose.p, np.zeros(2), self._pose.q])
        model.reset(x, self._pose)
        self._resting = linearise(model, x, np.zeros(self.robot.n_rods), self._scene.period)
        return self._resting

    def _make_along(self) -> AlongPlan | None:
        if self.tuning.model.linearise != "along_plan":
            return None
        return AlongPlan([self._make_model() for _ in range(self.tuning.horizon - 1)], self._scene.period)

    def _make_gate(self) -> Gate:
        scene, observer = self._told, self.tuning.observer
        noise = max(scene.tip_noise, observer.tip_noise if observer else 0.0)
        return Gate(self.robot, self._limits, scene.period, noise, scene.angle_step, scene.wrapped)

    def _make_observer(self, resting: LinearModel) -> DisturbanceObserver | None:
        if self.tuning.observer is None:
            return None
        return DisturbanceObserver(self.tuning.observer, self._told.tip_noise, self._told.angle_step, resting)

    def _make_model(self) -> Plant:
        model = self.tuning.model
        return Plant(
            self.robot, method=model.method, segments=model.segments, steps=model.steps, scheme=model.scheme,
            inertia=model.inertia,
        )  # fmt: skip

    def _make_law(self, pose: Equilibrium) -> Law:
        tuning, limits = self.tuning, self._limits
        if tuning.law == "linear_mpc":
            return LinearMPC(tuning, limits)
        if tuning.law == "nonlinear_mpc":
            if self._scene.payload is not None:
                raise ValueError("the nonlinear MPC knows no payload; set [model] payload = false in its tuning")
            hands, algebraic = rod_unknowns(self.robot, pose)
            return NonlinearMPC(tuning, limits, symbolic_dynamics(self.robot, hands), algebraic)
        if tuning.law == "lqr":
            return LQR(tuning, limits)
        if tuning.law == "pd":
            return PD(tuning, limits, lambda p, q, force: q + self._inverse.shift(p, q, force))
        return FeedForward(tuning, limits)


def motor_limits(robot: Robot, period: float) -> Limits:
    """Limits of the robot's motors as the controller needs them."""
    lower, upper = robot.angle_limits.T
    return Limits(robot.rate_limit, robot.acceleration_limit * period, lower.copy(), upper.copy())


def make_controller(
    scene: Scene, tuning: Tuning | None = None, robot: Robot | None = None, reference: InverseDynamics | None = None
) -> Controller:
    """Build the controller of a scene: that of its tuning, or none where there is nothing to track.

    Parameters
    ----------
    tuning : Tuning, optional
        Instead of the scene's own.
    robot : Robot, optional
        What the controller believes the robot to be.
    reference : InverseDynamics, optional
        Inverse dynamics that are known already (see `TrackingController`).
    """
    tuning = tuning or scene.tuning
    if scene.trajectory is None or tuning is None:
        return HoldMotors(scene.robot.n_rods)
    return TrackingController(scene, tuning, robot, reference)
