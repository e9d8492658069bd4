"""How well do implicit differentiation and finite differences agree, and at which step?

Measures the error of central differences of the joint force against K and G over a sweep of steps, at poses
around the default robot's centre; writes a CSV and a picture.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np

from pcr_mpc import Equilibrium, Robot, inverse_statics, load_robot, solve_statics
from pcr_mpc.report.style import BLUE, GREY, ORANGE, plt

METHODS = {"closed_form": BLUE, "multiple_shooting": ORANGE}


def error_curve(robot: Robot, pose: Equilibrium, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Largest relative error of central differences of F against [K G], for steps relative to length and radian."""
    options = {"method": method, "steps": 4}
    eq = solve_statics(robot, pose.p, pose.q, guess=pose, **options)
    exact = np.hstack([eq.dforce_dp, eq.dforce_dq])
    # Tip steps in units of a rod's length, so that one number serves metres and radians.
    units = np.concatenate([np.full(2, robot.lengths.min()), np.ones(robot.n_rods)])
    steps = np.geomspace(1e-9, 1e-2, 29)
    errors = []
    for step in steps:
        columns = []
        for i, unit in enumerate(units):
            move = np.zeros(len(units))
            move[i] = step * unit
            ahead, back = (
                solve_statics(robot, eq.p + s * move[:2], eq.q + s * move[2:], guess=eq, **options).force
                for s in (1, -1)
            )
            columns.append((ahead - back) / (2 * step))
        error = np.array(columns).T - exact * units
        errors.append(np.abs(error).max() / np.abs(exact * units).max())
    return steps, np.array(errors)


def main() -> None:
    """Measure, write the CSV, plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/finite_differences"))
    folder = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    robot = load_robot(Path(__file__).parents[2] / "models" / "planar_pair.toml")
    centre = inverse_statics(robot, (0.0, 0.25), mode="LR")
    pose = solve_statics(robot, (0.04, 0.22), centre.q + [0.2, -0.1], guess=centre)
    figure, axes = plt.subplots(figsize=(6.5, 4.2))
    rows = []
    for method, colour in METHODS.items():
        steps, errors = error_curve(robot, pose, method)
        rows += [(method, step, error) for step, error in zip(steps, errors, strict=True)]
        axes.loglog(steps, errors, "o-", ms=3, color=colour, label=method.replace("_", " "))
    axes.loglog(steps[-12:], errors[-1] * (steps[-12:] / steps[-1]) ** 2, ":", color=GREY, label="slope 2")
    axes.set(xlabel="step, in rod lengths and radians", ylabel="largest relative error of K and G",
             title="Central differences against implicit differentiation")  # fmt: skip
    axes.legend()
    figure.savefig(folder / "finite_differences.png")
    with open(folder / "finite_differences.csv", "w", newline="", encoding="utf-8") as handle:
        writer = csv.writer(handle)
        writer.writerow(["method", "step", "error"])
        writer.writerows(rows)
    print(f"written to {folder}")


if __name__ == "__main__":
    main()
