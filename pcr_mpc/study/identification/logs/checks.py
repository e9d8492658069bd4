"""Whether a log can be what the scene's robot did: units, signs, length; and what it says before any model of rods."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ....errors import LogError
from ....plant.robot import Robot
from ....plant.statics.equilibrium import Equilibrium
from .commands import told_angles
from .log import Log

# A log shorter than this, or of fewer tip positions, tells nothing.
_LEAST_TIME, _LEAST_ROWS = 0.3, 40
# Longest delay that is looked for [rows].
LONGEST_DELAY = 10
# Angles may be beyond a stop by the zero of an encoder and a little [rad].
_BESIDE_STOPS = 0.3
# Share of readings that must make sense.
_MOST = 0.9
_ALIKE = 0.12
# Distance from the scene's start, in rod lengths, within which a tip in other units is looked for.
_NEAR = 0.4
# Angle told over angle seen, were it in other units.
_UNITS = {
    180.0 / math.pi: "q{i}_rad changes 57.3 times as much as u{i}_rad_s tells: the angles look like degrees, or the "
    "rates are not in rad/s; write radians",
    math.pi / 180.0: "q{i}_rad changes 1/57.3 as much as u{i}_rad_s tells: the rates look like degrees per second; "
    "write rad/s",
    1e-3: "q{i}_rad changes a thousandth of what u{i}_rad_s tells: the times look like milliseconds; write seconds",
    1e-6: "q{i}_rad changes a millionth of what u{i}_rad_s tells: the times look like microseconds; write seconds",
    2.0 * math.pi / 60.0: "q{i}_rad changes 0.105 times as much as u{i}_rad_s tells: the rates look like turns per "
    "minute; write rad/s",
    2.0 * math.pi: "q{i}_rad changes 6.28 times as much as u{i}_rad_s tells: the rates look like turns per second; "
    "write rad/s",
    1.0 / (2.0 * math.pi): "q{i}_rad changes 0.159 times as much as u{i}_rad_s tells: the angles look like turns; "
    "write radians",
    -1.0: "q{i}_rad turns against u{i}_rad_s: the sign of one of them is wrong; both are positive counter-clockwise",
}


def checked_log(log: Log, robot: Robot, pose: Equilibrium) -> Log:
    """Return a log with its angles unwrapped, or say why it cannot be this robot's.

    Parameters
    ----------
    log : Log
    robot : Robot
    pose : Equilibrium
        Of the scene's start: near it is the tip, and to its turns belong the angles.

    Raises
    ------
    LogError
        Wrong units, a wrong sign, another robot; too short; nothing moves.
    """
    seen = int((~np.isnan(log.p)).any(axis=1).sum())
    if log.t[-1] - log.t[0] < _LEAST_TIME or seen < _LEAST_ROWS:
        raise _failure(
            log,
            f"is too short: {log.t[-1] - log.t[0]:.3g} s with {seen} tip positions; record {_LEAST_TIME:g} s and "
            f"{_LEAST_ROWS} positions at least, better some seconds",
        )
    _check_tip(log, robot, pose.p)
    if log.torque is not None and (why := robot.needs_shooting):
        raise _failure(log, f"has motor torques, which are understood of plain rods only, and {why}; leave them out")
    if not np.isnan(log.q).all():
        _check_angles(log, robot)
        log = unwrapped(log, robot, pose.q)
        if log.driven_by == "commands":
            _check_rates(log)
    if np.nanmax(np.abs(log.u)) * log.step < 1e-7 and np.nanmax(np.nanstd(log.p, axis=0)) < 1e-6:
        raise _failure(log, "nothing moves in it: record a motion, such as that of `pcr-mpc excite`")
    return log


def delay_in_angles(log: Log) -> float | None:
    """Rows by which angles follow commands, to a hundredth of one; None where angles do not tell."""
    if log.driven_by != "commands":
        return 0.0
    if np.isnan(log.q).all() or len(log.missing) > 0.3 * len(log.t):
        return None
    whole = np.arange(0.0, LONGEST_DELAY + 1.0)
    costs = [_misfit(log, delay) for delay in whole]
    best = float(whole[int(np.argmin(costs))])
    near = np.clip(best + np.linspace(-1.0, 1.0, 201), 0.0, LONGEST_DELAY)
    return float(near[int(np.argmin([_misfit(log, delay) for delay in near]))])


def _misfit(log: Log, delay: float) -> float:
    """Median distance of the angles from those that were told, rows before the longest delay left out [rad]."""
    rest = (log.q - told_angles(log, delay))[LONGEST_DELAY:]
    rest = rest - np.nanmedian(rest, axis=0)
    return float(np.nanmean(np.minimum(np.abs(rest), 0.2)))


def _failure(log: Log, problem: str) -> LogError:
    return LogError(f"{log.name}: {problem}", file=log.name)


def _check_tip(log: Log, robot: Robot, p_start: np.ndarray) -> None:
    p = log.p[~np.isnan(log.p).any(axis=1)]
    if not len(p):
        return  # one coordinate alone

    def reached(scale: float) -> float:
        gap = np.linalg.norm(scale * p[:, None] - robot.bases, axis=2) - robot.lengths
        return float((gap < 0.02 * robot.lengths).all(axis=1).mean())

    if reached(1.0) >= _MOST:
        return
    for scale, unit in ((1e-3, "millimetres"), (1e-2, "centimetres"), (1e-6, "micrometres")):
        near = np.linalg.norm(scale * np.median(p, axis=0) - p_start) < _NEAR * float(robot.lengths.mean())
        if near and reached(scale) >= _MOST:
            raise _failure(log, f"p_x_m, p_y_m look like {unit}, at {p[0].tolist()}; write metres")
    raise _failure(
        log,
        f"{100 * (1 - reached(1.0)):.0f} % of its tip positions are out of reach of the rods of {robot.name}, such as "
        f"{p[0].tolist()} m; it is another robot's, or in another frame than the bases",
    )


def _check_angles(log: Log, robot: Robot) -> None:
    for i, (lower, upper) in enumerate(robot.angle_limits):
        angles = log.q[~np.isnan(log.q[:, i]), i]
        if not len(angles):
            continue

        def fit(values: np.ndarray, low: float = lower, high: float = upper) -> float:
            turned = values - 2 * np.pi * np.rint((values - (low + high) / 2) / (2 * np.pi))
            return float(((turned > low - _BESIDE_STOPS) & (turned < high + _BESIDE_STOPS)).mean())

        beyond = (np.abs(angles - (lower + upper) / 2) > (upper - lower) / 2 + 2 * np.pi).mean() > 0.5
        if fit(angles) >= _MOST and not beyond:
            continue
        if fit(np.radians(angles)) >= _MOST and (beyond or fit(angles) < _MOST):
            raise _failure(
                log, f"q{i}_rad looks like degrees, from {angles.min():.4g} to {angles.max():.4g}; write radians"
            )
        raise _failure(
            log,
            f"q{i}_rad, from {angles.min():.4g} to {angles.max():.4g} rad, is beyond the stops of motor {i} of "
            f"{robot.name}, [{lower:g}, {upper:g}] rad; it is another robot's, or counts from another zero",
        )


def unwrapped(log: Log, robot: Robot, q_start: np.ndarray) -> Log:
    """Return a log whose angles do not jump by turns, and begin within half a turn of the scene's."""
    q = log.q.copy()
    for i in range(robot.n_rods):
        known = ~np.isnan(q[:, i])
        if not known.any():
            continue
        angles = q[known, i]
        # Only where the encoder wraps: an outlier is no turn.
        if (np.abs(np.abs(np.diff(angles)) - 2 * np.pi) < 1.0).any():
            angles = np.unwrap(angles)
        q[known, i] = angles - 2 * np.pi * np.rint((np.median(angles[:5]) - q_start[i]) / (2 * np.pi))
    return replace(log, q=q)


def _check_rates(log: Log) -> None:
    """Refuse angles that are not what the commands add up to."""
    for i in range(log.q.shape[1]):
        # In other units the delay that fits best is none: that of the best line is.
        lines = [_line(log, i, delay) for delay in range(LONGEST_DELAY + 1)]
        slope, explained, moved = max(lines, key=lambda line: line[1])
        if abs(slope - 1.0) <= _ALIKE or moved < 0.02 or explained < 0.5:
            continue
        for ratio, words in _UNITS.items():
            if abs(slope / ratio - 1.0) < _ALIKE:
                raise _failure(log, words.format(i=i))
        raise _failure(
            log,
            f"q{i}_rad changes {slope:.3g} times as much as u{i}_rad_s tells; check the units, and whether the motor "
            "follows its commands",
        )


def _line(log: Log, motor: int, delay: int) -> tuple[float, float, float]:
    """Slope of the angle over what was told, the share of its variance that this explains, and its range [rad]."""
    told = told_angles(log, float(delay))[:, motor]
    known = ~np.isnan(log.q[:, motor])
    known[:LONGEST_DELAY] = False
    x, y = told[known], log.q[known, motor]
    if len(x) < 10 or np.ptp(x) < 1e-12:
        return 1.0, 0.0, 0.0
    for _ in range(4):  # without outliers
        slope, offset = np.polyfit(x, y, 1)
        rest = np.abs(y - slope * x - offset)
        keep = rest <= 4.0 * np.median(rest) + 1e-12
        x, y = x[keep], y[keep]
    explained = 1.0 - np.var(y - slope * x - offset) / max(float(np.var(y)), 1e-300)
    return float(slope), float(explained), float(np.ptp(y))
