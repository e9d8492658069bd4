"""The three charts: error up the axis, time to the right, what no other point beats on a dashed line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments.charts.points import Row, failures, front
from experiments.charts.statics import DERIVATIVES
from experiments.charts.statics_poses import CLASSES
from pcr_mpc.report.style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, plt

Style = tuple[str, str, float]  # colour, marker, size
STATICS: dict[str, Style] = {
    "closed form": (GREEN, "*", 13),
    "multiple shooting, rk8": (BLUE, "s", 5),
    "multiple shooting, rk4": (SKY, "o", 5),
    "single shooting, SciPy": (ORANGE, "^", 6),
    "literal reading, at once": (PURPLE, "v", 6),
    "literal reading": (RED, "D", 6),
}


def draw_statics(rows: list[Row], path: Path) -> None:
    """Draw a panel for each class, one for the derivatives, and the legend."""
    figure, axes = plt.subplots(2, 3, figsize=(13, 8), layout="constrained")
    for panel, case in zip(axes.flat, (*CLASSES, DERIVATIVES), strict=False):
        mine = [row for row in rows if row["case"] == case]
        attempts = max((row["attempts"] for row in mine), default=0)
        panel.set(title=f"{case} ({attempts} poses)", xlabel="time of a solve, p50 [ms]")
        if case == DERIVATIVES:
            panel.set(ylabel="relative error, median [-]")
            _ways(panel, mine)
        else:
            panel.set(ylabel="relative error of F, median [-]")
            _draw(panel, mine, STATICS, _family, 1e3, label=_segments)
            _front(panel, mine, 1e3)
        panel.set(xscale="log", yscale="log", xlim=(1e-3 if case == DERIVATIVES else 1e-2, 1e4), ylim=(1e-15, 1e2))
        panel.minorticks_off()
    _legend(axes.flat[-1], {name: style for name, style in STATICS.items() if any(_family(r) == name for r in rows)},
            "lines of multiple shooting: N segments (number)\nof 1 to 16 steps of rk4, 1 to 4 of rk8")  # fmt: skip
    figure.savefig(path)
    plt.close(figure)


def _family(row: Row) -> str:
    name = str(row["method"])
    return f"{name}, {row['settings'].split()[-1]}" if name == "multiple shooting" else name


def _segments(row: Row) -> str:
    """Which points are joined: those with as many segments, and none of the literal reading."""
    return str(row["settings"] if row["method"].startswith("literal") else row["settings"].split(",")[0])


def _ways(panel: Any, rows: list[Row]) -> None:
    """What F, K and G cost: by name beside each point."""
    for row in rows:
        if np.isfinite(row["time_p50"]):
            colour, marker, size = STATICS[_family(row) if row["method"] != "multiple shooting" else
                                           "multiple shooting, rk8"]  # fmt: skip
            way = row["settings"].split(", ")[-1]
            at = 1e3 * row["time_p50"], row["error"]
            panel.plot(*at, marker, color=colour, ms=size)
            text = {"implicit": "K, G implicit", "differences": "K, G by differences"}.get(way, way)
            # On sides where the other points are not.
            offset, ha, va = {
                "implicit": ((0, 8), "center", "bottom"),
                "differences": ((8, 0), "left", "center"),
            }.get(way, ((-8, 0), "right", "center"))
            if row["method"].startswith("literal"):
                offset, ha = (-8, 0), "right"
            style = {"textcoords": "offset points", "fontsize": 8, "color": colour}
            panel.annotate(text, at, offset, ha=ha, va=va, **style)


def _draw(
    panel: Any,
    rows: list[Row],
    styles: dict[str, Style],
    family: Callable[[Row], str],
    unit: float,
    *,
    label: Callable[[Row], str],
    floor: float = 0.0,
) -> None:
    """Points of all rows, joined where method and label are the same; failures as a number beside a hollow marker."""
    lines: dict[tuple[str, str], list[Row]] = {}
    lost: dict[str, int] = {}
    for row in rows:
        if np.isfinite(row["time_p50"]) and np.isfinite(row["error"]):
            lines.setdefault((family(row), label(row)), []).append(row)
        else:
            lost[family(row)] = lost.get(family(row), 0) + 1
    for (name, text), found in lines.items():
        colour, marker, size = styles[name]
        x = [unit * row["time_p50"] for row in found]
        y = [max(row["error"], floor) for row in found]
        panel.plot(x, y, "-", color=colour, lw=0.8, alpha=0.6)
        for row, at in zip(found, zip(x, y, strict=True), strict=True):
            failed = failures(row)
            panel.plot(*at, marker, color=colour, ms=size, mfc="none" if failed else colour)
            if failed:
                panel.annotate(f"-{failed}", at, (-4, -9), textcoords="offset points", fontsize=7, color=colour,
                               ha="right")  # fmt: skip
        if name == "multiple shooting, rk4":
            panel.annotate(text.split()[-1], (x[-1], y[-1]), (5, -3), textcoords="offset points", fontsize=8)
    if lost:
        text = "\n".join(f"{name} ({count})" for name, count in lost.items())
        panel.annotate(f"failed throughout (settings):\n{text}", (0.98, 0.98), xycoords="axes fraction", ha="right",
                       va="top", fontsize=7.5, color=GREY)  # fmt: skip


def _front(panel: Any, rows: list[Row], unit: float, floor: float = 0.0) -> None:
    best = list(front(rows))
    x, y = [unit * row["time_p50"] for row in best], [max(row["error"], floor) for row in best]
    panel.step(x, y, where="post", color=GREY, ls="--", lw=1.2, zorder=0)


def _legend(panel: Any, styles: dict[str, Style], note: str, **place: Any) -> None:
    handles = [plt.Line2D([], [], color=colour, marker=marker, ms=size, ls="", label=name)
               for name, (colour, marker, size) in styles.items()]  # fmt: skip
    handles.append(plt.Line2D([], [], color=GREY, ls="--", lw=1.2, label="beaten by no other, without failures"))
    handles.append(plt.Line2D([], [], color=GREY, marker="o", ls="", mfc="none", label="hollow, -n: n failures"))
    panel.axis("off")
    panel.legend(handles=handles, loc="center", fontsize=10.5, title=note, title_fontsize=10, alignment="left", **place)
