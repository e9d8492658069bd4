"""What an identification came to: table, record and picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...study.identification.result import Estimate, Fit, Identification
from ..style import BLUE, GREEN, GREY, ORANGE, RED, plt, save_figure
from ..tables import table

_LINES = 6  # of correlations


def identification_record(found: Identification, files: dict[str, str]) -> dict[str, Any]:
    """Everything for JSON."""
    return {
        "scene": found.scene.name,
        "estimates": {
            one.name: {
                "value": one.value,
                "sd": one.sd,
                "interval_95": [one.low, one.high],
                "prior": one.prior,
                "prior_sd": one.prior_sd,
                "unit": one.unit,
                "told": one.told,
            }
            for one in found.estimates
        },
        "delay": found.delay,
        "forces_N": [list(force) for force in found.forces],
        "chi2_per_dof": found.chi2_per_dof,
        "unidentified": list(found.unidentified),
        "correlations": [{"of": [a, b], "value": value} for a, b, value in found.correlations],
        "whiteness": {"p_value": found.whiteness.p_value, "widening": found.whiteness.widening},
        "logs": [_fit_record(fit) for fit in found.fits],
        "validation": [_fit_record(fit) for fit in found.validation],
        "warnings": list(found.warnings),
        "method": found.method,
        "loss": found.loss,
        "iterations": found.iterations,
        "refused_steps": found.refused,
        "seconds": found.seconds,
        "files": files,
    }


def _fit_record(fit: Fit) -> dict[str, Any]:
    before = fit.rms(before=True)
    return {
        "log": fit.log.name,
        "duration_s": float(fit.log.t[-1] - fit.log.t[0]),
        "rows": len(fit.log.t),
        "driven_by": fit.log.driven_by,
        "rms_before_mm": None if before is None else 1e3 * before,
        "rms_after_mm": 1e3 * (fit.rms() or 0.0),
        "tip_noise_mm": 1e3 * fit.noise.tip,
        "angle_noise_rad": fit.noise.angle,
        "outliers": fit.outliers,
    }


def identification_table(found: Identification) -> str:
    """Figures for the terminal; what the data cannot tell comes right after the numbers."""
    rows = [
        (
            one.name,
            f"{one.prior:.5g}",
            f"{one.value:.5g}",
            f"{one.sd:.2g}",
            f"{one.prior_sd / one.sd:.3g}" if one.sd else "-",
            one.unit,
            "data" if one.told == "data" else "prior (as believed)",
        )
        for one in found.estimates
    ]
    lines = [
        f"scene       {found.scene.name}, robot {found.scene.robot.name}",
        f"method      {found.method}, {found.loss}; {found.iterations} steps, {found.refused} refused, "
        f"{found.seconds:.1f} s",
        "",
        table(("number", "believed", "estimate", "+- sd", "times surer", "unit", "told by"), rows),
        "",
    ]
    lines += [f"not told    {sentence}" for sentence in found.unidentified]
    scale = {name for name in _names(found) if any("share one scale" in s for s in found.unidentified)}
    told = [c for c in found.correlations if not {c[0], c[1]} <= scale]
    lines += [f"together    {a} and {b}: correlation {value:+.3f}" for a, b, value in told[:_LINES]]
    lines += [""] if found.unidentified or told else []
    for kind, fits in (("log", found.fits), ("not used", found.validation)):
        for fit in fits:
            before = fit.rms(before=True)
            off = "rods do not follow" if before is None else f"{1e3 * before:.4g} mm"
            lines.append(
                f"{kind:11} {fit.log.name}: tip predicted to {off} RMS as believed, "
                f"{1e3 * (fit.rms() or 0.0):.4g} mm now"
            )
    noise = found.fits[0].noise
    lines += [
        f"noise       tip {1e3 * noise.tip:.3g} mm, angles {noise.angle:.3g} rad (estimated)",
        f"chi^2       {found.chi2_per_dof:.3g} per degree of freedom; whiteness of the tip's residuals: "
        f"p = {found.whiteness.p_value:.2g}",
        f"delay       {found.delay:.4g} control periods",
        *(f"force       ({x:.4g}, {y:.4g}) N in log {i}" for i, (x, y) in enumerate(found.forces)),
        *(f"warning     {line}" for line in found.warnings),
    ]
    return "\n".join(lines)


def _names(found: Identification) -> list[str]:
    masses = ("bending_stiffness", "line_density", "tip_mass", "drag", "force_x", "force_y")
    return [one.name for one in found.estimates if one.name.split(".")[-1] in masses]


def identification_comments(found: Identification, logs: Sequence[str], commit: str) -> list[str]:
    """Where the numbers of a robot file come from."""
    untold = [one.name for one in found.estimates if one.told == "prior"]
    after = ", ".join(f"{1e3 * (fit.rms() or 0.0):.3g} mm" for fit in found.fits)
    return [
        f"{found.scene.robot.name} as identified by pcr-mpc identify from {', '.join(logs)}.",
        f"Scene {found.scene.name}; {found.method}, loss {found.loss}; code at {commit}.",
        f"Prediction of the tip: {after} RMS; chi^2 {found.chi2_per_dof:.3g} per degree of freedom.",
        f"Delay of the commands {found.delay:.4g} control periods; force on the tip "
        + ", ".join(f"({x:.4g}, {y:.4g}) N" for x, y in found.forces)
        + ": these belong into a scene.",
        *([f"As believed, not told by the data: {', '.join(untold)}."] if untold else []),
        *found.unidentified,
    ]


def plot_identification(found: Identification, path: Path) -> None:
    """Measured against predicted before and after, residuals with their autocorrelation, parameters with intervals."""
    figure, panels = plt.subplots(2, 3, figsize=(14.5, 7.6), layout="constrained")
    fit = found.fits[0]
    _draw_tip(panels[0, 0], fit)
    _draw_error(panels[0, 1], fit)
    _draw_parameters(panels[0, 2], found.estimates)
    _draw_residuals(panels[1, 0], fit)
    _draw_autocorrelation(panels[1, 1], found)
    _draw_gain(panels[1, 2], found.estimates)
    figure.suptitle(
        f"{found.scene.robot.name} from {Path(fit.log.name).name}: chi^2 {found.chi2_per_dof:.3g} per degree of freedom"
    )
    save_figure(figure, path)


def _draw_tip(axes: Any, fit: Fit) -> None:
    if fit.before is not None:
        axes.plot(*(1e3 * fit.before[:, :2].T), color=ORANGE, lw=1.2, label="predicted as believed")
    axes.plot(*(1e3 * fit.after[:, :2].T), color=BLUE, label="predicted now")
    axes.plot(*(1e3 * fit.log.p.T), ".", color="black", ms=2, label="measured")
    axes.set(xlabel="x [mm]", ylabel="y [mm]", title="Tip")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize=8, loc="upper right")


def _draw_error(axes: Any, fit: Fit) -> None:
    t = fit.log.t
    if fit.before is not None:
        off = 1e3 * np.linalg.norm(fit.before[:, :2] - fit.log.p, axis=1)
        axes.plot(t, np.maximum(off, 1e-9), color=ORANGE, lw=1.0, label="as believed")
    off = 1e3 * np.linalg.norm(fit.tip, axis=1)
    axes.plot(t, np.maximum(off, 1e-9), color=BLUE, lw=0.8, label="now")
    axes.set(yscale="log", xlabel="t [s]", ylabel="predicted less measured [mm]", title="Prediction error of the tip")
    axes.legend(fontsize=8)


def _draw_parameters(axes: Any, estimates: Sequence[Estimate]) -> None:
    """Estimates and 95 % intervals, in standard deviations of what was believed."""
    places = np.arange(len(estimates))[::-1]
    axes.axvspan(-1.96, 1.96, color=GREY, alpha=0.15, lw=0, label="believed, 95 %")
    for place, one in zip(places, estimates, strict=True):
        middle = (one.value - one.prior) / one.prior_sd
        reach = 1.96 * one.sd / one.prior_sd
        colour = BLUE if one.told == "data" else ORANGE
        axes.plot([middle - reach, middle + reach], [place, place], color=colour, lw=2.5)
        axes.plot(middle, place, "o" if one.told == "data" else "s", color=colour, ms=5)
    axes.plot([], [], "o-", color=BLUE, label="told by the data")
    axes.plot([], [], "s-", color=ORANGE, label="told by what was believed")
    axes.set_yticks(places, [one.name for one in estimates], fontsize=8)
    axes.set(xlabel="off what was believed [its standard deviations]", title="Numbers with 95 % intervals",
             ylim=(-0.7, len(estimates) + 2.6))  # fmt: skip
    axes.legend(fontsize=8, loc="upper right")


def _draw_residuals(axes: Any, fit: Fit) -> None:
    for channel, colour, label in zip(fit.tip.T, (BLUE, ORANGE), "xy", strict=True):
        axes.plot(fit.log.t, 1e3 * channel, ".", color=colour, ms=2.5, label=label)
    for side in (-1.96, 1.96):
        axes.axhline(1e3 * side * fit.noise.tip, color=GREY, lw=0.8, ls="--")
    known = np.abs(fit.tip[~np.isnan(fit.tip)])
    axes.set(xlabel="t [s]", ylabel="residual of the tip [mm]", title="Residuals, 95 % of the noise dashed")
    if len(known) and fit.outliers:
        axes.set_ylim(*(np.array([-8.0, 8.0]) * 1e3 * fit.noise.tip))
    axes.legend(fontsize=8, loc="upper right")


def _draw_autocorrelation(axes: Any, found: Identification) -> None:
    lags = np.arange(1, len(found.whiteness.autocorrelation) + 1)
    axes.axhspan(-found.whiteness.band, found.whiteness.band, color=GREY, alpha=0.25, lw=0, label="white noise, 95 %")
    axes.vlines(lags, 0.0, found.whiteness.autocorrelation, color=BLUE, lw=2.5)
    most = max(0.2, 1.15 * float(np.abs(found.whiteness.autocorrelation).max()))
    verdict = "white" if found.whiteness.white else "not white"
    axes.set(xlabel="lag [rows of the log]", ylabel="autocorrelation of residuals [-]", ylim=(-most, most),
             title=f"Residuals are {verdict} (Ljung-Box p = {found.whiteness.p_value:.2g})")  # fmt: skip
    axes.legend(fontsize=8, loc="upper right")


def _draw_gain(axes: Any, estimates: Sequence[Estimate]) -> None:
    places = np.arange(len(estimates))[::-1]
    gains = [one.prior_sd / one.sd if one.sd else math.nan for one in estimates]
    colours = [GREEN if one.told == "data" else ORANGE for one in estimates]
    axes.barh(places, gains, color=colours, height=0.6)
    axes.axvline(2.0, color=RED, lw=0.9, ls="--")
    axes.set_yticks(places, [one.name for one in estimates], fontsize=8)
    axes.set(
        xscale="log", xlabel="standard deviation before / after [-]", title="What the log has told (twice: dashed)"
    )
