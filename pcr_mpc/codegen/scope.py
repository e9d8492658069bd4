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
    robot = scene.robot.plain() if scene.plant.rods == "plain" else scene.robot
    for which, reason in (("controller", scene.robot.needs_shooting), ("plant", robot.weightless().needs_shooting)):
        if reason is not None:
            raise GenerationError(f"{scene.name}: C has rods in closed form only yet, and {reason}; take a {which} of "
                                  "plain rods without weight", part=f"rods of the {which}")  # fmt: skip
    for part, found, known, advice in _choices(scene, tuning):
        if found not in known:
            named = ", ".join(map(str, known))
            raise GenerationError(f"{scene.name}: C has no {part} {found!r} yet, only {named}; {advice}", part=part)
    return tuning


def _choices(scene: Scene, tuning: Tuning) -> list[tuple[str, Any, tuple[Any, ...], str]]:
    model, plant = tuning.model, scene.plant
    other = "give another tuning by --controller"
    carrying = "none" if scene.payload is None or plant.payload == "ignored" else plant.inertia
    return [
        ("law", tuning.law, ("linear_mpc",), other),
        ("solver", tuning.solver, ("osqp",), 'take solver = "osqp": its sources come with its wheel'),
        ("fallback", tuning.fallback, ("ladder",), other),
        ("observer that adapts", tuning.observer.adapts if tuning.observer else (), ((),), "leave out observer.adapts"),
        ("learning", tuning.learning, (None,), "leave [learning] out of the tuning"),
        ("method of the controller's rods", model.method, ("closed_form",), other),
        ("method of the plant's rods", plant.method, ("closed_form",), "set [plant] method"),
        ("inertia of the plant", plant.inertia, ("none", "constant", "condensed"), "set [plant] inertia"),
        ("plant that carries a payload with inertia", carrying, ("none", "constant"), "set [plant] inertia"),
        ("snapping plant", plant.on_snap, ("raise",), "set [plant] on_snap"),
        ("motors that do not follow at once", scene.motors, (None,), "leave [motors] out"),
        ("untold delay [s]", scene.untold_delay, (0.0,), "leave [control] untold_delay out"),
        ("start that moves, at [m/s]", tuple(scene.start_velocity), ((0.0, 0.0),), "start at rest"),
    ]
