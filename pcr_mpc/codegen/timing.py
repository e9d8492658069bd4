"""How long the steps of a scene take in C, compiled and run here, and how long a control step may take at most."""

from __future__ import annotations

import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import CompilerError
from ..loop.scene.scene import Scene
from .folder import write_folder
from .library import run_make
from .scope import check_scope
from .solver import flops
from .subject import Subject
from .vectors import recorded


def time_in_c(scene: Scene, solver: str, steps: int) -> dict[str, Any]:
    """Close the loop of a scene in C, with the compiler's flags as the Makefile has them, and time every step.

    Parameters
    ----------
    scene : Scene
    solver : {"osqp", "daqp"}
    steps : int
        Control steps, at least; whole runs of the scene.

    Returns
    -------
    dict
        ``control`` and ``plant``: CPU time and wall time of each step, shape (count, 2) [s]. ``worst``: the static
        worst case of a control step, see `worst_case`.

    Raises
    ------
    GenerationError
        The scene is beyond what C has.
    CompilerError
        There is no compiler, or what it made does not run as Python did.
    """
    tuning = check_scope(scene, scene.tuning)
    subject = Subject.of_scene(scene.tuned(replace(tuning, solver=solver)))
    run = recorded(subject)
    with tempfile.TemporaryDirectory() as place:
        folder, file = Path(place), Path(place) / "times"
        write_folder(subject, run, folder)
        run_make(folder, "example")
        command = [str(folder / "example"), str(steps), str(file)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise CompilerError(f"the C of {scene.name} does not run as Python did: {done.stdout.strip()}",
                                command=command)  # fmt: skip
        times = 1e-6 * np.fromfile(file).reshape(-1, 2)
    per = round(scene.period / subject.plant.dt)
    count = len(times) // (1 + per)
    least = times[:count, 0].reshape(-1, len(run.u)).min(axis=0)
    return {"control": times[:count], "plant": times[count:], "worst": worst_case(subject, run.iterations, least)}


def worst_case(subject: Subject, iterations: np.ndarray, seconds: np.ndarray) -> dict[str, Any]:
    """Iterations that are allowed, times what one costs, and what a step costs besides.

    Parameters
    ----------
    subject : Subject
    iterations : ndarray of int, shape (M,)
        Of the solver in each control step.
    seconds : ndarray, shape (M,)
        That the step has taken, nobody interrupting [s].

    Returns
    -------
    dict
        ``iterations`` allowed; ``flops`` of one of the largest QP, all soft rows in it; ``iteration_us`` of that QP,
        from how times grow with iterations, scaled by the operations from the QP that knows the rates' limits alone;
        ``rest_us``; ``us``, all of it. None where all steps took as many iterations, which tells nothing.
    """
    size, solver = subject.tuning.horizon * subject.robot.n_rods, subject.tuning.solver
    largest, usual = (flops(shape, solver, size) for shape in (subject.limited[-1], subject.rates))
    found: dict[str, Any] = {"iterations": subject.tuning.max_iterations, "flops": largest}
    counts = np.unique(iterations)
    if len(counts) < 2:
        return found | dict.fromkeys(("iteration_us", "rest_us", "us"))
    # The median of each number of iterations: what else differs between steps is not the iterations' doing.
    typical = np.array([np.median(seconds[iterations == count]) for count in counts])
    slope = max(float(np.polyfit(counts, typical, 1, w=np.sqrt(np.bincount(iterations)[counts]))[0]), 0.0)
    rest = float(np.max(seconds - slope * iterations))
    each = slope * max(largest / usual, 1.0)
    return found | {
        "iteration_us": 1e6 * each,
        "rest_us": 1e6 * rest,
        "us": 1e6 * (rest + subject.tuning.max_iterations * each),
    }
