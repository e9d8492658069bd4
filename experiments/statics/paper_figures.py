"""The figures of the paper, drawn by this toolkit.

Fig. 2  A pose by single shooting: the rods as integrated from the base loads.
Fig. 3  Response of the tip, let go with a velocity while the motors stand still.
Fig. 4  A pose by multiple shooting, N = 8, tip at (0.18, 0.12): the segments and their nodes.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from pcr_mpc import Equilibrium, inverse_statics, load_robot, load_scene, make_controller, simulate, solve_statics
from pcr_mpc.report.plots import draw_robot, frame
from pcr_mpc.report.style import BLUE, ORANGE, RED, RODS, plt

MODELS = Path(__file__).parents[2] / "models"


def figure_2(folder: Path) -> None:
    """Single shooting."""
    robot = load_robot(MODELS / "planar_pair.toml")
    balance = inverse_statics(robot, (0.0, 0.25), mode="LR")
    eq = solve_statics(robot, (0.05, 0.22), balance.q, method="single_shooting", guess=balance)
    figure, axes = plt.subplots(figsize=(6, 5))
    draw_robot(axes, eq)
    for i, (base, angle) in enumerate(zip(robot.bases, eq.q, strict=True)):
        direction = 0.05 * np.array([np.cos(angle), np.sin(angle)])
        axes.annotate("", base + direction, base, arrowprops={"arrowstyle": "->", "lw": 2}, zorder=6)
        axes.annotate(f"$q_{i + 1}$ = {np.degrees(angle):.0f}°", base + [0, -0.035], ha="center")
    pull = -0.02 * eq.force
    axes.annotate("", eq.p + pull, eq.p, arrowprops={"arrowstyle": "->", "color": RED, "lw": 2}, zorder=6)
    axes.annotate(f"-F = ({-eq.force[0]:.2f}, {-eq.force[1]:.2f}) N", eq.p + pull, ha="right", va="top", color=RED)
    frame(axes, eq.shape(60), margin=0.06)
    axes.set_title(f"Single shooting: residual {eq.residual_norm:.1e}, {eq.iterations} evaluations")
    figure.savefig(folder / "paper_fig2.png")
    plt.close(figure)


def figure_3(folder: Path) -> None:
    """Tip response with the motors fixed."""
    scene = load_scene(MODELS / "scenes" / "release.toml")
    # The paper's model and time step, not the scene's own.
    of_paper = replace(scene.plant, inertia="none", integrator="semi_implicit_euler", dt=1e-3)
    scene = replace(scene, plant=of_paper)
    run = simulate(scene, scene.make_plant(), make_controller(scene))
    figure, (time_axes, path_axes) = plt.subplots(1, 2, figsize=(10, 4), width_ratios=(2, 1))
    for axis, (name, colour) in enumerate((("x", BLUE), ("y", ORANGE))):
        time_axes.plot(run.t, 1e3 * (run.x[:, axis] - run.x[0, axis]), color=colour, label=f"{name} - {name}(0)")
    time_axes.set(xlabel="t [s]", ylabel="tip displacement [mm]", title="Released tip, motors fixed")
    time_axes.legend()
    path_axes.plot(*(1e3 * run.x[:, :2].T), color=BLUE, lw=1.2)
    path_axes.plot(*(1e3 * run.x[0, :2]), "o", color="black", label="start")
    path_axes.set(xlabel="x [mm]", ylabel="y [mm]", title="Path of the tip", aspect="equal")
    path_axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.25))
    figure.tight_layout()
    figure.savefig(folder / "paper_fig3.png")
    plt.close(figure)


def figure_4(folder: Path) -> None:
    """Multiple shooting with eight segments."""
    robot = load_robot(MODELS / "planar_pair.toml")
    centre = inverse_statics(robot, (0.0, 0.25), mode="LR")
    # On the branch with the rods bowed outward, as far to the side as (0.18, 0.12).
    balance = inverse_statics(robot, (0.18, 0.12), guess=centre)
    eq = solve_statics(robot, balance.p, balance.q, method="multiple_shooting", segments=8, guess=balance)
    figure, axes = plt.subplots(figsize=(6, 5))
    draw_segments(axes, eq)
    frame(axes, eq.shape(60), margin=0.06)
    axes.set_title(f"Multiple shooting, N = 8, tip at (0.18, 0.12) m\nresidual {eq.residual_norm:.1e}, mode {eq.mode}")
    figure.savefig(folder / "paper_fig4.png")
    plt.close(figure)


def draw_segments(axes: object, eq: Equilibrium) -> None:
    """Draw the rods with a dot at every shooting node."""
    draw_robot(axes, eq)
    segments = eq.nodes.shape[2]
    for i, line in enumerate(eq.shape(8 * segments + 1)):
        axes.plot(*line[:-1:8].T, "o", ms=5, mfc="white", mec=RODS[i], zorder=6)  # type: ignore[attr-defined]


def main() -> None:
    """Draw all three."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/paper_figures"), help="folder for the pictures")
    folder = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    for draw in (figure_2, figure_3, figure_4):
        draw(folder)
    print(f"written to {folder}")


if __name__ == "__main__":
    main()
