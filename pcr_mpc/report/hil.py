"""Table and picture of a loop that was closed over a wire."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ..wire.hil import HilRun
from .style import BLUE, GREY, ORANGE, PURPLE, RED, plt, save_figure
from .tables import table

_SAME = 1e-9  # mm, that another machine's rounding may differ by
_REMARKABLE = 0.25  # of a period
_OFTEN = 0.25  # of a period, that the mean may be above what most commands take

_ABOVE: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0)}  # legends hide no point


def hil_table(summary: dict[str, Any]) -> str:
    """Figures of a run."""
    names = ("p50", "p95", "p99", "p99.9", "max")
    rows = [
        (label, *(f"{summary[key][name]:.0f}" if summary[key] else "-" for name in names))
        for label, key in (("round trip", "round_trip_us"), ("plant step later than due", "plant_late_us"))
    ]
    server = ", ".join(f"{count} {name}" for name, count in summary["server"].items())
    stood = f"; its clock stood still for {summary['stood_still_s']:.3g} s" if summary["stood_still_s"] else ""
    lines = [
        f"scene       {summary['scene']}, {summary['duration_s']:g} s in real time{stood}",
        f"error       RMS {summary['rms_mm']:.5g} mm, at most {summary['max_mm']:.5g} mm",
        f"simulated   {_rms(summary['simulated_rms_mm'])}, every command {summary['simulated_delay_ms']:.3g} ms later "
        "than told",
        f"            {_rms(summary['replayed_rms_mm'])}, every command as late as it was" + _apart(summary),
        f"processes   with {summary['priority']} priority",
        f"commands    {summary['missed']} of {summary['periods']} missed their period of "
        f"{1e3 * summary['period_s']:g} ms, {summary['fallbacks']} by a lower rung",
        f"server      {server}",
        "",
        table(("[us]", *names), rows),
    ]
    return "\n".join([*lines, *_remark(summary)])


def _remark(summary: dict[str, Any]) -> list[str]:
    """What would help where commands come much later than the controller knows."""
    late, period = summary["simulated_delay_ms"], 1e3 * summary["period_s"]
    if late <= _REMARKABLE * period:
        return []
    told = summary["told_delay"] + max(1, math.ceil(late / period - _OFTEN))
    return [
        "",
        f"Commands come {late:.3g} ms later than the controller knows, {late / period:.2g} of its period. With",
        f"`[control] delay = {told}` in the scene it reckons with it, and each acts {told} "
        f"period{'s' if told > 1 else ''} after its measurement.",
    ]


def _rms(value: float | None) -> str:
    return "not had" if value is None else f"RMS {value:.5g} mm"


def _apart(summary: dict[str, Any]) -> str:
    apart = summary["replayed_apart_mm"]
    if apart is None:
        return ""
    if apart > _SAME:
        return f"; its tip is up to {apart:.2g} mm elsewhere: the wire adds more than latency"
    return "; the same motion" + (f", to {apart:.1g} mm" if apart else ", bit for bit")


def plot_hil(run: HilRun, path: Path) -> None:
    """Draw the error, the round trips with those that were missed, and how late the plant's steps were."""
    figure, (error, trips, late) = plt.subplots(3, 1, figsize=(9, 7.5), layout="constrained")
    summary = run.summary()
    error.plot(run.t, 1e3 * run.error, color=BLUE, lw=0.9)
    error.plot(run.t, 1e3 * run.replayed, color=PURPLE, lw=0.9, ls=":",
               label=f"simulated, commands as late as they were: {_rms(summary['replayed_rms_mm'])}")  # fmt: skip
    error.axhline(1e3 * run.simulated, color=ORANGE, ls="--", lw=1.0,
                  label=f"simulated, commands {summary['simulated_delay_ms']:.3g} ms late: "
                  f"{_rms(summary['simulated_rms_mm'])}")  # fmt: skip
    error.set(xlim=(0.0, run.t[-1]), ylim=(0.0, None), xlabel="time [s]", ylabel="error of the tip [mm]")
    figure.suptitle(f"{run.scene.name} over a wire: RMS {summary['rms_mm']:.3g} mm")
    error.legend(**_ABOVE)

    t = run.scene.period * np.arange(len(run.round_trip))
    missing = np.isnan(run.round_trip)
    trips.semilogy(t, 1e3 * run.round_trip, ".", color=BLUE, ms=3, label="measurement to command")
    trips.axhline(1e3 * run.scene.period, color=GREY, lw=1.0, label="control period")
    if missing.any():
        trips.plot(t[missing], np.full(missing.sum(), 1e3 * run.scene.period), "x", color=RED, ms=5,
                   label=f"{missing.sum()} missed")  # fmt: skip
    trips.set(xlim=(0.0, run.t[-1]), xlabel="time [s]", ylabel="round trip [ms]")
    trips.legend(**_ABOVE, ncols=3)

    bins = np.logspace(0.0, max(1.0, np.log10(1e6 * max(run.late.max(), 1e-6))), 60)
    late.hist(1e6 * np.maximum(run.late, 1e-6), bins=bins, color=BLUE)
    late.set(xscale="log", yscale="log", xlabel="plant step later than due [us]", ylabel="steps")
    save_figure(figure, path)
