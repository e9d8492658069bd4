"""How long the steps of a scene take in C, compiled and run here, and how long a control step may take at most."""

from __future__ import annotations

import re
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import interrupt
from ..errors import CompilerError
from ..loop.scene.scene import Scene
from .folder import write_folder
from .library import run_make
from .scope import check_scope
from .solver import flops
from .subject import Subject
from .vectors import recorded

_TOLERANCE = re.compile(r"(#define PCR_TOLERANCE) .*")
_RUNS = 5  # of the scene, at most, with a solver that is never content
_ANOTHER_RUN = 2  # result of an example that ends, and not as Python did


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
    periods, per = len(run.u), round(scene.period / subject.plant.dt)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_folder(subject, run, folder)
        times = _run(folder, steps)
        if isinstance(times, str):
            raise CompilerError(f"the C of {scene.name} does not run as Python did: {times}")
        config, capped = folder / "pcr_config.h", None
        if solver == "osqp":  # what DAQP does it does in finitely many iterations, whatever the tolerance
            config.write_text(_TOLERANCE.sub(r"\g<1> 1e-30", config.read_text(encoding="utf-8")), encoding="utf-8")
            capped = _run(folder, min(_RUNS * periods, steps), strict=False)
    count = len(times) // (1 + per)
    least = _least(times, per, periods)
    longest = None if capped is None or isinstance(capped, str) else _least(capped, per, periods)
    worst = worst_case(subject, run.iterations, least, longest)
    return {"control": times[:count], "plant": times[count:], "worst": worst}


def _run(folder: Path, steps: int, *, strict: bool = True) -> np.ndarray | str:
    """Compile and run the example: CPU and wall time of all steps [s]; or what it says, if it fails.

    ``strict``: it must run as Python did.
    """
    run_make(folder, "example")
    file = folder / "times"
    done = interrupt.completed([str(folder / "example"), str(steps), str(file)])
    if done.returncode not in ((0,) if strict else (0, _ANOTHER_RUN)):
        return done.stdout.strip()
    return np.asarray(1e-6 * np.fromfile(file).reshape(-1, 2))


def _least(times: np.ndarray, per: int, periods: int) -> np.ndarray:
    """Least CPU time of the control step of each period in all runs [s]."""
    return np.asarray(times[: len(times) // (1 + per), 0].reshape(-1, periods).min(axis=0))


def worst_case(
    subject: Subject, iterations: np.ndarray, seconds: np.ndarray, capped: np.ndarray | None
) -> dict[str, Any]:
    """Iterations that are allowed, times what one costs, and what a step costs besides.

    Parameters
    ----------
    subject : Subject
    iterations : ndarray of int, shape (M,)
        Of the solver in each control step.
    seconds : ndarray, shape (M,)
        That the step has taken, nobody interrupting [s].
    capped : ndarray, shape (M,), or None
        The same where the solver is never content, and stops at the iterations allowed. Else nothing is known of that.

    Returns
    -------
    dict
        ``iterations`` allowed; ``flops`` of one of the largest QP, all soft rows in it; ``iteration_us`` of that QP, by
        the operations from the QP that knows the rates' limits alone; ``rest_us``; ``us``, all of it. None where it is
        not known.
    """
    size, solver = subject.tuning.horizon * subject.robot.n_rods, subject.tuning.solver
    largest, usual = (flops(shape, solver, size) for shape in (subject.limited[-1], subject.rates))
    most = subject.tuning.max_iterations
    found: dict[str, Any] = {"iterations": most, "flops": largest}
    if capped is None:
        return found | dict.fromkeys(("iteration_us", "rest_us", "us"))
    slope = max(float(np.median(capped) - np.median(seconds)) / max(most - float(np.median(iterations)), 1.0), 0.0)
    rest = float(np.max(seconds - slope * iterations))
    each = slope * max(largest / usual, 1.0)
    return found | {"iteration_us": 1e6 * each, "rest_us": 1e6 * rest, "us": 1e6 * (rest + most * each)}
