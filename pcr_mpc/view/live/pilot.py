"""Who steers the motors: a controller that can be exchanged, sent elsewhere, and switched off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...catalogue import names_of, shipped
from ...control.tuning import Tuning, load_tuning
from ...errors import PCRError
from ...loop.controller.own_controller import OwnController
from ...loop.controller.tracking import TrackingController
from ...loop.parts.controllers import Controller, Decision, decision_of, name_of
from ...loop.scene.scene import Scene
from ...loop.scene.sensors import sensors_of
from ...plant.statics.equilibrium import Equilibrium

OFF = "off"


class Choice:
    """Controllers by name: the scene's own, those that come with the package, and one of somebody's own.

    Parameters
    ----------
    scene : Scene
    own : Tuning, OwnController or None
        Instead of the scene's.
    """

    def __init__(self, scene: Scene, own: Tuning | OwnController | None = None) -> None:
        self._known: dict[str, Tuning | OwnController] = {}
        for given in (own, scene.tuning):
            if given is not None:
                self._known[given.name] = given
        self.first = next(iter(self._known), OFF)
        self._paths = {name: shipped(name, "tuning") for name in names_of("tuning")}

    @property
    def names(self) -> list[str]:
        """Of all controllers, the usual one first."""
        return [*self._known, *(name for name in self._paths if name not in self._known), OFF]

    def __getitem__(self, name: str) -> Tuning | OwnController | None:
        """The controller of a name; None: motors that stand.

        Raises
        ------
        ValueError
            There is none of that name.
        """
        if name == OFF:
            return None
        if name not in self._known:
            if name not in self._paths:
                raise ValueError(f"there is no controller {name!r}, but {', '.join(self.names)}")
            self._known[name] = load_tuning(Path(self._paths[name]))
        return self._known[name]


class Pilot:
    """A controller in the loop, and what it is told to do.

    Parameters
    ----------
    scene : Scene
        As the controller is told it: its delay and its sensors, and the limits of its motors.
    choice : Tuning, OwnController or None
        None: the motors stand.

    Attributes
    ----------
    scene : Scene
        With the control period of the tuning.
    controller : Controller or None
    point : ndarray, shape (2,), or None
        To which the target is sent [m].
    following : bool
        Whether the target goes along the scene's path.
    """

    def __init__(self, scene: Scene, choice: Tuning | OwnController | None) -> None:
        self.scene = scene.tuned(choice) if isinstance(choice, Tuning) else scene
        self.controller: Controller | TrackingController | None = None
        if isinstance(choice, Tuning):
            # The path is joined from where the robot is, and can be left: to the controller it is no part of the scene.
            free = replace(self.scene, trajectory=None)
            self.controller = TrackingController(free, choice, sensors=sensors_of(scene))
        elif choice is not None:
            self.controller = choice(scene)
        self.point: np.ndarray | None = None
        self.following = False
        self._k = -1

    @property
    def name(self) -> str:
        """Of the controller."""
        return OFF if self.controller is None else name_of(self.controller)

    @property
    def steers(self) -> bool:
        """Whether the target can be moved."""
        return isinstance(self.controller, TrackingController)

    @property
    def period(self) -> int:
        """Periods since the start."""
        return max(self._k, 0)

    def start(self, pose: Equilibrium, velocity: np.ndarray) -> None:
        """Begin where the robot is; the target stands there.

        Raises
        ------
        PCRError
            The controller cannot hold the robot there.
        """
        self._k, self.point, self.following = -1, None, False
        if isinstance(self.controller, TrackingController):
            self.controller.start(pose, velocity=velocity)
        elif self.controller is not None:
            self.controller.start(pose)

    def decide(self, measured: np.ndarray) -> Decision:
        """Decide on the next period; errors as the controller's."""
        self._k += 1
        n = len(measured) - 4
        if isinstance(self.controller, TrackingController):
            tip, angles = measured[:2], measured[4:]
            return self.controller.step(tip=tip, angles=angles, target=self.point)
        if self.controller is None:
            return Decision(np.zeros(n))
        return decision_of(self.controller.step(self._k, measured), n)

    def target(self, since: float = 0.0) -> np.ndarray | None:
        """Where the tip is to be, a time [s] after the last decision, shape (2,) [m]; None where nobody says."""
        if isinstance(self.controller, TrackingController):
            p, v, a = self.controller.target
        elif self.controller is None or self.scene.trajectory is None:
            return None
        else:
            p, v, a = self.scene.trajectory(np.array([self.period * self.scene.period]))[0]
        return np.asarray(p + since * (v + since * a / 2))

    def send(self, point: np.ndarray) -> None:
        """Let the target go to a point [m]."""
        self._tracking()
        self.point, self.following = point, False

    def follow(self) -> None:
        """Let the target go along the scene's path, from its beginning; errors as `TrackingController.follow`."""
        if self.scene.trajectory is None:
            raise PCRError(f"scene {self.scene.name} has no path to follow")
        self._tracking().follow(self.scene.trajectory)
        self.point, self.following = None, True

    def stop(self) -> None:
        """Let the target brake, and stay."""
        self._tracking().stop()
        self.point, self.following = None, False

    def _tracking(self) -> Any:
        if not isinstance(self.controller, TrackingController):
            raise PCRError(f"controller {self.name} has no target that could be moved; choose another controller")
        return self.controller
