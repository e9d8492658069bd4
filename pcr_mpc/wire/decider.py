"""What answers a measurement: a scene's controller, started where the robot is found."""

from __future__ import annotations

import math

import numpy as np

from ..control.tuning import Limits
from ..errors import GenerationError, PCRError
from ..loop.make_controller import make_controller
from ..loop.parts import motor_limits
from ..loop.scene import Scene
from ..loop.tracking import TrackingController
from .packet import RESTING, Command, Measurement

_RUNGS = {None: 0, "softened": 1, "shifted_plan": 2, "lqr": 3, "hold": 4}
# As far from the start of the scene a robot still stands there, in lengths of the shortest rod and in rad.
_NEAR, _TURNED = 0.0125, 0.05


class Decider:
    """A scene's controller behind packets; whatever it is asked, it answers rates that keep the motors' limits.

    Parameters
    ----------
    scene : Scene

    Attributes
    ----------
    limits : Limits
        Of the motors.
    u : ndarray, shape (n,)
        Last rates [rad/s].
    """

    def __init__(self, scene: Scene) -> None:
        first = make_controller(scene)
        if not isinstance(first, TrackingController):
            raise GenerationError(f"{scene.name}: there is nothing to track, so nothing to serve", part="reference")
        pose = scene.start()
        first.start(pose)
        # The inverse dynamics of the reference are most of what a start takes: they are found once.
        controller = make_controller(scene, reference=first.reference)
        assert isinstance(controller, TrackingController)
        self._scene, self._controller = scene, controller
        self.n = scene.robot.n_rods
        self.limits: Limits = motor_limits(scene.robot, scene.period)
        self.u = np.zeros(self.n)
        self._pose = pose
        # What takes long is done before the first packet comes: one step pays for the loop's own parts.
        controller.start(self._pose)
        controller.step(tip=self._pose.p, angles=self._pose.q, time=0.0)
        self.stop()

    @property
    def period(self) -> float:
        """Control period [s]."""
        return self._scene.period

    def stop(self) -> None:
        """Get ready for the first measurement of a new run, at the start of the scene."""
        self._controller.start(self._pose)
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
        decision = self._controller.step(tip=found.p, angles=found.q, time=found.time)
        u = np.asarray(decision.u)
        if not np.isfinite(u).all():
            raise PCRError(f"the controller answered {u} rad/s")
        self.u = u
        plan = decision.plan
        signs = self._controller.work.foresight.outlook.signs
        doubts = sum(bit for bit, kept in zip((1, 2), self._controller.work.believed, strict=True) if not kept)
        return Command(
            found.sequence, found.time, u, _RUNGS[plan.fallback if plan else None], doubts,
            plan.iterations if plan else 0, float(signs[0]), signs[1 : 1 + self.n].copy(),
        )  # fmt: skip

    def rest(self, sequence: int, time: float) -> Command:
        """Brake the motors by one more period, as hard as they may."""
        self.u = self.limits.slowed(self.u)
        return Command(sequence, time, self.u, RESTING)

    def _begin(self, found: Measurement) -> None:
        """Start anew where the robot is found, unless it is at the start of the scene."""
        pose, scene = self._pose, self._scene
        away = math.hypot(*(found.p - pose.p).tolist())
        # So written that NaN is not near.
        if not (away <= _NEAR * scene.robot.lengths.min() and np.abs(found.q - pose.q).max() <= _TURNED):
            self._controller.start(found.p, found.q)
        self._begun = True
