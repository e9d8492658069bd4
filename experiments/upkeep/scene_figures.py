"""What the README and the pages say of the shipped scenes: each run with its own controller, into docs/records.

So is the lemniscate with motors that are later than anybody told (``late_motors``).

``python -m experiments.upkeep.scene_figures`` writes docs/records/scenes.json; ``python -m
experiments.upkeep.text_figures --write`` then puts the figures into the text.
Times are CPU times of the controller's thread, the least of three runs.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from pcr_mpc import Motors, Scene, SimulationError, load_scene, load_tuning, make_controller, simulate
from pcr_mpc.study.episodes.provenance import commit
from pcr_mpc.study.timing.machine import machine, versions

ROOT = Path(__file__).parents[2]
SCENES = ROOT / "models" / "scenes"
_TIMES = ("control_cpu_us", "plant_step_us")
_RUNS, _ENOUGH = 3, 10.0  # at most, and the time [s] after which no other is begun
_KEPT = ("controller", "plant", "rms_mm", "rms_after_1s_mm", "max_mm", "final_error_mm", "limit_violations", "failures")


def late_motors() -> Scene:
    """The lemniscate with the default tuning, which knows nothing of motors that lag and commands that come late."""
    scene = load_scene(SCENES / "lemniscate.toml").tuned(load_tuning(ROOT / "controllers" / "default.toml"))
    return replace(scene, motors=Motors(time_constant=0.02), untold_delay=0.02)


def measure(scene: Scene) -> dict[str, Any]:
    """Figures of one scene; times are the least of a few equal runs: what else a computer does makes none shorter."""
    times: dict[str, dict[str, float]] = {}
    began = time.monotonic()
    for _ in range(_RUNS):
        try:
            run = simulate(scene, scene.make_plant(), make_controller(scene))
        except SimulationError as error:
            run = error.run
        summary = run.summary()
        for name in _TIMES:
            found = summary[name]
            times[name] = {key: min(value, times.get(name, found)[key]) for key, value in found.items()}
        if time.monotonic() - began > _ENOUGH:
            break
    return {name: summary[name] for name in (*_KEPT, "run_hash")} | {"verdict": run.verdict()} | times


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", help="names, such as lemniscate (default: all)")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "records" / "scenes.json")
    options = parser.parse_args(arguments)
    scenes: dict[str, Callable[[], Scene]] = {
        path.stem: partial(load_scene, path) for path in sorted(SCENES.glob("*.toml"))
    }
    scenes["late_motors"] = late_motors
    record: dict[str, Any] = {}
    if options.scenes and options.out.exists():
        record = json.loads(options.out.read_text(encoding="utf-8"))
    for name in tqdm(options.scenes or list(scenes), unit="scene"):
        record[name] = measure(scenes[name]())
    about = machine()
    record["measured"] = {
        "processor": about["processor"], "cores": about["cores"], "load": about["load"], "versions": versions(),
        "commit": commit(),
    }  # fmt: skip
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(record, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    print(f"written to {options.out}")


if __name__ == "__main__":
    main()
