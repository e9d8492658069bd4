"""What the three charts have in common: error up the axis, time to the right, the best on a dashed line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.charts.points import Row, failures, front
from pcr_mpc.report.style import GREY, plt

Style = tuple[str, str, float]  # colour, marker, size


@dataclass(frozen=True)
class Look:
    """How the points of a level are drawn.

    Attributes
    ----------
    styles : dict
        Family -> colour, marker, size.
    family : callable
        Row -> family.
    line : callable
        Row -> which points of a family are joined; "" for none.
    tag : callable
        Row -> text beside the point, or "".
    unit : float
        Of the axis of time, per second.
    bars : bool
        Lines from p50 to p99.
    """

    styles: dict[str, Style]
    family: Callable[[Row], str]
    line: Callable[[Row], str]
    tag: Callable[[Row], str]
    unit: float
    bars: bool = False


def draw_points(panel: Any, rows: list[Row], look: Look, floor: float = 0.0) -> None:
    """Draw all rows; those that claim less than the floor lie on it, with a black rim."""
    lines: dict[tuple[str, str], list[tuple[float, float]]] = {}
    lost: dict[str, int] = {}
    for row in rows:
        family = look.family(row)
        x, y = look.unit * row["time_p50"], max(row["error"], floor)
        if not row["success"] or not np.isfinite([x, y]).all():
            lost[family] = lost.get(family, 0) + 1
            continue
        colour, marker, size = look.styles[family]
        if look.line(row):
            lines.setdefault((family, look.line(row)), []).append((x, y))
        if look.bars:
            panel.plot([x, look.unit * row["time_p99"]], [y, y], "-", color=colour, lw=1, alpha=0.5)
        failed = failures(row)
        rim = {"mec": "black", "mew": 1.2} if row["error"] < floor else {}
        panel.plot(x, y, marker, color=colour, ms=size, mfc="none" if failed else colour, **rim)
        style = {"textcoords": "offset points", "fontsize": 7.5}
        if failed:
            panel.annotate(f"-{failed}", (x, y), (-4, -9), color=colour, ha="right", **style)
        if look.tag(row):
            panel.annotate(look.tag(row), (x, y), (3, 4), **style)
    for (family, _), at in lines.items():
        panel.plot(*zip(*at, strict=True), "-", color=look.styles[family][0], lw=0.8, alpha=0.6)
    if lost:
        text = "\n".join(f"{name} ({count})" for name, count in lost.items())
        panel.annotate(f"failed throughout (settings):\n{text}", (0.98, 0.98), xycoords="axes fraction", ha="right",
                       va="top", fontsize=7.5, color=GREY)  # fmt: skip


def draw_front(panel: Any, rows: list[Row], unit: float, floor: float = 0.0) -> None:
    """Join the points that no other beats; what lies below the floor has a place there once."""
    best = list(front([row | {"error": max(row["error"], floor)} for row in rows]))
    x, y = [unit * row["time_p50"] for row in best], [row["error"] for row in best]
    panel.step(x, y, where="post", color=GREY, ls="--", lw=1.2, zorder=0)


def draw_legend(panel: Any, rows: list[Row], look: Look, note: str, *, floor: bool = False) -> None:
    """Families that are there, and the signs, in a panel of their own."""
    there = {look.family(row) for row in rows}
    handles = [plt.Line2D([], [], color=colour, marker=marker, ms=min(size, 9), ls="", label=name)
               for name, (colour, marker, size) in look.styles.items() if name in there]  # fmt: skip
    handles.append(plt.Line2D([], [], color=GREY, ls="--", lw=1.2, label="beaten by no other, without failures"))
    handles.append(plt.Line2D([], [], color=GREY, marker="o", ls="", mfc="none", label="hollow, -n: n failures"))
    if floor:
        handles.append(plt.Line2D([], [], color=GREY, ls=":", lw=1.5, label="how well the yardstick is known"))
        handles.append(plt.Line2D([], [], color=GREY, marker="o", ls="", mec="black", mew=1.2,
                                  label="black rim: closer than that, drawn on it"))  # fmt: skip
    panel.axis("off")
    panel.legend(
        handles=handles, loc="center", fontsize=9, labelspacing=0.25, title=note, title_fontsize=9.5, alignment="left"
    )
