"""What answers a measurement: a scene's controller in Python, or its generated C."""

from __future__ import annotations

import math
import tempfile
from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np

from ..codegen.folder import write_folder
from ..codegen.library import GeneratedController, build
from ..codegen.subject import Subject
from ..control.motor_limits import Limits
from ..errors import GenerationError, PCRError
from ..loop.controller.make_controller import make_controller
from ..loop.controller.tracking import TrackingController
from ..loop.parts.assembled import motor_limits
from ..loop.scene.scene import Scene
from .packet import RESTING, Command, Measurement

_RUNGS = {None: 0, "softened": 1, "shifted_plan": 2, "lqr": 3, "hold": 4}
# As far from the start of the scene a robot still stands there, in lengths of the shortest rod and in rad.
_NEAR, _TURNED = 0.0125, 0.05
_LONGEST_GAP = 100  # periods that a generated controller bridges
_AT_REST = 1e-12  # rad/s


def at_rest(command: Command) -> bool:
    """Whether a command holds the motors."""
    return float(np.abs(command.u).max()) <= _AT_REST


class Decider(ABC):
    """A scene's controller behind packets; whatever it is asked, it answers rates that keep the motors' limits.

    Attributes
    ----------
    n : int
        Motors.
    limits : Limits
        Of the motors.
    u : ndarray, shape (n,)
        Last rates [rad/s].
    """

    def __init__(self, scene: Scene) -> None:
        if scene.trajectory is None or scene.tuning is None:
            raise GenerationError(f"{scene.name}: there is nothing to track, so nothing to serve", part="reference")
        self._scene, self._pose = scene, scene.start()
        self.n = scene.robot.n_rods
        self.limits: Limits = motor_limits(scene.robot, scene.period)
        self.u, self._begun = np.zeros(self.n), False

    @property
    def period(self) -> float:
        """Control period [s]."""
        return self._scene.period

    def stop(self) -> None:
        """Get ready for the first measurement of a new run, at the start of the scene."""
        self._restart()
        self.u, self._begun = np.zeros(self.n), False

    def answer(self, found: Measurement) -> Command:
        """Decide on a measurement.

        Raises
        ------
        PCRError, ValueError
            There is no answer: the robot cannot be where it is said to be, for one.
        """
        if not self._begun:
            self._begin(found)
            self._begun = True
        command = self._decide(found)
        if not np.isfinite(command.u).all():
            raise PCRError(f"the controller answered {command.u} rad/s")
        self.u = command.u
        return command

    def rest(self, sequence: int, time: float) -> Command:
        """Brake the motors by one more period, as hard as they may."""
        self.u = self.limits.slowed(self.u)
        return Command(sequence, time, self.u, RESTING)

    def _at_start(self, found: Measurement) -> bool:
        """Whether a robot is found where the scene starts; NaN is nowhere."""
        away = math.hypot(*(found.p - self._pose.p).tolist())
        near = away <= _NEAR * self._scene.robot.lengths.min()
        return bool(near and np.abs(found.q - self._pose.q).max() <= _TURNED)

    @abstractmethod
    def _restart(self) -> None:
        """Start anew at the start of the scene."""

    @abstractmethod
    def _begin(self, found: Measurement) -> None:
        """Take in where the robot is, at the first measurement."""

    @abstractmethod
    def _decide(self, found: Measurement) -> Command:
        """Decide on a measurement."""


class PythonDecider(Decider):
    """The controller itself; a robot that is elsewhere than at the start of the scene joins the reference from there.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        first = make_controller(scene)
        assert isinstance(first, TrackingController)
        first.start(self._pose)
        # The inverse dynamics of the reference are most of what a start takes: they are found once.
        controller = make_controller(scene, reference=first.reference)
        assert isinstance(controller, TrackingController)
        self._controller = controller
        # What takes long is done before the first packet comes: one step pays for the loop's own parts.
        controller.start(self._pose)
        controller.step(tip=self._pose.p, angles=self._pose.q, time=0.0)
        self.stop()

    def _restart(self) -> None:
        self._controller.start(self._pose)

    def _begin(self, found: Measurement) -> None:
        if not self._at_start(found):
            self._controller.start(found.p, found.q)

    def _decide(self, found: Measurement) -> Command:
        decision = self._controller.step(tip=found.p, angles=found.q, time=found.time)
        plan, work = decision.plan, self._controller.work
        signs = work.foresight.outlook.signs
        doubts = sum(bit for bit, kept in zip((1, 2), work.believed, strict=True) if not kept)
        return Command(
            found.sequence, found.time, np.asarray(decision.u), _RUNGS[plan.fallback if plan else None], doubts,
            plan.iterations if plan else 0, float(signs[0]), signs[1 : 1 + self.n].copy(),
        )  # fmt: skip


class GeneratedDecider(Decider):
    """The controller as generated C, which is compiled first; the robot must stand where the scene starts.

    The reference goes by the time stamps: periods without a measurement are bridged by the prediction.

    Parameters
    ----------
    scene : Scene

    Raises
    ------
    GenerationError, CompilerError
        C does not have all of the scene yet; or there is no compiler.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        with tempfile.TemporaryDirectory() as folder:
            subject = Subject.of_scene(scene)
            write_folder(subject, None, Path(folder))
            self._controller = GeneratedController(build(Path(folder)), subject)
        self._zero, self._k = 0.0, -1
        self._nothing = [math.nan] * (4 + self.n)
        self.stop()

    def _restart(self) -> None:
        self._controller.start()

    def _begin(self, found: Measurement) -> None:
        if not self._at_start(found):
            raise PCRError(
                f"the robot stands at p = {found.p} m, q = {found.q} rad, the scene starts at p = {self._pose.p} m, "
                f"q = {self._pose.q} rad; move it there, or serve in Python, which joins the reference from elsewhere"
            )
        self._zero, self._k = found.time, -1

    def _decide(self, found: Measurement) -> Command:
        k = max(self._k + 1, round((found.time - self._zero) / self.period))
        if k - self._k > _LONGEST_GAP:
            raise PCRError(f"{k - self._k} periods without a measurement")
        controller = self._controller
        for _ in range(self._k + 1, k):
            controller.raw_step(self._nothing)
        controller.checked_step([*found.p.tolist(), 0.0, 0.0, *found.q.tolist()])
        self._k, out = k, controller.output
        return Command(found.sequence, found.time, np.array(out.u), out.rung, out.doubts & 3, out.iterations,
                       out.stiffness, np.array(out.torque))  # fmt: skip


def make_decider(scene: Scene, *, generated: bool) -> Decider:
    """The controller of a scene, in Python or as C."""
    return GeneratedDecider(scene) if generated else PythonDecider(scene)
