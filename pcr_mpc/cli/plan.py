"""The command of the command line that plans."""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

from ..design.moving_mass import moving_mass
from ..errors import OutputError, PCRError, cause
from ..files import require_free, saved, stamped, write_text
from ..loop.scene.file import load_scene
from ..loop.scene.scene import Scene
from ..report.designs.plan_table import LIGHT, plan_table
from ..study.planning.limits import PlanLimits
from ..study.planning.plan import plan_timing, rods_left_out
from ..study.planning.timed_path import TimedPath
from ..toml_table import seen_from
from .places import own_place


def plan(options: argparse.Namespace) -> int:
    """Run `pcr-mpc plan`."""
    scene = load_scene(options.scene)
    out = options.out or own_place(options, f"plan/{scene.name}.csv")
    picture = None if options.no_pictures else out.with_suffix(".png")
    for path in (out, picture):
        if path is not None:
            require_free(path, force=options.overwrite)
    more = {
        name: math.inf if value is None else value
        for name, value in vars(options).items()
        if name in ("tip_speed", "tip_acceleration", "tip_jerk")
    }
    begin = time.perf_counter()
    planned = plan_timing(
        scene,
        limits=PlanLimits.of_scene(scene, **more),
        tolerance=1e-3 * options.tolerance,
        cells=options.cells,
        free=options.free,
        progress=True,
    )
    summary = planned.summary() | {"planning_s": time.perf_counter() - begin}
    summary |= {"share_of_rods": moving_mass(scene.start())[1]}
    if planned.rods is None and summary["share_of_rods"] > LIGHT:
        summary["rods_left_out"] = _left_out(scene, planned)

    def write(folder: Path) -> None:
        write_text(folder / out.name, stamped(planned.csv()))
        if picture is not None:
            from ..report.designs.plan_picture import plot_plan  # Matplotlib, which takes half a second to import

            plot_plan(planned, folder / picture.name)

    folder, problem = saved(write, out.parent)
    names = [out.name] if picture is None else [out.name, picture.name]
    summary["files"] = {name: str(folder / name) for name in names}
    if options.json:
        print(json.dumps(summary))
    else:
        print(f"\n{plan_table(summary)}\n\nwritten to {folder / out.name}; {_use(options, folder / out.name)}")
    if problem:
        raise OutputError(problem, path=str(folder))
    return 0


def _left_out(scene: Scene, planned: TimedPath) -> dict[str, Any]:
    """What to expect where the rods have their mass."""
    try:
        return rods_left_out(scene, planned).summary()
    except PCRError as error:
        return {"error": cause(error)}


def _use(options: argparse.Namespace, file: Path) -> str:
    """What to write into which scene, whose paths are relative to its own folder."""
    if "scene" in options.named:
        scene = options.scene.stem
        place, named = f"a copy of {scene} (pcr-mpc copy {scene} FOLDER)", file.resolve().as_posix()
    else:
        place, named = str(options.scene), seen_from(file, options.scene.parent)
    return (
        f"to track it, put into {place}, instead of its [reference] and its duration:\n"
        f'[reference]\nkind = "file"\nfile = "{named}"'
    )
