"""The command of the command line that packs a plant or a controller as a functional mock-up unit."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path

from ..codegen.fmu.archive import require_platform, write_fmu
from ..codegen.fmu.description import identifier
from ..codegen.scope import check_scope
from ..codegen.subject import Subject
from ..control.tuning import load_tuning
from ..files import require_free
from ..loop.scene.file import load_scene


def fmu(options: argparse.Namespace) -> int:
    """Run `pcr-mpc fmu`."""
    scene = load_scene(options.scene)
    tuning = load_tuning(options.controller) if options.controller else scene.tuning
    if tuning is not None:
        scene = scene.tuned(tuning)
    tuning = check_scope(scene, tuning)
    require_platform()
    path = options.out or Path("build") / f"{identifier(scene.name, options.part)}.fmu"
    require_free(path, force=options.overwrite)
    subject = Subject.of_scene(scene, tuning)
    print(f"{scene.name}: compiling the {options.part} as a model of FMI {options.version}.0 ...", file=sys.stderr)
    write_fmu(subject, options.part, options.version, path)
    step = subject.plant.dt if options.part == "plant" else scene.period
    summary = {
        "scene": scene.name,
        "part": options.part,
        "version": options.version,
        "controller": subject.tuning.name if options.part == "controller" else None,
        "step_s": step,
        "file": str(path),
        "kB": round(path.stat().st_size / 1e3),
    }
    if options.json:
        print(json.dumps(summary))
        return 0
    print(f"{path}: {options.part} of scene {scene.name}, FMI {options.version}.0 for co-simulation, "
          f"{summary['kB']} kB; its steps are of {step:g} s\n")  # fmt: skip
    print("To look at it: pip install fmpy, and fmpy info " + shlex.quote(str(path)))
    return 0
