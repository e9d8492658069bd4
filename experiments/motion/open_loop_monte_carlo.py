"""How far does the tip stray if the motors run blindly, and the robot is not quite what one believes?

The motors turn at the rates that the inverse dynamics of the scene's reference ask of the believed robot. Robots whose
bending stiffness, tip mass, drag and bases are off by amounts drawn from their seeds (ranges and reasons in
`pcr_mpc.study.episodes.spread.Spread`), all at once and one kind at a time, start at rest at the same motor angles and
are moved by `rollout`, many in one call. The error is the distance of a tip from where the believed robot's is at that
time. Beside it stands what the derivatives of the believed robot's motion (`sensitivities`) predict of the same robots.
Robots that cannot follow are counted, with their reasons.

Writes open_loop_times.csv (quantiles against time), open_loop_robots.csv (a row for every robot) and the picture
open_loop_monte_carlo.png.

    python -m experiments.motion.open_loop_monte_carlo --robots 100
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pcr_mpc import (
    Equilibrium,
    PCRError,
    Plant,
    Robot,
    Scene,
    Sensitivities,
    forward_statics,
    load_scene,
    rollout,
    sensitivities,
)
from pcr_mpc.loop.demand.feed_forward import feed_forward
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import BLUE, GREEN, GREY, ORANGE, PURPLE, plt, save_figure
from pcr_mpc.report.tables import table
from pcr_mpc.study.episodes.episodes import EXACT, Spread, lighter

MODELS = Path(__file__).parents[2] / "models"
DEFAULT_SCENE = MODELS / "scenes" / "lemniscate.toml"
QUANTILES = {"p5": 0.05, "p50": 0.5, "p95": 0.95, "max": 1.0}
_ALL = Spread()
# What is off, and how it is drawn.
KINDS = {
    "all": (replace(_ALL, delay=0, force=0.0), GREY),
    "bending stiffness": (replace(EXACT, stiffness=_ALL.stiffness), BLUE),
    "tip mass": (replace(EXACT, mass=_ALL.mass), ORANGE),
    "drag": (replace(EXACT, drag=_ALL.drag), GREEN),
    "bases": (replace(EXACT, base_offset=_ALL.base_offset), PURPLE),
}  # fmt: skip

Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of the robots of one kind of mismatch.

    Attributes
    ----------
    seeds : list of int
        Of the R robots that came to the end.
    error, predicted : ndarray, shape (R, T + 1)
        Distance of the tip from the believed robot's, as it moved and by the derivatives [m].
    failures : dict of int to str
        Why the others did not, by their seeds.
    """

    seeds: list[int]
    error: np.ndarray
    predicted: np.ndarray
    failures: dict[int, str]


def told(scene: Scene) -> np.ndarray:
    """Motor rates of the scene at every step of its plant, shape (T, n) [rad/s]."""
    if scene.trajectory is None or scene.payload is not None:
        raise ValueError(f"scene {scene.name} has nothing to track, or something to carry, which a rollout does not")
    rates = feed_forward(scene, scene.robot, scene.start(), 0, scene.plant.inertia).inputs
    return np.repeat(rates, round(scene.period / scene.plant.dt), axis=0)


def move(
    plant: Plant, rest: Equilibrium, believed: Sensitivities, inputs: np.ndarray, robots: dict[int, Robot], threads: int
) -> Motion:
    """Move robots, by their seeds, from rest at the motor angles at which the believed one rests."""
    start = believed.x[0]
    starts, failures = {}, {}
    for seed, robot in robots.items():
        try:
            starts[seed] = np.concatenate([forward_statics(robot, rest.q, guess=rest).p, np.zeros(2), rest.q])
        except PCRError as error:
            failures[seed] = f"at rest: {type(error).__name__}: {error}"
    left = {seed: robots[seed] for seed in starts}
    while left:
        x0 = np.stack([starts[seed] for seed in left])
        try:
            x = rollout(plant, x0, inputs, guess=rest, robots=list(left.values()), threads=threads).x
            break
        except PCRError as error:
            seed = list(left)[error.robot]
            failures[seed] = f"step {error.step}: {type(error).__name__}: {error}"
            del left[seed]
    else:
        raise PCRError(f"none of {len(robots)} robots came to the end; the first: {next(iter(failures.values()))}")
    numbers = plant.step_model.kind.pack
    off = np.stack([numbers(robot) for robot in left.values()]) - numbers(plant.robot)
    by_numbers = np.einsum("tik,rk->rti", believed.dx_dnumbers[:, :2], off)
    by_start = np.einsum("tij,rj->rti", believed.dx_dx0[:, :2], x0 - start)
    distance = np.linalg.norm(x[:, :, :2] - believed.x[:, :2], axis=2)
    return Motion(list(left), distance, np.linalg.norm(by_numbers + by_start, axis=2), failures)


def measure(scene: Scene, count: int, seed: int, threads: int) -> tuple[np.ndarray, dict[str, Motion]]:
    """Times [s] and the motions of ``count`` robots of every kind of mismatch."""
    scene = lighter(scene)
    inputs, pose, plant = told(scene), scene.start(), scene.make_plant()
    start = np.concatenate([pose.p, np.zeros(2), pose.q])
    believed = sensitivities(plant, start, inputs, guess=pose)
    motions = {}
    for kind, (spread, _) in KINDS.items():
        seeds = range(seed, seed + count)
        robots = {one: spread.sample(scene.robot.n_rods, one).applied_to(scene).robot for one in seeds}
        motions[kind] = move(plant, pose, believed, inputs, robots, threads)
    return believed.t, motions


def times(t: np.ndarray, motions: dict[str, Motion], every: int) -> list[Row]:
    """Rows of quantiles against time."""
    rows: list[Row] = []
    for kind, motion in motions.items():
        for name, values in (("moved", motion.error), ("predicted", motion.predicted)):
            levels = 1e3 * np.quantile(values, list(QUANTILES.values()), axis=0)
            rows += [
                {"off": kind, "how": name, "t_s": t[k]}
                | {f"{key}_mm": level for key, level in zip(QUANTILES, levels[:, k].tolist(), strict=True)}
                for k in range(0, len(t), every)
            ]
    return rows


def by_robot(motions: dict[str, Motion]) -> list[Row]:
    """Rows of all robots."""
    rows: list[Row] = []
    for kind, motion in motions.items():
        for seed, error, predicted in zip(motion.seeds, motion.error, motion.predicted, strict=True):
            rows.append({"off": kind, "seed": seed, "rms_mm": 1e3 * float(np.sqrt(np.mean(error**2))),
                         "predicted_rms_mm": 1e3 * float(np.sqrt(np.mean(predicted**2))),
                         "max_mm": 1e3 * float(error.max()), "failure": ""})  # fmt: skip
        rows += [{"off": kind, "seed": seed, "failure": reason} for seed, reason in motion.failures.items()]
    return rows


def plot(t: np.ndarray, motions: dict[str, Motion], title: str, path: Path) -> None:
    """Distribution of the error against time, and its median for each kind of mismatch."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), sharey=True, layout="constrained")
    everything = motions["all"]
    low, middle, high = 1e3 * np.quantile(everything.error, [0.05, 0.5, 0.95], axis=0)
    left.fill_between(t, low, high, color=BLUE, alpha=0.25, lw=0, label="5 to 95 % of the robots")
    left.plot(t, middle, color=BLUE, label="median")
    predicted = 1e3 * np.quantile(everything.predicted, [0.5, 0.95], axis=0)
    left.plot(t, predicted[0], "--", color=ORANGE, label="median and 95 %, predicted by the derivatives")
    left.plot(t, predicted[1], "--", color=ORANGE)
    failed = sum(len(motion.failures) for motion in motions.values())
    left.set(xlabel="time [s]", ylabel="distance from the believed robot's tip [mm]",
             title=f"{title}: {len(everything.seeds)} robots, all off at once")  # fmt: skip
    for kind, motion in motions.items():
        style = {"ls": ":", "lw": 2.0} if kind == "all" else {}
        right.plot(t, 1e3 * np.median(motion.error, axis=0), color=KINDS[kind][1], label=kind, **style)
    right.set(xlabel="time [s]", title=f"Median, one kind off at a time ({failed} robots failed)")
    for axes in (left, right):
        axes.legend(loc="upper left", fontsize=8.5)
    left.set_ylim(0.0, 1.25 * max(high.max(), predicted.max()))  # room for the legend
    save_figure(figure, path)


def report(motions: dict[str, Motion]) -> str:
    """Table for the terminal."""
    cells = []
    for kind, motion in motions.items():
        rms = 1e3 * np.sqrt(np.mean(motion.error**2, axis=1))
        guess = 1e3 * np.sqrt(np.mean(motion.predicted**2, axis=1))
        levels = [f"{level:.3g}" for level in np.quantile(rms, list(QUANTILES.values()))]
        cells.append((kind, *levels, f"{np.median(guess):.3g}", str(len(motion.failures))))
    return table(("RMS of a robot [mm]", *QUANTILES, "p50 predicted", "failed"), cells)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write the CSV files, plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=DEFAULT_SCENE, help="default: lemniscate")
    parser.add_argument("--duration", type=float, default=3.0, help="[s], at most the scene's (default 3)")
    parser.add_argument("--robots", type=int, default=100, help="of each kind of mismatch (default 100)")
    parser.add_argument("--seed", type=int, default=0, help="of the first robot; the others count on (default 0)")
    parser.add_argument("--threads", type=int, default=1, help="of the machine to work in (default 1)")
    parser.add_argument("--out", type=Path, default=Path("results/open_loop"), help="folder for the results")
    options = parser.parse_args(arguments)
    try:
        if options.robots < 1:
            raise ValueError(f"--robots is {options.robots}, expected at least 1")
        scene = load_scene(options.scene)
        scene = replace(scene, duration=min(scene.duration, options.duration))
        t, motions = measure(scene, options.robots, options.seed, options.threads)
        every = round(scene.period / scene.plant.dt)
        write_rows(options.out / "open_loop_times.csv", times(t, motions, every), digits=6)
        write_rows(options.out / "open_loop_robots.csv", by_robot(motions))
        plot(t, motions, scene.name, options.out / "open_loop_monte_carlo.png")
    except (PCRError, ValueError, OSError) as error:
        print(f"open_loop_monte_carlo: {error}", file=sys.stderr)
        return 1
    print(f"\n{report(motions)}\n\nwritten to {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
