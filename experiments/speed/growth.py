"""How does the cost grow with segments, horizon, rods, duration and number of robots, and why not as expected?

Each study changes one number and times one thing, the fastest of several tries: CPU time, which others on the machine
hardly change, and wall time where several threads work. The slope is that of the upper half of the points on
logarithmic axes; a fixed part and one that grows as expected, fitted to all points with relative errors, say how much
of the departure is a price paid once. Robots of three and more rods have their motors on a circle about the tip, all
rods turned alike, which balances by symmetry; that of two is the default robot. Writes growth.csv and growth.png.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls
from tqdm import tqdm

from pcr_mpc import Equilibrium, Plant, Robot, Scene, inverse_statics, load_robot, load_scene, rollout, solve_statics
from pcr_mpc.buffered import BufferedFunction
from pcr_mpc.compiled import has_compiler
from pcr_mpc.control.tuning import Tuning, load_tuning
from pcr_mpc.loop.controller.make_controller import make_controller
from pcr_mpc.loop.run.simulate import simulate
from pcr_mpc.plant.motion.step_graph import step_function
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import BLUE, GREEN, GREY, ORANGE, plt
from pcr_mpc.study.timing.machine import machine

CODES = ("interpreted", "compiled") if has_compiler() else ("interpreted",)
CENTRE, RADIUS, BOW = (0.0, 0.25), 0.27, 2.177  # m, m, and angle of a rod's motor from the direction to the tip [rad]


@dataclass(frozen=True)
class Study:
    """One axis of growth.

    Attributes
    ----------
    name, x_label, y_label : str
    expected : float
        Power with which the time should grow, once what is fixed does not count.
    reason : str
        Why it departs from that.
    points, quick : tuple of int
        Where to measure, and where for a quick look.
    measure : callable
        number -> {series: time [us]}.
    """

    name: str
    x_label: str
    y_label: str
    expected: float
    reason: str
    points: tuple[int, ...]
    quick: tuple[int, ...]
    measure: Callable[[int], dict[str, float]]


def circle(pair: Robot, n: int) -> tuple[Robot, Equilibrium]:
    """Return a robot of n rods like the default robot's, and the pose in which it rests at the centre."""
    if n == 2:
        return pair, inverse_statics(pair, CENTRE, mode="LR")
    phi = -np.pi / 2 + 2 * np.pi * np.arange(n) / n
    bases = np.array(CENTRE) + RADIUS * np.stack([np.cos(phi), np.sin(phi)], axis=1)
    q = phi + np.pi + BOW
    rods = tuple(
        replace(pair.rods[0], base=tuple(base), angle_limits=(angle - 1.5, angle + 1.5))
        for base, angle in zip(bases.tolist(), q.tolist(), strict=True)
    )
    return (robot := replace(pair, name=f"{n} rods on a circle", rods=rods)), solve_statics(robot, CENTRE, q)


def step_time(plant: Plant, pose: Equilibrium, steps: int = 400, tries: int = 5) -> float:
    """Time of a step with the motors turning to and fro [us]."""
    inputs = 0.5 * np.sin(0.03 * np.arange(steps)[:, None] + np.arange(plant.robot.n_rods))
    start = np.concatenate([pose.p, (0.05, -0.05), pose.q])
    best = np.inf
    for _ in range(tries):
        x = start
        plant.reset(x, pose)
        x = plant.step(x, inputs[0])
        began = time.thread_time()
        for u in inputs[1:]:
            x = plant.step(x, u)
        best = min(best, (time.thread_time() - began) / (steps - 1))
    return 1e6 * best


def segments(pair: Robot, n: int) -> dict[str, float]:
    """Plant step by multiple shooting with n segments per rod, and its graph without Python."""
    pose = inverse_statics(pair, CENTRE, mode="LR")
    plant = Plant(pair, method="multiple_shooting", segments=n, integrator="velocity_verlet")
    found = {"plant step": step_time(plant, pose, steps=150, tries=4)}
    x = np.concatenate([pose.p, (0.05, -0.05), pose.q])
    plant.reset(x, pose)
    assert plant.step_model is not None
    graph = BufferedFunction(step_function(plant.step_model, 1, details=True, compiled=False))
    for place, value in zip(graph.inputs, (plant.memory(x), x, np.zeros(4), plant.numbers), strict=True):
        place[:] = value
    spent = []
    for _ in range(400):
        began = time.thread_time()
        graph()
        spent.append(time.thread_time() - began)
    return {**found, "its graph alone": 1e6 * float(np.median(spent))}


def horizon(scene: Scene, tunings: dict[str, Tuning], n: int) -> dict[str, float]:
    """Control step of a controller with a horizon of n periods, and what of it belongs to the QP alone."""
    found = {}
    for name, tuning in tunings.items():
        whole, update, solver = control_times(scene.tuned(replace(tuning, horizon=n)))
        found[f"step, {name}"] = whole
        if name == "along the plan":
            found |= {"assembling the QP": update, "inside OSQP": solver}
    return found


def control_times(scene: Scene, tries: int = 3) -> tuple[float, float, float]:
    """Least median of a control step's CPU time, and of the times of assembling its QP and inside OSQP [us]."""
    controller, medians = make_controller(scene), []
    for _ in range(tries):
        run = simulate(scene, scene.make_plant(), controller)
        medians.append(np.median(run.control_time[20:], axis=0))
    _, _, update, _, solver, whole = (1e6 * np.min(medians, axis=0)).tolist()
    return whole, update, solver


def rods(pair: Robot, scene: Scene, n: int) -> dict[str, float]:
    """Plant step and control step of a robot of n rods."""
    robot, pose = circle(pair, n)
    found = {}
    for code in CODES:
        plant = Plant(robot, integrator="velocity_verlet", compiled=code == "compiled")
        found[f"plant step, {code}"] = step_time(plant, pose)
    motors = replace(scene, robot=robot, start_tip=None, start_mode=None, start_motors=tuple(pose.q.tolist()))
    return {**found, "control step": control_times(motors if n > 2 else scene)[0]}


def duration(scene: Scene, n: int) -> dict[str, float]:
    """Closed loop of n tenths of a second."""
    shortened = replace(scene, duration=0.1 * n)
    controller = make_controller(shortened)
    loops, wholes = [], []
    for _ in range(3):
        began = time.thread_time()
        run = simulate(shortened, shortened.make_plant(), controller)
        wholes.append(time.thread_time() - began)
        loops.append(run.control_time[:, 5].sum())
    return {"control steps": 1e6 * min(loops), "all of simulate": 1e6 * min(wholes)}


def batch(pair: Robot, steps: int, n: int) -> dict[str, float]:
    """Rollout of n robots that start alike and move differently."""
    pose = inverse_statics(pair, CENTRE, mode="LR")
    x = np.concatenate([pose.p, (0.05, -0.05), pose.q])
    inputs = np.random.default_rng(0).uniform(-1.0, 1.0, (n, steps, 2))
    cores = machine()["usable_cores"]
    found = {}
    for code in CODES:
        plant = Plant(pair, integrator="velocity_verlet", compiled=code == "compiled")
        for threads in dict.fromkeys((1, cores)):
            rollout(plant, x, inputs[: min(n, 2)], guess=pose, threads=threads)  # builds what is to be built
            spent = []
            for _ in range(3 if n * steps < 1e5 else 1):
                clock = time.perf_counter if threads > 1 else time.thread_time
                began = clock()
                rollout(plant, x, inputs, guess=pose, threads=threads)
                spent.append(clock() - began)
            found[f"{code}, {threads} thread{'s' * (threads > 1)}"] = 1e6 * min(spent)
    return found


def studies(quick: bool) -> list[Study]:
    """All of them."""
    pair, scene = load_robot("models/planar_pair.toml"), load_scene("models/scenes/lemniscate.toml")
    lap = replace(scene, duration=1.0 if quick else 3.0)
    tunings = {
        "along the plan": load_tuning("controllers/default.toml"),
        "one model": load_tuning("controllers/frozen.toml"),
    }
    steps = 50 if quick else 100
    return [
        Study("Segments per rod", "segments N", "plant step [us]", 1.0,
              "the sweep is O(N); Python costs the same at any N,\nand long graphs leave the cache",
              (2, 4, 8, 16, 32, 64), (2, 8, 32), lambda n: segments(pair, n)),
        Study("Horizon", "control periods N", "[us]", 2.0,
              "N^2 entries of the QP, but few models are new in a\nstep and the checks cost the same at any N",
              (2, 3, 5, 8, 12, 20, 30, 45), (3, 10, 30), lambda n: horizon(lap, tunings, n)),
        Study("Rods", "rods n", "step [us]", 1.0,
              "rods do not couple; the call and the tip are paid once;\nin a control step the QP's n^2 begins to count",
              (2, 3, 4, 5, 6, 7, 8), (2, 4, 8), lambda n: rods(pair, lap, n)),
        Study("Duration", "tenths of a simulated second", "run [us]", 1.0,
              "start-up: a throw-away step, and the inverse\ndynamics of the reference, which is as long as the run",
              (2, 5, 10, 20, 40, 80), (2, 5, 10), lambda n: duration(scene, n)),
        Study("Robots at once", f"robots, {steps} steps each", "rollout [us]", 1.0,
              "start-up of 1 ms; memory for states beyond the cache\nis not noticed, threads cannot help one robot",
              (1, 3, 10, 30, 100, 300, 1000, 3000, 10000), (1, 10, 100, 1000), lambda n: batch(pair, steps, n)),
    ]  # fmt: skip


def fit(x: np.ndarray, y: np.ndarray, power: float) -> tuple[float, float, float]:
    """Slope of the upper half of the points, and the parts a, b >= 0 of a + b x^power [us]."""
    upper = x >= np.median(x)
    slope = float(np.polyfit(np.log(x[upper]), np.log(y[upper]), 1)[0])
    (a, b), _ = nnls(np.stack([1 / y, x**power / y], axis=1), np.ones(len(x)))
    return slope, float(a), float(b)


def measure(chosen: list[Study], quick: bool) -> list[dict[str, Any]]:
    """One row for each point of each series, with the fit of its series."""
    rows = []
    for study in chosen:
        points = study.quick if quick else study.points
        found: dict[str, list[float]] = {}
        for n in tqdm(points, desc=study.name, unit="point"):
            gc.collect()
            for series, us in study.measure(n).items():
                found.setdefault(series, []).append(us)
        for series, times in found.items():
            slope, fixed, growing = fit(np.array(points, dtype=float), np.array(times), study.expected)
            of_series = {"slope": slope, "expected": study.expected, "fixed_us": fixed, "growing_us": growing}
            rows += [{"study": study.name, "series": series, "n": n, "us": us, **of_series}
                     for n, us in zip(points, times, strict=True)]  # fmt: skip
    return rows


def plot(chosen: list[Study], rows: list[dict[str, Any]], path: Path) -> None:
    """Draw every study, with the slopes that were measured and the reasons for their departure."""
    figure, axes = plt.subplots(2, 3, figsize=(14, 9.5))
    for study, axis in zip(chosen, axes.flat, strict=False):
        mine = [row for row in rows if row["study"] == study.name]
        for series, colour, marker in zip(dict.fromkeys(r["series"] for r in mine), (BLUE, ORANGE, GREEN, GREY),
                                          "os^D", strict=False):  # fmt: skip
            of_series = [row for row in mine if row["series"] == series]
            x, y = (np.array([row[key] for row in of_series], dtype=float) for key in ("n", "us"))
            row = of_series[0]
            axis.plot(x, y, marker, color=colour, label=f"{series}: slope {row['slope']:.2f}")
            fine = np.geomspace(x[0], x[-1], 100)
            axis.plot(fine, row["fixed_us"] + row["growing_us"] * fine**study.expected, color=colour, lw=1.0)
        _triangle(axis, study, mine)
        axis.set(xscale="log", yscale="log", xlabel=study.x_label, ylabel=study.y_label)
        axis.set_xticks(ticks := sorted({row["n"] for row in mine}), map(str, ticks), fontsize=8)
        axis.minorticks_off()
        axis.set_title(f"{study.name}: expected slope {study.expected:g}\n{study.reason}", fontsize=9)
        axis.legend(fontsize=8, loc="upper left")
        axis.margins(y=0.25)
    _throughput(axes.flat[-1], rows, int(chosen[-1].x_label.split()[1]))
    figure.suptitle("Cost against size: points measured, lines a + b N^expected")
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def _triangle(axis: Any, study: Study, rows: list[dict[str, Any]]) -> None:
    """Expected slope, through the last point of the first series."""
    first = [row for row in rows if row["series"] == rows[0]["series"]]
    x = np.array([first[len(first) // 2]["n"], first[-1]["n"]], dtype=float)
    axis.plot(x, 0.6 * first[-1]["us"] * (x / x[-1]) ** study.expected, "--", color="black", lw=1.0, label="expected")


def _throughput(axis: Any, rows: list[dict[str, Any]], steps: int) -> None:
    """Robot-seconds per second of the batches, at 1 ms a step."""
    mine = [row for row in rows if row["study"] == "Robots at once"]
    for series, colour, marker in zip(dict.fromkeys(row["series"] for row in mine), (BLUE, ORANGE, GREEN, GREY),
                                      "os^D", strict=False):  # fmt: skip
        of_series = [row for row in mine if row["series"] == series]
        x, y = [row["n"] for row in of_series], [1e3 * steps * row["n"] / row["us"] for row in of_series]
        axis.plot(x, y, f"{marker}-", color=colour, label=f"{series}: {max(y):.0f}")
    axis.set(xscale="log", yscale="log", xlabel="robots", ylabel="robot-seconds per second (velocity Verlet, 1 ms)")
    axis.set_ylim(0.25 * min(1e3 * steps * row["n"] / row["us"] for row in mine), None)
    axis.set_title("Throughput of rollouts, and its maximum", fontsize=9)
    axis.legend(fontsize=8, loc="lower right")


def main() -> None:
    """Run the studies."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few points")
    parser.add_argument("--out", type=Path, default=Path("results/growth"))
    options = parser.parse_args()
    chosen = studies(options.quick)
    rows = measure(chosen, options.quick)
    write_rows(options.out / "growth.csv", rows, digits=5)
    plot(chosen, rows, options.out / "growth.png")
    for row in {(row["study"], row["series"]): row for row in rows}.values():
        print(f"{row['study']}, {row['series']}: slope {row['slope']:.2f}, expected {row['expected']:g}; "
              f"fixed {row['fixed_us']:.3g} us")  # fmt: skip
    print(machine())


if __name__ == "__main__":
    main()
