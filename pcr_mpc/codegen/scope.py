"""Which scenes C can be generated of."""

from __future__ import annotations

from typing import Any

from ..control.tuning import Tuning
from ..errors import GenerationError
from ..loop.scene import Scene


def check_scope(scene: Scene, tuning: Tuning | None) -> Tuning:
    """Return the tuning whose controller is generated, or say what of the scene C does not have yet.

    Raises
    ------
    GenerationError
        Names the first part that is missing, and what to do.
    """
    if scene.trajectory is None or tuning is None:
        raise GenerationError(f"{scene.name}: there is nothing to track, so there is no controller to generate; "
                              "give a scene with a [reference] and a tuning", part="reference")  # fmt: skip
    for part, found, known, advice in _choices(scene, tuning):
        if found not in known:
            named = ", ".join(map(str, known))
            raise GenerationError(f"{scene.name}: C has no {part} {found!r} yet, only {named}; {advice}", part=part)
    return tuning


def _choices(scene: Scene, tuning: Tuning) -> list[tuple[str, Any, tuple[Any, ...], str]]:
    model, plant = tuning.model, scene.plant
    other = "give another tuning by --controller"
    robot = scene.robot.plain() if plant.rods == "plain" else scene.robot
    return [
        ("law", tuning.law, ("linear_mpc",), other),
        ("solver", tuning.solver, ("osqp",), 'take solver = "osqp": its sources come with its wheel'),
        ("fallback", tuning.fallback, ("ladder",), other),
        ("observer that adapts", tuning.observer.adapts if tuning.observer else (), ((),), "leave out observer.adapts"),
        ("learning", tuning.learning, (None,), "leave [learning] out of the tuning"),
        ("method of the controller's rods", model.method, ("closed_form",), other),
        ("reason to shoot", scene.robot.weightless().needs_shooting, (None,), "take a robot of plain rods"),
        ("method of the plant's rods", plant.method, ("closed_form",), "set [plant] method"),
        ("reason to shoot the plant", robot.weightless().needs_shooting, (None,), "set [plant] rods = 'plain'"),
        ("inertia of the plant", plant.inertia, ("none", "constant", "condensed"), "set [plant] inertia"),
        ("snapping plant", plant.on_snap, ("raise",), "set [plant] on_snap"),
        ("motors that do not follow at once", scene.motors, (None,), "leave [motors] out"),
        ("untold delay [s]", scene.untold_delay, (0.0,), "leave [control] untold_delay out"),
        ("start that moves, at [m/s]", tuple(scene.start_velocity), ((0.0, 0.0),), "start at rest"),
    ]
