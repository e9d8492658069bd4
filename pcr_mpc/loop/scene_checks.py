"""What every scene must keep, whether it was read from a file or made in Python."""

from __future__ import annotations

import math
from typing import Any

from ..errors import ModelError, check_numbers, checked_vector
from ..files import name_problem

LATE = ("hold", "shifted_plan")


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
