"""Where does the loop fail? Maps of delay x stiffness, delay x period and lag x horizon for every controller.

Each cell runs the first seconds of the figure of eight with a robot that is not as the controller believes: commands
later than it was told, rods stiffer or softer, another control period, motors that lag, another horizon. The colour is
the RMS error after 1 s. The loop counts as lost where a small push of the tip does not die away, or where the run ends
early; a failure is a row like the others. The line is where the linear closed loop along the path is predicted to be
lost (`pcr_mpc.study.margins`). Finished cells are kept in loop_stability.csv: the same command goes on where it ended.

    python experiments/loop_stability.py --quick
    python experiments/loop_stability.py --controllers default frozen --jobs 2
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm

from pcr_mpc import MarginsError, PCRError, Scene, Tuning, load_scene, load_tuning
from pcr_mpc.loop.hardware.motors import Motors
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import RED, plt, save_figure
from pcr_mpc.study.margins.measured import push
from pcr_mpc.study.margins.poses import LINEAR_LAWS, LinearLoops, scaled
from pcr_mpc.study.margins.predicted import path_radius
from pcr_mpc.study.parallel import finished, local_workers

ROOT = Path(__file__).parent.parent
SCENE = ROOT / "models" / "scenes" / "lemniscate.toml"
DURATION, LATE, POSES = 2.4, 1.0, 9  # s, s
MILLISECOND = 1e-3


@dataclass(frozen=True)
class Map:
    """Two quantities that vary, and the values that they take."""

    name: str
    x_label: str
    y_label: str
    x: tuple[float, ...]
    y: tuple[float, ...]


DELAYS = tuple(float(ms) for ms in range(0, 44, 4))
MAPS = (
    Map("delay_stiffness", "untold delay [ms]", "true EI over believed [-]", DELAYS,
        (0.5, 0.6, 0.72, 0.86, 1.0, 1.2, 1.4, 1.7, 2.0)),
    Map("delay_period", "untold delay [ms]", "control period [ms]", DELAYS, (4.0, 5.0, 8.0, 10.0, 12.0, 15.0, 20.0)),
    Map("lag_horizon", "lag of the motors [ms]", "horizon [periods]", DELAYS, (2.0, 3.0, 4.0, 6.0, 10.0, 15.0, 20.0)),
)  # fmt: skip
QUICK = (Map(MAPS[0].name, MAPS[0].x_label, MAPS[0].y_label, (0.0, 8.0, 16.0), (1.0, 1.4)),)


@dataclass(frozen=True)
class Cell:
    """One run."""

    controller: str
    map: str
    x: float
    y: float


def tuned(cell: Cell) -> Tuning:
    """Tuning of a cell: its controller with the cell's period or horizon."""
    tuning = load_tuning(ROOT / "controllers" / f"{cell.controller}.toml")
    if cell.map == "delay_period":
        return replace(tuning, period=MILLISECOND * cell.y)
    return replace(tuning, horizon=int(cell.y)) if cell.map == "lag_horizon" else tuning


def believed_scene(cell: Cell) -> Scene:
    """What the controller is told."""
    return replace(load_scene(SCENE), duration=DURATION).tuned(tuned(cell))


def true_scene(cell: Cell, believed: Scene) -> Scene:
    """What is simulated."""
    if cell.map == "lag_horizon":
        return replace(believed, motors=Motors(time_constant=MILLISECOND * cell.x))
    stiffness = cell.y if cell.map == "delay_stiffness" else 1.0
    return replace(believed, untold_delay=MILLISECOND * cell.x, robot=scaled(believed.robot, stiffness=stiffness))


@lru_cache(maxsize=2)
def loops_of(tuning: Tuning) -> LinearLoops:
    """Linear loops of a tuning along the path: the same for all delays, lags and robots."""
    return LinearLoops(replace(load_scene(SCENE), duration=DURATION), tuning, poses=POSES)


def predicted(cell: Cell) -> float:
    """Factor by which a small deviation grows in a period, on the mean along the path."""
    loops = loops_of(tuned(cell))
    robot = scaled(loops.scene.robot, stiffness=cell.y if cell.map == "delay_stiffness" else 1.0)
    time = MILLISECOND * cell.x
    found = [loops.at(pose, robot) for pose in loops.poses]
    if cell.map == "lag_horizon":
        return path_radius([replace(loop, lag=time) for loop in found])
    return path_radius([loop.later(time) for loop in found])


def run_cell(cell: Cell) -> dict[str, Any]:
    """Row of a cell."""
    row: dict[str, Any] = {"controller": cell.controller, "map": cell.map, "x": cell.x, "y": cell.y}
    try:
        believed = believed_scene(cell)
        try:
            row["predicted_radius"] = predicted(cell)
        except MarginsError:  # measured it can be
            row["predicted_radius"] = math.nan
        found = push(believed, true_scene(cell, believed))
    except (PCRError, ValueError) as error:
        return {**row, "rms_mm": math.nan, "stable": 0, "failure": f"{type(error).__name__}: {error}"}
    rms = math.nan
    if found.run is not None and not found.failure:
        late = 1e3 * found.run.error[found.run.t >= LATE]
        rms = float(np.sqrt(np.mean(late**2)))
    return {**row, "rms_mm": rms, "stable": int(found.dies_away), "failure": found.failure}


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of an earlier run."""
    if not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8") as handle:
        rows = list(csv.DictReader(handle))
    numbers = ("x", "y", "rms_mm", "predicted_radius", "stable")
    return [row | {name: float(row[name] or "nan") for name in numbers} for row in rows]


def boundaries(rows: Sequence[dict[str, Any]], study: Map) -> list[tuple[int, int]]:
    """For each row of a map that has a boundary, how many cells are stable: measured, and predicted."""
    found = []
    by_place = {(row["x"], row["y"]): row for row in rows}
    for y in study.y:
        line = [by_place[x, y] for x in study.x if (x, y) in by_place]
        if len(line) < len(study.x) or any(math.isnan(row["predicted_radius"]) for row in line):
            continue
        measured = next((i for i, row in enumerate(line) if not row["stable"]), len(line))
        said = next((i for i, row in enumerate(line) if not row["predicted_radius"] < 1.0), len(line))
        if min(measured, said) < len(line):
            found.append((measured, said))
    return found


def agreement(rows: Sequence[dict[str, Any]], maps: Sequence[Map]) -> tuple[int, int]:
    """Cells along the measured boundaries, and those of them that have the predicted one within one cell."""
    pairs = []
    for study in maps:
        mine = [row for row in rows if row["map"] == study.name]
        for controller in dict.fromkeys(row["controller"] for row in mine):
            pairs += boundaries([row for row in mine if row["controller"] == controller], study)
    return len(pairs), sum(abs(measured - said) <= 1 for measured, said in pairs)


def plot(rows: Sequence[dict[str, Any]], study: Map, path: Path) -> None:
    """Heat map of the RMS error for each controller, the measured losses crossed, the predicted boundary drawn."""
    names = list(dict.fromkeys(row["controller"] for row in rows))
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
                values[at], radius[at], lost[at] = row["rms_mm"], row["predicted_radius"], not row["stable"]
        axis.set_facecolor("#dddddd")
        shades = axis.pcolormesh(np.clip(values, 1e-3, 100.0), norm=LogNorm(1e-3, 100.0), cmap="viridis")
        y, x = np.nonzero(lost == 1.0)
        axis.plot(x + 0.5, y + 0.5, "x", color="white", ms=4, mew=1.2)
        axis.plot(x + 0.5, y + 0.5, "x", color="black", ms=4, mew=0.6)
        for j in range(len(study.y)):  # the edge before the first cell that is predicted to be lost
            if np.isnan(radius[j]).any():
                continue
            edge = next((i for i, each in enumerate(radius[j]) if each >= 1.0), len(study.x))
            axis.plot([edge, edge], [j, j + 1], color=RED, lw=2.5, clip_on=False)
        axis.set_xticks(np.arange(len(study.x))[::2] + 0.5, [f"{each:g}" for each in study.x[::2]])
        axis.set_yticks(np.arange(len(study.y)) + 0.5, [f"{each:g}" for each in study.y])
        axis.set_title(names[place])
    for axis in axes[-1]:
        axis.set_xlabel(study.x_label)
    for axis in axes[:, 0]:
        axis.set_ylabel(study.y_label)
    if shades is not None:
        figure.colorbar(shades, ax=axes, label="RMS error after 1 s [mm]")
    figure.suptitle("line: predicted to be lost beyond\ncross: a small push does not die away\n"
                    "grey: ended early, or not run", fontsize=10)  # fmt: skip
    save_figure(figure, path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write CSV, plot, and say how well the boundary was predicted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--controllers", nargs="+", metavar="NAME", help="of controllers/ (default: all with a gain)")
    parser.add_argument("--maps", nargs="+", choices=[study.name for study in MAPS], help="default: all")
    parser.add_argument("--jobs", type=int, help="processes (default: one a core)")
    parser.add_argument("--out", type=Path, default=Path("results") / "loop_stability", help="folder for the results")
    parser.add_argument("--fresh", action="store_true", help="discard the finished cells in that folder first")
    parser.add_argument("--quick", action="store_true", help="six cells of one controller")
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
    cells = [
        Cell(name, study.name, x, y)
        for name in names
        for study in maps
        for y in study.y
        for x in study.x
        if tunings[name].law in LINEAR_LAWS and (study.name != "lag_horizon" or tunings[name].law == "linear_mpc")
    ]
    path = options.out / "loop_stability.csv"
    rows = [] if options.fresh else read_rows(path)
    done = {Cell(row["controller"], row["map"], row["x"], row["y"]) for row in rows}
    left = [cell for cell in cells if cell not in done]
    try:
        with local_workers(options.jobs) as executor:
            for count, (_, row) in enumerate(
                finished(executor, run_cell, left, desc="loop stability", unit="cell", before=len(cells) - len(left))
            ):
                rows.append(row)
                if count % 20 == 19:
                    write_rows(path, rows)
    finally:
        if rows:
            write_rows(path, rows)
    order = {cell: i for i, cell in enumerate(cells)}
    mine = [row for row in rows if Cell(row["controller"], row["map"], row["x"], row["y"]) in order]
    for study in maps:
        of_map = [row for row in mine if row["map"] == study.name]
        if of_map:
            plot(of_map, study, options.out / f"{study.name}.png")
    along, near = agreement(mine, maps)
    share = f"{100 * near / along:.0f} %" if along else "no boundary"
    failed = sum(bool(row["failure"]) for row in mine)
    print(f"{len(mine)} cells, {failed} ended early; predicted boundary within one cell of the measured one in {near} "
          f"of {along} rows ({share}); written to {options.out}")  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
