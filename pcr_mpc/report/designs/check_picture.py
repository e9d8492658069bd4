"""A robot at its start, where it can hold its tip, and the reference, in one picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.colors import Normalize

from ...design.examination import Examination
from ..style import GREY, RED, RODS, plt, save_figure

_POINTS = 60


def plot_check(found: Examination, path: Path) -> None:
    """Draw what was found of a robot or a scene.

    Parameters
    ----------
    found : Examination
    path : Path
        PNG, SVG or PDF.
    """
    robot = found.robot
    figure, axes = plt.subplots(figsize=(6.4, 5.6))
    for base, length in zip(robot.bases, robot.lengths, strict=True):
        axes.add_patch(plt.Circle(base, length, fill=False, color=GREY, ls=":", lw=0.9))
    axes.plot([], [], color=GREY, ls=":", lw=0.9, label="reach of a rod")
    if found.reach is not None and found.reach.poses:
        used = np.array([found.used(eq) for eq in found.reach.poses])
        tips, fits = found.reach.tips, used <= 1.0
        shown = axes.scatter(*tips[fits].T, c=100 * used[fits], s=42, marker="s", lw=0, cmap="viridis_r",
                             norm=Normalize(0, 100), label="tip can be held")  # fmt: skip
        figure.colorbar(shown, ax=axes, shrink=0.75, label="use of torque or strain, whichever is more [%]")
        if not fits.all():
            axes.plot(*tips[~fits].T, "x", color=RED, ms=4, mew=0.8, label="beyond torque or strain")
    if found.path is not None:
        axes.plot(*found.path.T, color="white", lw=3.2)
        axes.plot(*found.path.T, color=RED, lw=1.6, label="reference")
    if found.pose is not None:
        for i, shape in enumerate(found.pose.shape(_POINTS)):
            axes.plot(*shape.T, color="white", lw=4.4)
            axes.plot(*shape.T, color=RODS[i % len(RODS)], lw=2.6)
        axes.plot(*found.pose.p, "o", color="black", ms=8, label="tip")
    axes.plot(*robot.bases.T, "s", color="black", ms=8, label="motors")
    _frame(axes, found)
    what = "a pose" if found.scene is None else "start"
    axes.set(xlabel="x [m]", ylabel="y [m]", title=f"{found.name}: {what} and workspace")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, fontsize=8)
    save_figure(figure, path)


def _frame(axes: plt.Axes, found: Examination) -> None:
    """All but the circles of reach, which are large."""
    points = [found.robot.bases]
    if found.pose is not None:
        points.append(found.pose.shape(_POINTS).reshape(-1, 2))
    if found.reach is not None and found.reach.poses:
        points.append(found.reach.tips)
    if found.path is not None:
        points.append(found.path)
    every = np.concatenate(points)
    low, high = every.min(axis=0), every.max(axis=0)
    room = 0.08 * float((high - low).max())
    axes.set_aspect("equal")
    axes.set_xlim(low[0] - room, high[0] + room)
    axes.set_ylim(low[1] - room, high[1] + room)
