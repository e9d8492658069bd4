"""The control step of this tree against that of another one, in turns.

Two trees of the toolkit, each in processes of its own, run the same scene one after the other and again; CPU time of
the controller's thread counts, of which every figure is the best of all runs: what else a computer does makes a step
longer, never shorter. Of this tree the other QP solver and CasADi's interpreter are measured beside.
Run as ``python -m experiments.speed.paired_step OTHER_TREE``, a folder such as ``git worktree add`` makes.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pcr_mpc import load_scene, make_controller, simulate
from pcr_mpc.report.tables import table

ROOT = Path(__file__).parents[2]
_RUNS = 3  # in a process
_WARM_UP = 5  # steps after a start
VARIANTS: dict[str, dict[str, Any]] = {
    "machine code, OSQP": {"solver": "osqp", "compiled": True},
    "machine code, DAQP": {"solver": "daqp", "compiled": True},
    "interpreted, OSQP": {"solver": "osqp", "compiled": False},
}


def measure(path: Path, choice: dict[str, Any]) -> dict[str, Any]:
    """Percentiles [us] of the control step of a scene, each the best of a few runs, and the error [mm]."""
    scene = load_scene(path)
    if choice and scene.tuning is not None:
        model = replace(scene.tuning.model, compiled=choice["compiled"])
        scene = scene.tuned(replace(scene.tuning, solver=choice["solver"], model=model))
    plant, controller = scene.make_plant(), make_controller(scene)
    found = []
    for _ in range(_RUNS):
        gc.collect()
        run = simulate(scene, plant, controller)
        found.append(np.percentile(1e6 * run.control_time[_WARM_UP:, 5], [50, 99, 100]))
    return {"us": np.min(found, axis=0).tolist(), "rms_mm": run.summary()["rms_mm"]}


def measured(tree: Path, scene: str, choice: dict[str, Any]) -> dict[str, Any]:
    """`measure` in a process of its own, by the code of a tree."""
    path = tree / "models" / "scenes" / f"{scene}.toml"
    command = [sys.executable, str(Path(__file__).resolve()), str(path), "--measure", json.dumps(choice)]
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=tree, env=environment)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure in turns, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tree", type=Path, help="folder of the other tree")
    parser.add_argument("--scene", default="lemniscate", help="name of a scene that both have (default lemniscate)")
    parser.add_argument("--rounds", type=int, default=3, help="how often all are measured (default 3)")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.measure is not None:
        print(json.dumps(measure(options.tree, json.loads(options.measure))))
        return
    trees: dict[str, tuple[Path, dict[str, Any]]] = {"the other tree, as it is": (options.tree.resolve(), {})}
    trees |= {name: (ROOT, choice) for name, choice in VARIANTS.items()}
    best: dict[str, list[float]] = {}
    errors: dict[str, float] = {}
    for _ in range(options.rounds):
        for name, (tree, choice) in trees.items():
            found = measured(tree, options.scene, choice)
            best[name] = np.minimum(best.get(name, [np.inf] * 3), found["us"]).tolist()
            errors[name] = found["rms_mm"]
    first = next(iter(best.values()))
    rows = [
        [name, *(f"{value:.0f}" for value in us), *(f"{a / b:.1f}" for a, b in zip(first, us, strict=True)),
         f"{errors[name]:.6f}"]
        for name, us in best.items()
    ]  # fmt: skip
    heads = ["control step, CPU time [us]", "p50", "p99", "max", "p50 shorter by", "p99", "max", "RMS [mm]"]
    print(table(heads, rows))


if __name__ == "__main__":
    main()
