"""The scene of a robot that is not simulated."""

from __future__ import annotations

from ...control.tuning import Tuning
from ...errors import ModelError, checked_number
from ...plant.robot import Robot
from ..references.trajectory import Trajectory
from ..scene.scene import Scene
from ..scene.sensors import Sensors
from ..scene.settings import PlantSettings, default_margins


def live_scene(robot: Robot, path: Trajectory | None, tuning: Tuning, period: float, sensors: Sensors) -> Scene:
    """Return what a controller must know besides the robot: path, period, sensors, and the usual stability margins.

    Raises
    ------
    ModelError
        The tuning is for another period.
    """
    period = checked_number("period", period, above=0.0)
    if tuning.period is not None and abs(tuning.period - period) > 1e-9 * period:
        raise ModelError(
            f"{tuning.name} is for a control period of {tuning.period} s, not of {period} s; take that, or another "
            "tuning",
            key="period",
        )
    return Scene(
        name=robot.name,
        robot=robot,
        duration=period,
        start_tip=None,
        # Where it stands is measured; a scene must say something.
        start_motors=tuple(robot.angle_limits.mean(axis=1).tolist()),
        start_mode=None,
        start_velocity=(0.0, 0.0),
        trajectory=path,
        plant=PlantSettings("multiple_shooting", 8, 1, "rk8", "rk4", period, "raise"),  # of no use: the robot is real
        period=period,
        tuning=tuning,
        force=(0.0, 0.0),
        tip_noise=sensors.tip_noise,
        angle_step=sensors.angle_step,
        delay=sensors.delay,
        pose_limits=default_margins(robot),
        wrapped=sensors.wrapped,
    )
