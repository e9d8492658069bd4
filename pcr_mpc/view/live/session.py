"""A robot in motion that somebody plays with: plant, controller, time, and plain methods for what can be done."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from ...control.tuning import Tuning
from ...errors import PCRError, checked_integer, checked_number, checked_vector
from ...loop.controller.own_controller import OwnController
from ...loop.parts.controllers import Decision
from ...loop.scene.scene import Scene
from ...plant.statics.equilibrium import Equilibrium
from .falls import Falls
from .journal import Journal
from .pilot import OFF, Choice, Pilot
from .recorder import Recorder
from .rig import Rig, pose_of_mode
from .settings import Settings, dials_of, settings_of

_KEPT_EVERY = 0.1  # s, between poses to which the robot can go back
_BACK = 3  # of them
_LOST_AGAIN = 0.5  # s
SLOWEST, FASTEST = 0.02, 4.0


class Session(Journal):
    """One robot, one controller, one clock. Nothing here knows of a network or of real time.

    Parameters
    ----------
    scene : Scene
    own : Tuning, OwnController or None
        Controller instead of the scene's.
    seed : int
        Of the measurement noise.

    Attributes
    ----------
    t : float
        Time since the last reset [s].
    rig : Rig
    pilot : Pilot
    settings : Settings
    paused : bool
    speed : float
        Of its time over real time, as asked for.
    decision : Decision or None
        The last.
    mode, mode_now : str
        Working mode of the start, and that which the rods were last seen in.
    chosen : str
        Name of the controller.
    """

    def __init__(self, scene: Scene, own: Tuning | OwnController | None = None, seed: int = 0) -> None:
        super().__init__()
        self._told, self._seed = scene, checked_integer("seed", seed, minimum=0)
        self.choice, self.dials = Choice(scene, own), dials_of(scene)
        self.settings = settings_of(scene)
        self.start_pose = scene.start()
        self.mode = self.start_pose.mode
        self.paused, self.speed = False, 1.0
        self.chosen = self.choice.first
        self.pilot = Pilot(scene, self.choice[self.chosen])
        self._begin()

    def _begin(self) -> None:
        """Stand at the start, at time zero."""
        self.t, self._j = 0.0, 0
        self.decision: Decision | None = None
        self._lost_at, self._decided, self._falls = -math.inf, 0.0, Falls()
        self.rig = Rig(self.scene, self.start_pose, np.array(self._told.start_velocity), self._seed)
        self._kept: deque[Equilibrium] = deque([self.start_pose], maxlen=_BACK)
        self.mode_now = self.mode
        self._take_up(self.start_pose, follow=True)
        self.rig.carry(self._payload())

    @property
    def scene(self) -> Scene:
        """As it is now: with the controller's period, and with what was turned."""
        return self.settings.of(self.pilot.scene)

    @property
    def period(self) -> float:
        """Control period [s]."""
        return self.pilot.scene.period

    def advance(self, duration: float) -> int:
        """Run for a time [s], in whole steps of the plant; return how many. What is left over is lost."""
        steps = math.floor(duration / self.rig.dt + 1e-9)
        for _ in range(steps):
            self._step()
        return steps

    def step_once(self) -> None:
        """Run to the next control period, paused or not."""
        self._step()
        while self._j:
            self._step()

    def _step(self) -> None:
        rig = self.rig
        if self._j == 0:
            self._decide()
        before = rig.x
        try:
            snaps = rig.step()
        except PCRError as error:
            self._recover(error, before)
            return
        per = round(self.period / rig.dt)
        self._j = (self._j + 1) % per
        self.t += rig.dt
        if self.recorder is not None:
            self.recorder.step(rig, self.t, self.target())
        for snap in snaps:
            message = f"rod {snap.rod} snapped and lost {1e3 * snap.energy_lost:.3g} mJ"
            self.tell("snap", message, rod=snap.rod, p=list(snap.p), energy=snap.energy_lost)
        if math.floor(self.t / _KEPT_EVERY) != math.floor((self.t - rig.dt) / _KEPT_EVERY):
            self._kept.append(rig.equilibrium())
            self.mode_now = self._kept[-1].mode

    def _decide(self) -> None:
        self._decided = self.t
        rig, pilot = self.rig, self.pilot
        rig.carry(self._payload())
        if fall := self._falls.look(rig):
            self.tell(**fall)
        measured = rig.measure(pilot.period)
        if rig.hand is not None:
            self.decision = Decision(np.zeros(len(measured) - 4))
        else:
            try:
                self.decision = pilot.decide(measured)
            except Exception as error:  # whatever a controller of one's own does, the robot is still there
                self.tell("failure", f"the controller failed: {error}; the motors stand")
                self._switch_off()
                self.decision = Decision(np.zeros(len(measured) - 4))
            for event in self.decision.events:
                self.tell(**event)
            plan = self.decision.plan
            if plan is not None and plan.fallback:
                self.tell("fallback", f"{plan.fallback}: {plan.status}")
        rig.command(self.decision.u)
        if self.recorder is not None:
            self.recorder.decide(measured, self.decision)
            if self.recorder.full:
                self.record(False)

    def _payload(self) -> float:
        """That the tip carries [kg]: the scene's, by the controller's clock, and what was put on."""
        scheduled = self._told.carried(np.array([self.pilot.period * self.period]))[0]
        own = float(scheduled) if self._told.plant.payload == "carried" else 0.0
        return own + self.settings.load

    def _recover(self, error: PCRError, before: np.ndarray) -> None:
        """Go back to where the rods could be followed, at rest; let go of everything."""
        again = self.t - self._lost_at < _LOST_AGAIN
        self._lost_at = self.t
        self.tell("failure", f"the rods could not follow: {error}")
        self.rig.x = before
        self.record(False)
        back = self.start_pose if again else self._kept[0]
        self.rig.put(back)
        self._falls = Falls()
        self._kept = deque([back], maxlen=_BACK)
        self._j, self.paused = 0, self.paused or again
        self.tell("recovered", f"the robot was put {'at the start, time stands' if again else 'to rest a moment back'}")
        self._take_up(back, follow=False)

    def _take_up(self, pose: Equilibrium, *, follow: bool) -> None:
        """Let the controller begin where the robot is."""
        self._j, self._decided = 0, self.t
        try:
            self.pilot.start(pose, self.rig.x[2:4].copy())
            if follow and self.pilot.steers and self._told.trajectory is not None:
                self.pilot.follow()
        except (PCRError, ValueError) as error:
            self.tell("refused", f"{error}")
            if self.pilot.controller is not None and self.pilot.period == 0 and not self._begun():
                self._switch_off()

    def _begun(self) -> bool:
        """Whether the controller has a target to stand on."""
        try:
            return self.pilot.target() is not None
        except (PCRError, IndexError, AssertionError):
            return False

    def _switch_off(self) -> None:
        self.pilot, self.chosen = Pilot(self.pilot.scene, None), OFF

    def choose(self, name: str) -> None:
        """Let another controller steer from where the robot is, along the path if that was followed; "off" for none.

        Raises
        ------
        PCRError, ValueError
            There is none of that name, or it does not fit; the old one goes on.
        """
        self._replace(self.settings, name, follow=name != OFF and (self.pilot.following or not self.pilot.steers))
        self.tell("controller", f"controller {self.pilot.name}")

    def _replace(self, settings: Settings, name: str, *, follow: bool) -> None:
        """Put another controller in, told of other settings."""
        point = self.pilot.point
        pilot = Pilot(settings.of(replace(self._told, untold_delay=0.0)), self.choice[name])
        pose = self.rig.equilibrium()
        self.settings, self.pilot, self.chosen = settings, pilot, name
        self.rig.refit(self.scene, pose)
        self._take_up(pose, follow=follow)
        if point is not None and self.pilot.steers:
            self.pilot.send(point)

    def target(self) -> np.ndarray | None:
        """Where the tip is to be now, shape (2,) [m]; None where nobody says."""
        return self.pilot.target(self.t - self._decided)

    def move_target(self, x: float, y: float) -> None:
        """Send the target to a point [m]; PCRError if the controller has none."""
        self.pilot.send(checked_vector("target", (x, y), 2))

    def follow(self) -> None:
        """Let the target go along the scene's path, from its beginning."""
        self.pilot.follow()

    def stop(self) -> None:
        """Let the target brake, and stay."""
        self.pilot.stop()

    def drag(self, x: float, y: float) -> None:
        """Pull the tip by a spring whose other end is at a point [m]."""
        self.rig.pull = checked_vector("pull", (x, y), 2)

    def drag_motor(self, i: int, angle: float) -> None:
        """Turn a motor by hand towards an angle [rad]; the controller is off while it is held."""
        robot = self._told.robot
        i = checked_integer("motor", i, minimum=0)
        if i >= robot.n_rods:
            raise ValueError(f"motor is {i}, there are 0 to {robot.n_rods - 1}")
        lower, upper = robot.angle_limits[i]
        self.rig.hand = i, min(max(checked_number("angle", angle), float(lower)), float(upper))

    def release(self) -> None:
        """Let go of tip and motors; a controller goes on where the robot is, its target there."""
        self.rig.pull = None
        if self.rig.hand is not None:
            self.rig.hand = None
            self._take_up(self.rig.equilibrium(), follow=False)

    def pause(self, on: bool) -> None:
        """Let time stand, or go on."""
        self.paused = bool(on)

    def slow_motion(self, speed: float) -> None:
        """Let time run at a share of real time."""
        self.speed = checked_number("speed", speed, minimum=SLOWEST, maximum=FASTEST)

    def reset(self) -> None:
        """Go back to the start, at time zero; what was turned stays."""
        self.record(False)
        self._begin()
        self.tell("reset", f"at the start, mode {self.mode}")

    def switch_mode(self, mode: str) -> None:
        """Go to the start in another working mode, or as near to it as that one holds the tip.

        Raises
        ------
        PCRError, ValueError
            There is no such pose; the robot stays as it is.
        """
        self.start_pose = pose_of_mode(self._told, mode)
        self.mode = mode
        self.reset()

    def set(self, name: str, value: float) -> None:
        """Turn one of the settings; errors as `Settings.turned`, and those of a controller that is told."""
        settings = self.settings.turned(name, value, self.dials)
        dial = self.dials[name]
        if dial.told:
            self._replace(settings, self.chosen, follow=self.pilot.following)
        else:
            self.settings = settings
            if name != "load":
                self.rig.refit(self.scene, self.rig.equilibrium())
        self.tell("setting", f"{dial.label} {dial.scale * getattr(settings, name):.4g} {dial.unit}")

    def record(self, on: bool) -> None:
        """Begin to record, or end it: then the record is ``finished``."""
        if not on:
            self.end_record(self.pilot, self.rig)
        elif self.recorder is None:
            while self._j:
                self._step()
            self.recorder = Recorder(self.scene, self.rig, self.target(), self._seed)
