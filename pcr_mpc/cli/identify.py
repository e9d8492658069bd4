"""The commands of the command line that find a robot's numbers."""

from __future__ import annotations

import argparse
import json
import shlex
from pathlib import Path

from .. import interrupt
from ..errors import IdentificationError, OutputError
from ..files import require_folder, require_free, results, saved
from ..loop.scene.file import load_scene
from ..plant.uncertainty import load_uncertainty
from ..report.studies.excitation import excitation_record, excitation_table, plot_excitation
from ..report.studies.identification import (
    identification_comments,
    identification_record,
    identification_table,
    plot_identification,
)
from ..study.episodes.provenance import commit
from ..study.excitation.design import excite
from ..study.excitation.file import PATH, SCENE, require_readable, write_path, write_scene
from ..study.identification.identify import identify
from ..study.identification.logs.log import Log, read_log
from ..study.identification.robot_file import robot_path, write_robot
from .places import own_place

_FILES = ("identification.json", "identification.png")
_EXCITED = (PATH, SCENE, "excitation.json", "excitation.png")


def identify_robot(options: argparse.Namespace) -> int:
    """Run `pcr-mpc identify`."""
    scene, robot_file = load_scene(options.scene), robot_path(options.scene)
    fixed = dict(_fixed(one) for one in options.fix)
    free = [name for names in options.free or ["default"] for name in names.split(",") if name.strip()]
    logs = _logs(options.logs, scene.robot.n_rods)
    others = _logs(options.validate, scene.robot.n_rods)
    folder = options.results or own_place(options, f"identify/{scene.name}", "--results takes another folder")
    require_folder(folder, _FILES, force=options.overwrite)
    if options.out:
        require_free(options.out, force=options.overwrite)
    found = identify(
        scene,
        logs,
        free=free,
        fixed=fixed,
        uncertainty=load_uncertainty(robot_file),
        loss="huber" if options.robust else options.loss,
        validate=others,
        progress=True,
    )
    interrupt.check()
    files = {name: str(folder / name) for name in _FILES}
    problems = []
    if options.out:
        comments = identification_comments(found, [Path(log).name for log in options.logs], commit())

        def write(where: Path) -> None:
            write_robot(found, robot_file, where / options.out.name, comments, force=options.overwrite)

        parent, problem = saved(write, options.out.parent)
        files["robot"], problems = str(parent / options.out.name), [problem]

    def write_figures(where: Path) -> None:
        with results(where) as staged:
            named = files | {name: str(where / name) for name in _FILES}
            text = json.dumps(identification_record(found, named), indent=2)
            (staged / _FILES[0]).write_text(text + "\n", encoding="utf-8")
            plot_identification(found, staged / _FILES[1])

    folder, problem = saved(write_figures, folder)
    files |= {name: str(folder / name) for name in _FILES}
    if options.json:
        print(json.dumps(identification_record(found, files)))
    else:
        print(f"\n{identification_table(found)}\n\nwritten to {', '.join(files.values())}")
    if problem := "; ".join(filter(None, [*problems, problem])):
        raise OutputError(problem, path=str(folder))
    return 0


def excite_robot(options: argparse.Namespace) -> int:
    """Run `pcr-mpc excite`."""
    scene, known = load_scene(options.scene), load_uncertainty(robot_path(options.scene))
    folder = options.out or own_place(options, f"excite/{scene.name}")
    require_folder(folder, _EXCITED, force=options.overwrite)
    found = excite(scene, options.duration, trials=options.trials, seed=options.seed, uncertainty=known, progress=True)
    interrupt.check()
    files: dict[str, str] = {}

    def write(where: Path) -> None:
        with results(where) as staged:
            files.update({name: str(where / name) for name in _EXCITED})
            write_path(found, staged / PATH)
            write_scene(found, options.scene, staged / SCENE, where)
            text = json.dumps(excitation_record(found, files), indent=2)
            (staged / "excitation.json").write_text(text + "\n", encoding="utf-8")
            plot_excitation(found, staged / "excitation.png")

    folder, problem = saved(write, folder)
    if options.json:
        print(json.dumps(excitation_record(found, files)))
    else:
        place = shlex.quote(str(folder / SCENE))
        print(f"\n{excitation_table(found)}\n\nwritten to {folder}; record it with: pcr-mpc track {place}")
    if problem:
        raise OutputError(problem, path=str(folder))
    require_readable(folder / SCENE)
    return 0


def _logs(paths: list[str], n: int) -> list[Log]:
    return [log for path in paths for log in read_log(path, n)]


def _fixed(text: str) -> tuple[str, float]:
    name, sign, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        what = f"{value!r} is no number" if sign else "there is no '='"
        raise IdentificationError(f"--fix {text}: {what}; write NAME=VALUE, such as tip_mass=0.25") from None
