"""How much better does a robot get from lap to lap, and when is there nothing left but noise?

Robots that are not as believed (`Spread`) go round the figure of eight, with what is learnt from each lap taken off the
next one's feed-forward. Beside them: the same without learning, and the same under controllers that know the robot's
true numbers, where what is left is noise.

    python -m experiments.control.learning --episodes 20
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from pcr_mpc import PCRError, Scene, load_scene, make_controller, simulate
from pcr_mpc.control.tuning import LearningTuning
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.laps import draw_errors
from pcr_mpc.report.style import BLUE, GREEN, ORANGE, plt, save_figure
from pcr_mpc.report.tables import table
from pcr_mpc.study.episodes.episodes import Spread, lighter
from pcr_mpc.study.episodes.parallel import local_workers

SCENES = Path(__file__).parents[2] / "models" / "scenes"
ARMS = {"as it is": ORANGE, "learning": BLUE, "true numbers": GREEN}
WIDE = Spread(stiffness=0.2, mass=0.3, base_offset=2e-3, delay=1, tip_noise=2e-4, force=1.5)


def laps(scene: Scene, spread: Spread, seed: int) -> dict[str, list[float]]:
    """RMS of each lap [mm] of the robot of a seed, for each arm."""
    true = spread.sample(scene.robot.n_rods, seed).applied_to(scene)
    found = {}
    for arm in ARMS:
        believed = replace(scene, angle_step=true.angle_step)
        if arm == "true numbers":
            believed = replace(true, force=scene.force)
        tuning = replace(scene.tuning, learning=LearningTuning()) if arm == "learning" else scene.tuning
        run = simulate(true, true.make_plant(), make_controller(believed, tuning), seed)
        found[arm] = (1e3 * run.lap_errors()).tolist()
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, write rows and a picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20, help="robots for each case (default 20)")
    parser.add_argument("--laps", type=int, default=8, help="default 8")
    parser.add_argument("--jobs", type=int, help="processes on this machine (default: one a core)")
    parser.add_argument("--out", type=Path, default=Path("results/learning"), help="default results/learning")
    options = parser.parse_args(arguments)
    try:
        return _study(options)
    except (PCRError, ValueError, OSError) as error:
        print(f"learning: {error}", file=sys.stderr)
        return 1


def _study(options: argparse.Namespace) -> int:
    options.out.mkdir(parents=True, exist_ok=True)
    cases = {"lemniscate": Spread(), "sensors": Spread(), "lemniscate, twice as far off": WIDE}
    figure, panels = plt.subplots(1, len(cases), figsize=(13.5, 4.0), layout="constrained", sharey=True)
    rows, lines = [], []
    with local_workers(options.jobs) as executor:
        for axes, (name, spread) in zip(panels, cases.items(), strict=True):
            scene = load_scene(SCENES / f"{name.split(',')[0]}.toml")
            scene = lighter(replace(scene, duration=1.0 + 2.0 * options.laps))
            found = list(executor.map(partial(laps, scene, spread), range(options.episodes)))
            for arm, colour in ARMS.items():
                errors = [np.array(each[arm]) for each in found]
                draw_errors(axes, [1e-3 * each for each in errors], colour, arm)
                rows += [{"case": name, "arm": arm, "seed": seed, **{f"lap{i + 1}_mm": e for i, e in enumerate(each)}}
                         for seed, each in enumerate(errors)]  # fmt: skip
                middle = np.median(errors, axis=0)
                worst = max(float(max(each[1:]) / each[0]) for each in errors)
                lines.append((f"{name}: {arm}", *(f"{middle[i]:.3f}" for i in (0, 1, 2, -1)), f"{worst:.2f}"))
            axes.set_title(f"{name}\n{options.episodes} robots and their median", fontsize=10)
            axes.legend(fontsize=8, loc="lower left")
            axes.label_outer()
    write_rows(options.out / "learning.csv", rows)
    save_figure(figure, options.out / "learning.png")
    print(table(("RMS, medians [mm]", "lap 1", "2", "3", "last", "worst over its first"), lines))
    print(f"\nwritten to {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
