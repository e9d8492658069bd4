"""Whether plant and controller of a scene begin: what a run would refuse at its start, without the run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..errors import PCRError
from ..loop.controller.make_controller import make_controller
from ..loop.scene.scene import Scene
from ..plant.statics.equilibrium import Equilibrium
from .remarks import Remark


def rehearse(scene: Scene, pose: Equilibrium, *, start: bool = True) -> list[Remark]:
    """Make the plant of a scene and take a step, make its controller and start it: some tenths of a second.

    Parameters
    ----------
    scene : Scene
    pose : Equilibrium
        At its start.
    start : bool
        False: the controller is made and not started, as where its reference is known not to begin.
    """
    remarks = []
    try:
        x, plant = np.concatenate([pose.p, scene.start_velocity, pose.q]), scene.make_plant()
        plant.reset(x, pose)
        plant.step(x, np.zeros(scene.robot.n_rods))
    except (PCRError, ValueError) as error:
        remarks.append(Remark("error", "plant", str(error)))
    try:
        controller = make_controller(_brief(scene))
        if start:
            controller.start(pose)
    except (PCRError, ValueError) as error:
        remarks.append(Remark("error", "controller", str(error)))
    return remarks


def _brief(scene: Scene) -> Scene:
    """The scene for a period, interpreted, as it costs least; whole where its laps count."""
    if scene.tuning is None:
        return scene
    tuning = replace(scene.tuning, model=replace(scene.tuning.model, compiled=False))
    return replace(scene, tuning=tuning, duration=scene.duration if tuning.learning else scene.period)
