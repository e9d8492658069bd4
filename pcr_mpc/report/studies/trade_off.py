"""Picture of a tuning study: what accuracy costs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from ..style import BLUE, GREEN, GREY, ORANGE, RED, plt, save_figure


def plot_trade_off(trials: list[dict[str, Any]], chosen: int | None, title: str, path: Path) -> None:
    """Draw the error under mismatch against the time of a step, with the Pareto front, and the scores in their order.

    Parameters
    ----------
    trials : list of dict
        As `finished_trials` returns them; the first is the start.
    chosen : int or None
        Number of the trial that was chosen.
    title : str
    path : Path
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
    number, score, time, error, failures = (
        np.array([trial[key] for trial in trials], dtype=float)
        for key in ("trial", "score", "step_time_us", "tracking_mm", "failure_rate")
    )
    sound = failures == 0
    ran = np.isfinite(time) & np.isfinite(error)
    for axes, x, y in ((left, time, error), (right, number, score)):
        axes.plot(x[sound & ran], y[sound & ran], "o", color=BLUE, ms=5, alpha=0.8, label="no episode failed")
        axes.plot(x[~sound & ran], y[~sound & ran], "x", color=RED, ms=6, label="some episodes failed")
        axes.plot(x[:1], y[:1], "s", color=ORANGE, ms=11, mfc="none", mew=2, label="start")
        mine = number == (-1 if chosen is None else chosen)
        axes.plot(x[mine], y[mine], "o", color=GREEN, ms=13, mfc="none", mew=2, label="chosen" if mine.any() else None)
    front = pareto(time[sound & ran], error[sound & ran])
    left.step(*front.T, where="post", color=GREY, lw=1.2, ls="--", zorder=0, label="Pareto front without failures")
    left.set(xscale="log", yscale="log", xlabel="CPU time of a control step, median [us]",
             ylabel="RMS error under mismatch, mean [mm]", title=title)  # fmt: skip
    left.legend(loc="best", fontsize=8)
    right.axhline(1.0, color=ORANGE, lw=1.0, ls=":")
    right.set(yscale="log", xlabel="trial", ylabel="score, less is better [-]", title="Score relative to the start")
    right.xaxis.set_major_locator(MaxNLocator(integer=True))
    for axis in (left.xaxis, left.yaxis, right.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    save_figure(figure, path)


def pareto(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Points that no other beats in both, by increasing x, shape (m, 2)."""
    front: list[tuple[float, float]] = []
    for i in np.lexsort((y, x)):
        if not front or y[i] < front[-1][1]:
            front.append((float(x[i]), float(y[i])))
    return np.array(front).reshape(-1, 2)
