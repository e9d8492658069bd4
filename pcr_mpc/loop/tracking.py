"""The controller of a scene: estimate, linearise, decide by a control law, and say how."""

from __future__ import annotations

import time
from collections import deque
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..control.laws import Law
from ..control.mpc import LinearMPC
from ..control.observer import DisturbanceObserver, ObserverTuning
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
from .live.loop import LiveLoop
from .live.motions import as_trajectory
from .live.on_the_fly import OnTheFly
from .live.reference import LiveReference
from .live.rows import Asked
from .live.scene import live_scene
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
from .sensors import EXACT_SENSORS, Sensors, sensors_of
from .start_pose import StartPose, find_start
from .target import MotorTarget
from .track import Track

_SETTLING = 8  # looks ahead until the motor target carries a load that is known at the start

__all__ = ["TrackingController", "make_controller", "motor_limits"]


@set_once("make a new controller with it", "robot", tuning="call retune, which lets all of it take effect")
class TrackingController(OnTheFly, Remade):
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
    sensors : Sensors, optional
        Beside what the scene says of them, for how long they are bridged.
    """

    def __init__(
        self, scene: Scene, tuning: Tuning, robot: Robot | None = None, reference: InverseDynamics | None = None,
        sensors: Sensors | None = None,
    ) -> None:  # fmt: skip
        if scene.trajectory is None and sensors is None:
            raise ValueError(f"scene {scene.name} has no reference to track")
        self.tuning: Tuning
        self.robot = robot or scene.robot
        self.observer: DisturbanceObserver | None = None
        self._told, self._known, self._sensors = scene, reference, sensors or sensors_of(scene)
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
        self._live: LiveLoop | None = None
        self._track: Track | LiveReference
        self._k, self._believed, self._turning = -1, (True, True), np.zeros(self.robot.n_rods)

    @property
    def reference(self) -> InverseDynamics:
        """Inverse dynamics of the scene's reference, from `start` on."""
        return self._reference

    def start(
        self, pose: Equilibrium | ArrayLike, q: ArrayLike | None = None, *, mode: str | None = None,
        load: float | None = None,
    ) -> None:  # fmt: skip
        """Get ready, in a pose or where the robot is measured to stand.

        In a pose the inverse dynamics of the whole reference are solved, if they are not known. From measurements, the
        reference is solved a little ahead while the robot moves, and joined from where the robot stands: then it may
        change on the fly.

        Parameters
        ----------
        pose : Equilibrium or array_like, shape (2,)
            In which the robot rests; or the measured position p of its tip [m].
        q : array_like, shape (n,), optional
            Measured motor angles [rad], with a measured tip. None: ``pose`` is an equilibrium.
        mode : str, optional
            Working mode, where several fit the measurements (see `find_start`).
        load : float, optional
            Greatest load that may act on the tip at the start [N] (see `find_start`).

        Raises
        ------
        MeasurementError, AmbiguousPoseError
            No pose, or more than one, fits the measurements.
        """
        if q is not None:
            self._start_live(find_start(self.robot, pose, q, sensors=self._sensors, mode=mode, load=load))
            return
        if not isinstance(pose, Equilibrium):
            raise ValueError(f"start({pose!r}): give an Equilibrium, or the measured tip and motor angles, start(p, q)")
        self._pose, self._live = pose, None
        self._invert_dynamics(self._known)
        self._begin(pose)

    def _start_live(self, found: StartPose) -> None:
        """Get ready for a loop that keeps its own time, in a pose under a load."""
        note = self._require_observer()
        self._pose, self._u = found.pose, np.zeros(self.robot.n_rods)
        live = self._live = (
            self._live if self._live is not None and self._live.fits(self._asked()) else self._make_live()
        )
        live.reference.start(found.pose, 0)
        self._track = live.reference
        self._begin(found.pose)
        live.start(found)
        if self._scene.trajectory is not None:
            live.follow(self._scene.trajectory, None)
        live.notes += note

    def _begin(self, pose: Equilibrium) -> None:
        """Build what is needed, and begin at rest."""
        x = np.concatenate([pose.p, np.zeros(2), pose.q])
        if self._law is None:
            self._law = self._make_law()
        resting = self._rest()
        # One throw-away step pays for building graphs and workspaces before the clock runs.
        self._restart(x, pose, resting)
        self.period_step(0, x)
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
        self._u = self._turning = np.zeros(self.robot.n_rods)
        self._plan, self._k = None, -1

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
        if self._live is not None:
            self._live.ask(self._asked())
            self._track = self._live.reference
        else:
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

    def _on_the_fly(self) -> LiveLoop:
        """See `OnTheFly`; made when it is first asked for."""
        if self._law is None or self._foresight is None:
            raise PCRError(f"controller {self.name} was not started: call start(pose) or start(p, q) first")
        if self._live is None:
            note = self._require_observer()
            self._live = self._make_live()
            self._live.notes += note
            self._live.take_over(self._reference, self._k, self._pose, self._scene.trajectory)
            self._track = self._live.reference
        return self._live

    def _require_observer(self) -> list[tuple[str, str]]:
        """Put the default observer into a tuning that has none: nobody measures the velocity in a loop of one's own."""
        if self.tuning.observer is not None:
            return []
        self.retune(replace(self.tuning, observer=ObserverTuning()))
        return [("observer", f"tuning {self.tuning.name} has no observer, and no velocity is measured: the default "
                 "observer estimates it, and an unknown force")]  # fmt: skip

    def _make_live(self) -> LiveLoop:
        return LiveLoop(self, self._asked(), self._sensors)

    def _asked(self) -> Asked:
        scene, tuning = self._scene, self.tuning
        return Asked(self.robot, scene.period, self._delay, tuning.horizon, tuning.model.inertia, scene.payload,
                     tuning.model.compiled)  # fmt: skip

    @property
    def expected(self) -> np.ndarray:
        """State that is expected at the next step, shape (4 + n,)."""
        assert self._foresight is not None
        return np.asarray(self._foresight.inputs["estimate"][:-2])

    @property
    def turning(self) -> np.ndarray:
        """Rates at which the motors turn until the next step [rad/s]."""
        return self._turning

    @property
    def believed(self) -> tuple[bool, bool]:
        """Whether the last measured tip was believed, and the last angles."""
        return self._believed

    def stand(self, k: int, x: np.ndarray, pose: Equilibrium, force: np.ndarray) -> None:
        """Begin the estimates anew: state x, rods in ``pose``, a load ``force`` [N]; the last rates are kept."""
        foresight, period = self._foresight, self._scene.period
        assert foresight is not None
        foresight.reset(x, pose)
        foresight.inputs["estimate"][:] = np.concatenate([x, force])
        # Where the commands that are on the way will have led; the last one is added in the step.
        foresight.inputs["reckoned"][:] = x[4:] + period * (sum(self._on_the_way, np.zeros(len(self._u))) - self._u)
        self._watch.reset(x, pose)
        self._inverse.start(pose)
        self._gate.start(x[4:], first=False)
        self._plan, self._pose = None, pose
        if not force.any():
            return
        # The motors carry the load from the first step on.
        foresight.inputs["measured"][:] = np.concatenate([x[:2], x[4:]])
        reckoned = foresight.inputs["reckoned"].copy()
        self._tell(k, foresight)
        with suppress(PCRError, ValueError):
            for _ in range(_SETTLING):
                foresight()
        foresight.inputs["reckoned"][:] = reckoned

    def pass_by(self, count: int) -> None:
        """Reckon ``count`` periods without a step, in which the motors were told nothing new."""
        foresight, period = self._foresight, self._scene.period
        assert foresight is not None
        x, force = self.expected.copy(), foresight.inputs["estimate"][-2:].copy()
        robot = foresight.plant_at(x, period)
        for _ in range(count):
            self._send(self._u)
            try:
                x = robot.step(x, self._turning, force)
            except PCRError:
                x = self._predicts[0](x, self._turning)
        foresight.inputs["estimate"][:-2] = x
        self._gate.pass_by(count, x[4:])

    def coast(self) -> np.ndarray:
        """Bring the motors to rest, whatever is measured; return the rates of this period [rad/s]."""
        foresight, period, x = self._foresight, self._scene.period, self.expected
        assert foresight is not None
        reckoned = foresight.inputs["reckoned"] + period * self._u
        u = self._limits.kept(self._limits.slowed(self._u), self._u, x[4:], period, reckoned)
        self._send(u)
        x[2:4] = 0.0
        x[4:] += period * self._turning
        self._plan = None
        return u

    def _send(self, u: np.ndarray) -> None:
        """Note rates that the motors are told without a step."""
        assert self._foresight is not None
        self._foresight.inputs["reckoned"][:] += self._scene.period * self._u
        self._u = u
        self._sent.append(u)
        self._on_the_way.append(u)
        self._turning = self._on_the_way.popleft()

    def period_step(self, k: Any, x: Any) -> Decision:
        """`step` of period k from the measured state x."""
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
        arriving = self._turning = self._on_the_way.popleft()
        here = self._look_on(outlook, plan, estimate, arriving, foreseen=plan is decided and not self._delay)
        known = foresight.inputs["estimate"]
        known[:-2], known[-2:] = here, force
        return Decision(u, plan, linearised - began, estimate, force, events)

    def _believe(self, k: int, x: np.ndarray, given: dict[str, np.ndarray]) -> tuple[Event, ...]:
        """Write what is believed of a measurement; what is not is as expected."""
        expected, observer = given["estimate"][:-2], self.observer
        found = self._gate.sift(k, x, expected, observer is None)
        self._k, self._believed = k, (found.p is not None, found.q is not None)
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
    scene: Scene | Robot,
    tuning: Tuning | Any = None,
    robot: Robot | Tuning | None = None,
    reference: InverseDynamics | None = None,
    *,
    path: Any = None,
    period: float | None = None,
    sensors: Sensors | None = None,
) -> TrackingController | HoldMotors:
    """Build the controller of a scene, or of a robot that is to follow a path.

    ``make_controller(scene)`` is that of the scene's tuning, or none where there is nothing to track;
    ``make_controller(robot, path, tuning, period=0.01)`` needs no scene.

    Parameters
    ----------
    scene : Scene or Robot
    tuning : Tuning or Trajectory, optional
        Instead of the scene's own; with a robot, the path (see ``path``), or None for a robot that is to hold.
    robot : Robot or Tuning, optional
        What the controller believes the robot of a scene to be; with a robot, the tuning.
    reference : InverseDynamics, optional
        Inverse dynamics of a scene that are known already (see `TrackingController`).
    path : Trajectory or callable, optional
        Of a robot, by name: a trajectory, or a function of time [s] that returns positions [m].
    period : float, optional
        Control period of a robot [s]. None: that of the tuning, or 10 ms.
    sensors : Sensors, optional
        Of a robot, or for a scene in the place of its own. None: those of the scene, or exact ones.

    Raises
    ------
    ValueError
        The arguments fit neither a scene nor a robot.
    """
    if isinstance(scene, Robot):
        if isinstance(tuning, Tuning) and not isinstance(robot, Tuning):
            tuning, robot = None, tuning
        if not isinstance(robot, Tuning):
            raise ValueError(
                f"make_controller(robot, path, tuning): tuning is {robot!r}, expected a Tuning; load_tuning reads one"
            )
        way = tuning if path is None else path
        own = robot.period or 0.01 if period is None else period
        made = live_scene(scene, None if way is None else as_trajectory(way), robot, own, sensors or EXACT_SENSORS)
        return TrackingController(made, robot, sensors=sensors or EXACT_SENSORS)
    if isinstance(robot, Tuning) or path is not None or period is not None:
        raise ValueError("a scene has a path, a period and a robot: make_controller(scene), or give a robot instead")
    tuning = tuning or scene.tuning
    if scene.trajectory is None or tuning is None:
        return HoldMotors(scene.robot.n_rods)
    if sensors is not None:
        scene = replace(scene, tip_noise=sensors.tip_noise, angle_step=sensors.angle_step, wrapped=sensors.wrapped,
                        delay=sensors.delay)  # fmt: skip
    return TrackingController(scene, tuning, robot, reference, sensors)
