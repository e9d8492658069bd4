"""The longest control step of every scene: CPU time over ten thousand steps, and who answered.

Each scene is run again and again, with other seeds of the noise and small other starts of the tip's velocity, until so
many control steps are done. CPU time of the controller's thread is what counts: on a shared machine wall time is
somebody else's. Writes worst_case.csv.
"""

from __future__ import annotations

import argparse
import gc
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from pcr_mpc import Scene, SimulationError, load_scene, make_controller, simulate
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.tables import table

SCENES = Path(__file__).parents[2] / "models" / "scenes"
_KICK = 0.02  # m/s, standard deviation of the tip's velocity at the start
_WARM_UP = 5  # steps after a start


def measure(scene: Scene, steps: int) -> dict[str, Any]:
    """Times [us], iterations, rungs, failures over at least ``steps`` control steps."""
    times: list[np.ndarray] = []
    most, rungs, failures, violations, seed = 0, Counter[str](), 0, 0, 0
    plant, controller = scene.make_plant(), make_controller(scene)
    bar = tqdm(total=steps, desc=scene.name, unit="step")
    while bar.n < steps:
        kick = np.random.default_rng(seed).normal(0.0, _KICK, 2)
        velocity = np.array(scene.start_velocity) + (kick if seed else 0.0)
        varied = replace(scene, start_velocity=(float(velocity[0]), float(velocity[1])))
        gc.collect()
        try:
            run = simulate(varied, plant, controller, seed)
        except SimulationError as error:
            run, failures = error.run, failures + 1
        times.append(1e6 * run.control_time[_WARM_UP:, 5])
        summary = run.summary()
        rungs.update(summary["control_rungs"])
        most, violations = max(most, summary["qp_iterations"]["max"]), violations + summary["limit_violations"]
        seed += 1
        bar.update(len(run.u))
    bar.close()
    p50, p99, p999, longest = np.percentile(np.concatenate(times), [50, 99, 99.9, 100])
    return {
        "scene": scene.name, "steps": bar.n, "p50_us": p50, "p99_us": p99, "p99.9_us": p999, "max_us": longest,
        "iterations_max": most, "rungs": " ".join(f"{rung}:{count}" for rung, count in rungs.items() if count),
        "limit_violations": violations, "failures": failures,
    }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, write the CSV file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=10_000, help="control steps of every scene (default 10000)")
    parser.add_argument("--out", type=Path, default=Path("results/worst_case"), help="folder for the results")
    options = parser.parse_args(arguments)
    scenes = [load_scene(path) for path in sorted(SCENES.glob("*.toml"))]
    rows = [measure(scene, options.steps) for scene in scenes if scene.trajectory is not None]
    write_rows(options.out / "worst_case.csv", rows)
    cells = [[f"{v:.0f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    print(table(list(rows[0]), cells))


if __name__ == "__main__":
    main()
