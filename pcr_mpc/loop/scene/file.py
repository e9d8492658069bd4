"""A scene as it is read from a file."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...control.tuning import load_tuning
from ...errors import ModelError
from ...plant.robot import Robot, load_robot
from ...toml_table import Table, read_toml
from ..hardware.camera import read_camera
from ..hardware.motors import read_motors
from ..references.blended import duration_of
from ..references.reading import read_reference
from ..references.trajectory import Trajectory
from .checks import LATE, require_reach, require_within_stops
from .scene import Scene
from .settings import read_finding, read_need, read_payload, read_plant, read_pose_limits

# Distance of the start that is given from the reference that is taken for the same place, in rod lengths.
_START_ROUNDING = 2.5e-9
_START_SMOOTHING = 1e-4  # by which a path of a file may begin beside its first row
_TENS = 10  # control periods, of which a duration that follows from the reference is a multiple


def load_scene(path: str | Path) -> Scene:
    """Read a scene from TOML (see ``models/scenes/lemniscate.toml``); paths of its robot and tuning are relative to it.

    Raises
    ------
    ModelError
        A key is missing, misspelt, of the wrong type or out of range, in the scene or in its robot; the motors start
        beyond a stop; a rod is too short for the start or for the reference; or the scene's own limit on torque is too
        low for the start. What else takes statics to see is seen at the start of a run, or by `check_scene`.
    """
    with read_toml(path) as file:
        name = file.text("name")
        robot = load_robot(file.file("robot"))
        with file.table("reference") as reference:
            trajectory = read_reference(reference)
        with file.table("limits", {}) as limits:
            own_torque = limits.has("torque")
            robot = replace(
                robot,
                rate_limit=limits.number("rate", robot.rate_limit, above=0.0),
                acceleration_limit=limits.number("acceleration", robot.acceleration_limit, above=0.0),
                torque_limit=limits.number("torque", robot.torque_limit, above=0.0),
            )
            pose_limits = read_pose_limits(limits, robot)
            tracking_error = limits.number("tracking_error", 0.0, above=0.0) or None
        with file.table("world", {}) as world:
            robot = replace(robot, gravity=world.vector("gravity", 2, robot.gravity))
        with file.table("start") as start:
            tip = start.vector("tip", 2, None)
            motors = start.vector("motors", robot.n_rods, None)
            mode = start.text("mode", None)
            velocity = start.vector("velocity", 2, (0.0, 0.0))
            if tip is None and motors is None and mode is not None and trajectory is not None:
                tip = tuple(trajectory(np.zeros(1))[0, 0].tolist())
            elif tip is not None and trajectory is not None:
                tip = _where_it_begins(start, tip, trajectory, robot)
            if (tip is None) == (motors is None) or (tip is None) != (mode is None):
                alone = '; mode = "LR" alone (a letter a rod) where the reference begins' if trajectory else ""
                raise start.fail("tip", f"give either tip and mode, or motors{alone}")
        with file.table("plant") as table:
            plant = read_plant(table, robot)
        with file.table("control") as control:
            period = control.number("period", above=0.0)
            duration = _duration(file, trajectory, period)
            tuning = control.file("tuning", None)
            delay = control.integer("delay", 0, minimum=0)
            untold_delay = control.number("untold_delay", 0.0, minimum=0.0)
            deadline = control.number("deadline", math.inf, minimum=0.0)
            late = control.text("late", LATE[0], choices=LATE)
        with file.table("load", {}) as load, file.table("sensor", {}) as sensor:
            force = load.vector("force", 2, (0.0, 0.0))
            noise = sensor.number("tip_noise", 0.0, minimum=0.0)
            angle_step = sensor.number("angle_step", 0.0, minimum=0.0)
            wrapped = sensor.boolean("wrapped", False)
            camera = read_camera(sensor)
        payload = read_payload(file)
        (need, margin), finding, moved_by = read_need(file), read_finding(file), read_motors(file)
        scene = Scene(name, robot, duration, tip, motors, mode, velocity, trajectory, plant, period,
                      tuning and load_tuning(tuning), force, noise, angle_step,
                      delay, deadline, late, pose_limits, payload, need, finding,
                      wrapped=wrapped, tracking_error=tracking_error, untold_delay=untold_delay,
                      motors=moved_by, delay_margin=margin, camera=camera)  # fmt: skip
    if (trajectory is None) != (tuning is None):
        raise ModelError(
            f"{path}: a reference needs control.tuning, and reference.kind = 'none' has no use for it",
            file=str(path),
            key="control.tuning",
        )
    try:
        require_within_stops(scene)
        require_reach(scene)
        if own_torque:
            scene.start()
    except ModelError as error:
        raise ModelError(f"{path}: {error}", file=str(path), **error.details) from None
    return scene if scene.tuning is None else scene.tuned(scene.tuning)


def _where_it_begins(start: Table, tip: tuple[float, ...], trajectory: Trajectory, robot: Robot) -> tuple[float, ...]:
    """Return the tip at the start; that of the reference if what is given is it but for rounding and smoothing."""
    begin = trajectory(np.zeros(1))[0, 0]
    apart = math.hypot(*(begin - tip)) / robot.lengths.mean()
    if apart > _START_SMOOTHING:
        said = "(" + ", ".join(f"{x:.6g}" for x in begin) + ")"
        raise ModelError(
            f"{start.path}: start.tip {tip} is not where the reference begins, {said}; without start.tip it starts "
            "there",
            file=str(start.path),
            key="start.tip",
        )
    return tip if apart <= _START_ROUNDING else tuple(begin.tolist())


def _duration(file: Table, trajectory: Trajectory | None, period: float) -> float:
    """As stated, or as long as the reference takes, in tens of control periods: other periods are to fit, too."""
    if file.has("duration") or trajectory is None or math.isinf(duration_of(trajectory)):
        return file.number("duration", above=0.0)
    return _TENS * period * math.ceil(duration_of(trajectory) / (_TENS * period) - 1e-9)
