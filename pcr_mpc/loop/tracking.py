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
from ..control.qp import QuadraticProgram, Reference, constraint_matrix, motor_bounds, stage_weights
from ..control.tuning import SAME_ANGLE, Limits, Tuning
from ..errors import PCRError, checked_period, measured_vector
from ..frozen import Remade, set_once
from ..linearisation.linear_limits import LinearLimits
from ..linearisation.linear_model import LinearModel, LinearModels
from ..linearisation.linearise import linearise
from ..linearisation.pose_limits import LimitWatch
from ..plant.motion.plant import Plant
from ..plant.robot import Robot
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.symbolic import rod_unknowns, symbolic_dynamics
from .controllers import Decision, HoldMotors
from .feed_forward import InverseDynamics, feed_forward, held
from .foresight import Foresight, Outlook
from .foresight_graph import Places
from .gate import Gate
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
        self._foresight: Foresight | None = None
        self._watch = LimitWatch(scene.pose_limits, self._make_model())
        self._limits = motor_limits(scene.robot, scene.period)
        self._gate = self._make_gate()
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
        if self._foresight is None:
            self._foresight = self._make_foresight()
        self._foresight.reset(x, pose)
        self._write_constants()
        self._watch.reset(x, pose)
        self._inverse.start(pose)
        self._gate.start(pose.q)
        self._reckoned = pose.q  # where the commands so far lead, whatever is measured
        self._predicts, self._next = LinearModels.of([resting]), x
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
            self._watch = LimitWatch(self._told.pose_limits, self._make_model())
        if self._law is None or self._foresight is None:
            self._foresight = None
            return
        here, last = self._expected(), self._foresight
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
        if tuning.law == old.law and not model_changed:
            self._law.retune(tuning)
        else:
            self._law = self._make_law(self._pose)
            self._law.prepare(resting, self._watch.combinations())
        if self._graph_of(tuning) == self._graph_of(old) and self._delay == last.places.delay:
            self._write_constants()
            return
        pose = last.pose(here)
        self._foresight = self._make_foresight()
        self._foresight.reset(here, pose)
        self._foresight.target_from(last)
        self._write_constants()
        if model_changed:
            self._watch.reset(here, pose)

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
        foresight, observer, now = self._foresight, self.observer, self._expected()
        found = self._gate.sift(k, x, now, observer is None)
        if observer is None:
            velocity = x[2:4] if found.velocity is None else found.velocity
            now = np.concatenate([now[:4] if found.p is None else np.concatenate([found.p, velocity]), now[4:]])
            if found.q is not None:
                now[4:] = found.q
        elif found.p is not None and found.velocity is not None:
            observer.move(found.p, found.velocity)
            now = observer.x
        self._tell(k, now, found.p, found.q)
        failure, pose_limits, outlook = "", None, None
        try:
            outlook = foresight()
            if not (self._watch.follows_model and self._watch.far(outlook.signs.tolist())):
                pose_limits = self._near(outlook)
        except (PCRError, ValueError) as error:
            if self.tuning.fallback == "raise":
                raise
            failure, outlook = f"no linear model: {error}", None
        corrected = foresight.corrected
        if observer is not None:
            observer.take(corrected)
        estimate, force = corrected[:-2].copy(), corrected[-2:].copy()
        linearised = time.perf_counter()
        decided, ahead = self._decide(k, outlook, pose_limits, estimate, force, failure, linearised)
        plan = self._within_stops(decided, ahead)
        self._u, self._plan = plan.inputs[0], plan
        self._reckoned = self._reckoned + self._scene.period * self._u
        self._sent.append(self._u)
        self._on_the_way.append(self._u)
        arriving = self._on_the_way.popleft()
        self._look_on(outlook, plan, estimate, arriving, foreseen=plan is decided and not self._delay)
        return Decision(plan.inputs[0], plan, linearised - began, estimate, force, found.events)

    def _tell(self, k: int, now: np.ndarray, p: np.ndarray | None, q: np.ndarray | None) -> None:
        """Write what is known in period k into the graph that looks ahead."""
        assert self._foresight is not None
        given, horizon, observer = self._foresight.inputs, self.tuning.horizon, self.observer
        given["estimate"][:-2] = now
        given["estimate"][-2:] = 0.0 if observer is None else observer.force
        given["measured"][:2] = now[:2] if p is None else p
        given["measured"][2:] = now[4:] if q is None else q
        rows = self._foresight.rows
        for j, u in enumerate(self._on_the_way):
            rows["on_the_way"][j] = u
        given["u_previous"][:] = self._u
        reference, row = self._rows(k, k + self._delay)
        rows["states"][:] = reference.states[row + 1 : row + 1 + horizon]
        rows["inputs"][:] = reference.inputs[row : row + horizon]
        given["end_force"][:] = reference.forces[row + horizon]
        count = self._foresight.places.count
        first = min(k, len(self._payloads) - count)
        rows["payloads"][:, 0] = self._payloads[first : first + count]
        if self._foresight.places.models > 1:
            # The last plan, one period on; at the start, and beyond the end of a shorter plan, the reference.
            reference, row = self._rows(k, k + self._delay + 1)
            path = reference.states[row : row + horizon - 1]
            if self._plan is not None and self._plan.states is not None:
                known = self._plan.states[2:]
                path = known if len(known) == len(path) else np.concatenate([known[: len(path)], path[len(known) :]])
            rows["path"][:] = path

    def _near(self, outlook: Outlook) -> LinearLimits | None:
        """Limits of the pose ahead that are near."""
        if self._watch.follows_model:
            self._watch.recall(outlook.record)
        return self._watch.rows(outlook.ahead.copy())

    def _decide(
        self,
        k: int,
        outlook: Outlook | None,
        pose_limits: LinearLimits | None,
        estimate: np.ndarray,
        force: np.ndarray,
        failure: str,
        began: float,
    ) -> tuple[Plan, np.ndarray]:
        """The law's plan, and the state from which it starts."""
        assert self._law is not None
        assert self._foresight is not None
        horizon = self.tuning.horizon
        reference, row = self._rows(k, k + self._delay)
        inputs, forces = reference.inputs[row : row + horizon], reference.forces[row + 1 : row + 1 + horizon]
        if outlook is None:
            states = reference.states[row + 1 : row + 1 + horizon].copy()
            states[:, 4:] += self._foresight.inputs["shift"]
            return self._law.fall_back(failure, estimate, Reference(states, inputs, forces + force), self._u), estimate
        window, ahead = Reference(outlook.states.copy(), inputs, forces + force), outlook.ahead.copy()
        if isinstance(self._law, LinearMPC):
            p, q, lower, upper, sizes = outlook.qp
            rows = constraint_matrix(horizon, self.robot.n_rods)
            qp = QuadraticProgram(p, q, rows, lower, upper, tuple(sizes.tolist()))
            models = outlook.models.copy()
            return self._law.decide(qp, ahead, models, window, self._u, pose_limits, began), ahead
        return self._law.solve(ahead, outlook.models.copy(), window, self._u, pose_limits), ahead

    def _look_on(
        self, outlook: Outlook | None, plan: Plan, estimate: np.ndarray, arriving: np.ndarray, *, foreseen: bool
    ) -> None:
        """Foresee the state at the next measurement; the plan has ``foreseen`` it if its first rates act at once."""
        if outlook is not None and self._delay:
            self._predicts = outlook.now.copy()
            self._next = outlook.arriving.copy()
        else:
            if outlook is not None:
                # A plan may know better than the models that it was asked for with.
                better = outlook.models.copy() if plan.models is None or plan.fallback else plan.models
                self._predicts = LinearModels.of([better] if isinstance(better, LinearModel) else better)
            if foreseen and plan.states is not None and not plan.fallback:
                self._next = plan.states[1].copy()
            else:
                self._next = self._predicts[0](estimate, arriving)
        if self.observer is not None:
            self.observer.x = self._next

    def _within_stops(self, plan: Plan, ahead: np.ndarray) -> Plan:
        """The plan, its first rates within the stops for the sum of the commands too: a wrong angle may be measured."""
        first = plan.inputs[0]
        if max(map(abs, (self._reckoned - ahead[4:]).tolist())) <= SAME_ANGLE:
            return plan  # of one opinion, as the law was
        kept = self._limits.kept(first, self._u, ahead[4:], self._scene.period, self._reckoned)
        if kept.tolist() == first.tolist():
            return plan
        active = plan.active if "angle" in plan.active else (*plan.active, "angle")
        return replace(plan, inputs=np.vstack([kept, plan.inputs[1:]]), active=active)

    def _rows(self, k: int, row: int) -> tuple[InverseDynamics, int]:
        """Where to read the reference's ``row`` in period k: beyond the scene's end its last point is held."""
        last = self._scene.n_periods
        if k < last:
            return self._reference, row
        if self._end is None:
            payload = float(self._payloads[-1])
            self._end = held(self._reference, last, self.robot, self._pose, payload, self.tuning.horizon)
        return self._end, 0

    def _expected(self) -> np.ndarray:
        """State that is expected at the next step."""
        return self._next if self.observer is None else self.observer.x

    def _take(self, tuning: Tuning) -> None:
        self.__dict__["tuning"], self.name = tuning, tuning.name
        # A payload that the model does not know is one that the scene does not have.
        self._scene = self._told if tuning.model.payload else replace(self._told, payload=None)
        self._delay = self._told.delay if tuning.model.predict_delay else 0

    def _invert_dynamics(self, known: InverseDynamics | None) -> None:
        tail, inertia = self.tuning.horizon + self._delay, self.tuning.model.inertia
        self._reference = known or feed_forward(self._scene, self.robot, self._pose, tail, inertia)
        # Longer than any place is ahead of the end.
        times = self._scene.period * np.arange(self._scene.n_periods + 2 * tail)
        self._payloads = self._scene.carried(times)

    def _rest(self) -> LinearModel:
        """Linear model about the start."""
        model, x = self._make_model(), np.concatenate([self._pose.p, np.zeros(2), self._pose.q])
        model.reset(x, self._pose)
        self._resting = linearise(model, x, np.zeros(self.robot.n_rods), self._scene.period)
        return self._resting

    def _make_foresight(self) -> Foresight:
        """Graph of the model, the law's QP included, with everything in it that does not change from step to step."""
        tuning, law = self.tuning, self._law
        models = tuning.horizon if tuning.model.linearise == "along_plan" else 1
        places = Places(self._delay, models, tuning.horizon)
        condense = law.condensing(self.robot.n_rods, models) if isinstance(law, LinearMPC) else None
        return Foresight(
            self._make_model(), Plant(self.robot), places, self._scene.period, condense, compiled=tuning.model.compiled
        )

    @staticmethod
    def _graph_of(tuning: Tuning) -> tuple[object, ...]:
        """What of a tuning the graph that looks ahead is made of."""
        weighed = tuning.velocity_weight > 0, tuning.angle_weight > 0
        return tuning.model, tuning.horizon, tuning.law, *weighed

    def _write_constants(self) -> None:
        """Write into the graph that looks ahead what does not change from step to step."""
        assert self._foresight is not None
        given = self._foresight.inputs
        if isinstance(self._law, LinearMPC):
            given["weights"][:] = stage_weights(self.tuning)
            given["bounds"][:] = motor_bounds(self._limits)
            given["terminal"][:] = self._law.terminal
        if self.observer is not None:
            given["gain"][:], given["half_step"][:] = self.observer.gain, self.observer.half_step
        given["carries"][:] = self.observer is not None

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
