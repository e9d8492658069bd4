"""Picture of a planned motion: what limits it where."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection

from ...study.planning.timed_path import TimedPath
from ..style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, plt, save_figure

_COLOURS = {
    "motor rate": BLUE,
    "change of rate": ORANGE,
    "motor torque": RED,
    "motor angle": SKY,
    "tip region": "#999933",
    "tip speed": GREEN,
    "tip acceleration": PURPLE,
    "tip jerk": "#882255",
    "stiffness": "#332288",
    "rod margin": "#44AA99",
    "strain": "#661100",
}
_NONE = "none of them"
_HARDLY = 0.05  # share below which a limit is not drawn


def plot_plan(planned: TimedPath, path: Path) -> None:
    """Draw the speed along the path, coloured by what limits it, how much of each limit is used, and the path."""
    figure = plt.figure(figsize=(11, 6.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(2.1, 1.0))
    speed_axes, share_axes = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    path_axes = figure.add_subplot(grid[:, 1])
    s, acting = 1e3 * planned.s, planned.acting
    speed = np.linalg.norm(planned.motion[:, 1], axis=1)

    _coloured(speed_axes, s, speed, planned)
    speed_axes.set(xlim=(0.0, s[-1]), ylim=(0.0, 1.12 * speed.max()), ylabel="speed of the tip [m/s]")
    speed_axes.set_title(f"{planned.name}: {planned.duration:.3f} s, and what limits it")
    for kind in _order(planned):
        colour = GREY if kind == _NONE else _COLOURS[kind]
        which = acting == (-1 if kind == _NONE else planned.kinds.index(kind))
        share = np.gradient(planned.t)[which].sum() / planned.duration
        speed_axes.plot([], [], color=colour, lw=4, label=f"{kind}, {100 * share:.0f} % of the time")
    speed_axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, fontsize=9)

    for kind, share in zip(planned.kinds, planned.shares, strict=True):
        if share.max() > _HARDLY:
            share_axes.plot(s, 100 * share, color=_COLOURS[kind], lw=1.2, label=kind)
    share_axes.axhline(100.0, color="black", lw=0.8, ls="--")
    share_axes.set(xlim=(0.0, s[-1]), ylim=(0.0, 108.0))
    share_axes.set(xlabel="length along the path [mm]", ylabel="share of the limit [%]")
    share_axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=4, fontsize=9)

    x, y = 1e3 * planned.motion[:, 0].T
    _coloured(path_axes, x, y, planned)
    path_axes.plot(x[0], y[0], "o", color="black", ms=7, label="start")
    path_axes.plot(x[-1], y[-1], "s", color="black", ms=7, label="end")
    path_axes.set(xlabel="x [mm]", ylabel="y [mm]", title="Path")
    path_axes.set_aspect("equal")
    path_axes.margins(0.1)
    path_axes.locator_params(nbins=6)
    path_axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.28), ncols=2)
    save_figure(figure, path, tight=False)


def _coloured(axes: Any, x: np.ndarray, y: np.ndarray, planned: TimedPath) -> None:
    """A line whose colour says what limits the motion."""
    points, acting = np.stack([x, y], axis=1), planned.acting[:-1]
    # One line for each stretch of one colour: thousands of short ones take a good part of a second.
    ends = np.concatenate([[0], np.flatnonzero(np.diff(acting)) + 1, [len(acting)]])
    stretches = [points[first : last + 1] for first, last in pairwise(ends)]
    colours = [GREY if at < 0 else _COLOURS[planned.kinds[at]] for at in acting[ends[:-1]]]
    axes.add_collection(LineCollection(stretches, colors=colours, linewidths=3.0, capstyle="butt"))
    axes.autoscale_view()


def _order(planned: TimedPath) -> list[str]:
    """What limits the motion somewhere, the most frequent first."""
    found = [int(at) for at in np.unique(planned.acting)]
    found.sort(key=lambda at: -int((planned.acting == at).sum()))
    return [_NONE if at < 0 else planned.kinds[at] for at in found]
