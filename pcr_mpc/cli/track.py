"""The command of the command line that runs a scene."""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from .. import interrupt
from ..control.tuning import Tuning, load_tuning
from ..errors import MarginsError, OutputError, PCRError, SimulationError
from ..files import require_folder, results, saved
from ..loop.controller.make_controller import make_controller
from ..loop.controller.own_controller import OwnController
from ..loop.demand.feed_forward import InverseDynamics
from ..loop.parts.controllers import Controller
from ..loop.run.model_inertia import by_model_inertia
from ..loop.run.run import RECORD, Run
from ..loop.run.simulate import simulate
from ..loop.run.simulated_plant import SimulatedPlant
from ..loop.scene.file import load_scene
from ..loop.scene.scene import Scene
from ..plant.mujoco.plant import MuJoCoPlant
from ..report.laps import plot_laps
from ..report.plots import animate_run, plot_run
from ..report.tables import summary_table
from ..study.margins.predicted import predict_delay_margin
from ..view.replay import write_replay
from .options.command import LINKS
from .places import own_place

_MARGIN_POSES = 5  # a quarter of a second
_PICTURES, _LEARNT = ("track.png", "track.gif", "replay.html"), ("laps.png",)


def track(options: argparse.Namespace) -> int:
    """Run `pcr-mpc track`."""
    scene = load_scene(options.scene)
    own = OwnController(options.controller) if isinstance(options.controller, str) else None
    tuning = load_tuning(options.controller) if options.controller and own is None else None
    if tuning and scene.trajectory is None:
        raise ValueError(f"scene {scene.name} has nothing to track, so --controller has no use")
    if tuning:
        scene = scene.tuned(tuning)
    controller: Controller = make_controller(scene, tuning) if own is None else own(scene)
    if options.plant and options.method:
        raise ValueError("--method has no use with --plant: MuJoCo solves no statics")
    if options.links is not None and not options.plant:
        raise ValueError("--links goes with --plant mujoco")
    if options.method:
        scene = replace(scene, plant=replace(scene.plant, method=options.method))
    plant: SimulatedPlant = (
        MuJoCoPlant(scene.robot, links=LINKS if options.links is None else options.links, dt=scene.plant.dt)
        if options.plant
        else scene.make_plant()
    )
    folder = options.out or own_place(options, scene.name)
    # Rather now than after the run.
    used: Tuning | None = None if own else tuning or scene.tuning
    drawn = () if options.no_pictures else _pictures(used)
    require_folder(folder, (*RECORD, *drawn), force=options.overwrite)
    failure: SimulationError | None = None
    try:
        run = simulate(scene, plant, controller, options.seed, progress=True)
    except SimulationError as error:
        failure, run = error, error.run
    folder, problem = saved(partial(run.save, force=options.overwrite), folder)
    summary = {**run.summary(), "scene_file": str(options.scene)}
    if options.plant and used is not None and failure is None:
        summary["by_model_inertia"] = by_model_inertia(run, used, plant, progress=True)
    if used is not None and not interrupt.noted():
        summary["delay_margin"] = _delay_margin(scene, used, getattr(controller, "reference", None))
    # Of a run that was interrupted the record is enough: who presses Ctrl-C wants no pictures.
    pictures = not (options.no_pictures or interrupt.noted())
    folder, second = saved(partial(_complete, run, summary, pictures), folder)
    print(json.dumps(summary) if options.json else f"\n{summary_table(summary)}\n\nwritten to {folder}")
    if failure is not None:
        raise failure
    if run.verdict():
        raise SimulationError(f"{scene.name}: {run.verdict()}", run=run)
    if problem or second:
        raise OutputError(problem or second, path=str(folder))
    return 0


def _delay_margin(scene: Scene, tuning: Tuning, reference: InverseDynamics | None) -> dict[str, Any] | None:
    """What the loop bears and what the scene needs; None where there is nothing to predict."""
    try:
        least = predict_delay_margin(scene, tuning, poses=_MARGIN_POSES, reference=reference)
    except MarginsError:
        return None
    needed = None if scene.delay_margin is None else 1e3 * scene.delay_margin
    predicted = 1e3 * least.value if math.isfinite(least.value) else None
    return {"predicted_ms": predicted, "t_s": least.t, "p_m": list(least.p), "needed_ms": needed}


def _complete(run: Run, summary: dict[str, Any], pictures: bool, folder: Path) -> None:
    """Add the pictures, and to the summary where everything is."""
    with results(folder, keep=RECORD) as staged:
        drawn = _pictures(run.tuning) if pictures and _drawn(run, staged) else ()
        summary["files"] = {name: str(folder / name) for name in (*RECORD, *drawn)}
        (staged / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def _pictures(tuning: Tuning | None) -> tuple[str, ...]:
    return (*_PICTURES, *_LEARNT) if tuning is not None and tuning.learning is not None else _PICTURES


def _drawn(run: Run, folder: Path) -> bool:
    """Draw a run; what cannot be drawn, as a robot that was lost, is said and no reason to lose the figures."""
    paths = [folder / name for name in _pictures(run.tuning)]
    try:
        plot_run(run, paths[0])
        animate_run(run, paths[1], progress=True)
        write_replay(run, paths[2])
        for path in paths[3:]:
            plot_laps(run, path)
    except (PCRError, ValueError) as error:
        for path in paths:
            path.unlink(missing_ok=True)
        print(f"pcr-mpc: no pictures: {error}", file=sys.stderr)
        return False
    return True
