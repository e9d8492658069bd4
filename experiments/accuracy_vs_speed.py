"""Speed against accuracy on three levels: statics, motion, control. `make charts`.

Each level writes a CSV, a row a point, as soon as the point is measured, and a picture. Started again at the same
commit it goes on where it stopped; --fresh begins anew. What is compared, and how, stands in `experiments.charts`:
`statics`, `motion` and `control`. At the end the ratios that the README quotes and the project's own methods that
others of its own beat in both time and error go into ratios.json.

Times are wall times: run it on a computer that does nothing else. Run as ``python -m experiments.accuracy_vs_speed``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from experiments.charts import statics
from experiments.charts.draw import draw_statics
from experiments.charts.points import Row, collect, complete
from pcr_mpc import Robot, load_robot

MODELS = Path(__file__).parent.parent / "models"


def _statics(robot: Robot, quick: bool, folder: Path, fresh: bool) -> list[Row]:
    plan = statics.QUICK if quick else statics.Plan()
    return collect("statics", statics.keys(plan), lambda key: statics.measure(robot, plan, key), folder, fresh=fresh)


LEVELS: dict[str, tuple[Callable[[Robot, bool, Path, bool], list[Row]], Callable[[list[Row], Path], None]]] = {
    "statics": (_statics, draw_statics),
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
    for level in options.level or LEVELS:
        measure, draw = LEVELS[level]
        rows = complete(measure(robot, options.quick, folder, options.fresh))
        draw(rows, folder / f"accuracy_vs_speed_{level}.png")
    print(f"written to {folder}")


if __name__ == "__main__":
    main()
