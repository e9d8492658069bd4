"""The pose in which a robot stands, from what its sensors say: branch, working mode, and the load on its tip."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import AmbiguousPoseError, MeasurementError, PCRError, checked_number, checked_vector
from ...frozen import Frozen
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.held_tip import solve_statics
from ...plant.statics.stability import held_equilibria
from ..scene.sensors import EXACT_SENSORS, Sensors

_G = 9.81  # m/s^2; the load that is taken for possible is the tip's weight on Earth, and at least the rods' own forces
_DEVIATIONS = 4.0  # of the tip's sensor within which it may be wrong
# The next pose must take so many times the load of the one that is chosen, or both are possible.
_CLEAR = 2.0
_ROUNDING = 1e-9  # of sum EI/L^2
_MILLIMETRES = 10.0  # rod lengths out of reach, from which on other units may be meant
_SURELY = 0.3  # share of the possible load that an explanation may ask for
_BEYOND = 0.05  # rad, by which a motor may seem to be beyond its stop
_TAUT = 1e-3  # of a rod's length, by which a tip that is measured out of reach is drawn into it
_TURN = 2 * math.pi


@dataclass(frozen=True, eq=False)
class StartPose(Frozen):
    """Where a robot stands.

    Attributes
    ----------
    pose : Equilibrium
        Of the rods, near what was measured.
    force : ndarray, shape (2,)
        Load on the tip that holds the robot there, besides its weight [N].
    """

    pose: Equilibrium
    force: np.ndarray


def find_start(
    robot: Robot,
    p: Any,
    q: Any,
    *,
    sensors: Sensors = EXACT_SENSORS,
    mode: str | None = None,
    load: float | None = None,
) -> StartPose:
    """Find the pose of a robot at rest from the measured tip and motor angles.

    Every combination of the rods' stable shapes at (p, q) is a candidate, and the force F - m g that it takes to stay
    there is the load that it asks for. The one that asks for least is taken. If the sensors' tolerance explains that
    load, it is none: then the nearest equilibrium without load is taken, tip and angles moved within the tolerance.

    Parameters
    ----------
    robot : Robot
    p : array_like, shape (2,)
        Measured tip position [m].
    q : array_like, shape (n,)
        Measured motor angles [rad].
    sensors : Sensors
        Their tolerance: four standard deviations of the tip, half a step of the encoders.
    mode : str, optional
        Working mode, a letter L or R a rod (see `Equilibrium.mode`), where it is known.
    load : float, optional
        Greatest load that may act on the tip [N]. None: m times 9.81 m/s^2, or sum EI/L^2 if that is more.

    Raises
    ------
    MeasurementError
        No pose of the robot fits; the message has the numbers, and says whether other units, whole turns or swapped
        motors would.
    AmbiguousPoseError
        Several do, none of them clearly better; ``mode`` settles it.
    ValueError
        Names the argument that is not finite or of the wrong shape.
    """
    p, q = checked_vector("p", p, 2), robot.checked_angles("q", q)
    if mode is not None and (not isinstance(mode, str) or len(mode) != robot.n_rods or set(mode) - set("LR")):
        raise ValueError(f"mode is {mode!r}, expected {robot.n_rods} letters L or R")
    if load is None:
        load = max(_G * robot.tip_mass, robot.force_scale)
    elif load != math.inf:
        load = checked_number("load", load, minimum=0.0)
    if sensors.wrapped:
        q = _within(robot, q)
    found = _fitting(robot, p, q, sensors, mode, load)
    if not found:
        raise _misfit(robot, p, q, sensors, mode, load)
    best = found[0]
    rivals = [one for one in found[1:] if one.load <= _CLEAR * max(best.load, best.tolerance)]
    if rivals:
        listed = (best, *rivals)
        said = ", ".join(f"{one.pose.mode} with a load of {one.load:.3g} N" for one in listed)
        distinct = sorted({one.pose.mode for one in listed})
        advice = (
            f"give start(..., mode={distinct[0]!r}), or another of them"
            if len(distinct) > 1
            else "move the robot to another pose first: these have the same working mode"
        )
        raise AmbiguousPoseError(
            f"the robot at p = {p} m, q = {q} rad may be in any of these poses: {said}; what the sensors say within "
            f"their tolerance does not tell which; {advice}",
            candidates=tuple((one.pose.mode, one.load) for one in listed),
        )
    if best.load <= best.tolerance:
        return _unloaded(robot, best, sensors)
    return StartPose(best.pose, best.pose.force - robot.tip_weight)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A pose, the load that it asks for, and the load that the sensors' tolerance explains [N]."""

    pose: Equilibrium
    load: float
    tolerance: float


def _fitting(
    robot: Robot, p: np.ndarray, q: np.ndarray, sensors: Sensors, mode: str | None, load: float
) -> list[_Candidate]:
    """Poses that ask for no more than ``load``, beyond the tolerance of the sensors, least first."""
    lower, upper = robot.angle_limits.T
    if (q < lower - _BEYOND).any() or (q > upper + _BEYOND).any():
        return []
    inside = _drawn_in(robot, p, _DEVIATIONS * sensors.tip_noise)
    if inside is None:
        return []
    found = []
    for eq in held_equilibria(robot, inside, q):
        if not eq.stable or mode not in (None, eq.mode):
            continue
        missing = math.hypot(*(eq.force - robot.tip_weight))
        tolerance = (
            _ROUNDING * robot.force_scale
            + _DEVIATIONS * sensors.tip_noise * float(eq.stiffness_eigenvalues[1])
            + sensors.angle_step / 2 * float(np.linalg.norm(eq.dforce_dq, axis=0).sum())
        )
        if missing <= load + tolerance:
            found.append(_Candidate(eq, missing, tolerance))
    return sorted(found, key=lambda one: one.load)


def _drawn_in(robot: Robot, p: np.ndarray, tolerance: float) -> np.ndarray | None:
    """The tip, drawn into reach if it is out of it by no more than the tolerance; None if that is not enough."""
    centre, least = robot.bases.mean(axis=0), 1e-6
    for _ in range(20):
        over = -min(robot.slacks(p)) + least
        if over <= 0 or any(rod.stretches for rod in robot.rods):
            return p
        way = over * float(robot.lengths.max())
        if way > tolerance + _TAUT * float(robot.lengths.min()):
            return None
        towards = centre - p
        p = p + 1.5 * way * towards / max(math.hypot(*towards), 1e-300)
    return None


def _unloaded(robot: Robot, found: _Candidate, sensors: Sensors) -> StartPose:
    """The equilibrium without load that is nearest, in units of the sensors' tolerance."""
    eq = found.pose
    scale = np.concatenate([np.full(2, sensors.tip_noise), np.full(robot.n_rods, sensors.angle_step / 2)])
    if scale.any():
        try:
            for _ in range(3):
                missing = robot.tip_weight - eq.force
                slopes = np.hstack([eq.dforce_dp, eq.dforce_dq]) * scale
                step = scale * np.linalg.lstsq(slopes, missing, rcond=1e-10)[0]
                eq = solve_statics(robot, eq.p + step[:2], eq.q + step[2:], guess=eq)
        except PCRError:  # so near a fold or a straight rod that no equilibrium is at hand
            eq = found.pose
    return StartPose(eq, eq.force - robot.tip_weight)


def _misfit(
    robot: Robot, p: np.ndarray, q: np.ndarray, sensors: Sensors, mode: str | None, load: float
) -> MeasurementError:
    """Why nothing fits, and what would."""
    said = f"the robot {robot.name} has no pose at p = {p} m, q = {q} rad"
    far = min(robot.slacks(p)) < -_MILLIMETRES
    lower, upper = robot.angle_limits.T
    # What cannot be as it stands is explained by whatever can be; what could, by what fits well.
    impossible = far or bool((q < lower - _BEYOND).any() or (q > upper + _BEYOND).any())
    possible = load if impossible else _SURELY * load
    for of_tip, change, advice in _EXPLANATIONS:
        # Between the motors is always somewhere: what is in reach is no millimetres.
        if of_tip <= far and _fitting(robot, *change(robot, p, q), sensors, mode, possible):
            return MeasurementError(f"{said}: {advice}", p=p, q=q)
    reasons = []
    for i, slack in enumerate(robot.slacks(p)):
        if slack < 0:
            length = robot.rods[i].length
            reasons.append(f"the tip is {length * (1 - slack):.4g} m from the base of rod {i}, whose length is "
                           f"{length:.4g} m")  # fmt: skip
    for i in range(robot.n_rods):
        if not lower[i] - _BEYOND <= q[i] <= upper[i] + _BEYOND:
            reasons.append(f"motor {i} is at {q[i]:.4g} rad, beyond its stops [{lower[i]:.4g}, {upper[i]:.4g}] rad")
    if not reasons:
        others = held_equilibria(robot, p, q)
        stable = [eq for eq in others if eq.stable and mode in (None, eq.mode)]
        of_mode = f" of mode {mode}" if mode else ""
        if stable:
            least = min(stable, key=lambda eq: math.hypot(*(eq.force - robot.tip_weight)))
            missing = least.force - robot.tip_weight
            reasons.append(
                f"the nearest{of_mode}, {least.mode}, takes a load of ({missing[0]:.4g}, {missing[1]:.4g}) N on the "
                f"tip to stay there, and no more than {load:.3g} N is taken for possible"
            )
        else:
            modes = sorted({eq.mode for eq in others if eq.stable})
            reasons.append(f"none of its poses there{of_mode} is stable" + (f"; those of {', '.join(modes)} are"
                                                                           if modes else ""))  # fmt: skip
    advice = "check the robot's file, its bases and the zeros of the sensors, or give start(..., load=) a greater load"
    return MeasurementError(f"{said}: {'; '.join(reasons)}; {advice}", p=p, q=q)


def _within(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Motor angles on the turn between the stops; on that nearest to their middle where there are several."""
    middle = robot.angle_limits.mean(axis=1)
    return np.asarray(q + _TURN * np.round((middle - q) / _TURN))


_Changed = tuple[np.ndarray, np.ndarray]
_EXPLANATIONS: tuple[tuple[bool, Callable[[Robot, np.ndarray, np.ndarray], _Changed], str], ...] = (
    (False, lambda robot, p, q: (p, np.radians(q)), "are the angles degrees? give radians"),
    (True, lambda robot, p, q: (p / 1e3, q), "is the tip in millimetres? give metres"),
    (True, lambda robot, p, q: (p / 1e3, np.radians(q)), "are these millimetres and degrees? give metres and radians"),
    (False, lambda robot, p, q: (p, _within(robot, q)), "the angles are whole turns off: encoders that wrap? set "
     "Sensors(wrapped=True), or [sensor] wrapped = true in the scene"),
    (False, lambda robot, p, q: (p, q[::-1]), "are the motors swapped? their order is that of the rods"),
    (False, lambda robot, p, q: (p, -q), "do the encoders count clockwise? angles are counter-clockwise from world x"),
)  # fmt: skip
