"""The command of the command line that generates C."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from dataclasses import asdict, replace
from pathlib import Path

from ..codegen.folder import require_free_folder, write_folder
from ..codegen.loss import measure_loss
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
    subject = Subject.of_scene(scene, tuning, single=options.float32)
    run, loss = recorded(subject, progress=True), None
    if options.float32:
        print(f"{scene.name}: compiling and running it in single precision ...", file=sys.stderr)
        loss = measure_loss(scene.name, lambda place: write_folder(subject, run, place), run.summary()["rms_mm"],
                            subject.robot.lengths.max())  # fmt: skip
    write_folder(subject, run, folder, loss)
    summary = {
        "scene": scene.name,
        "controller": subject.tuning.name,
        "solver": subject.tuning.solver,
        "rms_mm": run.summary()["rms_mm"],
        "single": None if loss is None else asdict(loss),
        "folder": str(folder),
        "source_kB": round(sum(path.stat().st_size for path in folder.rglob("*.[ch]")) / 1e3),
    }
    if options.json:
        print(json.dumps(summary))
    else:
        print(f"\nC of scene {scene.name}, controller {subject.tuning.name}, is in {folder}; to build and run it:\n")
        if loss is not None:
            print(f"  single precision: {loss}\n")
        place = shlex.quote(str(folder))
        print(f"  make -C {place} && {place}/example\n\n{folder / 'README.md'} says how to use it")
    return 0
