"""The commands of the command line that begin with somebody's own robot: make one, and examine it."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from ..design.examination import Examination, examine
from ..design.remarks import Remark, about_wish
from ..design.sizing import Design, design
from ..design.strips import stiffer_upright
from ..design.toml_text import files
from ..design.wish import Wish
from ..errors import InfeasibleError, ModelError, PCRError
from ..files import require_absent, require_free, write_text
from ..loop.demand.feasibility import check_scene
from ..loop.scene.file import load_scene
from ..plant.robot import Robot, load_robot
from ..report.designs.check_tables import check_record, check_table
from ..report.designs.new_table import new_record, new_table
from ..toml_table import read_toml
from .behind import file_behind

_SLOWER = 1.25  # by which a lap is made longer until the reference keeps every limit
_ATTEMPTS = 12
_NAMES = ("robot.toml", "scene.toml", "tuning.toml")


def new(options: argparse.Namespace) -> int:
    """Run `pcr-mpc new`."""
    folder = options.folder
    if options.diameter is not None and (options.width, options.thickness) != (None, None):
        raise ModelError(
            "--diameter is of round rods, --width and --thickness are of strips: give one kind", key="width"
        )
    diameter = Wish.diameter if options.diameter is None else options.diameter
    wish = Wish(
        folder.resolve().name, options.rods, options.material, diameter, options.length, options.spacing,
        options.tip_mass, options.motor, options.width, options.thickness,
    )  # fmt: skip
    # Rather now than after the search.
    require_absent((folder / name for name in _NAMES), force=options.overwrite)
    chosen = _kept(design(wish))
    for name, text in files(chosen).items():
        write_text(folder / name, text)
    found = examine(load_scene(folder / "scene.toml"), modes=False, upright=wish.upright)
    found.remarks += about_wish(wish, found.robot)
    written = {name: str(folder / name) for name in _NAMES}
    print(json.dumps(new_record(chosen, found, written)) if options.json else new_table(chosen, found))
    scene = shlex.quote(str(folder / "scene.toml"))
    print(f"\nwritten to {folder}; next: pcr-mpc check {scene}, pcr-mpc track {scene}", file=sys.stderr)
    return _verdict(found, shown=not options.json)


def _kept(chosen: Design) -> Design:
    """The design with a lap so slow that its reference keeps every limit.

    Raises
    ------
    InfeasibleError
        Slowness does not help.
    """
    with tempfile.TemporaryDirectory(prefix="pcr-mpc-") as place:
        for _ in range(_ATTEMPTS):
            for name, text in files(chosen).items():
                write_text(Path(place) / name, text)
            try:
                excess = check_scene(load_scene(Path(place) / "scene.toml"))
            except ModelError:
                raise
            except PCRError as error:
                excess = [str(error)]
            if not excess:
                return chosen
            chosen = replace(chosen, lap=float(f"{_SLOWER * chosen.lap:.2g}"))
    raise InfeasibleError(
        f"{chosen.wish.name}: the path cannot be followed however slowly: {excess[0]}; take other numbers of the rods",
        limit="reference",
    )


def check(options: argparse.Namespace) -> int:
    """Run `pcr-mpc check`."""
    if options.picture:
        require_free(options.picture, force=options.overwrite)
    is_robot = read_toml(options.target).has("rods")
    what = load_robot(options.target) if is_robot else load_scene(options.target)
    robot_file = options.target if is_robot else options.target.parent / read_toml(options.target).text("robot")
    upright = stiffer_upright(what if isinstance(what, Robot) else what.robot, robot_file)
    found = examine(what, upright=upright)
    found.remarks = [_with_file(one, options) for one in found.remarks]
    print(json.dumps(check_record(found)) if options.json else check_table(found))
    if options.picture:
        from ..report.designs.check_picture import plot_check

        plot_check(found, options.picture)
        print(f"drawn in {options.picture}", file=sys.stderr)
    return _verdict(found, shown=not options.json)


def _with_file(remark: Remark, options: argparse.Namespace) -> Remark:
    key = {"controller": "model", "plant": "plant", "start of the reference": "reference"}.get(remark.about)
    file = file_behind(key, options) if key and remark.level == "error" else None
    return remark if file is None else replace(remark, text=f"{file}: {remark.text}")


def _verdict(found: Examination, *, shown: bool) -> int:
    """Exit status of what can run as asked; raises for what cannot, with why where the table has not shown it."""
    if found.errors:
        first = found.errors[0]
        more = f" (and {len(found.errors) - 1} more)" if len(found.errors) > 1 else ""
        asked = "cannot be held" if found.scene is None else "cannot run as asked"
        why = f"{first.about} (ERROR in the table)" if shown else first.text
        raise ModelError(f"{found.name} {asked}: {why}{more}", key=first.about, said=True)
    return 0
