"""The pictures of the three levels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter

from experiments.charts.control import CROCODDYL, DAQP, DO_MPC, SCENES
from experiments.charts.draw import Look, Style, draw_front, draw_legend, draw_points
from experiments.charts.motion import ELASTICA, MUJOCO, YARDSTICK
from experiments.charts.points import Row
from experiments.charts.statics import DERIVATIVES, LITERAL, LITERAL_AT_ONCE
from experiments.charts.statics_poses import CLASSES
from experiments.motion.rod_inertia import RELEASES
from pcr_mpc.report.style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, plt

_INTEGRATORS = {"semi_implicit_euler": ("Euler", "o", 4), "velocity_verlet": ("Verlet", "s", 4), "rk4": ("RK4", "D", 5)}
_INERTIAS = {"none": BLUE, "constant": ORANGE, "condensed": GREEN}
_ALONE, _EXTRAPOLATED = "MuJoCo, as it comes", "MuJoCo, extrapolated (number: links)"
_LINEAR = {"default": GREEN, "frozen": BLUE, "robust": ORANGE, "shooting": SKY}
_MODES = {"along_plan": ("along the plan", "s"), "here": ("here", "o")}


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
            draw_points(panel, mine, STATICS)
            draw_front(panel, mine, STATICS.unit)
        panel.set(xscale="log", yscale="log", xlim=(1e-3 if case == DERIVATIVES else 1e-2, 1e4), ylim=(1e-15, 1e2))
        panel.minorticks_off()
    draw_legend(axes.flat[-1], rows, STATICS,
                "lines of multiple shooting: N segments (number)\nof 1 to 16 steps of rk4, 1 to 4 of rk8")  # fmt: skip
    figure.savefig(path)
    plt.close(figure)


def draw_motion(rows: list[Row], path: Path) -> None:
    """Draw a panel for each release, and the legend."""
    figure, axes = plt.subplots(1, 3, figsize=(14, 5.6), layout="constrained", width_ratios=(1, 1, 0.6), sharey=True)
    for panel, (release, title) in zip(axes, RELEASES.items(), strict=False):
        mine = [row for row in rows if row["case"] == release and row["method"] != YARDSTICK]
        floor = max(row["error"] for row in rows if row["case"] == release and row["method"] == YARDSTICK)
        draw_points(panel, mine, MOTION, floor)
        draw_front(panel, mine, MOTION.unit, floor)
        panel.axhline(floor, color=GREY, ls=":", lw=1.5)
        panel.set(xscale="log", yscale="log", xlabel="wall time per simulated second [s]", title=title)
        panel.set_ylim(top=3e2)  # room for what failed
        panel.axvline(1.0, color=GREY, lw=0.8, alpha=0.5)
        panel.annotate("real time", (1.0, 0.3), xycoords=("data", "axes fraction"), fontsize=7.5, color=GREY,
                       rotation=90, ha="right", va="bottom")  # fmt: skip
        panel.minorticks_off()
    axes[0].set_ylabel("largest error of the tip within 1 s [mm]")
    draw_legend(axes[-1], rows, MOTION, "lines: time step", floor=True)
    figure.savefig(path)
    plt.close(figure)


def draw_control(rows: list[Row], path: Path) -> None:
    """Draw a panel for each scene, and the legend."""
    figure, axes = plt.subplots(1, 3, figsize=(14, 5.6), layout="constrained", width_ratios=(1, 1, 0.6))
    for panel, case in zip(axes, SCENES, strict=False):
        mine = [row for row in rows if row["case"] == case]
        draw_points(panel, mine, CONTROL)
        draw_front(panel, mine, CONTROL.unit)
        panel.set(xscale="log", yscale="log", xlabel="wall time of a control step, p50 to p99 [ms]", title=case)
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5)))
        panel.yaxis.set_major_formatter("{x:g}")
        panel.yaxis.set_minor_formatter(NullFormatter())
    axes[0].set_ylabel("RMS tracking error after 1 s [mm]")
    draw_legend(axes[-1], rows, CONTROL, "number: horizon [periods of 10 ms]")
    figure.savefig(path)
    plt.close(figure)


def _of_statics(row: Row) -> str:
    name, words = str(row["method"]), row["settings"].replace(",", "").split()
    return f"{name}, {words[5]}" if name == "multiple shooting" else name


def _segments(row: Row) -> str:
    """Which points are joined: those with as many segments, and none of the literal reading."""
    return "" if row["method"].startswith(LITERAL) else str(row["settings"].split(",")[0])


def _segments_tag(row: Row) -> str:
    """N at the end of a line."""
    ends = row["method"] == "multiple shooting" and row["settings"].endswith(", 16 x rk4")
    return str(row["settings"].split(",")[0].split()[-1]) if ends else ""


def _of_motion(row: Row) -> str:
    name, settings = str(row["method"]), str(row["settings"])
    if "in one call" in settings:
        return f"{name}, {settings.split(', ', 2)[2]}"
    if name in _INERTIAS:
        return f"{name}, {_INTEGRATORS[settings.split(',')[0]][0]}"
    if name == MUJOCO:
        return _EXTRAPOLATED if "extrapolated" in settings else _ALONE
    return f"{name}, Gauss (number: modes)" if name == "full" else name


def _motion_tag(row: Row) -> str:
    numbered = row["method"] == "full" or "extrapolated" in row["settings"]
    return str(row["settings"].split()[0]) if numbered else ""


def _motion_line(row: Row) -> str:
    joined = (row["method"] in _INERTIAS and "in one call" not in row["settings"]) or "extrapolated" in row["settings"]
    return "by step" if joined else ""


def _of_control(row: Row) -> str:
    name = "default" if row["method"] == "slow_motors" else str(row["method"])
    return f"{name}, {_MODES[row['settings'].split(', ')[1]][0]}" if name in _LINEAR else name.replace("_", " ")


def _horizon(row: Row) -> str:
    return str(row["settings"].split(",")[0].split()[-1]).strip("-")


def _ways(panel: Any, rows: list[Row]) -> None:
    """What F, K and G cost: by name beside each point."""
    for row in rows:
        if not np.isfinite(row["time_p50"]):
            continue
        colour, marker, size = STATICS.styles[_of_statics(row)]
        way = row["settings"].split(", ")[-1]
        at = 1e3 * row["time_p50"], row["error"]
        panel.plot(*at, marker, color=colour, ms=size)
        text = {"implicit": "K, G implicit", "differences": "K, G by differences"}.get(way, way)
        # On sides where the other points are not.
        offset, ha, va = {
            "implicit": ((0, 8), "center", "bottom"),
            "differences": ((8, 0), "left", "center"),
        }.get(way, ((-8, 0), "right", "center"))
        if row["method"].startswith(LITERAL):
            offset, ha = (-8, 0), "right"
        style = {"textcoords": "offset points", "fontsize": 8, "color": colour}
        panel.annotate(text, at, offset, ha=ha, va=va, **style)


_LITERAL_STYLES: dict[str, Style] = {LITERAL_AT_ONCE: (PURPLE, "v", 6), LITERAL: (RED, "X", 7)}
STATICS = Look(
    {
        "closed form": (GREEN, "*", 13),
        "multiple shooting, rk8": (BLUE, "s", 5),
        "multiple shooting, rk4": (SKY, "o", 5),
        "single shooting, SciPy": (ORANGE, "^", 6),
    }
    | _LITERAL_STYLES,
    _of_statics,
    _segments,
    _segments_tag,
    1e3,
)
MOTION = Look(
    {
        f"{inertia}, {name}": (colour, marker, size)
        for inertia, colour in _INERTIAS.items()
        for name, marker, size in _INTEGRATORS.values()
    }
    | {
        f"{inertia}, {how}": (colour, marker, 6)
        for inertia, colour in _INERTIAS.items()
        for how, marker in (("in one call", "<"), ("in one call, compiled", "p"))
    }
    | {
        "none, multiple shooting": (BLUE, "^", 6),
        "none, single shooting": (BLUE, "v", 6),
        "full, Gauss (number: modes)": (GREY, "P", 6),
        _EXTRAPOLATED: (SKY, "^", 6),
        _ALONE: (SKY, "x", 5),
        ELASTICA: (ORANGE, "*", 10),
    }
    | _LITERAL_STYLES,
    _of_motion,
    _motion_line,
    _motion_tag,
    1.0,
)
CONTROL = Look(
    {f"{file}, {name}": (colour, marker, 6.0) for file, colour in _LINEAR.items() for name, marker in _MODES.values()}
    | {
        DAQP: (GREEN, "h", 7),
        "nonlinear": (RED, "D", 6),
        DO_MPC: (PURPLE, "P", 8),
        CROCODDYL: (PURPLE, "X", 8),
        "lqr": (GREY, "^", 6),
        "pd": (GREY, "v", 6),
        "open loop": (GREY, "x", 6),
    },
    _of_control,
    _of_control,
    _horizon,
    1e3,
    bars=True,
)
