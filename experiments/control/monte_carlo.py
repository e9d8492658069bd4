"""How robust is a controller? Many episodes in which the robot is not quite what the controller believes.

In each episode bending stiffness, mass, drag, bases, delay, sensors and load are off by amounts drawn from its seed
(`pcr_mpc.study.episodes.spread.Spread` gives the ranges and their reasons). Prints the failure rate with its 95 %
confidence interval, the distribution of the RMS error, and the command that replays the worst episode. Finished
episodes are kept in episodes.jsonl: the same command, given again, goes on where the last one ended.

    python -m experiments.control.monte_carlo --episodes 500
    python -m experiments.control.monte_carlo --episodes 20000 --dask tcp://scheduler:8786
    python -m experiments.control.monte_carlo --robot mine.toml       numbers as `pcr-mpc identify` knows them
    python -m experiments.control.monte_carlo --replay 17
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter
from scipy.stats import binomtest, spearmanr

from pcr_mpc import (
    ModelError,
    PCRError,
    Scene,
    SimulationError,
    Spread,
    Tuning,
    load_robot,
    load_scene,
    load_tuning,
    load_uncertainty,
)
from pcr_mpc.cli.options.command import tuning_or_class
from pcr_mpc.loop.controller.own_controller import OwnController
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.plots import animate_run, plot_run
from pcr_mpc.report.style import BLUE, GREY, ORANGE, RED, plt
from pcr_mpc.report.tables import summary_table, table
from pcr_mpc.study.episodes.episodes import ALLOWED_ERROR, SETTLING, lighter, run_episode, simulate_episode
from pcr_mpc.study.episodes.parallel import collect, local_workers
from pcr_mpc.study.episodes.provenance import described, source_digest

Row = dict[str, Any]
MODELS = Path(__file__).parents[2] / "models"
QUANTILES = {"p5": 0.05, "p50": 0.5, "p95": 0.95, "max": 1.0}
DEFAULT_SCENE = MODELS / "scenes" / "lemniscate.toml"


# Kinds of mismatch, as they are drawn from top to bottom.
KINDS = (
    "delay", "motor lag", "load", "bending stiffness", "tip mass", "drag", "bases", "lengths", "line density",
    "tip noise", "encoder step",
)  # fmt: skip


def sizes(row: Row) -> dict[str, float]:
    """How far off an episode was, in one number for each kind of mismatch."""

    def off(prefix: str, nominal: float) -> float:
        return math.hypot(*(value - nominal for name, value in row.items() if name.startswith(prefix)))

    return {
        "bending stiffness": off("stiffness", 1.0),
        "tip mass": off("mass", 1.0),
        "drag": abs(math.log(row["drag"])),
        "bases": off("base", 0.0),
        "lengths": off("length", 1.0),
        "line density": off("line_density", 1.0),
        "delay": off("delay", 0.0),
        "motor lag": off("motor_lag", 0.0),
        "tip noise": off("tip_noise", 0.0),
        "encoder step": off("angle_step", 0.0),
        "load": off("force", 0.0),
    }


def correlations(rows: list[Row]) -> dict[str, float]:
    """Spearman's rank correlation of the RMS error with each kind of mismatch that varies."""
    known = [row for row in rows if row["rms_mm"] is not None]
    rms = [row["rms_mm"] for row in known]
    columns = {name: [sizes(row)[name] for row in known] for name in sizes(rows[0])}
    varying = {name: values for name, values in columns.items() if min(len(set(values)), len(set(rms))) > 1}
    return {name: float(spearmanr(values, rms).statistic) for name, values in varying.items()}


def worst(rows: list[Row]) -> Row:
    """The episode with the largest error among the failed ones, or among all."""
    candidates = [row for row in rows if row["failure"]] or rows
    return max(candidates, key=lambda row: math.inf if row["rms_mm"] is None else row["rms_mm"])


def summarise(rows: list[Row]) -> dict[str, Any]:
    """Figures of the study, ready for JSON; the timing apart, for it does not repeat."""
    failed = sum(bool(row["failure"]) for row in rows)
    interval = binomtest(failed, len(rows)).proportion_ci(0.95, method="exact")
    by_delay = {
        str(delay): {
            "episodes": len(mine := [row for row in rows if row["delay"] == delay]),
            "failed": sum(bool(row["failure"]) for row in mine),
        }
        for delay in sorted({row["delay"] for row in rows})
    }
    return {
        "episodes": len(rows),
        "seeds": [rows[0]["seed"], rows[-1]["seed"]],
        "failed": failed,
        "failure_rate": failed / len(rows),
        "interval_95": [float(interval.low), float(interval.high)],
        "by_periods_of_unknown_delay": by_delay,
        **{name: quantiles(rows, name) for name in ("rms_mm", "rms_after_1s_mm", "max_mm", "effort_rad_s2")},
        "limit_violations": sum(row["limit_violations"] for row in rows),
        "episodes_with_fallbacks": sum(row["fallbacks"] > 0 for row in rows),
        "worst_seed": worst(rows)["seed"],
        "worst_failure": worst(rows)["failure"],
        "rank_correlation": correlations(rows),
    }


def quantiles(rows: list[Row], name: str) -> dict[str, float | None]:
    """Quantiles over the episodes that have the figure."""
    values = [row[name] for row in rows if row[name] is not None]
    return {key: float(np.quantile(values, q)) if values else None for key, q in QUANTILES.items()}


def report(summary: dict[str, Any], replay: str) -> str:
    """Tables for the terminal."""
    low, high = summary["interval_95"]
    lines = [
        f"failure rate      {100 * summary['failure_rate']:.1f} % ({summary['failed']} of {summary['episodes']}), "
        f"95 % interval {100 * low:.1f} to {100 * high:.1f} % (Clopper-Pearson)",
        f"                  failed: stopped early, broke a limit, or strayed more than {1e3 * ALLOWED_ERROR:g} mm "
        f"after {SETTLING:g} s",
    ]
    lines += [
        f"                  {counts['failed']} of {counts['episodes']} with {delay} periods of unknown delay"
        for delay, counts in summary["by_periods_of_unknown_delay"].items()
    ]
    shown = (("RMS [mm]", "rms_mm"), ("RMS after 1 s [mm]", "rms_after_1s_mm"), ("largest [mm]", "max_mm"),
             ("effort [rad/s^2]", "effort_rad_s2"))  # fmt: skip
    cells = [
        (name, *("-" if value is None else f"{value:.3g}" for value in summary[key].values())) for name, key in shown
    ]
    lines += ["", table(("all episodes", *QUANTILES), cells), ""]
    ranked = sorted(summary["rank_correlation"].items(), key=lambda pair: -abs(pair[1]))
    lines += [
        f"limit violations  {summary['limit_violations']}",
        f"fall-backs in     {summary['episodes_with_fallbacks']} episodes",
        f"RMS goes with     {', '.join(f'{name} {value:+.2f}' for name, value in ranked)}",
        f"worst episode     seed {summary['worst_seed']}: {summary['worst_failure'] or 'no failure'}",
        f"  replay it with  {replay} --replay {summary['worst_seed']}",
    ]
    return "\n".join(lines)


def plot(rows: list[Row], title: str, path: Path) -> None:
    """Distribution of the RMS error, what goes with it, and the error against the load."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13.5, 4.2), layout="constrained")
    known = [row for row in rows if row["rms_mm"] is not None]
    told, longer = ([row for row in known if (row["delay"] > 0) == late] for late in (False, True))
    groups = (("as told", told, BLUE, "o"), ("longer than told", longer, ORANGE, "^"))
    for number, (label, mine, colour, marker) in enumerate(groups):
        if not mine:
            continue
        mine = sorted(mine, key=lambda row: row["rms_mm"])
        rms = np.array([row["rms_mm"] for row in mine])
        share = 100 * (np.arange(len(mine)) + 1) / len(mine)
        failed = np.array([bool(row["failure"]) for row in mine])
        left.step(rms, share, where="post", color=colour, label=f"delay {label}: {len(mine)} episodes")
        left.plot(rms[failed], share[failed], "x", color=RED, ms=5)
        load = np.array([sizes(row)["load"] for row in mine])
        right.plot(load[~failed], rms[~failed], marker, color=colour, ms=4, alpha=0.7, label=f"delay {label}")
        right.plot(load[failed], rms[failed], "x", color=RED, ms=5)
        among = correlations(mine)
        places = [KINDS.index(name) + 0.27 * (number + 1) for name in among]
        middle.barh(places, list(among.values()), height=0.25, color=colour, label=f"among delay {label}")
    label = f"failed: {sum(bool(row['failure']) for row in rows)} of {len(rows)}"
    for axes in (left, right):
        axes.plot([], [], "x", color=RED, ms=5, label=label)
    left.set(xscale="log", xlabel="RMS error of an episode [mm]", ylabel="episodes [%]", ylim=(0, 118), title=title)
    left.legend(loc="upper left", fontsize=8)

    everything = correlations(rows)
    places = [KINDS.index(name) for name in everything]
    middle.barh(places, list(everything.values()), height=0.25, color=GREY, label="among all episodes")
    middle.axvline(0.0, color="black", lw=0.8)
    middle.set_yticks(np.arange(len(KINDS)) + 0.27, KINDS)
    middle.set(xlabel="rank correlation of RMS error and size [-]", xlim=(-1, 1), xticks=(-1, -0.5, 0, 0.5, 1),
               ylim=(len(KINDS), -2.6), title="What matters")  # fmt: skip
    middle.legend(loc="upper left", fontsize=8)

    right.set(yscale="log", xlabel="size of the unknown load [N]", ylabel="RMS error of an episode [mm]",
              title="Error against load")  # fmt: skip
    low, high = right.get_ylim()
    right.set_ylim(low, high * (high / low) ** 0.25)  # room for the legend
    right.legend(loc="upper left", fontsize=8)
    for axis in (left.xaxis, right.yaxis):  # within a decade, as across several
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    figure.savefig(path)
    plt.close(figure)


@contextmanager
def workers(jobs: int | None, dask: str | None) -> Iterator[Executor]:
    """Open processes on this machine, or a Dask cluster."""
    if dask is None:
        with local_workers(jobs) as executor:
            yield executor
        return
    try:
        from distributed import Client
    except ImportError:
        raise PCRError("--dask needs Dask's scheduler: pip install pcr_mpc[cluster]") from None
    with Client(dask) as client:
        yield client.get_executor()


def replay(scene: Scene, tuning: Tuning | OwnController, seed: int, spread: Spread, folder: Path) -> str:
    """Run one episode once more; write its record and pictures; return its table."""
    try:
        run = simulate_episode(scene, tuning, seed, spread, progress=True)
    except SimulationError as error:
        print(error, file=sys.stderr)
        run = error.run
    run.save(folder)
    plot_run(run, folder / "track.png")
    animate_run(run, folder / "track.gif", progress=True)
    off = ", ".join(f"{name} {value:.4g}" for name, value in spread.sample(scene.robot.n_rods, seed).row().items())
    return f"seed {seed}: {off}\n\n{summary_table(run.summary())}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write CSV and summary, plot; or replay one episode."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=DEFAULT_SCENE, help="default: lemniscate")
    parser.add_argument("--controller", type=tuning_or_class, metavar="FILE|MODULE:CLASS",
                        help="controller tuning instead of the scene's own, or a controller of your own")  # fmt: skip
    parser.add_argument(
        "--duration", type=float, default=3.0, help="of an episode [s], at most the scene's (default 3)"
    )
    parser.add_argument("--episodes", type=int, default=500, help="default 500")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; the others count on (default 0)")
    parser.add_argument("--jobs", type=int, help="processes on this machine (default: one a core)")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster, as tcp://host:8786")
    parser.add_argument(
        "--out", type=Path, help="folder for the results (default results/monte_carlo/SCENE_CONTROLLER)"
    )
    parser.add_argument(
        "--robot", type=Path, metavar="FILE",
        help="robot that the controller believes in, as `pcr-mpc identify --out` writes it: how far off its numbers "
        "are is drawn from its [uncertainty], not from assumed ranges",
    )  # fmt: skip
    parser.add_argument("--motor-lag", type=float, default=0.0, metavar="SECONDS",
                        help="motors lag by up to this, which the controller does not know (default 0)")  # fmt: skip
    parser.add_argument("--delay", type=int, metavar="PERIODS", help="of commands, untold, up to this many (default 1)")
    parser.add_argument("--replay", type=int, metavar="SEED", help="run this one episode in full, with pictures")
    parser.add_argument("--fresh", action="store_true", help="discard the finished episodes in that folder first")
    parser.add_argument("--quick", action="store_true", help="8 episodes of 1.2 s")
    options = parser.parse_args(arguments)
    try:
        return _study(options)
    except (PCRError, ValueError, OSError) as error:
        print(f"monte_carlo: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as interrupt:
        print(f"monte_carlo: {interrupt}", file=sys.stderr)
        return 130


def as_known(scene: Scene, path: Path) -> tuple[Scene, Spread]:
    """Scene whose robot is believed to have the numbers in a file, and how far off they may be by its [uncertainty].

    Raises
    ------
    ModelError
        The file does not say, or is of another kind of robot.
    """
    robot, known = load_robot(path), load_uncertainty(path)
    if known is None:
        raise ModelError(f"{path}: has no [uncertainty]; pcr-mpc identify --out writes robots that have one")
    if robot.n_rods != scene.robot.n_rods:
        raise ModelError(
            f"{path}: {robot.name} has {robot.n_rods} rods, that of scene {scene.name} {scene.robot.n_rods}"
        )
    # Limits and gravity may be the scene's own.
    believed = replace(scene.robot, name=robot.name, rods=robot.rods, tip_mass=robot.tip_mass, drag=robot.drag)
    return replace(scene, robot=believed), Spread(known=known, believed=believed)


def _study(options: argparse.Namespace) -> int:
    scene, spread = load_scene(options.scene), Spread()
    if options.robot:
        scene, spread = as_known(scene, options.robot)
    spread = replace(spread, motor_lag=options.motor_lag,
                     delay=spread.delay if options.delay is None else options.delay)  # fmt: skip
    tuning: Tuning | OwnController | None = scene.tuning
    if options.controller:
        own = isinstance(options.controller, str)
        tuning = OwnController(options.controller) if own else load_tuning(options.controller)
    if tuning is None:
        raise ValueError(f"scene {scene.name} has nothing to track")
    episodes, duration = (8, 1.2) if options.quick else (options.episodes, options.duration)
    if episodes < 1:
        raise ValueError(f"--episodes is {episodes}, expected at least 1")
    scene = lighter(replace(scene, duration=min(scene.duration, duration)))
    scene = scene.tuned(tuning) if isinstance(tuning, Tuning) else scene
    folder = options.out or Path("results") / "monte_carlo" / f"{scene.name}_{tuning.name}"
    folder.mkdir(parents=True, exist_ok=True)
    if options.replay is not None:
        folder = folder / f"seed_{options.replay}"
        print(f"\n{replay(scene, tuning, options.replay, spread, folder)}\n\nwritten to {folder}")
        return 0
    journal = folder / "episodes.jsonl"
    if options.fresh:
        journal.unlink(missing_ok=True)
    seeds = range(options.seed, options.seed + episodes)
    settings = {**described(scene, tuning, spread), "code": source_digest()}
    with workers(options.jobs, options.dask) as executor:
        task = partial(run_episode, scene, tuning, **({"spread": spread} if spread != Spread() else {}))
        rows = collect(executor, task, seeds, journal, settings, desc=scene.name)
    summary = summarise(rows)
    timing = [row["timing"] for row in rows if row["timing"]["control_cpu_us"] is not None]
    measured = {name: quantiles(timing, name) for name in ("control_cpu_us", "episode_s")}
    # What repeats bit for bit.
    write_rows(folder / "episodes.csv", rows, [name for name in rows[0] if name != "timing"])
    (folder / "summary.json").write_text(json.dumps({**summary, "timing": measured}, indent=2) + "\n")
    plot(rows, f"{scene.name}, controller {tuning.name}", folder / "monte_carlo.png")
    print(f"\n{report(summary, _again(options))}\n\nwritten to {folder}")
    return 0


def _again(options: argparse.Namespace) -> str:
    """The command that replays an episode of this study, but for the seed."""
    parts = ["python -m experiments.control.monte_carlo"]
    parts += [f"--scene {options.scene}"] if options.scene != DEFAULT_SCENE else []
    parts += [f"--robot {options.robot}"] if options.robot else []
    parts += [f"--motor-lag {options.motor_lag:g}"] if options.motor_lag else []
    parts += [f"--delay {options.delay}"] if options.delay is not None else []
    parts += [f"--controller {options.controller}"] if options.controller else []
    parts += ["--quick"] if options.quick else [f"--duration {options.duration:g}"]
    parts += [f"--out {options.out}"] if options.out else []
    return " ".join(parts)


if __name__ == "__main__":
    sys.exit(main())
