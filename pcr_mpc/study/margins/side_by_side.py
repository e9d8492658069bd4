"""Predicted and measured margins of a scene, side by side."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from ...control.tuning import Tuning
from ...loop.hardware.camera import IDEAL as IDEAL_CAMERA
from ...loop.hardware.motors import IDEAL
from ...loop.scene.scene import Scene
from .measured import Measured, measure_delay_margin, measure_largest
from .poses import scaled_scene
from .predicted import Margins, predict_margins


def compare_margins(
    scene: Scene, tuning: Tuning | None = None, *, poses: int = 24, measure: bool = True, progress: bool = False
) -> tuple[Margins, dict[str, Any]]:
    """Predict the margins of a scene's loop, and measure those that a simulation can show.

    Parameters
    ----------
    scene : Scene
    tuning : Tuning, optional
        Instead of the scene's own.
    poses : int
    measure : bool
        False: only predict, in a few seconds.
    progress : bool

    Returns
    -------
    Margins
        As `predict_margins`.
    dict
        Ready for JSON: ``scene``, ``controller``, ``period_ms``, ``poses``, and under ``margins`` for each of
        ``delay_margin_ms``, ``stiffness_factor``, ``mass_factor``, ``motor_lag_ms`` what is ``predicted`` for the pose
        where it is least (``t_s``, ``p_m``) and ``measured`` for a tip that is held there; the delay margin also
        ``predicted_along_path`` and ``measured_along_path``, where a loop may be unstable for a moment.
        ``spectral_radius``, ``sensitivity_peak`` and, for each motor, ``gain_margin`` and ``phase_margin_deg`` are
        predicted only; the last three are left out where the tip is not measured in every period. None: no limit was
        found; a margin of 0, or a factor of 1: the loop is not stable as it is.

    Raises
    ------
    MarginsError
        As `predict_margins`.
    """
    predicted = predict_margins(scene, tuning, poses=poses)
    used = tuning or scene.tuning
    told = scene if used is None else scene.tuned(used)
    found = predicted.summary()
    rows: dict[str, Any] = {
        name: {"predicted": said["value"], "t_s": said["t_s"], "p_m": said["p_m"]} for name, said in found.items()
        if isinstance(said, dict)
    }  # fmt: skip
    for name in {"gain_margin", "phase_margin_deg"} & set(found):
        rows[name] = [{"predicted": said["value"], "t_s": said["t_s"], "p_m": said["p_m"]} for said in found[name]]
    along_path = 0.0 if math.isnan(predicted.path_delay) else 1e3 * predicted.path_delay
    rows["delay_margin_ms"]["predicted_along_path"] = along_path if math.isfinite(along_path) else None
    if measure:
        least = predicted.least(predicted.delay)
        held = measure_delay_margin(told, p=least.p, guess=least.value, progress=progress)
        along = measure_delay_margin(told, guess=least.value, progress=progress)
        rows["delay_margin_ms"] |= {"measured": _plain(held, 1e3), "measured_along_path": _plain(along, 1e3)}
        own = told.motors or IDEAL
        changes: dict[str, tuple[Callable[[Scene, float], Scene], float, float]] = {
            "stiffness_factor": (lambda s, v: scaled_scene(s, stiffness=v), 1.0, 1.0),
            "mass_factor": (lambda s, v: scaled_scene(s, mass=v), 1.0, 1.0),
            "motor_lag_ms": (lambda s, v: replace(s, motors=replace(own, time_constant=v)), own.time_constant, 1e3),
        }
        for name, (change, nominal, unit) in changes.items():
            said, (x, y) = rows[name]["predicted"], rows[name]["p_m"]
            guess = math.inf if said is None else said / unit
            got = measure_largest(told, change, p=(x, y), nominal=nominal, guess=guess,
                                  desc=f"held: {_WORDS[name]}", progress=progress)  # fmt: skip
            rows[name]["measured"] = _plain(got, unit)
    summary = {
        "scene": told.name,
        "controller": predicted.controller,
        "period_ms": 1e3 * predicted.period,
        "told_delay_ms": 1e3 * told.delay * told.period,
        "untold_delay_ms": 1e3 * told.untold_delay,
        "lag_ms": 1e3 * (told.motors or IDEAL).time_constant,
        "tip_late_ms": 1e3 * (told.camera or IDEAL_CAMERA).latency,
        "tip_every": predicted.cycle,
        "poses": len(predicted.t),
        "margins": rows,
    }
    return predicted, summary


_WORDS = {"stiffness_factor": "factor on EI", "mass_factor": "factor on mass", "motor_lag_ms": "motor lag"}


def _plain(measured: Measured, unit: float) -> float | None:
    return unit * measured.value if math.isfinite(measured.value) else None
