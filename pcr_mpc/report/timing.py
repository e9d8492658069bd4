"""The budgets of real time as tables and as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .style import BLUE, GREEN, GREY, ORANGE, RED, SKY, plt, save_figure
from .tables import table

_FIGURES = ("p50", "p95", "p99", "p99.9", "max")
_PART_COLOURS = {"look ahead": BLUE, "QP update": SKY, "QP handed over": GREEN, "inside OSQP": ORANGE,
                 "inside DAQP": ORANGE, "rest": GREY}  # fmt: skip
_BUDGETS_HZ = {"plant step": (1000,), "control step": (100, 200, 500)}


def timing_tables(result: dict[str, Any]) -> str:
    """Figures of `time_scene` for the terminal."""
    components = result["components"]
    rows = [(f"{c['name']} ({c['method']})", *(_us(c[key]) for key in _FIGURES), str(c["n"])) for c in components]
    parts = [table(("wall time [us]", *_FIGURES, "calls"), rows)]
    if "c" in result:
        parts.append(_table_of_c(result))
    steps = [c for c in components if c.get("misses")]
    rows = []
    for c in steps:
        first, pauses = c["first"], c["collections"]
        rows.append(
            (
                f"{c['name']} ({c['method']})",
                _us(c["cpu"]["p50"]),
                _us(c["cpu"]["p99.9"]),
                _us(first[0]),
                _us(float(np.median(first[1:]))),
                f"{_us(c['collector_on']['p99'])} / {_us(c['collector_off']['p99'])}",
                f"{pauses['n']} ({_us(pauses['max'])})",
                str(c["interrupted"]),
            )
        )
    header = (
        "steps [us]",
        "CPU p50",
        "p99.9",
        "1st",
        "2nd to 20th",
        "p99, gc on / off",
        "gc runs (max)",
        "interrupted",
    )
    parts.append(table(header, rows))
    rows = [
        (f"{c['name']} ({c['method']})", hz, str(missed["wall"]), str(missed["cpu"]), str(c["n"]))
        for c in steps
        for hz, missed in c["misses"].items()
    ]
    parts.append(table(("deadlines missed", "at", "by wall time", "by CPU time", "of"), rows))
    if "control_parts" in result:
        whole = sum(result["control_parts"].values())
        rows = [(name, _us(us), f"{100 * us / whole:.0f} %") for name, us in result["control_parts"].items()]
        parts.append(table(("a control step, nobody interrupting", "mean [us]", "share"), rows))
        rows = [(str(c["iterations"]), *(_us(c[key]) for key in _FIGURES), str(c["n"])) for c in result["iterations"]]
        parts.append(table(("QP iterations", *_FIGURES, "steps"), rows))
    if result.get("solvers"):
        rows = [
            (
                row["solver"],
                *(_us(row["step"][key]) for key in ("p50", "p99", "max")),
                *(_us(row["inside"][key]) for key in ("p50", "p99", "max")),
                *(f"{row['iterations'][key]:.0f}" for key in ("p50", "p99", "max")),
                str(row["n"]),
            )
            for row in result["solvers"]
        ]
        columns = ("QP solvers [us]", "control step p50", "p99", "max", "inside p50", "p99", "max",
                  "iterations p50", "p99", "max", "steps")  # fmt: skip
        parts.append(table(columns, rows))
    names = dict.fromkeys(row["name"] for row in result["overhead"])
    codes = list(dict.fromkeys(row["code"] for row in result["overhead"]))
    found = {(row["name"], row["code"]): row["us"] for row in result["overhead"]}
    rows = [(name, *(f"{found[name, code]:.2f}" for code in codes)) for name in names]
    parts.append(table(("a step of the plant, CPU time [us]", *codes), rows))
    errors = [f"{c['method']} {c['force_error']:.1e}" for c in components if "force_error" in c]
    parts.append(f"relative error of F along the run: {', '.join(errors)}")
    parts.append(", ".join(f"{name} {value}" for name, value in {**result["machine"], **result["versions"]}.items()))
    return "\n\n".join(parts)


def _table_of_c(result: dict[str, Any]) -> str:
    """Steps in C beside Python's, and the longest that a control step can be."""
    own = {"plant step of the scene", "plant step", "control step"}
    rows = [
        (f"{c['name']}, {c['method'] if c['method'].startswith('C') else 'Python'}",
         *(_us(c["cpu"][key]) for key in _FIGURES), str(c["n"]))
        for c in result["components"]
        if c["name"] in own and (c["method"].startswith("C") or c["name"] != "plant step")
    ]  # fmt: skip
    parts = [table(("CPU time [us]", *_FIGURES, "steps"), rows)]
    for row in result["c"]:
        if "missing" in row:
            parts.append(f"no times of C with {row['solver']}: {row['missing']}")
            continue
        worst = row["worst"]
        text = f"longest control step in C with {row['solver']}, by its count: {worst['iterations']} iterations"
        if worst["us"] is None:
            text += f" of {worst['flops']:.2g} operations; what one takes was not measured"
        else:
            text += (f" x {worst['iteration_us']:.3g} us (all soft rows, {worst['flops']:.2g} operations) + "
                     f"{worst['rest_us']:.3g} us = {worst['us']:.3g} us")  # fmt: skip
        parts.append(text)
    return "\n".join(parts)


def _us(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def plot_timing(result: dict[str, Any], path: Path) -> None:
    """Draw histogram, tail, parts of a control step, iterations and overhead into ``path``."""
    controlled = "control_parts" in result
    figure = plt.figure(figsize=(11, 10 if controlled else 8.5))
    grid = figure.add_gridspec(3 if controlled else 2, 2, height_ratios=[4, 1, 3.4] if controlled else [4, 3.4])
    _histogram(figure.add_subplot(grid[0, 0]), result["histogram"])
    _tail(figure.add_subplot(grid[0, 1]), result["histogram"])
    if controlled:
        _parts(figure.add_subplot(grid[1, :]), result["control_parts"])
        _iterations(figure.add_subplot(grid[2, 0]), result["iterations"])
    _overhead(figure.add_subplot(grid[-1, 1]), result["overhead"])
    machine = result["machine"]
    load = f", load {machine['load']:.1f} to {machine['load_after']:.1f}" if machine["load"] is not None else ""
    figure.suptitle(f"{result['scene']}: step times on {machine['usable_cores']} cores of {machine['processor']}{load}")
    figure.tight_layout()
    save_figure(figure, path)


def _series(histogram: dict[str, Any]) -> list[tuple[str, str, str]]:
    colours = {"plant step": BLUE, "control step": ORANGE, "plant step in C": SKY, "control step in C": GREEN}
    return [(name, collector, colours[name]) for name in colours if name in histogram
            for collector, counts in histogram[name].items() if any(counts)]  # fmt: skip


def _from(histogram: dict[str, Any]) -> float:
    """Where the axis of times begins: at 3 us, or at the first bin that holds a step."""
    edges = np.array(histogram["edges_us"])
    used = [edges[:-1][np.array(histogram[name][collector]) > 0][0] for name, collector, _ in _series(histogram)]
    return float(min([3.0, *used]))


def _histogram(axis: Any, histogram: dict[str, Any]) -> None:
    edges = np.array(histogram["edges_us"])
    for name, collector, colour in _series(histogram):
        counts, on = np.array(histogram[name][collector]), collector == "collector on"
        style = {"fill": on, "alpha": 0.35 if on else 1.0, "lw": 1.4}
        axis.stairs(counts, edges, color=colour, label=f"{name}, {collector}", **style)
    axis.set(xscale="log", yscale="log", xlabel="wall time of a step [us]", ylabel="steps per bin")
    axis.set_ylim(0.8, None)
    axis.set_xlim(_from(histogram), None)
    axis.set_title("Jitter")
    axis.legend(fontsize=8)


def _tail(axis: Any, histogram: dict[str, Any]) -> None:
    edges = np.array(histogram["edges_us"])
    last = edges[1]
    for name, collector, colour in _series(histogram):
        counts = np.array(histogram[name][collector], dtype=float)
        share = 1 - np.cumsum(counts) / counts.sum()
        beyond = share > 0.5 / counts.sum()
        last = max(last, edges[1:][beyond].max(initial=0.0))
        style = ":" if collector.endswith("off") else "-"
        axis.plot(edges[1:][beyond], share[beyond], style, color=colour, label=f"{name}, {collector}")
    for name, colour in (("plant step", BLUE), ("control step", RED)):
        for hz in _BUDGETS_HZ[name] if name in histogram else ():
            axis.axvline(1e6 / hz, color=colour, lw=1.0, ls="--")
            axis.text(1e6 / hz, 1.1, f"{hz} Hz", color=colour, rotation=90, fontsize=8, ha="right", va="top")
    axis.set(xscale="log", yscale="log", xlabel="wall time t [us]", ylabel="share of steps longer than t")
    axis.set_xlim(_from(histogram), max(2e4, 1.5 * last))
    axis.set_title("Tail, and budgets (dashed)")
    axis.legend(fontsize=8, loc="lower left")


def _parts(axis: Any, parts: dict[str, float]) -> None:
    left, whole = 0.0, sum(parts.values())
    for name, us in parts.items():
        axis.barh([0.0], [us], left=left, color=_PART_COLOURS[name], label=f"{name}, {us:.0f} us")
        left += us
    axis.set(xlabel="mean time [us]", ylim=(-0.4, 0.4), xlim=(0, whole))
    axis.set_title(f"Where a control step's {whole:.0f} us go")
    axis.set_yticks([])
    axis.grid(visible=False)
    axis.legend(fontsize=9, ncol=len(parts), loc="upper center", bbox_to_anchor=(0.5, -0.75), columnspacing=1.2)


def _iterations(axis: Any, rows: list[dict[str, Any]]) -> None:
    count = [row["iterations"] for row in rows]
    for key, colour, marker in (("p50", BLUE, "o"), ("p99", ORANGE, "s")):
        axis.plot(count, [row[key] for row in rows], marker, color=colour, label=key, ms=5)
    for row in rows:
        axis.annotate(f"{row['n']}", (row["iterations"], 0.0), fontsize=8, ha="center", xytext=(0, 3),
                      textcoords="offset points")  # fmt: skip
    axis.set(xlabel="QP iterations (number of steps beside the axis)", ylabel="control step [us]")
    axis.set_ylim(0, 1.15 * max(row["p99"] for row in rows))
    axis.set_xlim(min(count) - 0.5, max(count) + 0.5)
    axis.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)  # there are no parts of an iteration
    axis.set_title("Iterations")
    axis.legend(fontsize=8)


def _overhead(axis: Any, rows: list[dict[str, Any]]) -> None:
    names = list(dict.fromkeys(row["name"] for row in rows))
    for row in rows:
        compiled = row["code"] == "compiled"
        place = names.index(row["name"]) + (0.2 if compiled else -0.2)
        axis.barh(place, row["us"], 0.38, color=GREEN if compiled else BLUE)
        axis.text(1.05 * row["us"], place, f"{row['us']:.1f}", va="center", fontsize=9)
    for code, colour in (("interpreted", BLUE), ("compiled", GREEN)):
        if any(row["code"] == code for row in rows):
            axis.barh(0, 0, color=colour, label=code)
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    axis.set(xscale="log", xlabel="CPU time of a velocity Verlet step [us]")
    axis.set_xlim(1.0, 3 * max(row["us"] for row in rows))
    axis.set_title("Arithmetic, and what calling it costs")
    axis.legend(fontsize=8, loc="lower right")
