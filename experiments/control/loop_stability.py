"""Where does the loop fail? Maps of delay x stiffness, delay x period and lag x horizon for every controller.

Each cell runs the first seconds of the figure of eight with a robot that is not as the controller believes: commands
later than it was told, rods stiffer or softer, another control period, motors that lag, another horizon. The colour is
the RMS error after 1 s. The loop counts as lost where a small push of the tip does not die away, or where the run ends
early; a failure is a row like the others. The line is where the linear closed loop along the path is predicted to be
lost (`pcr_mpc.study.margins`).

Not every cell is measured. In each line every fifth cell is; between the last of them that holds and the first that
is lost, bisection finds the two neighbours between which the boundary is. The other cells are drawn as their nearest
measured neighbour in the line. Finished lines are kept in loop_stability.csv: the same command goes on where it ended.

    python -m experiments.control.loop_stability --quick
    python -m experiments.control.loop_stability --controllers default frozen --jobs 2
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm

from pcr_mpc import PCRError, Scene, Tuning, load_scene, load_tuning
from pcr_mpc.loop.hardware.motors import Motors
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import RED, plt, save_figure
from pcr_mpc.report.tables import table
from pcr_mpc.study.episodes.parallel import finished, local_workers
from pcr_mpc.study.margins.measured import Pushed, PushTest
from pcr_mpc.study.margins.poses import LINEAR_LAWS, LinearLoops, scaled, scaled_scene
from pcr_mpc.study.margins.predicted import path_radius

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "models" / "scenes" / "lemniscate.toml"
DURATION, LATE, POSES = 2.4, 1.0, 9  # s, s
COARSE = 5  # cells, from one that is measured in any case to the next
MILLISECOND = 1e-3


@dataclass(frozen=True)
class Map:
    """Two quantities that vary, and the values that they take."""

    name: str
    x_label: str
    y_label: str
    x: tuple[float, ...]
    y: tuple[float, ...]


LATENESS = tuple(float(ms) for ms in range(0, 64, 4))
MAPS = (
    Map("delay_stiffness", "untold delay [ms]", "true EI over believed [-]", LATENESS,
        (0.5, 0.6, 0.72, 0.86, 1.0, 1.2, 1.4, 1.7, 2.0)),
    Map("delay_period", "untold delay [ms]", "control period [ms]", LATENESS, (5.0, 8.0, 10.0, 15.0, 20.0)),
    Map("lag_horizon", "lag of the motors [ms]", "horizon [periods]", LATENESS, (2.0, 4.0, 6.0, 10.0, 20.0)),
)  # fmt: skip
QUICK = (Map(MAPS[0].name, MAPS[0].x_label, MAPS[0].y_label, (0.0, 8.0, 16.0), (1.0, 1.4)),)


@dataclass(frozen=True)
class Line:
    """A controller with one value of the second quantity, and the values of the first that its cells have."""

    controller: str
    map: str
    y: float
    x: tuple[float, ...]


def tuned(line: Line) -> Tuning:
    """Tuning of a line: its controller with the line's period or horizon."""
    tuning = load_tuning(ROOT / "controllers" / f"{line.controller}.toml")
    if line.map == "delay_period":
        return replace(tuning, period=MILLISECOND * line.y)
    if line.map == "delay_stiffness" or tuning.horizon == int(line.y):
        return tuning
    # Machine code of another horizon would take longer to build than it saves.
    return replace(tuning, horizon=int(line.y), model=replace(tuning.model, compiled=False))


def scene_of(tuning: Tuning) -> Scene:
    """What the controller is told."""
    return replace(load_scene(SCENE), duration=DURATION).tuned(tuning)


def true_scene(line: Line, x: float) -> Scene:
    """What is simulated."""
    believed = scene_of(tuned(line))
    if line.map == "lag_horizon":
        return replace(believed, motors=Motors(time_constant=MILLISECOND * x))
    moves = scaled_scene(believed, stiffness=line.y) if line.map == "delay_stiffness" else believed
    return replace(moves, untold_delay=MILLISECOND * x)


@lru_cache(maxsize=1)
def test_of(tuning: Tuning) -> PushTest:
    """What pushes a robot that a tuning drives: the same for all delays, lags and robots."""
    return PushTest(scene_of(tuning))


@lru_cache(maxsize=1)
def loops_of(tuning: Tuning) -> LinearLoops:
    """Linear loops of a tuning along the path: likewise."""
    return LinearLoops(scene_of(tuning), tuning, poses=POSES)


def predicted(line: Line) -> list[float]:
    """Factors by which a small deviation grows in a period, on the mean along the path: one for each cell."""
    try:
        loops = loops_of(tuned(line))
        robot = scaled(loops.scene.robot, stiffness=line.y if line.map == "delay_stiffness" else 1.0)
        found = [loops.at(pose, robot) for pose in loops.poses]
    except (PCRError, ValueError):  # measured it can be
        return [math.nan] * len(line.x)
    if line.map == "lag_horizon":
        return [path_radius([replace(loop, lag=MILLISECOND * x) for loop in found]) for x in line.x]
    return [path_radius([loop.later(MILLISECOND * x) for loop in found]) for x in line.x]


def chosen(holds: Callable[[int], bool], count: int) -> None:
    """Ask of some of so many cells in a line whether the loop holds: coarsely all along, and to either side of where it
    is lost."""
    coarse = sorted({*range(0, count, COARSE), count - 1})
    answers = [holds(i) for i in coarse]
    if all(answers) or not answers[0]:
        return
    first = answers.index(False)
    low, high = coarse[first - 1], coarse[first]
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if holds(middle) else (low, middle)


def run_line(line: Line) -> list[dict[str, Any]]:
    """Rows of a line's cells; those that were not measured have no figures but the predicted one."""
    rows: list[dict[str, Any]] = [
        {"controller": line.controller, "map": line.map, "x": x, "y": line.y, "predicted_radius": radius,
         "rms_mm": math.nan, "stable": math.nan, "failure": ""}
        for x, radius in zip(line.x, predicted(line), strict=True)
    ]  # fmt: skip

    def holds(i: int) -> bool:
        try:
            found = test_of(tuned(line))(true_scene(line, line.x[i]))
        except (PCRError, ValueError) as error:
            found = Pushed(False, None, f"{type(error).__name__}: {error}")
        rows[i] |= {"stable": int(found.dies_away), "failure": found.failure}
        if found.run is not None and not found.failure:
            late = 1e3 * found.run.error[found.run.t >= LATE]
            rows[i]["rms_mm"] = float(np.sqrt(np.mean(late**2)))
        return found.dies_away

    chosen(holds, len(line.x))
    return rows


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of an earlier run."""
    if not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8") as handle:
        rows = list(csv.DictReader(handle))
    numbers = ("x", "y", "rms_mm", "predicted_radius", "stable")
    return [row | {name: float(row[name] or "nan") for name in numbers} for row in rows]


def boundaries(rows: Sequence[dict[str, Any]], study: Map) -> list[tuple[int, int]]:
    """For each line of a map that has a boundary, how many cells are stable: measured, and predicted.

    A line of which nothing holds, measured and predicted, has none, nor has one that holds all along.
    """
    found = []
    by_place = {(row["x"], row["y"]): row for row in rows}
    for y in study.y:
        line = [by_place[x, y] for x in study.x if (x, y) in by_place]
        if len(line) < len(study.x) or any(math.isnan(row["predicted_radius"]) for row in line):
            continue
        measured = next((i for i, row in enumerate(line) if row["stable"] == 0.0), len(line))
        said = next((i for i, row in enumerate(line) if not row["predicted_radius"] < 1.0), len(line))
        if (measured, said) not in ((0, 0), (len(line), len(line))):
            found.append((measured, said))
    return found


def filled(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Values of a line, where one is not known that of the nearest cell that is."""
    places = np.flatnonzero(known)
    if not len(places):
        return values
    return np.asarray(values[places[np.abs(np.arange(len(values))[:, None] - places).argmin(axis=1)]])


def agreement(rows: Sequence[dict[str, Any]], maps: Sequence[Map]) -> dict[tuple[str, str], tuple[int, int]]:
    """For each map and controller: cells along the measured boundary, and those that have the predicted one within one
    cell."""
    found = {}
    for study in maps:
        mine = [row for row in rows if row["map"] == study.name]
        for controller in dict.fromkeys(row["controller"] for row in mine):
            pairs = boundaries([row for row in mine if row["controller"] == controller], study)
            found[study.name, controller] = len(pairs), sum(abs(measured - said) <= 1 for measured, said in pairs)
    return found


def plot(rows: Sequence[dict[str, Any]], study: Map, path: Path) -> None:
    """Heat map of the RMS error for each controller, the measured losses crossed, the predicted boundary drawn."""
    names = sorted({row["controller"] for row in rows})
    columns = min(len(names), 4)
    lines = math.ceil(len(names) / columns)
    figure, axes = plt.subplots(lines, columns, figsize=(3.6 * columns + 1, 3.2 * lines + 0.6), layout="constrained",
                                squeeze=False, sharex=True, sharey=True)  # fmt: skip
    shades = None
    for place, axis in enumerate(axes.flat):
        axis.grid(False)
        if place >= len(names):
            axis.set_visible(False)
            continue
        values, radius, lost = (np.full((len(study.y), len(study.x)), np.nan) for _ in range(3))
        for row in rows:
            if row["controller"] == names[place] and row["x"] in study.x and row["y"] in study.y:
                at = study.y.index(row["y"]), study.x.index(row["x"])
                values[at], radius[at], lost[at] = row["rms_mm"], row["predicted_radius"], 1.0 - row["stable"]
        known = ~np.isnan(lost)
        values = np.stack([filled(*line) for line in zip(values, known, strict=True)])
        axis.set_facecolor("#dddddd")
        shades = axis.pcolormesh(np.clip(values, 1e-3, 100.0), norm=LogNorm(1e-3, 100.0), cmap="viridis")
        y, x = np.nonzero(lost == 1.0)
        axis.plot(x + 0.5, y + 0.5, "x", color="white", ms=4, mew=1.2)
        axis.plot(x + 0.5, y + 0.5, "x", color="black", ms=4, mew=0.6)
        y, x = np.nonzero(lost == 0.0)
        axis.plot(x + 0.5, y + 0.5, "o", color="white", ms=1.5)
        for j in range(len(study.y)):  # the edge before the first cell that is predicted to be lost
            if np.isnan(radius[j]).any():
                continue
            edge = next((i for i, each in enumerate(radius[j]) if each >= 1.0), len(study.x))
            axis.plot([edge, edge], [j, j + 1], color=RED, lw=2.5, clip_on=False)
        axis.set_xticks(np.arange(len(study.x))[::2] + 0.5, [f"{each:g}" for each in study.x[::2]])
        axis.set_yticks(np.arange(len(study.y)) + 0.5, [f"{each:g}" for each in study.y])
        axis.set_title(names[place])
    for axis in axes.flat[max(len(names) - columns, 0) : len(names)]:  # the lowest of each column
        axis.set_xlabel(study.x_label)
        axis.tick_params(labelbottom=True)
    for axis in axes[:, 0]:
        axis.set_ylabel(study.y_label)
    if shades is not None:
        figure.colorbar(shades, ax=axes, label="RMS error after 1 s [mm]")
    figure.suptitle(
        "line: predicted to be lost beyond\ndot: measured, holds; cross: measured, a push does not die away\n"
        "the others as their nearest measured neighbour in the line; grey: ended early",
        fontsize=10,
    )
    save_figure(figure, path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write CSV, plot, and say how well the boundary was predicted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--controllers", nargs="+", metavar="NAME", help="of controllers/ (default: all with a gain)")
    parser.add_argument("--maps", nargs="+", choices=[study.name for study in MAPS], help="default: all")
    parser.add_argument("--jobs", type=int, help="processes (default: one a core)")
    parser.add_argument("--out", type=Path, default=Path("results") / "loop_stability", help="folder for the results")
    parser.add_argument("--fresh", action="store_true", help="discard the finished lines in that folder first")
    parser.add_argument("--quick", action="store_true", help="two lines of one controller")
    options = parser.parse_args(arguments)
    try:
        return _study(options)
    except (PCRError, ValueError, OSError) as error:
        print(f"loop_stability: {error}", file=sys.stderr)
        return 1


def _study(options: argparse.Namespace) -> int:
    maps = QUICK if options.quick else [study for study in MAPS if options.maps is None or study.name in options.maps]
    tunings = {path.stem: load_tuning(path) for path in sorted((ROOT / "controllers").glob("*.toml"))}
    names = options.controllers or (["frozen"] if options.quick else list(tunings))
    if unknown := sorted(set(names) - set(tunings)):
        raise ValueError(f"there is no controller {unknown[0]}; there are {', '.join(tunings)}")
    for name in names:
        if tunings[name].law not in LINEAR_LAWS:
            print(f"{name}: law {tunings[name].law} has no linear loop, and is left out", file=sys.stderr)
    lines = [
        Line(name, study.name, y, study.x)
        for study in maps
        for name in names
        for y in study.y
        if tunings[name].law in LINEAR_LAWS and (study.name != "lag_horizon" or tunings[name].law == "linear_mpc")
    ]
    path = options.out / "loop_stability.csv"
    rows = [] if options.fresh else read_rows(path)
    done = {(row["controller"], row["map"], row["x"], row["y"]) for row in rows}
    left = [line for line in lines if any((line.controller, line.map, x, line.y) not in done for x in line.x)]
    again = {(line.controller, line.map, line.y) for line in left}
    rows = [row for row in rows if (row["controller"], row["map"], row["y"]) not in again]
    try:
        with local_workers(options.jobs) as executor:
            for _, of_line in finished(executor, run_line, left, desc="loop stability", unit="line",
                                       before=len(lines) - len(left)):  # fmt: skip
                rows += of_line
                write_rows(path, rows)
    finally:
        if rows:
            write_rows(path, rows)
    wanted = {(line.controller, line.map, line.y) for line in lines}
    mine = [row for row in rows if (row["controller"], row["map"], row["y"]) in wanted]
    for study in maps:
        of_map = [row for row in mine if row["map"] == study.name]
        if of_map:
            plot(of_map, study, options.out / f"{study.name}.png")
    counts = agreement(mine, maps)
    print(table(("map", "controller", "lines with a boundary", "within one cell"),
                [(*key, str(along), str(near)) for key, (along, near) in counts.items() if along]))  # fmt: skip
    along, near = (sum(each) for each in zip(*counts.values(), strict=True)) if counts else (0, 0)
    share = f"{100 * near / along:.0f} %" if along else "no boundary"
    measured = [row for row in mine if not math.isnan(row["stable"])]
    failed = sum(bool(row["failure"]) for row in measured)
    print(f"{len(mine)} cells, {len(measured)} of them measured, of which {failed} ended early")
    print(f"predicted boundary within one cell of the measured one in {near} of {along} lines ({share})")
    print(f"written to {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
