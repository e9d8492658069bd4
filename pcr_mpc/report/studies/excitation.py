"""What a motion worth recording would tell: table, record and picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...loop.references.trajectory import sampled
from ...study.excitation.design import Excitation, Expected
from ..style import BLUE, GREY, ORANGE, plt, save_figure
from ..tables import table


def excitation_record(found: Excitation, files: dict[str, str]) -> dict[str, Any]:
    """Everything for JSON."""
    return {
        "scene": found.scene.name,
        "duration_s": found.scene.duration,
        "criterion": "least worst standard deviation over what is believed (E-optimal in the numbers), tip weighed",
        "worst": found.best.worst,
        "worst_of_lemniscate": found.beside.worst,
        "ratio": found.best.worst / found.beside.worst,
        "expected_sd": {
            name: {"excited": sd, "lemniscate": found.beside.sd[name], "unit": found.units[name],
                   "excited_over_believed": found.best.ratio[name],
                   "lemniscate_over_believed": found.beside.ratio[name]}
            for name, sd in found.best.sd.items()
        },
        "limits_used": found.best.use,
        "noise": {"tip_m": found.noise.tip, "angle_rad": found.noise.angle},
        "trials": found.trials,
        "files": files,
    }  # fmt: skip


def excitation_table(found: Excitation) -> str:
    """Figures for the terminal."""
    best, beside = found.best, found.beside
    rows = [
        (name, f"{sd:.2g}", f"{beside.sd[name]:.2g}", f"{beside.sd[name] / sd:.1f}", found.units[name],
         f"{100 * best.ratio[name]:.2g} %", f"{100 * beside.ratio[name]:.2g} %")
        for name, sd in best.sd.items()
    ]  # fmt: skip
    used = ", ".join(f"{name} {100 * share:.0f} %" for name, share in best.use.items())
    header = ("expected sd", "excited", "lemniscate", "times less", "unit", "over believed", "lemniscate")
    return "\n".join(
        [
            f"scene       {found.scene.name}, robot {found.scene.robot.name}, {found.scene.duration:g} s",
            f"sought      least worst sd over what is believed (E-optimal in the numbers), of {found.trials} motions",
            f"sensors     tip {1e3 * found.noise.tip:.3g} mm, angles {found.noise.angle:.3g} rad; the tip is weighed",
            "",
            table(header, rows),
            "",
            f"worst       {100 * best.worst:.3g} % of what is believed; {100 * beside.worst:.3g} % after the "
            f"lemniscate: {beside.worst / best.worst:.1f} times less",
            f"uses        of what it may: {used}",
        ]
    )


def plot_excitation(found: Excitation, path: Path) -> None:
    """Paths of both motions, the excited one in time, and the expected standard deviations."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(14.5, 4.4), layout="constrained")
    t = found.scene.period * np.arange(found.scene.n_periods + 1)
    names: tuple[tuple[Expected, str, str], ...] = ((found.beside, ORANGE, "lemniscate"), (found.best, BLUE, "excited"))
    for one, colour, label in names:
        left.plot(*(1e3 * sampled(one.trajectory, t)[:, 0].T), color=colour, lw=1.3, label=label)
    left.set(xlabel="x [mm]", ylabel="y [mm]", title="Path of the tip")
    left.set_aspect("equal", adjustable="datalim")
    left.legend(fontsize=8)
    position = sampled(found.best.trajectory, t)[:, 0]
    for values, colour, label in zip((position - position[0]).T, (BLUE, ORANGE), "xy", strict=True):
        middle.plot(t, 1e3 * values, color=colour, label=label)
    middle.set(xlabel="t [s]", ylabel="tip from its start [mm]", title="Excited motion")
    middle.legend(fontsize=8)
    places = np.arange(len(found.best.sd))[::-1]
    for (one, colour, label), shift in zip(names, (0.18, -0.18), strict=True):
        right.barh(
            places + shift, [100 * value for value in one.ratio.values()], height=0.34, color=colour, label=label
        )
    right.axvline(100 * found.best.worst, color=GREY, lw=0.9, ls="--")
    right.set_yticks(places, list(found.best.sd), fontsize=8)
    right.set(xscale="log", xlabel="expected sd over what is believed [%]", title="What would be told")
    right.legend(fontsize=8)
    save_figure(figure, path)
