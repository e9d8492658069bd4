"""The work of one control period: believe, look ahead, decide; and what it remembers until the next."""

from __future__ import annotations

import time
from collections import deque
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from ...control.laws import Law
from ...control.motor_limits import SAME_ANGLE, Limits
from ...control.mpc import LinearMPC
from ...control.observer import DisturbanceObserver
from ...control.plan import Plan
from ...control.qp.program import Reference
from ...errors import PCRError, checked_period, measured_vector
from ...frozen import made
from ...linearisation.linear_limits import LinearLimits
from ...linearisation.linear_model import LinearModel, LinearModels
from ...linearisation.pose_limits import LimitWatch
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.held_tip import solve_statics
from ..demand.track import Track
from ..hardware.past import PastEstimates
from ..learning.learner import Learner
from ..live.reference import LiveReference
from ..parts.assembled import resting_state
from ..parts.controllers import Decision
from ..parts.foresight import Foresight, Outlook
from ..parts.gate import Event, Gate
from ..parts.target import MotorTarget
from .adaptation import Adaptation

_SETTLING = 8  # looks ahead until the motor target carries a load that is known at the start


class ControlStep:
    """What a controller does in each period, with the parts that it is given; see `TrackingController`, which makes
    them.

    Parameters
    ----------
    robot : Robot
        What the controller believes the robot to be.
    period : float
        Control period [s].
    limits : Limits
        Of the motors.
    gate : Gate

    Attributes
    ----------
    law, foresight, observer, past, watch, track, learner, adaptation, delay, fallback
        Set, and set anew, by the controller between two steps: the control law, what looks ahead, the observer or None,
        estimates that late tips correct or None,
        the limits of a pose, windows of the reference, what learns from its laps or None, what adapts or None,
        the periods that are predicted over, and whether a failure is raised.
    inverse : MotorTarget
    pose : Equilibrium
        In which the robot was last known to be.
    k : int
        The last period.
    u, turning : ndarray, shape (n,)
        Rates of the last decision, and those at which the motors turn until the next step [rad/s].
    sent, on_the_way : deque of ndarray
        Rates that were told, over the real delay, and those of them that have not arrived, over the predicted one.
    plan : Plan or None
        The last.
    believed : (bool, bool)
        Whether the last measured tip was believed, and the last angles.
    """

    law: Law
    foresight: Foresight
    track: Track | LiveReference
    watch: LimitWatch
    pose: Equilibrium
    fallback: str

    def __init__(self, robot: Robot, period: float, limits: Limits, gate: Gate) -> None:
        self.robot, self.limits = robot, limits
        self._period, self._gate = period, gate
        self.observer: DisturbanceObserver | None = None
        self.past: PastEstimates | None = None
        self.learner: Learner | None = None
        self.adaptation: Adaptation | None = None
        self.inverse = MotorTarget(robot)
        self.delay, self.k, self.believed = 0, -1, (True, True)
        self.u = self.turning = np.zeros(robot.n_rods)
        self.sent: deque[np.ndarray] = deque()
        self.on_the_way: deque[np.ndarray] = deque()
        self.plan: Plan | None = None
        self._begun_anew = False  # by the tip of this period, against the estimate

    @property
    def expected(self) -> np.ndarray:
        """State that is expected at the next step, shape (4 + n,)."""
        return self.foresight.expected

    def restart(self, pose: Equilibrium, resting: LinearModel, delay: int) -> None:
        """Forget all periods: the robot rests in ``pose``, about which ``resting`` is the linear model.

        ``delay`` is the real one [periods].
        """
        x = resting_state(pose)
        self.foresight.reset(x, pose)
        self.foresight.expected[:] = x
        if self.observer is not None:
            self.observer.start(x)
        if self.past is not None:
            self.past.clear()
        self.watch.reset(x, pose)
        self.inverse.start(pose)
        self._gate.start(pose.q)
        if self.learner is not None:
            self.learner.reset()
        if self.adaptation is not None:
            self.adaptation.reset()
        self._predicts = LinearModels.of([resting])
        rest = np.zeros(self.robot.n_rods)
        self.sent = deque([rest] * delay, maxlen=delay)
        self.on_the_way = deque([rest] * self.delay)
        self.u = self.turning = rest
        self.plan, self.k = None, -1

    def stand(self, k: int, x: np.ndarray, pose: Equilibrium, force: np.ndarray) -> None:
        """Begin the estimates anew: state x, rods in ``pose``, a load ``force`` [N]; the last rates are kept."""
        foresight = self.foresight
        foresight.reset(x, pose)
        foresight.inputs["estimate"][:] = np.concatenate([x, force])
        # Where the commands that are on the way will have led; the last one is added in the step.
        foresight.inputs["reckoned"][:] = x[4:] + self._period * (sum(self.on_the_way, np.zeros(len(self.u))) - self.u)
        self.watch.reset(x, pose)
        self.inverse.start(pose)
        self._gate.start(x[4:], first=False)
        self.plan, self.pose = None, pose
        if self.past is not None:
            self.past.clear()
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
        foresight = self.foresight
        x, force = self.expected.copy(), foresight.force.copy()
        robot = None
        with suppress(PCRError):  # where the tip is expected the rods cannot be: the linear model goes on
            robot = foresight.plant_at(x, self._period)
        for _ in range(count):
            self._send(self.u)
            try:
                x = self._predicts.moved(0, x, self.turning) if robot is None else robot.step(x, self.turning, force)
            except PCRError:
                x = self._predicts.moved(0, x, self.turning)
        foresight.expected[:] = x
        self._gate.pass_by(count, x[4:])

    def coast(self) -> np.ndarray:
        """Bring the motors to rest, whatever is measured; return the rates of this period [rad/s]."""
        period, x = self._period, self.expected
        reckoned = self.foresight.inputs["reckoned"] + period * self.u
        u = self.limits.kept(self.limits.slowed(self.u), self.u, x[4:], period, reckoned)
        self._send(u)
        x[2:4] = 0.0
        x[4:] += period * self.turning
        self.plan = None
        return u

    def _send(self, u: np.ndarray) -> None:
        """Note rates that the motors are told without a step."""
        self.foresight.inputs["reckoned"][:] += self._period * self.u
        self.u = u
        self.sent.append(u)
        self.on_the_way.append(u)
        self.turning = self.on_the_way.popleft()

    def period_step(self, k: Any, x: Any) -> Decision:
        """Decide on period k from the measured state x."""
        k, x = checked_period("k", k), measured_vector("x", x, 4 + self.robot.n_rods)
        began = time.perf_counter()
        foresight = self.foresight
        events = self._believe(k, x, foresight)
        if self.adaptation is not None:
            self.adaptation.correct(foresight, seen=self.believed[0])
        self._tell(k, foresight)
        failure, pose_limits, outlook = "", None, None
        try:
            outlook = self._look_ahead(k, foresight)
            if not self.watch.idle:
                pose_limits = self._near(outlook)
        except (PCRError, ValueError) as error:
            if self.fallback == "raise":
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
        self.u = u = plan.inputs[0]
        self.plan = plan
        self.sent.append(u)
        self.on_the_way.append(u)
        arriving = self.turning = self.on_the_way.popleft()
        here = self._look_on(outlook, plan, estimate, arriving, foreseen=plan is decided and not self.delay)
        if self.adaptation is not None:
            self.adaptation.predict(self._predicts[0], estimate, here, force)
        foresight.expected[:], foresight.force[:] = here, force
        if self.past is not None:
            self.past.remember(corrected, self._predicts[0])
        return made(Decision, {"u": u, "plan": plan, "linearise_time": linearised - began, "estimate": estimate,
                               "force": force, "events": events})  # fmt: skip

    def _believe(self, k: int, x: np.ndarray, foresight: Foresight) -> tuple[Event, ...]:
        """Write what is believed of a measurement; what is not is as expected."""
        expected, observer, past = foresight.expected, self.observer, self.past
        if past is not None:
            # As far from where it is expected as it was from where it was when the picture was taken.
            x = np.concatenate([x[:2] + (expected[:2] - past.tip(expected)), x[2:]])
        found = self._gate.sift(k, x, expected, observer is None)
        self.k, self.believed = k, (found.p is not None, found.q is not None)
        if self.learner is not None:
            self.learner.see(k, found.p)
        if observer is None:
            if found.p is not None:
                expected[:2], expected[2:4] = found.p, x[2:4] if found.velocity is None else found.velocity
            if found.q is not None:
                expected[4:] = found.q
        elif found.velocity is not None:
            observer.move(found.p, found.velocity)
            if past is not None:
                past.clear()
        elif past is not None and found.p is not None:
            change = past.correct(observer.gain @ (np.array(found.p) - expected[:2]))
            expected[:4] += change[:4]
            foresight.force[:] += change[4:]
            found.p = None  # it is done with
        self._begun_anew = found.velocity is not None
        p = expected[:2] if found.p is None else found.p
        foresight.measured[:] = [*p, *(expected[4:] if found.q is None else found.q)]
        return found.events

    def _look_ahead(self, k: int, foresight: Foresight) -> Outlook:
        """Where a tip was believed against the estimate: if rods and plan lead nowhere, from where the robot is."""
        if not self._begun_anew:
            return foresight()
        reckoned = foresight.inputs["reckoned"].copy()
        try:
            return foresight()
        except (PCRError, ValueError):
            x = self.expected
            pose = solve_statics(self.robot, x[:2], x[4:], guess=self.pose)
            self._predicts, self.plan = LinearModels.of([foresight.follow(x, pose)]), None
            self.watch.reset(x, pose)
            foresight.inputs["reckoned"][:] = reckoned
            self._tell(k, foresight)
            return foresight()

    def _tell(self, k: int, foresight: Foresight) -> None:
        """Write the rest of what is known in period k into the graph that looks ahead."""
        rows, track = foresight.rows, self.track
        for j, u in enumerate(self.on_the_way):
            rows["on_the_way"][j] = u
        foresight.u_previous[:] = self.u
        foresight.window[:] = track.window(k, self.delay)
        places = foresight.places
        if track.carries:
            rows["payloads"][:, 0] = track.payloads(k, places.count)
        if places.models > 1:
            # The last plan, one period on; at the start, and beyond the end of a shorter plan, the reference.
            path = rows["path"]
            known = None if self.plan is None else self.plan.states
            if known is not None and len(known) == len(path) + 2:
                path[:] = known[2:]
            else:
                path[:] = rows["states"][:-1]
                if known is not None:
                    path[: len(known) - 2] = known[2 : 2 + len(path)]

    def _near(self, outlook: Outlook) -> LinearLimits | None:
        """Limits of the pose ahead that are near."""
        if self.watch.follows_model:
            if self.watch.far(outlook.signs.tolist()):
                return None
            self.watch.recall(outlook.record)
        return self.watch.rows(outlook.ahead.copy())

    def _decide(self, outlook: Outlook, pose_limits: LinearLimits | None, began: float) -> Plan:
        """The law's plan."""
        law, ahead, models, window = self.law, outlook.ahead, outlook.models, outlook.reference
        if isinstance(law, LinearMPC):
            assert outlook.qp is not None
            return law.decide(outlook.qp, ahead, models, window, self.u, pose_limits, began)
        return law.solve(ahead.copy(), models.copy(), window, self.u, pose_limits)

    def _fall_back(self, failure: str, estimate: np.ndarray, force: np.ndarray, foresight: Foresight) -> Plan:
        """The law's plan where there are no linear models."""
        states, n = foresight.rows["states"].copy(), self.robot.n_rods
        states[:, 4:] += foresight.inputs["shift"]
        forces = foresight.window[:, 4 + 2 * n :] + force
        return self.law.fall_back(failure, estimate, Reference(states, foresight.rows["inputs"], forces), self.u)

    def _look_on(
        self, outlook: Outlook | None, plan: Plan, estimate: np.ndarray, arriving: np.ndarray, *, foreseen: bool
    ) -> np.ndarray:
        """Foresee the state at the next measurement; the plan has ``foreseen`` it if its first rates act at once."""
        if outlook is not None:
            if self.delay:
                self._predicts = outlook.now.copy()
                return outlook.arriving
            if self.foresight.pull.item() < 1.0:
                # The plan is of commanded angles, and so are its states and models.
                self._predicts = outlook.first.copy()
            else:
                # A plan may know better than the models that it was asked for with.
                better = outlook.models.copy() if plan.models is None or plan.fallback else plan.models
                self._predicts = LinearModels.of([better] if isinstance(better, LinearModel) else better)
                if foreseen and plan.states is not None and not plan.fallback:
                    return np.asarray(plan.states[1])
        return self._predicts.moved(0, estimate, arriving)

    def _within_stops(self, plan: Plan, ahead: np.ndarray, foresight: Foresight) -> Plan:
        """The plan, its first rates within the stops for the sum of the commands too: a wrong angle may be measured."""
        if foresight.strayed <= SAME_ANGLE and ahead is foresight.outlook.ahead:
            return plan  # of one opinion, as the law was
        first = plan.inputs[0]
        kept = self.limits.kept(first, self.u, ahead[4:], self._period, foresight.outlook.reckoned)
        if kept.tolist() == first.tolist():
            return plan
        active = plan.active if "angle" in plan.active else (*plan.active, "angle")
        return replace(plan, inputs=np.vstack([kept, plan.inputs[1:]]), active=active)
