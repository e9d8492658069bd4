"""The controller of a scene: estimate, linearise, decide by a control law, and say how."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...control.laws import Law
from ...control.observer import DisturbanceObserver, ObserverTuning
from ...control.tuning import Tuning
from ...errors import PCRError, checked_vector
from ...frozen import Remade, set_once
from ...linearisation.linear_model import LinearModel
from ...linearisation.pose_limits import LimitWatch
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ..demand.feed_forward import InverseDynamics, feed_forward
from ..demand.track import track_of
from ..learning.learner import learning_on
from ..live.loop import LiveLoop
from ..live.on_the_fly import OnTheFly
from ..live.rows import Asked
from ..parts.assembled import (
    graph_of,
    make_foresight,
    make_gate,
    make_law,
    make_model,
    make_observer,
    make_past,
    motor_limits,
    resting_model,
    resting_state,
    write_constants,
)
from ..parts.controllers import Decision
from ..parts.foresight import Foresight
from ..parts.start_pose import StartPose, find_start
from ..scene.scene import Scene
from ..scene.sensors import Sensors, sensors_of
from .adaptation import adapt
from .control_step import ControlStep


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
        self.robot = robot = robot or scene.robot
        self._told, self._known, self._sensors = scene, reference, sensors or sensors_of(scene)
        limits = motor_limits(scene.robot, scene.period)
        self._work = ControlStep(robot, scene.period, limits, make_gate(scene, tuning, robot, limits))
        self._started = False
        self._take(tuning)
        needed = scene.n_periods + tuning.horizon + self._work.delay
        if reference is not None and len(reference.inputs) < needed:
            raise ValueError(f"reference has {len(reference.inputs)} periods; scene and horizon need {needed}")
        self._work.watch = LimitWatch(scene.pose_limits, make_model(robot, tuning.model))
        self._live: LiveLoop | None = None

    @property
    def observer(self) -> DisturbanceObserver | None:
        """Of the tip's velocity and the unknown force, if the tuning wants one; from `start` on."""
        return self._work.observer

    @property
    def work(self) -> ControlStep:
        """What is done in each period, with its parts; from `start` on."""
        return self._work

    @property
    def reference(self) -> InverseDynamics:
        """Inverse dynamics of the scene's reference, from `start` on."""
        return self._reference

    def start(
        self, pose: Equilibrium | ArrayLike, q: ArrayLike | None = None, *, mode: str | None = None,
        load: float | None = None, velocity: ArrayLike | None = None,
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
        velocity : array_like, shape (2,), optional
            Of the tip [m/s], where the robot passes through ``pose``, an equilibrium of its rods: what these carry is
            then taken for inertia, not for a load, and the reference begins there as from measurements.

        Raises
        ------
        MeasurementError, AmbiguousPoseError
            No pose, or more than one, fits the measurements.
        """
        if q is not None:
            self._start_live(find_start(self.robot, pose, q, sensors=self._sensors, mode=mode, load=load))
            return
        if velocity is not None and isinstance(pose, Equilibrium):
            self._start_live(StartPose(pose, np.zeros(2)), checked_vector("velocity", velocity, 2))
            return
        if not isinstance(pose, Equilibrium):
            raise ValueError(f"start({pose!r}): give an Equilibrium, or the measured tip and motor angles, start(p, q)")
        self._work.pose, self._live = pose, None
        self._invert_dynamics(self._known)
        self._begin(pose)

    def _start_live(self, found: StartPose, velocity: np.ndarray | None = None) -> None:
        """Get ready for a loop that keeps its own time, in a pose under a load, or in motion."""
        note = self._require_observer()
        self._work.pose, self._work.u = found.pose, np.zeros(self.robot.n_rods)
        live = self._live
        if live is None or not live.fits(self._asked()):
            live = self._make_live()
        live.reference.start(found.pose, 0)
        self._work.track = live.reference
        self._begin(found.pose)
        live.start(found, velocity=velocity)
        if self._scene.trajectory is not None:
            live.follow(self._scene.trajectory, None)
        live.notes += note

    def _begin(self, pose: Equilibrium) -> None:
        """Build what is needed, and begin at rest."""
        work, resting = self._work, self._rest()
        if not self._started:
            work.law = self._make_law()
            work.foresight = self._make_foresight()
            self._started = True
        # One throw-away step pays for building graphs and workspaces before the clock runs.
        self._restart(pose, resting)
        work.period_step(0, resting_state(pose))
        self._restart(pose, resting)

    def _restart(self, pose: Equilibrium, resting: LinearModel) -> None:
        """Forget everything: the robot rests in ``pose``, about which ``resting`` is the linear model."""
        work = self._work
        work.law.reset()
        work.law.prepare(resting, work.watch.combinations())
        work.observer = make_observer(self._told, self.tuning, resting)
        adapt(work, self.tuning, self._told, resting)
        work.past = make_past(self.tuning, self._told.period)
        work.restart(pose, resting, self._told.delay)
        write_constants(work.foresight, self.tuning, work.law, work.limits, work.observer)

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
        parts = (self, self._work, *([self._work.law] if self._started else []))
        before = [(part, part.__dict__.copy()) for part in parts]
        try:
            self._retune(tuning)
        except BaseException:
            for part, attributes in before:
                part.__dict__.clear()
                part.__dict__.update(attributes)
            raise
        self._now_made_of(tuning=tuning, reference=None)

    def _retune(self, tuning: Tuning) -> None:
        old, scene, work = self.tuning, self._scene, self._work
        self._take(tuning)
        self._known = None
        model_changed = tuning.model != old.model
        if model_changed:
            work.watch = LimitWatch(self._told.pose_limits, make_model(self.robot, tuning.model))
        if not self._started:
            return
        last = work.foresight
        here = last.expected.copy()
        needed = self._scene.n_periods + tuning.horizon + work.delay
        same_dynamics = (tuning.model.inertia, self._scene) == (old.model.inertia, scene)
        if self._live is not None:
            self._live.ask(self._asked())
            work.track = self._live.reference
        else:
            known = self._reference if same_dynamics and len(self._reference.inputs) >= needed else None
            self._invert_dynamics(known)
        resting = self._rest() if model_changed else self._resting
        observer = work.observer
        if model_changed or tuning.observer != old.observer:
            work.observer, work.past = make_observer(self._told, tuning, resting), make_past(tuning, self._told.period)
            if work.observer is not None:
                work.observer.start(here)
                if observer is not None:
                    work.observer.force = observer.force
        adapt(work, self.tuning, self._told, resting)
        if work.delay != len(work.on_the_way):
            work.on_the_way = deque(list(work.sent)[len(work.sent) - work.delay :])
        if tuning.law == old.law and not model_changed:
            work.law.retune(tuning)
        else:
            work.law = self._make_law()
            work.law.prepare(resting, work.watch.combinations())
        if graph_of(tuning) != graph_of(old) or work.delay != last.places.delay:
            pose = last.pose(here)
            work.foresight = self._make_foresight()
            work.foresight.reset(here, pose)
            work.foresight.target_from(last)
            work.foresight.expected[:] = here
            if model_changed:
                work.watch.reset(here, pose)
        write_constants(work.foresight, tuning, work.law, work.limits, work.observer)

    def _on_the_fly(self) -> LiveLoop:
        """See `OnTheFly`; made when it is first asked for."""
        if not self._started:
            raise PCRError(f"controller {self.name} was not started: call start(pose) or start(p, q) first")
        if self._live is None:
            note = self._require_observer()
            self._live = self._make_live()
            self._live.notes += note
            self._live.take_over(self._reference, self._work.k, self._work.pose, self._scene.trajectory)
            self._work.track = self._live.reference
        return self._live

    def _make_live(self) -> LiveLoop:
        self._work.learner, self._live = None, LiveLoop(self._work, self._asked(), self._sensors)
        return self._live

    def _require_observer(self) -> list[tuple[str, str]]:
        """Put the default observer into a tuning that has none: nobody measures the velocity in a loop of one's own."""
        name, notes = self.tuning.name, []
        if self.tuning.learning is not None:
            notes.append(("learning", f"tuning {name} learns from laps, which a reference that may change has not"))
        if self.tuning.observer is None:
            self.retune(replace(self.tuning, observer=ObserverTuning()))
            notes.append(("observer", f"tuning {name} has no observer, and no velocity is measured: the default "
                          "observer estimates it, and an unknown force"))  # fmt: skip
        return notes

    def _asked(self) -> Asked:
        scene, tuning = self._scene, self.tuning
        return Asked(self.robot, scene.period, self._work.delay, tuning.horizon, tuning.model.inertia, scene.payload,
                     tuning.model.compiled)  # fmt: skip

    def period_step(self, k: Any, x: Any) -> Decision:
        """`step` of period k from the measured state x."""
        if not self._started:
            raise PCRError(f"controller {self.name} was not started: call start(pose) before the first step")
        return self._work.period_step(k, x)

    def _take(self, tuning: Tuning) -> None:
        self.__dict__["tuning"], self.name = tuning, tuning.name
        # A payload that the model does not know is one that the scene does not have.
        self._scene = self._told if tuning.model.payload else replace(self._told, payload=None)
        self._work.delay = self._told.delay if tuning.model.predict_delay else 0
        self._work.fallback = tuning.fallback

    def _invert_dynamics(self, known: InverseDynamics | None) -> None:
        scene, work, horizon = self._scene, self._work, self.tuning.horizon
        tail = horizon + work.delay
        self._reference = known or feed_forward(scene, self.robot, work.pose, tail, self.tuning.model.inertia)
        track = track_of(scene, self.robot, work.pose, self._reference, horizon, tail)
        work.track, work.learner = learning_on(track, scene, self.tuning, work, self._reference, work.learner)

    def _rest(self) -> LinearModel:
        """Linear model about the start."""
        self._resting = resting_model(self.robot, self.tuning.model, self._work.pose, self._scene.period)
        return self._resting

    def _make_law(self) -> Law:
        work = self._work
        return make_law(self._scene, self.tuning, self.robot, work.limits, work.pose, work.inverse.angles)

    def _make_foresight(self) -> Foresight:
        work = self._work
        return make_foresight(self.tuning, work.law, self.robot, work.delay, self._scene.period)
