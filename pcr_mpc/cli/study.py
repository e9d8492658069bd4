"""The commands of the command line that learn from many runs: choice of physics, timing, tuning."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from .. import interrupt
from ..codegen.timing import time_in_c
from ..errors import OutputError
from ..files import require_folder, require_free, results, saved
from ..loop.scene.file import load_scene
from ..loop.scene.scene import Scene
from ..plant.uncertainty import load_uncertainty
from ..report.csv_rows import write_rows
from ..report.studies.choice import choice_record, choice_table
from ..report.studies.trade_off import plot_trade_off
from ..report.studies.tuning import tuning_comments, tuning_table
from ..report.timing import plot_timing, timing_tables
from ..study.choice.choice import choose
from ..study.choice.file import require_plant_table, write_rung
from ..study.episodes.episodes import lighter
from ..study.episodes.parallel import local_workers
from ..study.episodes.provenance import commit
from ..study.episodes.spread import Spread
from ..study.identification.robot_file import robot_path
from ..study.timing.timing import time_scene
from ..study.tuning.file import default_path, to_tune, write_tuning
from ..study.tuning.space import Search
from ..study.tuning.study import finished_trials, tune
from .places import own_place

_TIMING = ("timing.json", "timing.png")
_STEPS, _QUICK_STEPS = 100_000, 2_000
_TRIALS = ("trials.csv", "trade_off.png")


def choose_rung(options: argparse.Namespace) -> int:
    """Run `pcr-mpc choose`."""
    scene = load_scene(options.scene)
    if options.write:
        if "scene" in options.named:
            raise ValueError(
                f"--write changes no file that comes with the package: pcr-mpc copy {scene.name} FOLDER first"
            )
        require_plant_table(options.scene)
        require_free(options.scene, force=True)
    known = load_uncertainty(robot_path(options.scene))
    choice = choose(scene, progress=True, **({} if known is None else {"uncertainty": known}))
    interrupt.check()
    print(json.dumps(choice_record(choice)) if options.json else f"\n{choice_table(choice)}")
    if options.write:
        write_rung(choice, options.scene)
        print(f"written to {options.scene}", file=sys.stderr)
    return 0


def time_loop(options: argparse.Namespace) -> int:
    """Run `pcr-mpc timing`."""
    scene = load_scene(options.scene)
    folder = options.out or own_place(options, f"timing/{scene.name}")
    require_folder(folder, _TIMING, force=options.overwrite)
    steps = options.steps or (_QUICK_STEPS if options.quick else _STEPS)
    without_c = options.quick or options.no_c
    result = time_scene(scene, steps, progress=True, in_c=None if without_c else time_in_c)

    def write(where: Path) -> None:
        with results(where) as staged:
            result["files"] = {name: str(where / name) for name in _TIMING}
            (staged / "timing.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
            plot_timing(result, staged / "timing.png")

    folder, problem = saved(write, folder)
    print(json.dumps(result) if options.json else f"\n{scene.name}\n\n{timing_tables(result)}\n\nwritten to {folder}")
    return _ended(problem, folder)


def tune_controller(options: argparse.Namespace) -> int:
    """Run `pcr-mpc tune`."""
    scene, known = to_tune(options.scene, options.start)
    folder = own_place(options, f"tune/{scene.name}", "give one of them another name")
    # What comes with the package is left as it came.
    path = options.out or Path(f"{scene.name}.toml")
    if options.out is None and "scene" not in options.named:
        path = default_path(options.scene, scene.name)
    require_free(path, force=options.overwrite)
    require_folder(folder, _TRIALS, force=options.overwrite)
    storage = options.storage or f"sqlite:///{folder / 'study.db'}"
    search = Search(lighter(scene), Spread(), options.episodes, options.seed, storage, known, options.keep_period)
    with local_workers(options.jobs) as executor:
        chosen = tune(search, options.trials, executor)
    interrupt.check()
    trials = finished_trials(search)
    problems = []
    if chosen is not None:
        comments = tuning_comments(search, chosen, len(trials), commit())
        best = replace(chosen.tuning, name=path.stem)

        def write_best(where: Path) -> None:
            write_tuning(best, where / path.name, comments, force=options.overwrite)

        parent, problem = saved(write_best, path.parent)
        path, problems = parent / path.name, [problem]

    def write_trials(where: Path) -> None:
        with results(where) as staged:
            write_rows(staged / "trials.csv", trials)
            title = f"Tuning for {scene.name}"
            plot_trade_off(trials, chosen.trial if chosen else None, title, staged / "trade_off.png")

    folder, problem = saved(write_trials, folder)
    files = {name: str(folder / name) for name in _TRIALS}
    if chosen is not None:
        files[path.name] = str(path)
    record: dict[str, Any] = {
        "scene": scene.name, "trials": len(trials), "storage": storage, "files": files,
        "chosen": {**asdict(chosen), "file": str(path)} if chosen else None,
    }  # fmt: skip
    if options.json:
        print(json.dumps(record))
    elif chosen is None:
        beaten = f"{search.start.name}{_enough(scene, trials)}"
        print(f"\nnone of {len(trials)} trials beats {beaten}: no tuning is written; see {folder}")
    else:
        print(f"\n{tuning_table(search, chosen)}\n\nwritten to {path}; the study is in {folder}")
    return _ended("; ".join(filter(None, [*problems, problem])), folder)


def _enough(scene: Scene, trials: list[dict[str, Any]]) -> str:
    """What a scene needs beside a better score, and what came nearest."""
    if scene.delay_margin is None:
        return ""
    most = max((row.get("delay_margin_ms", 0.0) for row in trials), default=0.0)
    return f" with the delay margin of {1e3 * scene.delay_margin:g} ms that is needed (the largest is {most:.3g} ms)"


def _ended(problem: str, folder: Path) -> int:
    """Exit status of a command that has said all; raises if its results are not where they should be."""
    if problem:
        raise OutputError(problem, path=str(folder))
    return 0
