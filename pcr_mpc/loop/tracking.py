"""The controller of a scene: estimate, linearise, decide by a control law, and say how."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from ..control.laws import Law
from ..control.mpc import LinearMPC
from ..control.observer import DisturbanceObserver
from ..control.plan import Plan
from ..control.qp import Reference
from ..control.tuning import SAME_ANGLE, Tuning
from ..errors import PCRError, checked_period, measured_vector
from ..frozen import Remade, set_once
from ..linearisation.linear_limits import LinearLimits
from ..linearisation.linear_model import LinearModel, LinearModels
from ..linearisation.linearise import linearise
from ..linearisation.pose_limits import LimitWatch
from ..plant.robot import Robot
from ..plant.statics.equilibrium import Equilibrium
from .controllers import Decision, HoldMotors
from .feed_forward import InverseDynamics, feed_forward, held
from .foresight import Foresight, Outlook
from .gate import Event
from .parts import (
    graph_of,
    make_foresight,
    make_gate,
    make_law,
    make_model,
    make_observer,
    motor_limits,
    write_constants,
)
from .scene import Scene
from .target import MotorTarget
from .track import Track

__all__ = ["TrackingController", "make_controller", "motor_limits"]


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
        self._foresight: Foresight | None = None
        self._watch = LimitWatch(scene.pose_limits, make_model(self.robot, tuning.model))
        self._limits = motor_limits(scene.robot, scene.period)
        self._gate = make_gate(scene, tuning, self.robot, self._limits)
        self._sent: deque[np.ndarray] = deque(maxlen=scene.delay)
        self._on_the_way: deque[np.ndarray] = deque()
        self._u = np.zeros(self.robot.n_rods)
        self._plan: Plan | None = None
        self._inverse = MotorTarget(self.robot)
        self._law: Law | None = None

    @property
    def reference(self) -> InverseDynamics:
        """Inverse dynamics of the scene's reference, from `start` on."""
        return self._reference

    def start(self, pose: Equilibrium) -> None:
        """See `Controller`; solves the inverse dynamics of the whole reference, if they are not known."""
        self._pose = pose
        self._invert_dynamics(self._known)
        x = np.concatenate([pose.p, np.zeros(2), pose.q])
        if self._law is None:
            self._law = self._make_law()
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
        self.observer = make_observer(self._told, self.tuning, resting)
        if self._foresight is None:
            self._foresight = self._make_foresight()
        self._foresight.reset(x, pose)
        self._foresight.inputs["estimate"][:-2] = x
        if self.observer is not None:
            self.observer.start(x)
        write_constants(self._foresight, self.tuning, self._law, self._limits, self.observer)
        self._watch.reset(x, pose)
        self._inverse.start(pose)
        self._gate.start(pose.q)
        self._predicts = LinearModels.of([resting])
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
        # A law is retuned in place.
        before = [(part, part.__dict__.copy()) for part in (self, self._law) if part is not None]
        try:
            self._retune(tuning)
        except BaseException:
            for part, attributes in before:
                part.__dict__.clear()
                part.__dict__.update(attributes)
            raise
        self._now_made_of(tuning=tuning, reference=None)

    def _retune(self, tuning: Tuning) -> None:
        old, scene = self.tuning, self._scene
        self._take(tuning)
        self._known = None
        model_changed = tuning.model != old.model
        if model_changed:
            self._watch = LimitWatch(self._told.pose_limits, make_model(self.robot, tuning.model))
        if self._law is None or self._foresight is None:
            self._foresight = None
            return
        last = self._foresight
        here = last.inputs["estimate"][:-2].copy()
        needed = self._scene.n_periods + tuning.horizon + self._delay
        same_dynamics = (tuning.model.inertia, self._scene) == (old.model.inertia, scene)
        known = self._reference if same_dynamics and len(self._reference.inputs) >= needed else None
        self._invert_dynamics(known)
        resting = self._rest() if model_changed else self._resting
        observer = self.observer
        if model_changed or tuning.observer != old.observer:
            self.observer = make_observer(self._told, tuning, resting)
            if self.observer is not None:
                self.observer.start(here)
                if observer is not None:
                    self.observer.force = observer.force
        if self._delay != len(self._on_the_way):
            self._on_the_way = deque(list(self._sent)[len(self._sent) - self._delay :])
        if tuning.law == old.law and not model_changed:
            self._law.retune(tuning)
        else:
            self._law = self._make_law()
            self._law.prepare(resting, self._watch.combinations())
        if graph_of(tuning) != graph_of(old) or self._delay != last.places.delay:
            pose = last.pose(here)
            self._foresight = self._make_foresight()
            self._foresight.reset(here, pose)
            self._foresight.target_from(last)
            self._foresight.inputs["estimate"][:-2] = here
            if model_changed:
                self._watch.reset(here, pose)
        write_constants(self._foresight, tuning, self._law, self._limits, self.observer)

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
        if self._law is None or self._foresight is None:
            raise PCRError(f"controller {self.name} was not started: call start(pose) before the first step")
        k, x = checked_period("k", k), measured_vector("x", x, 4 + self.robot.n_rods)
        began = time.perf_counter()
        foresight = self._foresight
        events = self._believe(k, x, foresight.inputs)
        self._tell(k, foresight)
        failure, pose_limits, outlook = "", None, None
        try:
            outlook = foresight()
            if not self._watch.idle:
                pose_limits = self._near(outlook)
        except (PCRError, ValueError) as error:
            if self.tuning.fallback == "raise":
                raise
            failure, outlook = f"no linear model: {error}", None
        corrected = foresight.corrected.copy()
        estimate, force = corrected[:-2], corrected[-2:]
        linearised = time.perf_counter()
        if outlook is None:
            decided, ahead = self._fall_back(failure, estimate, force, foresight), estimate
        else:
            decided, ahead = self._decide(outlook, pose_limits, linearised), outlook.ahead
        plan = self._within_stops(decided, ahead, foresight)
        self._u = u = plan.inputs[0]
        self._plan = plan
        self._sent.append(u)
        self._on_the_way.append(u)
        arriving = self._on_the_way.popleft()
        here = self._look_on(outlook, plan, estimate, arriving, foreseen=plan is decided and not self._delay)
        known = foresight.inputs["estimate"]
        known[:-2], known[-2:] = here, force
        return Decision(u, plan, linearised - began, estimate, force, events)

    def _believe(self, k: int, x: np.ndarray, given: dict[str, np.ndarray]) -> tuple[Event, ...]:
        """Write what is believed of a measurement; what is not is as expected."""
        expected, observer = given["estimate"][:-2], self.observer
        found = self._gate.sift(k, x, expected, observer is None)
        if observer is None:
            if found.p is not None:
                expected[:2], expected[2:4] = found.p, x[2:4] if found.velocity is None else found.velocity
            if found.q is not None:
                expected[4:] = found.q
        elif found.velocity is not None:
            observer.move(found.p, found.velocity)
        measured = given["measured"]
        measured[:2] = expected[:2] if found.p is None else found.p
        measured[2:] = expected[4:] if found.q is None else found.q
        return found.events

    def _tell(self, k: int, foresight: Foresight) -> None:
        """Write the rest of what is known in period k into the graph that looks ahead."""
        rows, track = foresight.rows, self._track
        for j, u in enumerate(self._on_the_way):
            rows["on_the_way"][j] = u
        foresight.inputs["u_previous"][:] = self._u
        foresight.window[:] = track.window(k, self._delay)
        places = foresight.places
        if track.carries:
            rows["payloads"][:, 0] = track.payloads(k, places.count)
        if places.models > 1:
            # The last plan, one period on; at the start, and beyond the end of a shorter plan, the reference.
            path = rows["path"]
            known = None if self._plan is None else self._plan.states
            if known is not None and len(known) == len(path) + 2:
                path[:] = known[2:]
            else:
                path[:] = rows["states"][:-1]
                if known is not None:
                    path[: len(known) - 2] = known[2 : 2 + len(path)]

    def _near(self, outlook: Outlook) -> LinearLimits | None:
        """Limits of the pose ahead that are near."""
        if self._watch.follows_model:
            if self._watch.far(outlook.signs.tolist()):
                return None
            self._watch.recall(outlook.record)
        return self._watch.rows(outlook.ahead.copy())

    def _decide(self, outlook: Outlook, pose_limits: LinearLimits | None, began: float) -> Plan:
        """The law's plan."""
        law, ahead, models, window = self._law, outlook.ahead, outlook.models, outlook.reference
        assert law is not None
        if isinstance(law, LinearMPC):
            assert outlook.qp is not None
            return law.decide(outlook.qp, ahead, models, window, self._u, pose_limits, began)
        return law.solve(ahead.copy(), models.copy(), window, self._u, pose_limits)

    def _fall_back(self, failure: str, estimate: np.ndarray, force: np.ndarray, foresight: Foresight) -> Plan:
        """The law's plan where there are no linear models."""
        assert self._law is not None
        states, n = foresight.rows["states"].copy(), self.robot.n_rods
        states[:, 4:] += foresight.inputs["shift"]
        forces = foresight.window[:, 4 + 2 * n :] + force
        return self._law.fall_back(failure, estimate, Reference(states, foresight.rows["inputs"], forces), self._u)

    def _look_on(
        self, outlook: Outlook | None, plan: Plan, estimate: np.ndarray, arriving: np.ndarray, *, foreseen: bool
    ) -> np.ndarray:
        """Foresee the state at the next measurement; the plan has ``foreseen`` it if its first rates act at once."""
        if outlook is not None and self._delay:
            self._predicts = outlook.now.copy()
            return outlook.arriving
        if outlook is not None:
            # A plan may know better than the models that it was asked for with.
            better = outlook.models.copy() if plan.models is None or plan.fallback else plan.models
            self._predicts = LinearModels.of([better] if isinstance(better, LinearModel) else better)
        if foreseen and plan.states is not None and not plan.fallback:
            return np.asarray(plan.states[1])
        return self._predicts[0](estimate, arriving)

    def _within_stops(self, plan: Plan, ahead: np.ndarray, foresight: Foresight) -> Plan:
        """The plan, its first rates within the stops for the sum of the commands too: a wrong angle may be measured."""
        if foresight.strayed <= SAME_ANGLE and ahead is foresight.outlook.ahead:
            return plan  # of one opinion, as the law was
        first = plan.inputs[0]
        kept = self._limits.kept(first, self._u, ahead[4:], self._scene.period, foresight.outlook.reckoned)
        if kept.tolist() == first.tolist():
            return plan
        active = plan.active if "angle" in plan.active else (*plan.active, "angle")
        return replace(plan, inputs=np.vstack([kept, plan.inputs[1:]]), active=active)

    def _take(self, tuning: Tuning) -> None:
        self.__dict__["tuning"], self.name = tuning, tuning.name
        # A payload that the model does not know is one that the scene does not have.
        self._scene = self._told if tuning.model.payload else replace(self._told, payload=None)
        self._delay = self._told.delay if tuning.model.predict_delay else 0

    def _invert_dynamics(self, known: InverseDynamics | None) -> None:
        scene, tail, inertia = self._scene, self.tuning.horizon + self._delay, self.tuning.model.inertia
        self._reference = known or feed_forward(scene, self.robot, self._pose, tail, inertia)
        # Longer than any place is ahead of the end.
        payloads = scene.carried(scene.period * np.arange(scene.n_periods + 2 * tail))

        def hold() -> InverseDynamics:
            return held(self._reference, scene.n_periods, self.robot, self._pose, float(payloads[-1]), 1)

        self._track = Track(self._reference, payloads, scene.n_periods, self.tuning.horizon, hold)

    def _rest(self) -> LinearModel:
        """Linear model about the start."""
        model, x = make_model(self.robot, self.tuning.model), np.concatenate([self._pose.p, np.zeros(2), self._pose.q])
        model.reset(x, self._pose)
        self._resting = linearise(model, x, np.zeros(self.robot.n_rods), self._scene.period)
        return self._resting

    def _make_law(self) -> Law:
        def inverse(p: np.ndarray, q: np.ndarray, force: np.ndarray) -> np.ndarray:
            return np.asarray(q + self._inverse.shift(p, q, force))

        return make_law(self._scene, self.tuning, self.robot, self._limits, self._pose, inverse)

    def _make_foresight(self) -> Foresight:
        assert self._law is not None
        return make_foresight(self.tuning, self._law, self.robot, self._delay, self._scene.period)


def make_controller(
    scene: Scene, tuning: Tuning | None = None, robot: Robot | None = None, reference: InverseDynamics | None = None
) -> TrackingController | HoldMotors:
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
