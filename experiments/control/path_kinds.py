"""What the kinds of path look like, and how fast the tip goes along each: docs/figures/paths.png."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pcr_mpc import Blended, Polygon, Spline, Trajectory, Waypoints, load_path
from pcr_mpc.report.style import BLUE, GREY, ORANGE, RED, plt, save_figure

SCENES = Path(__file__).parents[2] / "models" / "scenes"
POINTS = ((-0.05, 0.22), (-0.03, 0.27), (0.0, 0.23), (0.03, 0.27), (0.05, 0.22))
SQUARE = ((-0.03, 0.22), (0.03, 0.22), (0.03, 0.28), (-0.03, 0.28))
_CORNERS = np.array(POINTS)


def kinds() -> dict[str, tuple[Trajectory, np.ndarray]]:
    """Title -> path, and the points that it was given."""
    drawn = load_path(SCENES / "hand_drawn.csv", smoothing=5e-4)
    circle = load_path(SCENES / "circle_60mm.csv", closed=True)
    return {
        "file, closed": (Blended(circle), np.array(circle.points)),
        "file, smoothed": (Blended(drawn), np.array(drawn.points)),
        "waypoints with times": (Blended(Waypoints(POINTS, times=(0.0, 0.8, 1.5, 2.2, 3.0), radius=0.008)), _CORNERS),
        "waypoints, rest at each": (Blended(Waypoints(POINTS, 0.15)), _CORNERS),
        "spline": (Blended(Spline(POINTS, 0.1)), _CORNERS),
        "polygon": (Blended(Polygon(SQUARE, 0.005, 0.1)), np.array(SQUARE)),
    }


def draw(path: Path) -> None:
    """Draw all kinds side by side."""
    figure, panels = plt.subplots(2, 6, figsize=(15, 5.2), layout="constrained", height_ratios=(1.3, 1))
    for (title, (trajectory, points)), (above, below) in zip(kinds().items(), panels.T, strict=True):
        end = trajectory.duration  # type: ignore[attr-defined]
        t = np.linspace(0.0, end, 1500)
        p, v, a = np.moveaxis(trajectory(t), 1, 0)
        above.plot(*(1e3 * points.T), "x" if len(points) < 20 else ".", color=GREY, ms=6 if len(points) < 20 else 3)
        above.plot(*(1e3 * p.T), color=BLUE)
        above.plot(*(1e3 * p[0]), "o", color=RED, ms=6)
        above.set(title=title, xlabel="x [mm]", aspect="equal", xlim=(-66, 66), ylim=(205, 295))
        below.plot(t, np.linalg.norm(v, axis=1), color=BLUE, label="speed [m/s]")
        below.plot(t, np.linalg.norm(a, axis=1) / 10, color=ORANGE, ls="--", label="acceleration / 10 [m/s²]")
        below.set(xlabel="t [s]", ylim=(0.0, 0.36))
        for axes in (above, below):
            axes.label_outer()
            axes.xaxis.set_tick_params(labelbottom=True)
    panels[0, 0].set_ylabel("y [mm]")
    panels[1, 0].legend(fontsize=8, loc="upper left")
    save_figure(figure, path)


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/path_kinds"), help="folder for the picture")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    draw(options.out / "paths.png")


if __name__ == "__main__":
    main()
