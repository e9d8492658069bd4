"""What was learnt from lap to lap, as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from ..loop.run.run import Run
from .style import BLUE, GREY, plt, save_figure


def plot_laps(run: Run, path: Path) -> None:
    """Draw the error against the lap, and the first and the last lap's error on the way round.

    Parameters
    ----------
    run : Run
        Of a reference that comes round.
    path : Path
        Of the picture; its ending says which kind.

    Raises
    ------
    ValueError
        There is no lap in it.
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.0), layout="constrained")
    left.set_title(f"{run.scene.name}, seed {run.seed}")
    laps, errors = run.laps(), run.lap_errors()
    if laps is None or not len(errors):
        plt.close(figure)
        raise ValueError(f"{path}: no lap was run at full speed")
    draw_errors(left, [errors], BLUE, run.controller)
    edges = laps.judged(run.scene.period) * run.steps_per_period
    for lap, colour, name in ((0, GREY, "first"), (len(errors) - 1, BLUE, "last")):
        at = slice(edges[lap], edges[lap + 1])
        right.plot(run.t[at] - run.t[edges[lap]], 1e3 * run.error[at], color=colour, label=f"{name} lap")
    right.legend(fontsize=9)
    right.set(xlabel="time in the lap [s]", ylabel="tip error [mm]", ylim=(0, None), title="On the way round")
    save_figure(figure, path)


def draw_errors(axes: Any, errors: Sequence[np.ndarray], colour: str, label: str) -> None:
    """Draw RMS errors of laps [m] of some runs: each thin, their median thick."""
    shortest = min(len(each) for each in errors)
    lap = np.arange(1, shortest + 1)
    for each in errors if len(errors) > 1 else ():
        axes.plot(lap, 1e3 * each[:shortest], color=colour, lw=0.8, alpha=0.4)
    middle = np.median([each[:shortest] for each in errors], axis=0)
    axes.plot(lap, 1e3 * middle, "o-", color=colour, ms=5, label=label)
    axes.set(yscale="log", xlabel="lap", ylabel="RMS error of the tip [mm]")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
