"""A pace to begin with: one that the robot can keep, slow where much is asked and fast where little is."""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import CubicSpline

from ....errors import ConvergenceError, InfeasibleError, PCRError
from ....plant.statics.equilibrium import Equilibrium
from ....plant.statics.free_tip import inverse_statics
from .meshing import points
from .pace import cells_of, constant_pace, spline_of
from .path import TipPath
from .timing import Problem, Timing, evaluated, on_stand

_ROUGH_CELLS = 40
STATICS = 40  # poses that are found one by one
_REST = 1e4  # s: so slow that motion asks for nothing
# Of the speed, with which the shares of some limits grow.
_POWERS = {"change of rate": 3.0, "tip acceleration": 2.0, "tip jerk": 3.0, "motor rate": 2.0, "tip speed": 1.0}
_TRIALS, _ESTIMATES = 40, 20
_AIM, _NEAR_ENOUGH = 0.8, 0.8  # of the limits; of the duration that is expected to use so much of them
# Cells over which the speed is changed, by what at most; the largest share to begin with.
_REACH, _LARGEST_CHANGE, _WORST_START, _SWEEPS = 3, 3.0, 1.2, 8


def evened(timing: Timing) -> Timing:
    """Change a pace where little of the limits is used, or much, until it no longer gets faster.

    The shares go about with a power of the speed; whatever else the change does to them is seen when it is evaluated.
    """
    best, tried = timing, timing
    for _ in range(_SWEEPS):
        cells = cells_of(tried.pace)
        x = np.linspace(0.0, 1.0, 10 * cells + 1)
        power = np.array([_POWERS.get(use.limit, math.inf) for use in tried.uses])
        ratio = (tried.shares / _AIM) ** (1.0 / power)[:, None]
        slower = _spread(np.interp(x, tried.x, ratio[np.isfinite(power)].max(axis=0)), 10 * _REACH)
        slower = np.clip(slower, 1.0 / _LARGEST_CHANGE, _LARGEST_CHANGE)
        middles = np.clip((np.arange(len(tried.pace.c)) - 1.5) / cells, 0.0, 1.0)
        pace = spline_of(tried.pace.c * np.interp(middles, x, slower) ** -2.0)
        try:
            tried = evaluated(tried.problem, pace, tried.x, tried.turned.q.value, tried.turned.poses)
        except PCRError:
            break
        if tried.duration < best.duration and tried.worst < _WORST_START:
            best = tried
    return best


def _spread(values: np.ndarray, width: int) -> np.ndarray:
    """The largest of as many neighbours, and then a smooth mean of half as many more on each side."""
    half, width = width // 2, 3 * width // 2
    largest = sliding_window_view(np.pad(values, half, mode="edge"), 2 * half + 1).max(axis=1)
    weights = np.hanning(2 * width + 1)
    return np.convolve(np.pad(largest, width, mode="edge"), weights / weights.sum(), mode="valid")


def started(problem: Problem, path: TipPath) -> Timing:
    """A pace that the robot can keep."""
    x = points(_ROUGH_CELLS, 2)
    q = _angles_at_rest(problem, path, x)
    acceleration = 5.0 * problem.pose.robot.force_scale / problem.carrier.mass
    # The polynomial of degree 7 has a largest acceleration of 7.5 length / duration^2.
    seconds = math.sqrt(7.5 * path.length / acceleration)
    still = evaluated(problem, constant_pace(_ROUGH_CELLS, max(_REST, 1e3 * seconds)), x, q)
    _require_rest(still, path)
    found: Timing | None = None
    seconds = _estimated(still, seconds)
    resting = still.turned.q.value, still.turned.poses
    kept: Timing | None = None
    for _ in range(_TRIALS):
        try:
            found = evaluated(problem, constant_pace(_ROUGH_CELLS, seconds), x, *resting)
        except PCRError:
            found = None
        if kept is not None and (found is None or found.worst > 1.0):
            return kept
        if found is None:
            seconds *= 2.0
            continue
        ratio = _slower(found)
        if found.worst <= 1.0:
            kept = found
            if ratio > _NEAR_ENOUGH:
                return kept
        seconds *= ratio if found.worst <= 1.0 else max(1.1, ratio)
    raise ConvergenceError(
        f"no pace was found at which the robot keeps its limits on this path: in {seconds:.3g} s it would still use "
        f"{found.worst if found else math.inf:.3g} times what is allowed; is a limit almost reached at rest?",
        residual=found.worst if found else math.inf,
        iterations=_TRIALS,
        last=seconds,
    )


def _estimated(still: Timing, seconds: float) -> float:
    """Time in which limits on motion would be used well, if the rods answered to it as they do at rest [s]."""
    for _ in range(_ESTIMATES):
        pace = constant_pace(cells_of(still.pace), seconds)
        ratio = _slower(on_stand(still.problem, pace, still.x, still.turned.stand))
        seconds *= ratio
        if abs(ratio - 1.0) < 1.0 - _NEAR_ENOUGH:
            break
    return seconds


def _slower(timing: Timing) -> float:
    """How many times as long it would take to use what is aimed at of the limits on motion."""
    shares = dict(zip((use.limit for use in timing.uses), timing.shares.max(axis=1), strict=True))
    return float(max((shares[kind] / _AIM) ** (1.0 / power) for kind, power in _POWERS.items() if kind in shares))


def resting(problem: Problem, path: TipPath) -> list[Equilibrium]:
    """Poses at rest along a path, in equal steps of its length."""
    s = np.linspace(0.0, path.length, STATICS)
    pose: Equilibrium = problem.pose
    payload = problem.carrier.weight - pose.robot.tip_weight
    found = []
    for length, tip in zip(s, path.derivatives(s)[0], strict=True):
        try:
            pose = inverse_statics(pose.robot, tip, payload, guess=pose)
        except PCRError as error:
            raise type(error)(f"{where(length, tip)}: {error}", **error.details, s=float(length)) from None
        found.append(pose)
    return found


def _angles_at_rest(problem: Problem, path: TipPath, x: np.ndarray) -> np.ndarray:
    """Motor angles that hold the tip on the path at the points x."""
    q = np.array([pose.q for pose in resting(problem, path)])
    s = np.clip(problem.course.nominal(x), 0.0, path.length)
    return np.asarray(CubicSpline(np.linspace(0.0, path.length, STATICS), q)(s))


def _require_rest(still: Timing, path: TipPath) -> None:
    """Raise if a limit is exceeded where the tip stands still."""
    shares = still.shares
    if shares.max() <= 1.0:
        return
    limit, at = np.unravel_index(int(shares.argmax()), shares.shape)
    kind, robot = still.uses[limit].limit, still.problem.pose.robot
    value = {
        "motor torque": f"takes {np.abs(still.turned.torque.value[at]).max():.4g} N m, where "
        f"{still.problem.limits.torque:.4g} N m are allowed",
        "motor angle": f"needs motor angles of {np.array2string(still.turned.q.value[at], precision=4)} rad, where "
        f"the stops are {robot.angle_limits.tolist()} rad",
        "stiffness": f"leaves a stiffness of {still.problem.limits.stiffness / shares[limit, at]:.4g} N/m, where "
        f"{still.problem.limits.stiffness:.4g} N/m are to be kept",
        "rod margin": f"leaves a rod margin of {1 - shares[limit, at] * (1 - still.problem.limits.rod_margin):.4g}, "
        f"where {still.problem.limits.rod_margin:.4g} is to be kept",
    }.get(kind, f"uses {shares[limit, at]:.4g} times what is allowed")
    p = still.moved.path[0][at]
    s = float(still.problem.course.nominal(still.x[at]))
    why = f"cannot be kept at any speed: to rest there {value} ({kind}); move the path, or allow more"
    if kind in _POWERS:
        why = f"{value} ({kind}) even if all of the path takes {still.duration:.3g} s; allow more"
    raise InfeasibleError(
        f"{where(s, p)} {why}",
        status="infeasible at rest",
        limit=kind,
        share=float(shares[limit, at]),
        s=s,
    )


def where(s: float, p: np.ndarray) -> str:
    """Name a place of the path."""
    return f"the path at {1e3 * s:.4g} mm from its start, p = ({p[0]:.6g}, {p[1]:.6g}) m,"
