"""The longest control step of every scene: CPU time over ten thousand steps, and what the longest of them did.

Each scene is simulated again and again, with other seeds of the noise and small other starts of the tip's velocity,
until so many control steps are done. Then a controller is given what was measured, all of it several times
over. It decides the same each time, to the last bit, so that the least of the times of a step is what it takes: what
other work of the machine adds is not the step's. CPU time of the controller's thread is what counts. Plants move in
processes of their own, and nothing of this script runs beside what is timed. Writes worst_case.csv.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from pcr_mpc import Plant, Scene, SimulationError, load_scene, make_controller, simulate
from pcr_mpc.loop.controller.tracking import TrackingController
from pcr_mpc.loop.parts.controllers import Controller, decision_of
from pcr_mpc.plant.statics.equilibrium import Equilibrium
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.tables import table
from pcr_mpc.study.episodes.parallel import local_workers

SCENES = Path(__file__).parents[2] / "models" / "scenes"
_KICK = 0.02  # m/s, standard deviation of the tip's velocity at the start


@dataclass(frozen=True, eq=False)
class Recorded:
    """What a controller was told in a run, and what it answered: see `Run`."""

    pose: Equilibrium
    measured: np.ndarray
    u: np.ndarray
    violations: int
    failed: bool


@lru_cache(maxsize=1)
def _parts(path: Path) -> tuple[Scene, Plant, Controller]:
    """A scene, its plant, and its controller, who knows its dynamics: they are most of what a start takes."""
    scene = load_scene(path)
    controller = make_controller(scene)
    if isinstance(controller, TrackingController):
        controller.start(scene.start())
        controller = make_controller(scene, reference=controller.reference)
    return scene, scene.make_plant(), controller


def record(path: Path, seeds: Sequence[int]) -> list[Recorded]:
    """Run a scene once for each seed, from a start that the seed varies unless it is zero."""
    scene, plant, controller = _parts(path)
    runs = []
    for seed in seeds:
        kick = np.random.default_rng(seed).normal(0.0, _KICK, 2) if seed else np.zeros(2)
        x, y = (np.array(scene.start_velocity) + kick).tolist()
        failed = False
        try:
            run = simulate(replace(scene, start_velocity=(x, y)), plant, controller, seed)
        except SimulationError as error:
            run, failed = error.run, True
        assert run.measured is not None
        runs.append(Recorded(run.pose, run.measured, run.u, run.summary()["limit_violations"], failed))
    return runs


def measure(path: Path, runs: Sequence[Recorded], repeats: int) -> dict[str, Any]:
    """Times [us] of all steps of the runs, each done ``repeats`` times, and what the longest did."""
    scene, _, controller = _parts(path)
    did: list[tuple[int, int, str, int]] = []  # run, period, rung, iterations
    times = np.empty((repeats, sum(len(run.u) for run in runs)))
    for repeat, row in enumerate(times):
        at = 0
        for number, run in enumerate(runs):
            controller.start(run.pose)
            gc.collect()
            for k, x in enumerate(run.measured[: len(run.u)]):
                began = time.thread_time()
                answer = controller.step(k, x)
                row[at] = time.thread_time() - began
                at += 1
                decision = decision_of(answer, x.size - 4)
                if decision.u.tolist() != run.u[k].tolist():
                    raise RuntimeError(f"{scene.name}: period {k} of run {number} was decided otherwise than before")
                if not repeat:
                    plan = decision.plan
                    did.append((number, k, plan.fallback or "solved", plan.iterations) if plan else (number, k, "-", 0))
    rungs = Counter(rung for _, _, rung, _ in did)
    least, single = 1e6 * times.min(axis=0), 1e6 * times.max(axis=0)
    p50, p99, p999, longest = np.percentile(least, [50, 99, 99.9, 100])
    begun = np.array([k > 0 for _, k, _, _ in did])
    number, k, rung, iterations = did[int(least.argmax())]
    return {
        "scene": scene.name, "steps": len(least), "p50_us": p50, "p99_us": p99, "p99.9_us": p999, "max_us": longest,
        "max_after_first_us": least[begun].max(), "max_single_us": single.max(), "longest_run": number,
        "longest_period": k, "longest_rung": rung, "longest_iterations": iterations,
        "iterations_max": max(count for *_, count in did),
        "rungs": " ".join(f"{rung}:{count}" for rung, count in rungs.items()),
        "limit_violations": sum(run.violations for run in runs), "failures": sum(run.failed for run in runs),
    }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, write the CSV file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=10_000, help="control steps of every scene (default 10000)")
    parser.add_argument("--repeats", type=int, default=3, help="how often each step is done (default 3)")
    parser.add_argument("--scenes", nargs="+", metavar="NAME", help="these only")
    parser.add_argument("--out", type=Path, default=Path("results/worst_case"), help="folder for the results")
    options = parser.parse_args(arguments)
    paths = [SCENES / f"{name}.toml" for name in options.scenes or ()] or sorted(SCENES.glob("*.toml"))
    periods = {path: load_scene(path).n_periods for path in paths if load_scene(path).trajectory is not None}
    with local_workers() as workers:
        tasks = {path: workers.submit(record, path, range(-(-options.steps // n))) for path, n in periods.items()}
        for task in tqdm(as_completed(tasks.values()), desc="simulations", unit="scene", total=len(tasks)):
            task.result()
    rows = []
    for path, task in tqdm(tasks.items(), desc="control steps", unit="scene"):
        rows.append(measure(path, task.result(), options.repeats))
        write_rows(options.out / "worst_case.csv", rows)  # what is measured is kept, whatever happens to the rest
    cells = [[f"{v:.0f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    print(table(list(rows[0]), cells))


if __name__ == "__main__":
    main()
