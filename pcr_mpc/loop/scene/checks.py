"""What every scene must keep, whether it was read from a file or made in Python."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...errors import ModelError, UnreachableError, check_numbers, checked_vector
from ...files import name_problem
from ...plant.robot import Robot
from ..references.blended import Blended
from ..references.tabulated import Tabulated
from ..references.trajectory import Trajectory, sampled

LATE = ("hold", "shifted_plan")
_FAR = 3.0  # rod lengths out of reach, from which a place may be in other units
_UNITS = {"millimetres": 1e3, "centimetres": 1e2}  # in a metre


def is_multiple(value: float, of: float) -> bool:
    """Whether ``value`` is ``of`` once or several times, but for rounding."""
    ratio = value / of if of > 0 else math.nan
    return ratio >= 0.5 and abs(ratio - round(ratio)) <= 1e-9 * ratio


def check_scene(scene: Any) -> None:
    """Check what a scene says but for how its times go together; numbers become floats, vectors tuples of them.

    Raises
    ------
    ModelError
        Names the attribute.
    """
    if problem := name_problem(scene.name):
        raise ModelError(f"name: {problem}", key="name")
    check_numbers(
        scene,
        {"duration": {"above": 0.0}, "period": {"above": 0.0}, "tip_noise": {"minimum": 0.0},
         "angle_step": {"minimum": 0.0}, "untold_delay": {"minimum": 0.0}},
    )  # fmt: skip
    if scene.own_period is not None:
        check_numbers(scene, {"own_period": {"above": 0.0}})
    if scene.delay_margin is not None:
        check_numbers(scene, {"delay_margin": {"above": 0.0}})
    if scene.deadline != math.inf:
        check_numbers(scene, {"deadline": {"minimum": 0.0}})
    if isinstance(scene.delay, bool) or not hasattr(scene.delay, "__index__") or scene.delay < 0:
        raise ModelError(f"delay is {scene.delay!r}, expected a whole number of control periods >= 0", key="delay")
    if scene.late not in LATE:
        raise ModelError(f"late is {scene.late!r}, expected one of {', '.join(LATE)}", key="late")
    for name, size in (("start_tip", 2), ("start_motors", scene.robot.n_rods), ("start_velocity", 2), ("force", 2)):
        value = getattr(scene, name)
        if value is None and name.startswith("start_") and name != "start_velocity":
            continue
        try:
            vector = checked_vector(name, value, size).tolist()
        except ValueError as error:
            raise ModelError(str(error), key=name) from None
        object.__setattr__(scene, name, tuple(vector))
    if (scene.start_tip is None) == (scene.start_motors is None) or (scene.start_tip is None) != (
        scene.start_mode is None
    ):
        raise ModelError("give either start_tip and start_mode, or start_motors", key="start_tip")


def require_within_stops(scene: Any) -> None:
    """Raise if the motors are to start beyond a stop."""
    for i, angle in enumerate(scene.start_motors or ()):
        lower, upper = scene.robot.angle_limits[i]
        if not lower <= angle <= upper:
            raise ModelError(
                f"{scene.name}: start.motors: motor {i} is to start at {angle:g} rad, beyond its stops, "
                f"[{lower:g}, {upper:g}] rad; start within them",
                key="start.motors",
            )


def begins(scene: Any) -> bool:
    """Whether the tip starts where the reference begins."""
    if scene.trajectory is None or scene.start_tip is None:
        return False
    return bool(np.array_equal(sampled(scene.trajectory, np.zeros(1))[0, 0], scene.start_tip))


def require_reach(scene: Any) -> None:
    """Raise if a rod is too short for the start or for the reference, which costs no statics to see."""
    # A start that follows from the reference is nowhere in the file: the reference is to be named.
    checks = (_require_reference, _require_start) if begins(scene) else (_require_start, _require_reference)
    for check in checks:
        check(scene)


def _require_start(scene: Any) -> None:
    if scene.start_tip is None:
        return
    try:
        scene.robot.require_reachable(np.array(scene.start_tip))
    except UnreachableError as error:
        units = _units_hint(np.array([scene.start_tip]), scene.robot)
        raise ModelError(f"{scene.name}: start.tip: {error}{units}", key="start.tip", **error.details) from None


def _require_reference(scene: Any) -> None:
    if scene.trajectory is None:
        return
    t = scene.period * np.arange(scene.n_periods + 1)
    tips = sampled(scene.trajectory, t)[:, 0]
    robot = scene.robot
    beyond = np.linalg.norm(tips[:, None] - robot.bases, axis=2) - robot.lengths
    if not (outside := (beyond >= 0).any(axis=1)).any():
        return
    first, farthest = int(outside.argmax()), np.unravel_index(int(beyond.argmax()), beyond.shape)
    most = float(beyond[farthest])
    try:
        robot.require_reachable(tips[first])
    except UnreachableError as error:
        worst = f"; at t = {t[farthest[0]]:.3f} s rod {farthest[1]} is {1e3 * most:.4g} mm too short"
        raise ModelError(
            f"{scene.name}: reference at t = {t[first]:.3f} s{_row(scene.trajectory, tips[first])}: {error}"
            f"{worst if most > 0 else ''}{_units_hint(tips, robot)}",
            key="reference",
            t=float(t[first]),
            **error.details,
        ) from None


def _row(trajectory: Trajectory, p: np.ndarray) -> str:
    """Which row of a path of rows a place is at, counted as in its file."""
    path = trajectory.path if isinstance(trajectory, Blended) else trajectory
    if not isinstance(path, Tabulated):
        return ""
    return f" (at row {1 + int(np.linalg.norm(np.array(path.points) - p, axis=1).argmin())} of its file)"


def _units_hint(tips: np.ndarray, robot: Robot) -> str:
    """In what units tips that are far out of reach would all be within it."""

    def beyond(tips: np.ndarray) -> float:
        return float((np.linalg.norm(tips[:, None] - robot.bases, axis=2) - robot.lengths).max())

    if beyond(tips) <= _FAR * float(robot.lengths.max()):
        return ""
    fit = [name for name, many in _UNITS.items() if beyond(tips / many) < 0.0]
    return f"; is it in {' or '.join(fit or ['other units'])}?"
