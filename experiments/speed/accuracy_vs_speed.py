"""Speed against accuracy on three levels: statics, motion, control. `make charts`.

Each level writes a CSV, a row a point, as soon as the point is measured, and a picture. Started again at the same
commit it goes on where it stopped; --fresh begins anew. What is compared, and how, stands in `experiments.charts`:
`statics`, `motion` and `control`. At the end the ratios that the README quotes and the project's own methods that
others of its own beat in both time and error are printed, and go into accuracy_vs_speed_ratios.json.

Times are wall times: run it on a computer that does nothing else.
Run as ``python -m experiments.speed.accuracy_vs_speed``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.charts import control, motion, statics
from experiments.charts.draw import Look
from experiments.charts.pictures import CONTROL, MOTION, STATICS, draw_control, draw_motion, draw_statics
from experiments.charts.points import Row, collect, complete, read
from experiments.charts.ratios import beaten, ratios, report
from pcr_mpc import Robot, load_robot

MODELS = Path(__file__).parents[2] / "models"


def _statics(robot: Robot, quick: bool, folder: Path, fresh: bool) -> list[Row]:
    plan = statics.QUICK if quick else statics.Plan()
    return collect("statics", statics.keys(plan), lambda key: statics.measure(robot, plan, key), folder, fresh=fresh)


def _motion(robot: Robot, quick: bool, folder: Path, fresh: bool) -> list[Row]:
    found = motion.points(robot, motion.QUICK if quick else motion.Plan())
    return collect("motion", list(found), lambda key: found[key](), folder, fresh=fresh)


def _control(robot: Robot, quick: bool, folder: Path, fresh: bool) -> list[Row]:
    found = control.points(control.QUICK if quick else control.Plan())
    return collect("control", list(found), lambda key: found[key](), folder, fresh=fresh)


@dataclass(frozen=True)
class Level:
    """How to measure, draw and group the points of a level."""

    measure: Callable[[Robot, bool, Path, bool], list[Row]]
    draw: Callable[[list[Row], Path], None]
    look: Look


LEVELS = {
    "statics": Level(_statics, draw_statics, STATICS),
    "motion": Level(_motion, draw_motion, MOTION),
    "control": Level(_control, draw_control, CONTROL),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, draw, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--level", choices=LEVELS, action="append", help="this one only; may be repeated")
    parser.add_argument("--quick", action="store_true", help="few points, to see it work: under two minutes")
    parser.add_argument("--fresh", action="store_true", help="discard what is there from an earlier run")
    parser.add_argument("--out", type=Path, help="folder for the results (results/charts, or results/charts_quick)")
    options = parser.parse_args(arguments)
    folder = options.out or Path("results/charts_quick" if options.quick else "results/charts")
    robot = load_robot(MODELS / "planar_pair.toml")
    for name in options.level or LEVELS:
        rows = complete(LEVELS[name].measure(robot, options.quick, folder, options.fresh))
        LEVELS[name].draw(rows, folder / f"accuracy_vs_speed_{name}.png")
    compare(folder)
    print(f"written to {folder}")


def compare(folder: Path) -> None:
    """Print and write the ratios of all levels that are in the folder."""
    paths = {name: folder / f"accuracy_vs_speed_{name}.csv" for name in LEVELS}
    levels = {name: read(path) for name, path in paths.items() if path.exists()}
    comparisons = ratios([row for rows in levels.values() for row in rows])
    worse = {name: beaten(rows, LEVELS[name].look.family) for name, rows in levels.items()}
    print(report(comparisons))
    for name, families in worse.items():
        for family, by in families.items():
            print(f"{name}: {family} is beaten throughout, by {by}")
    commits = sorted({row["commit"] for rows in levels.values() for row in rows})
    text = json.dumps({"commits": commits, "ratios": comparisons, "beaten": worse}, indent=2)
    (folder / "accuracy_vs_speed_ratios.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
