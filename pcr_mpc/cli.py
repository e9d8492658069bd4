"""Command line: track a scene, solve a pose, time the loop, tune a controller."""

from __future__ import annotations

import argparse
import json
import re
import sys
import traceback
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .methods import METHODS

if TYPE_CHECKING:
    from .loop.run import Run

# The rest is loaded by the command that needs it, what reads its files first: an error need not wait for all.

_EXAMPLES = """\
examples:
  pcr-mpc track models/scenes/lemniscate.toml            closed loop, pictures and a table
  pcr-mpc track models/scenes/limited.toml --json        the same figures for a machine
  pcr-mpc statics models/planar_pair.toml --p 0 0.25 --mode LR     motor angles that hold the tip there
  pcr-mpc statics models/rfrfr.toml --q 120 60 --degrees           where the free tip comes to rest
  pcr-mpc statics models/planar_pair.toml --p 0.18 0.12 --equilibria   what else it could snap to
  pcr-mpc track models/scenes/lemniscate.toml --plant mujoco       against another engine's robot
  pcr-mpc export models/planar_pair.toml --p 0 0.25 --mode LR --out pair.xml     that robot as MJCF
  pcr-mpc choose models/scenes/vertical.toml             what physics the scene needs, and why
  pcr-mpc timing models/scenes/lemniscate.toml           step times against the real-time budgets
  pcr-mpc tune models/scenes/pick_and_place.toml --trials 20 --jobs 2     a better controller for it
"""

_LINKS = 40
# Least values of the options that are whole numbers.
_LEAST = {"seed": 0, "links": 2, "steps": 1, "trials": 1, "jobs": 1, "episodes": 1}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = _parser()
    options = parser.parse_args(arguments)
    from .errors import PCRError, described
    from .toml_table import read_toml

    try:
        for name, least in _LEAST.items():
            if (value := getattr(options, name, None)) is not None and value < least:
                raise ValueError(f"--{name} is {value}, expected at least {least}")
        for name in ("scene", "robot", "controller", "start"):
            if path := getattr(options, name, None):
                read_toml(path)  # the commonest error, before the rest is loaded
        status: int = options.run(options)
        return status
    except (PCRError, ValueError, OSError, MemoryError) as error:
        if options.traceback:
            traceback.print_exc()
        print(f"pcr-mpc: {described(error)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as interrupt:
        print(f"pcr-mpc: {str(interrupt) or 'interrupted'}", file=sys.stderr)
        return 130


class _Version(argparse.Action):
    """Looks the version up only where it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"pcr-mpc {version('pcr_mpc')}")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pcr-mpc",
        description="Model-predictive control of planar parallel continuum robots.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, run: Any, text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        # Python 3.14's pattern; before, argparse takes -1e-2 for an option.
        sub._negative_number_matcher = re.compile(r"-\.?\d")
        sub.set_defaults(run=run)
        sub.add_argument("--json", action="store_true", help="print one JSON object on stdout instead of tables")
        sub.add_argument("--traceback", action="store_true", help="show the traceback of a failure")
        return sub

    track = command("track", _track, "Run a scene in closed loop; write its record, a picture and an animation.")
    track.add_argument("scene", type=Path, help="scene file, such as models/scenes/lemniscate.toml")
    track.add_argument("--controller", type=Path, help="controller tuning instead of the scene's own")
    track.add_argument("--method", choices=METHODS, help="statics of the plant instead of the scene's own")
    track.add_argument("--plant", choices=("mujoco",), help="simulate the robot with MuJoCo instead (extra 'mujoco')")
    track.add_argument("--links", type=int, help="of each rod, with --plant mujoco (default 40)")
    track.add_argument("--seed", type=int, default=0, help="of the measurement noise (default 0)")
    track.add_argument("--out", type=Path, help="folder for the results (default results/NAME)")
    track.add_argument("--no-pictures", action="store_true", help="write the record only")

    statics = command(
        "statics",
        _statics,
        "Solve a pose: give --p and --q, or one of them to find the other in balance with --force.",
    )
    statics.add_argument("robot", type=Path, help="robot file, such as models/planar_pair.toml")
    statics.add_argument("--p", type=float, nargs=2, metavar=("X", "Y"), help="tip position [m]")
    statics.add_argument("--q", type=float, nargs="+", metavar="A", help="motor angles [rad]")
    statics.add_argument("--degrees", action="store_true", help="motor angles are given in degrees")
    statics.add_argument("--force", type=float, nargs=2, metavar=("FX", "FY"),
                         help="external force on the tip [N], where p or q is to be found (default 0 0)")  # fmt: skip
    statics.add_argument("--mode", help="working mode to look for, a letter L or R per rod, such as LR")
    statics.add_argument("--method", choices=METHODS, help="where both p and q are given (default closed_form)")
    statics.add_argument(
        "--equilibria",
        action="store_true",
        help="list every equilibrium, with its verdict: with --p and --q of the held tip, with --q of the free one, "
        "with --p of the held tip at the motor angles that balance it",
    )
    statics.add_argument("--picture", type=Path, metavar="FILE", help="draw the pose into FILE")

    mjcf = command("export", _export, "Write a robot in balance as a model file of MuJoCo (MJCF).")
    mjcf.add_argument("robot", type=Path, help="robot file, such as models/planar_pair.toml")
    mjcf.add_argument("--p", type=float, nargs=2, metavar=("X", "Y"), required=True, help="tip position [m]")
    mjcf.add_argument("--mode", help="working mode, a letter L or R per rod, such as LR")
    mjcf.add_argument("--links", type=int, default=_LINKS, help=f"of each rod (default {_LINKS})")
    mjcf.add_argument("--out", type=Path, required=True, metavar="FILE", help="model file, such as planar_pair.xml")

    choice = command(
        "choose",
        _choose,
        "Find the lowest physics and the cheapest discretisation that meet what a scene's [need] table asks for.",
    )
    choice.add_argument("scene", type=Path, help="scene file, such as models/scenes/vertical.toml")
    choice.add_argument("--write", action="store_true", help="put the chosen rung into the scene's [plant] table")

    timing = command(
        "timing", _timing, "Time plant steps of every method and the control step against their budgets; draw it."
    )
    timing.add_argument("scene", type=Path, help="scene file")
    timing.add_argument("--steps", type=int, default=100_000,
                        help="plant steps and control steps (default 100000: two or three minutes)")  # fmt: skip
    timing.add_argument("--out", type=Path, help="folder for the results (default results/timing/NAME)")

    tuning = command(
        "tune",
        _tune,
        "Search for a better tuning of a scene's linear MPC, with Optuna; write it if there is one. "
        "A study goes on where the last call with the same settings ended.",
    )
    tuning.add_argument("scene", type=Path, help="scene file")
    tuning.add_argument("--start", type=Path, metavar="FILE", help="tuning to beat (default: the scene's; default.toml "
                        "beside it if that is from an earlier search)")  # fmt: skip
    tuning.add_argument("--trials", type=int, default=50, help="to add to the study (default 50)")
    tuning.add_argument("--jobs", type=int, default=1, help="processes on this machine (default 1)")
    tuning.add_argument("--storage", metavar="URL", help="Optuna storage, for several machines "
                      "(default SQLite in results/tune/SCENE)")  # fmt: skip
    tuning.add_argument("--episodes", type=int, default=24, help="with mismatch, in each trial (default 24: a "
                        "study that sees no failure, which is rare, takes a fragile tuning for the best)")  # fmt: skip
    tuning.add_argument("--keep-period", action="store_true", help="the control period is given: search the rest")
    tuning.add_argument("--seed", type=int, default=0, help="of the first episode (default 0)")
    tuning.add_argument(
        "--out", type=Path, metavar="FILE", help="tuning to write (default SCENE.toml beside the scene's)"
    )
    return parser


def _statics(options: argparse.Namespace) -> int:
    from .cli_statics import solve_pose

    return solve_pose(options)


def _export(options: argparse.Namespace) -> int:
    from .cli_statics import export

    return export(options)


def _track(options: argparse.Namespace) -> int:
    from .control.tuning import load_tuning
    from .loop.scene import load_scene

    scene = load_scene(options.scene)
    tuning = load_tuning(options.controller) if options.controller else None
    if tuning and scene.trajectory is None:
        raise ValueError(f"scene {scene.name} has nothing to track, so --controller has no use")
    if tuning:
        scene = scene.tuned(tuning)
    if options.plant and options.method:
        raise ValueError("--method has no use with --plant: MuJoCo solves no statics")
    if options.links is not None and not options.plant:
        raise ValueError("--links goes with --plant mujoco")
    from .errors import SimulationError
    from .loop.model_inertia import by_model_inertia
    from .loop.simulate import simulate
    from .loop.simulated_plant import SimulatedPlant
    from .loop.tracking import make_controller
    from .plant.mujoco_plant import MuJoCoPlant
    from .report.tables import summary_table

    plant: SimulatedPlant = scene.make_plant()
    if options.plant:
        plant = MuJoCoPlant(scene.robot, links=_LINKS if options.links is None else options.links, dt=scene.plant.dt)
    elif options.method:
        scene = replace(scene, plant=replace(scene.plant, method=options.method))
        plant = scene.make_plant()
    folder = options.out or Path("results") / scene.name
    folder.mkdir(parents=True, exist_ok=True)  # rather now than after the run
    failure: SimulationError | None = None
    try:
        run = simulate(scene, plant, make_controller(scene, tuning), options.seed, progress=True)
    except SimulationError as error:
        failure, run = error, error.run
    files = run.save(folder)
    summary = {**run.summary(), "files": files}
    used = tuning or scene.tuning
    if options.plant and used is not None and failure is None:
        summary["by_model_inertia"] = by_model_inertia(run, used, plant, progress=True)
    if not options.no_pictures:
        files |= _pictures(run, folder)
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    print(json.dumps(summary) if options.json else f"\n{summary_table(summary)}\n\nwritten to {folder}")
    if failure is not None:
        raise failure
    return 0


def _pictures(run: Run, folder: Path) -> dict[str, str]:
    from .report.plots import animate_run, plot_run

    picture, animation = folder / "track.png", folder / "track.gif"
    plot_run(run, picture)
    animate_run(run, animation, progress=True)
    return {"track.png": str(picture), "track.gif": str(animation)}


def _choose(options: argparse.Namespace) -> int:
    from .loop.scene import load_scene

    scene = load_scene(options.scene)

    from .report.choice_tables import choice_record, choice_table
    from .study.choice import choose
    from .study.chosen_rung import write_rung

    choice = choose(scene, progress=True)
    print(json.dumps(choice_record(choice)) if options.json else f"\n{choice_table(choice)}")
    if options.write:
        write_rung(choice, options.scene)
        print(f"written to {options.scene}", file=sys.stderr)
    return 0


def _timing(options: argparse.Namespace) -> int:
    from .loop.scene import load_scene

    scene = load_scene(options.scene)

    from .report.timing import plot_timing, timing_tables
    from .study.timing import time_scene

    folder = options.out or Path("results") / "timing" / scene.name
    folder.mkdir(parents=True, exist_ok=True)
    result = time_scene(scene, options.steps, progress=True)
    result["files"] = {name: str(folder / name) for name in ("timing.json", "timing.png")}
    (folder / "timing.json").write_text(json.dumps(result, indent=2) + "\n")
    plot_timing(result, folder / "timing.png")
    print(json.dumps(result) if options.json else f"\n{scene.name}\n\n{timing_tables(result)}\n\nwritten to {folder}")
    return 0


def _tune(options: argparse.Namespace) -> int:
    from .study.tuning_file import default_path, to_tune, write_tuning

    scene, known = to_tune(options.scene, options.start)

    from .report.csv_rows import write_rows
    from .report.tables import tuning_comments, tuning_table
    from .report.trade_off import plot_trade_off
    from .study.episodes import Spread, lighter
    from .study.parallel import local_workers
    from .study.provenance import commit
    from .study.tuning_space import Search
    from .study.tuning_study import finished_trials, tune

    folder = Path("results") / "tune" / scene.name
    folder.mkdir(parents=True, exist_ok=True)
    storage = options.storage or f"sqlite:///{folder / 'study.db'}"
    search = Search(lighter(scene), Spread(), options.episodes, options.seed, storage, known, options.keep_period)
    with local_workers(options.jobs) as executor:
        chosen = tune(search, options.trials, executor)
    trials = finished_trials(search)
    files = {name: str(folder / name) for name in ("trials.csv", "trade_off.png")}
    write_rows(Path(files["trials.csv"]), trials)
    plot_trade_off(trials, chosen.trial if chosen else None, f"Tuning for {scene.name}", folder / "trade_off.png")
    if chosen is not None:
        path = options.out or default_path(options.scene, scene.name)
        comments = tuning_comments(search, chosen, len(trials), commit())
        write_tuning(replace(chosen.tuning, name=path.stem), path, comments)
        files[path.name] = str(path)
    record = {"scene": scene.name, "trials": len(trials), "storage": storage, "files": files,
              "chosen": {**asdict(chosen), "file": str(path)} if chosen else None}  # fmt: skip
    if options.json:
        print(json.dumps(record))
    elif chosen is None:
        print(f"\nnone of {len(trials)} trials beats {search.start.name}: no tuning is written; see {folder}")
    else:
        print(f"\n{tuning_table(search, chosen)}\n\nwritten to {path}; the study is in {folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
