"""Where the search begins: starts of the pieces from what was measured there, and how noisy the readings are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ...errors import PCRError
from ...plant.robot import Robot
from ...plant.statics.free_tip import inverse_statics
from .logs.commands import told_angles
from .logs.log import Log
from .prediction import Piece, Predictor
from .problem import Guess, Noise

# Readings about a start by which its position and velocity are guessed.
_ABOUT = 7
# Third differences beyond this many times their median are outliers'; those of motion and noise are within ten.
_JUMP = 50.0
# Least noise, relative to the mean length of the rods, or in radians: rounding.
_LEAST = 1e-7
# Length of a piece of multiple shooting [s], and of a piece of a long run [s].
SHORT, LONG = 0.4, 5.0


def noise_of(log: Log, robot: Robot, known: Noise | None = None) -> Noise:
    """Guess the noise of the readings from their third differences, in which motion hardly shows."""

    def spread(values: np.ndarray, least: float) -> float:
        change = np.diff(values, 3, axis=0)
        change = change[~np.isnan(change)]
        # Of white noise the third difference has 20 times the variance.
        found = 1.4826 * float(np.median(np.abs(change))) / math.sqrt(20.0) if len(change) else least
        return max(found, least)

    least = _LEAST * float(robot.lengths.mean())
    tip, angle = spread(log.p, least), spread(log.q, _LEAST)
    torque = spread(log.torque, floor_of(robot).torque) if log.torque is not None else math.inf
    return Noise(max(tip, known.tip), max(angle, known.angle), torque) if known else Noise(tip, angle, torque)


def jumps(log: Log) -> bool:
    """Whether the tip jumps as no tip does: third differences far beyond what is usual in the log."""
    change = np.abs(np.diff(log.p, 3, axis=0))
    usual = np.nanmedian(change, axis=0)
    return bool((change > _JUMP * np.maximum(usual, 1e-9)).any())


def floor_of(robot: Robot) -> Noise:
    """Least noise that is believed."""
    length = float(robot.lengths.mean())
    return Noise(_LEAST * length, _LEAST, _LEAST * robot.force_scale * length)


def pieces_of(logs: Sequence[Log], skipped: Sequence[int], length: float | None) -> list[Piece]:
    """Cut logs into pieces of about one length [s]; None: each is one."""
    pieces = []
    for number, (log, first) in enumerate(zip(logs, skipped, strict=True)):
        rows = len(log.t) - 1 - first
        count = 1 if length is None else max(1, round(rows * log.step / length))
        size = math.ceil(rows / count)
        edges = [*range(first, first + rows, size), first + rows]
        pieces += [Piece(number, a, b, joined=b < edges[-1]) for a, b in pairwise(edges)]
    return pieces


def first_guess(predictor: Predictor, robot: Robot, pieces: Sequence[Piece], delay: float, free: int) -> Guess:
    """Starts as they were measured; where there are no angles, as if each log began in balance."""
    tips = [_tip(predictor.logs[piece.log], piece.first, predictor) for piece in pieces]
    angles: list[np.ndarray] = []
    for number, log in enumerate(predictor.logs):
        told = told_angles(log, delay if log.driven_by == "commands" else 0.0)
        unseen = np.isnan(log.q).all(axis=0)
        off = np.zeros(predictor.n)
        if not unseen.all():
            off[~unseen] = np.nanmedian(log.q[:, ~unseen] - told[:, ~unseen], axis=0)
        if unseen.any():
            i = next(i for i, piece in enumerate(pieces) if piece.log == number)
            off[unseen] = (_balanced(predictor, robot, tips[i][0]) - told[pieces[i].first])[unseen]
        angles.append(told + off)
    starts = [np.concatenate([p, v, angles[piece.log][piece.first]])
              for piece, (p, v) in zip(pieces, tips, strict=True)]  # fmt: skip
    missing = tuple(np.zeros(predictor.missing(i)) for i in range(len(predictor.logs)))
    return Guess(np.zeros(free), missing, np.stack(starts))


def _tip(log: Log, row: int, predictor: Predictor) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity of the tip at a row; a coordinate that was not measured is that of the scene's start."""
    p, v = np.array(predictor.pose.p), np.zeros(2)
    for axis in range(2):
        known = np.flatnonzero(~np.isnan(log.p[:, axis]))
        near = np.sort(known[np.argsort(np.abs(known - row), kind="stable")[:_ABOUT]])
        if len(near) < _ABOUT:
            continue
        # The line through the middle of what all pairs say: outliers aside.
        ahead = near - row
        rise, run = np.subtract.outer(log.p[near, axis], log.p[near, axis]), np.subtract.outer(ahead, ahead)
        slope = float(np.median(rise[run > 0] / run[run > 0]))
        p[axis], v[axis] = float(np.median(log.p[near, axis] - slope * ahead)), slope / log.step
    return p, v


def _balanced(predictor: Predictor, robot: Robot, p: np.ndarray) -> np.ndarray:
    """Motor angles with which the tip rests at p."""
    try:
        return np.asarray(inverse_statics(robot, p, mode=predictor.pose.mode).q)
    except PCRError:
        return np.asarray(predictor.pose.q)
