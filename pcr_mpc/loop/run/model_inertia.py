"""What the inertia of the rods in the controller's model is worth on a robot that has it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ... import interrupt
from ...control.tuning import Tuning
from ...errors import SimulationError
from ..controller.make_controller import make_controller
from .run import Run
from .simulate import simulate
from .simulated_plant import SimulatedPlant

INERTIAS = ("none", "condensed")
_FIGURES = ("rms_mm", "rms_after_1s_mm", "max_mm", "failures")


def by_model_inertia(
    run: Run, tuning: Tuning, plant: SimulatedPlant, *, progress: bool = False
) -> dict[str, dict[str, Any]]:
    """Tracking errors of a run, and of the same run with controllers whose models differ in the rods' inertia.

    Parameters
    ----------
    run : Run
        Of a controller with ``tuning`` on ``plant``.

    Returns
    -------
    dict
        Inertia of the model -> rms_mm, rms_after_1s_mm, max_mm and failures.
    """
    found = {tuning.model.inertia: run}
    others = [inertia for inertia in INERTIAS if inertia not in found]
    for inertia in others:
        other = replace(tuning, model=replace(tuning.model, inertia=inertia))
        try:
            found[inertia] = simulate(run.scene, plant, make_controller(run.scene, other), run.seed, progress=progress)
        except SimulationError as error:
            interrupt.pass_on(error)
            found[inertia] = error.run
    summaries = {inertia: found[inertia].summary() for inertia in sorted(found, reverse=True)}
    return {inertia: {key: summary[key] for key in _FIGURES} for inertia, summary in summaries.items()}
