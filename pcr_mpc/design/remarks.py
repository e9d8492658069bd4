"""What is to be said of a robot's and a scene's numbers, in sentences."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..loop.scene.scene import Scene
from ..plant.motion.step_limit import longest_step
from ..plant.robot import Robot
from ..plant.statics.equilibrium import Equilibrium
from .wish import LEAST_MASS, Wish, rounded

NEAR = 0.85  # of a limit, from which it is near
_FEW_PERIODS = 15.0  # of control in a swing of the tip
_LONG_STEP = 0.5  # of the longest stable one
_SWINGS_BELOW = 3.0  # times, by which what moves is to be slower than the rods' own swings
_COUNTS = 0.03  # share of the rods in the moving mass from which their inertia is to be modelled
_HANGS = 0.02  # of the length, by which a tip may sag unsupported before one is told
_GRAVITY = 9.81


@dataclass(frozen=True)
class Remark:
    """One sentence.

    Attributes
    ----------
    level : {"error", "warning", "note"}
        An error keeps the scene from running as asked.
    about : str
    text : str
    """

    level: str
    about: str
    text: str


def _error(about: str, text: str) -> Remark:
    return Remark("error", about, text)


def _warning(about: str, text: str) -> Remark:
    return Remark("warning", about, text)


def _note(about: str, text: str) -> Remark:
    return Remark("note", about, text)


def about_start(eq: Equilibrium, torque_limit: float) -> list[Remark]:
    """Torque and strain at rest."""
    remarks = []
    i = int(np.abs(eq.motor_torque).argmax())
    torque = abs(float(eq.motor_torque[i]))
    if torque > torque_limit:
        remarks.append(
            _error(
                "torque",
                f"to rest at p = {eq.p} m takes {torque:.4g} N m of motor {i}, which has {torque_limit:.4g} N m",
            )
        )
    elif torque > NEAR * torque_limit:
        share = 100 * torque / torque_limit
        remarks.append(_warning("torque", f"to rest at p = {eq.p} m takes {share:.0f} % of the torque of motor {i}"))
    for i in eq.overstrained:
        strain, limit = 100 * eq.max_strain[i], 100 * eq.robot.strain_limits[i]
        remarks.append(
            _error(
                "strain",
                f"rod {i} is strained to {strain:.3g} % at p = {eq.p} m, where its material bears {limit:.3g} %: take "
                "a thinner or longer rod, another material, or a pose in which it is less bent",
            )
        )
    return remarks


def about_steps(scene: Scene, mass: np.ndarray, figures: dict[str, Any]) -> tuple[dict[str, Any], list[Remark]]:
    """Control period and plant step against how fast the tip swings on its rods."""
    remarks = []
    start, reference = figures["start"], figures["reference"] or {}
    moving = mass if scene.plant.inertia != "none" else scene.robot.tip_mass * np.eye(2)
    # The stiffest pose of the reference, in which the tip swings fastest.
    stiffest = reference.get("stiffness_N_m", start["stiffness_N_m"])[-1] * np.eye(2)
    dt, kind = scene.plant.dt, scene.plant.integrator
    longest, _ = longest_step(kind, stiffest, moving, scene.robot.drag)
    swing = 2 * math.pi / longest_step("rk4", stiffest, moving, 0.0)[1]
    steps = {
        "fastest_swing_s": swing,
        "control_period_s": scene.period,
        "periods_per_swing": swing / scene.period,
        "plant_step_s": dt,
        "integrator": kind,
        "longest_stable_step_s": longest if math.isfinite(longest) else None,
    }
    if dt > longest:
        remarks.append(
            _error(
                "plant step",
                f"the plant's step of {dt:g} s is longer than {longest:.3g} s, up to which {kind} is stable where the "
                f"tip swings once in {swing:.3g} s; take at most half of that",
            )
        )
    elif dt > _LONG_STEP * longest:
        remarks.append(
            _warning(
                "plant step",
                f"the plant's step of {dt:g} s is {100 * dt / longest:.0f} % of {longest:.3g} s, up to which {kind} is "
                "stable; a shorter one is more exact",
            )
        )
    if scene.tuning is not None and swing < _FEW_PERIODS * scene.period:
        remarks.append(
            _warning(
                "control period",
                f"the tip swings once in {swing:.3g} s, which is {swing / scene.period:.2g} control periods of "
                f"{scene.period:g} s; {_FEW_PERIODS:g} or more are usual: take "
                f"{rounded(swing / _FEW_PERIODS, down=True):g} s, or a heavier tip",
            )
        )
    return steps, remarks


def about_rods(robot: Robot, scene: Scene | None, figures: dict[str, Any], upright: float | None) -> list[Remark]:
    """The rods' own mass, what the toolkit's model of them leaves out, and what is not stated.

    ``upright`` is how many times stiffer the rods are out of the plane; None where nobody said.
    """
    remarks = []
    start, reference = figures["start"], figures.get("reference") or {}
    if scene is not None and start["share_of_rods"] > _COUNTS:
        model = scene.tuning.model.inertia if scene.tuning else "condensed"
        without = [
            f"{where} (inertia = 'none')"
            for where, inertia in (("the plant", scene.plant.inertia), ("the controller's model", model))
            if inertia == "none"
        ]
        if without:
            remarks.append(
                _warning(
                    "rods' mass",
                    f"the rods are {100 * start['share_of_rods']:.2g} % of the mass that moves, which is left out of "
                    f"{' and of '.join(without)}; inertia = 'condensed' has it",
                )
            )
    own = min((rod["own_frequency_Hz"] for rod in figures["rods"] if rod["own_frequency_Hz"]), default=math.inf)
    swing, asked = max(start["natural_frequencies_Hz"]), reference.get("frequency_Hz") or 0.0
    for what, hertz in (("the tip swings on its rods", swing), ("the reference moves", asked)):
        if own < _SWINGS_BELOW * hertz and (scene is None or scene.plant.inertia != "full"):
            remarks.append(
                _warning(
                    "rods' swings",
                    f"{what} at up to {hertz:.3g} Hz, and a rod alone swings at {own:.3g} Hz: rods are taken to follow "
                    f"at once, which wants a factor of {_SWINGS_BELOW:g} between them. A heavier tip, lighter rods or "
                    "a slower reference give it; inertia = 'full' in the plant shows what it costs",
                )
            )
    if not np.isfinite(robot.strain_limits).any():
        remarks.append(
            _note("strain", "no strain limit is known: state material and diameter of the rods, and it is watched")
        )
    if not any(robot.gravity):
        sag = robot.tip_mass * _GRAVITY / (3 * float((robot.stiffnesses / robot.lengths**3).sum())) / (upright or 1.0)
        shortest = float(robot.lengths.min())
        if sag > _HANGS * shortest:
            far = f"about {1e3 * sag:.0f} mm" if sag < shortest else "their own length or more"
            rods, more = "its rods let", ""
            if upright is None:
                rods = "round rods let"
                more = ". Upright strips let it sag by that over the square of width over thickness"
            remarks.append(
                _note(
                    "support",
                    f"the robot lies flat, and {rods} the tip sag out of the plane by {far}: let it slide on a plate, "
                    f"or hang it on a long string{more}",
                )
            )
    return remarks


def about_wish(wish: Wish, robot: Robot) -> list[Remark]:
    """What was wished and is taken, though it would not have been chosen."""
    ratio = robot.tip_mass / sum(rod.line_density * rod.length for rod in robot.rods)
    if wish.tip_mass is None or ratio >= LEAST_MASS:
        return []
    return [
        _note(
            "tip mass",
            f"the tip weighs {ratio:.2g} times what its rods weigh, as was wished; {LEAST_MASS:g} times or more is "
            "chosen where nothing is, so that the rods follow it",
        )
    ]


def unidentifiable(robot: Robot) -> list[Remark]:
    """What motion does not tell of a robot, however long one looks."""
    remarks = [
        _note(
            "identification",
            "motion alone does not tell the scale of EI, masses, drag and force: with all of them twice as large the "
            "robot moves the same. One of them must be known, or a motor torque measured",
        )
    ]
    if spare := robot.n_rods - 2:
        motors = "is 1 motor" if spare == 1 else f"are {spare} motors"
        remarks.append(
            _note(
                "identification",
                f"there {motors} more than the tip has coordinates: how hard the rods pull against each other is not "
                "told by where the tip is",
            )
        )
    return remarks
