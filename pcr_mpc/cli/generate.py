"""The command of the command line that generates C."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

from ..codegen.folder import require_free_folder, write_folder
from ..codegen.scope import check_scope
from ..codegen.subject import Subject
from ..codegen.vectors import recorded
from ..control.tuning import load_tuning
from ..loop.scene.file import load_scene


def generate(options: argparse.Namespace) -> int:
    """Run `pcr-mpc generate`."""
    scene = load_scene(options.scene)
    tuning = load_tuning(options.controller) if options.controller else scene.tuning
    if tuning is not None:
        tuning = tuning if options.solver is None else replace(tuning, solver=options.solver)
        scene = scene.tuned(tuning)
    tuning = check_scope(scene, tuning)
    folder = options.out or Path("build") / scene.name
    require_free_folder(folder, tuning.solver, force=options.overwrite)
    subject = Subject.of_scene(scene, tuning)
    run = recorded(subject, progress=True)
    write_folder(subject, run, folder)
    summary = {
        "scene": scene.name,
        "controller": subject.tuning.name,
        "solver": subject.tuning.solver,
        "rms_mm": run.summary()["rms_mm"],
        "folder": str(folder),
        "source_kB": round(sum(path.stat().st_size for path in folder.rglob("*.[ch]")) / 1e3),
    }
    if options.json:
        print(json.dumps(summary))
    else:
        print(f"\nC of scene {scene.name}, controller {subject.tuning.name}, is in {folder}; to build and run it:\n")
        print(f"  make -C {folder} && {folder / 'example'}\n\n{folder / 'README.md'} says how to use it")
    return 0
