"""The controller of a scene, or of a robot that is to follow a path."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ...control.tuning import Tuning
from ...plant.robot import Robot
from ..demand.feed_forward import InverseDynamics
from ..live.motions import as_trajectory
from ..live.scene import live_scene
from ..parts.controllers import HoldMotors
from ..scene.scene import Scene
from ..scene.sensors import EXACT_SENSORS, Sensors
from .tracking import TrackingController


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
    if sensors is not None and not isinstance(sensors, Sensors):
        raise ValueError(f"sensors is {sensors!r}, expected Sensors(tip_noise=..., ...)")
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
