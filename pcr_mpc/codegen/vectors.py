"""The scene as Python runs it, recorded for C to be held against."""

from __future__ import annotations

import numpy as np

from ..errors import GenerationError, SimulationError
from ..loop.controller.make_controller import make_controller
from ..loop.run.run import Run
from ..loop.run.simulate import simulate
from .ctext import array, number
from .subject import Subject

RUNGS = ("solved", "softened", "shifted_plan", "lqr", "hold")


def recorded(subject: Subject, *, progress: bool = False) -> Run:
    """Run the scene in closed loop, each decision taken at once.

    Raises
    ------
    GenerationError
        The run ends early: there is nothing to be held against.
    """
    scene, tuning = subject.scene, subject.tuning
    try:
        return simulate(scene, scene.plant.make(scene.robot), make_controller(scene, tuning), 0,
                        spent=lambda k, measured: 0.0, progress=progress)  # fmt: skip
    except SimulationError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise
        raise GenerationError(f"Python's own run ends early: {error}; give another tuning", part="run") from error


def rungs_of(run: Run) -> np.ndarray:
    """Rung of the ladder that answered in each period, shape (M,), as an index of `RUNGS`."""
    found = np.zeros(len(run.u), dtype=int)
    for event in run.events:
        if event["kind"] == "fallback":
            found[round(event["t"] / run.scene.period)] = RUNGS.index(event["rung"])
    return found


def vectors(subject: Subject, run: Run) -> str:
    """Text of ``pcr_vectors.c``."""
    scene, per = subject.scene, round(subject.scene.period / run.dt)
    count = len(run.u)
    noise = np.zeros((count, 2))
    if scene.tip_noise:
        source = np.random.default_rng(run.seed)
        noise = np.array([source.normal(0.0, scene.tip_noise, 2) for _ in range(count)])
    carried = scene.carried(run.dt * np.arange(count * per)) * (scene.plant.payload == "carried")
    return "\n".join(
        [
            f"/* The scene {scene.name!r} as Python ran it, with seed {run.seed}. */\n"
            '#include "pcr_vectors.h"\n\n#include <math.h>\n',
            array("double", "pcr_vector_noise", noise),
            array("unsigned char", "pcr_vector_seen", np.isfinite(run.measured[:, 0]).astype(int)),
            array("double", "pcr_vector_measured", run.measured),
            array("double", "pcr_vector_u", run.u),
            array("unsigned char", "pcr_vector_rung", rungs_of(run)),
            array("unsigned short", "pcr_vector_iterations", run.iterations),
            array("double", "pcr_vector_x", run.x[per::per]),
            array("double", "pcr_vector_wanted", run.reference),
            array("double", "pcr_vector_payload", carried),
            array("double", "pcr_vector_force", np.array(scene.force, dtype=float)),
            f"const double pcr_vector_rms_mm = {number(float(run.summary()['rms_mm']))};\n",
        ]
    )
