"""Which scenes C can be generated of."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from ..control.tuning import Tuning
from ..errors import GenerationError
from ..loop.scene.scene import Scene

# What of a scene, a tuning and its model C knows, or need not know; all else must be as it is by default.
_KNOWN = {
    "scene": "name robot duration start_tip start_motors start_mode start_velocity trajectory plant period tuning "
    "force tip_noise angle_step delay deadline late pose_limits payload need finding own_period wrapped tracking_error "
    "untold_delay motors camera",
    "tuning": "name horizon position_weight velocity_weight angle_weight input_weight tolerance max_iterations "
    "fallback model observer law pd period solver",
    "model": "method segments steps scheme inertia linearise payload predict_delay compiled angles motor_lag",
}


def check_scope(scene: Scene, tuning: Tuning | None) -> Tuning:
    """Return the tuning whose controller is generated, or say what of the scene C does not have.

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
            raise GenerationError(f"{scene.name}: C has no {part} {found!r}, only {named}; {advice}", part=part)
    for what, of in (("scene", scene), ("tuning", tuning), ("model", tuning.model)):
        for field in fields(of):
            value = getattr(of, field.name)
            if field.name not in _KNOWN[what].split() and value != field.default:
                raise GenerationError(f"{scene.name}: C does not know {field.name} of the {what}, which is "
                                      f"{value!r}; leave it out", part=field.name)  # fmt: skip
    return tuning


def _choices(scene: Scene, tuning: Tuning) -> list[tuple[str, Any, tuple[Any, ...], str]]:
    plant = scene.plant
    other = "give another tuning by --controller"
    carrying = "none" if scene.payload is None or plant.payload == "ignored" else plant.inertia
    return [
        ("law", tuning.law, ("linear_mpc",), other),
        ("fallback", tuning.fallback, ("ladder",), other),
        ("observer that adapts", tuning.observer.adapts if tuning.observer else (), ((),), "leave out observer.adapts"),
        ("learning", tuning.learning, (None,), "leave [learning] out of the tuning"),
        ("method of the plant's rods", plant.method, ("closed_form", "multiple_shooting"), "set [plant] method"),
        ("inertia of the plant", plant.inertia, ("none", "constant", "condensed"), "set [plant] inertia"),
        ("plant that carries a payload with inertia", carrying, ("none", "constant"), "set [plant] inertia"),
        ("snapping plant", plant.on_snap, ("raise",), "set [plant] on_snap"),
        (
            "motors at their torque limit",
            bool(scene.motors and scene.motors.saturated and plant.motors != "ideal"),
            (False,),
            "leave [motors] saturated out",
        ),
        ("start that moves, at [m/s]", tuple(scene.start_velocity), ((0.0, 0.0),), "start at rest"),
    ]
