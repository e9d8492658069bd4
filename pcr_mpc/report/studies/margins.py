"""Table and picture of a loop's margins."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...study.margins.predicted import Margins
from ..style import BLUE, GREEN, GREY, ORANGE, RED, SKY, plt, save_figure
from ..tables import table

_ROWS = {
    "delay_margin_ms": "further delay [ms]",
    "motor_lag_ms": "motor lag [ms]",
    "stiffness_factor": "factor on EI",
    "mass_factor": "factor on tip mass",
    "spectral_radius": "spectral radius of a period",
    "sensitivity_peak": "peak of the sensitivity",
}


def margins_table(summary: dict[str, Any]) -> str:
    """Predicted and measured margins, side by side, with the pose where each is least."""
    margins = summary["margins"]
    lines = [(text, margins[name]) for name, text in _ROWS.items() if name in margins]
    for name, text in (("gain_margin", "gain"), ("phase_margin_deg", "phase [deg]")):
        lines += [(f"{text} at motor {i}", each) for i, each in enumerate(margins.get(name, ()))]
    rows = [
        (
            text,
            _number(each["predicted"]),
            _number(each["measured"]) if "measured" in each else "",
            f"{each['t_s']:.2f}",
            "({:.1f}, {:.1f})".format(*(1e3 * value for value in each["p_m"])),
        )
        for text, each in lines
    ]
    along = margins["delay_margin_ms"]
    head = [
        f"scene       {summary['scene']}, period {summary['period_ms']:g} ms",
        f"controller  {summary['controller']}",
        f"loop has    {summary['told_delay_ms']:g} ms of delay that is told, {summary['untold_delay_ms']:g} ms untold, "
        f"motors that lag by {summary['lag_ms']:g} ms; margins count from there",
    ]
    if summary["tip_late_ms"] or summary["tip_every"] > 1:
        head.append(f"camera      {summary['tip_late_ms']:g} ms late, a tip in every {summary['tip_every']}. period")
    tail = [f"Predicted at {summary['poses']} poses of the reference, where it is least; measured in the nonlinear "
            "simulation, held there."]  # fmt: skip
    text = f"Following the reference it bears {_number(along['predicted_along_path'])} ms of further delay, predicted"
    if "measured_along_path" in along:
        text += f"; {_number(along['measured_along_path'])} ms, measured"
    tail.append(f"{text}.")
    if summary["tip_every"] > 1:
        tail.append("Gain, phase and sensitivity have no plain meaning where the tip is not measured in every period.")
    if not (margins["spectral_radius"]["predicted"] or 0.0) < 1.0:
        tail.append("NOT STABLE AS IT IS: take a slower tuning, or tell the controller of its delays.")
    header = ("margin", "predicted", "measured", "at [s]", "tip [mm]")
    return "\n".join([*head, "", table(header, rows), "", *tail])


def _number(value: float | None) -> str:
    return "none found" if value is None else f"{value:.4g}"


def plot_margins(predicted: Margins, summary: dict[str, Any], path: Path) -> None:
    """Draw eigenvalues, sensitivity over frequency, and the margins along the path."""
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    margins = summary["margins"]
    worst = int(np.nan_to_num(predicted.delay).argmin())
    _eigenvalues(axes[0, 0], predicted, worst)
    _sensitivity(axes[0, 1], predicted, worst)

    times = axes[1, 0]
    for name, values, colour, text in (
        ("delay_margin_ms", predicted.delay, BLUE, "further delay"),
        ("motor_lag_ms", predicted.lag, ORANGE, "motor lag"),
    ):
        _along(times, predicted.t, 1e3 * values, colour, text, margins[name])
    along = margins["delay_margin_ms"].get("measured_along_path")
    if along is not None:
        times.axhline(along, color=BLUE, lw=1.0, ls=":", label=f"further delay, measured along the path {along:.3g}")
    times.set(ylim=(0.0, None), xlabel="time [s]", ylabel="bears at most [ms]", title="Delay and lag along the path")
    factors = axes[1, 1]
    for name, values, colour, text in (
        ("stiffness_factor", predicted.stiffness, GREEN, "EI"),
        ("mass_factor", predicted.mass, RED, "tip mass"),
    ):
        _along(factors, predicted.t, values, colour, text, margins[name])
    factors.set(ylim=(1.0, None), xlabel="time [s]", ylabel="true over believed [-]",
                title="Largest factor along the path")  # fmt: skip
    for each in (times, factors):
        low, high = each.get_ylim()
        each.set_ylim(low, high + 0.45 * (high - low))  # room for the legend
        each.legend(loc="upper left", fontsize=9)
    figure.suptitle(f"{predicted.scene}, controller {predicted.controller}")
    save_figure(figure, path)


def _sensitivity(axes: Any, predicted: Margins, worst: int) -> None:
    if predicted.response is None or predicted.sensitivity is None:
        axes.set_axis_off()
        axes.text(0.5, 0.5, f"no sensitivity:\nthe tip is measured in every {predicted.cycle}. period", ha="center",
                  va="center", color=GREY)  # fmt: skip
        return
    low, high = predicted.response.min(axis=0), predicted.response.max(axis=0)
    axes.fill_between(predicted.frequencies, low, high, color=SKY, alpha=0.5, label="all poses")
    axes.plot(predicted.frequencies, predicted.response[worst], color=BLUE,
              label=f"where the delay margin is least, t = {predicted.t[worst]:.2f} s")  # fmt: skip
    axes.axhline(1.0, color="black", lw=0.8, ls="--")
    axes.set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="sensitivity at the motors [-]",
             title=f"Sensitivity, peak {predicted.sensitivity.max():.3g}")  # fmt: skip
    axes.legend(loc="lower right")


def _eigenvalues(axes: Any, predicted: Margins, worst: int) -> None:
    circle = np.exp(2j * np.pi * np.linspace(0.0, 1.0, 361))
    axes.plot(circle.real, circle.imag, color="black", lw=0.8)
    everywhere = predicted.eigenvalues.ravel()
    axes.plot(everywhere.real, everywhere.imag, ".", color=GREY, ms=4, alpha=0.6, label="all poses")
    at = predicted.eigenvalues[worst]
    axes.plot(at.real, at.imag, "x", color=BLUE, ms=6, label="where the delay margin is least")
    cycle = "a period" if predicted.cycle == 1 else f"{predicted.cycle} periods"
    axes.set(xlabel="real part [-]", ylabel="imaginary part [-]",
             title=f"Eigenvalues of {cycle}, largest {np.abs(everywhere).max():.3f}")  # fmt: skip
    axes.set_aspect("equal")
    axes.set_xlim(-1.9, 1.9)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize=9)


def _along(axes: Any, t: np.ndarray, values: np.ndarray, colour: str, text: str, margin: dict[str, Any]) -> None:
    values = np.where(np.isfinite(values), values, np.nan)
    axes.plot(t, values, ".-", color=colour, label=f"{text}, predicted")
    if margin.get("measured") is not None:
        axes.plot(margin["t_s"], margin["measured"], "D", color=colour, mec="black", ms=8,
                  label=f"{text}, measured where it is least")  # fmt: skip
