"""Whether what a log shows can be in balance: the rods' force at each pose, against how the tip moves there.

It takes tens of solved poses and no search, and tells a mirrored log, or one whose angles count the other way, at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...errors import IdentificationError, PCRError
from ...plant.motion.plant import Plant
from ...plant.robot import Robot
from .first_guess import noise_of
from .logs.checks import unwrapped
from .logs.log import Log
from .prediction import Predictor

# Poses that are solved for each log.
_POSES = 40
# Half a window in which the tip moves on a parabola, in radians of its fastest swing; and rows in it at least.
_WINDOW, _LEAST_ROWS = 0.8, 3
# Off by more than this share of how the tip moves is another motion; by more than that is one if what was exchanged
# explains it so many times better.
_ANOTHER, _DOUBTFUL, _BETTER = 0.6, 0.25, 3.0
_TIMES_NOISE = 10.0
_CROOKED = 5.0  # times the median distance from a parabola, from which a window has an outlier
_KNOWN = 0.5  # share of poses that must be there
# Masses over stiffness may be believed this many times too small.
_LIGHTER = (0.25, 0.5, 1.0, 2.0, 4.0)
# What may have been exchanged in a log of n motors: words, and the change that makes it right.
_Change = Callable[[Log], Log]
_EXCHANGED: dict[str, _Change] = {
    "p_x_m had the other sign": lambda log: replace(log, p=log.p * (-1.0, 1.0)),
    "p_y_m had the other sign": lambda log: replace(log, p=log.p * (1.0, -1.0)),
    "p_x_m and p_y_m were exchanged": lambda log: replace(log, p=log.p[:, ::-1]),
    "the motors' angles and rates had the other sign": lambda log: replace(log, q=-log.q, u=-log.u),
    "the motors were numbered the other way round": lambda log: replace(log, q=log.q[:, ::-1], u=log.u[:, ::-1]),
    "left and right of the motors were exchanged": lambda log: replace(
        log, q=np.pi - log.q[:, ::-1], u=-log.u[:, ::-1]
    ),
}


def require_balance(predictor: Predictor, robot: Robot) -> None:
    """Refuse logs whose tip is not where such rods hold it.

    Raises
    ------
    IdentificationError
        Says by how much, and what looks exchanged.
    """
    for number, log in enumerate(predictor.logs):
        plant = predictor.plant(number, robot)
        off = imbalance(predictor, plant, log)
        if off is None or off <= _DOUBTFUL:
            continue
        others = {words: imbalance(predictor, plant, change(log)) for words, change in _EXCHANGED.items()}
        better = [words for words, other in others.items() if other is not None and _BETTER * other < off]
        if off <= _ANOTHER and not better:
            continue
        hint = (
            f"it would be one if {' or if '.join(better)}" if better else "check geometry, signs and the scene's start"
        )
        how = f"off by {100 * off:.0f} % of its motion" if math.isfinite(off) else "where no such rods can be"
        raise IdentificationError(
            f"{log.name}: at the measured motor angles the tip is {how} from where rods hold it: it is hardly a log of "
            f"{robot.name}; {hint}",
            residual=off,
        )


def imbalance(predictor: Predictor, plant: Plant, log: Log) -> float | None:
    """How far the tip is from where rods and inertia hold it, over how far it moves; a constant force aside.

    Infinite where the rods cannot be in most of the poses; None where the log does not say: angles are missing, or
    next to nothing moves.
    """
    log = unwrapped(log, plant.robot, predictor.pose.q)
    half = max(_LEAST_ROWS, round(_WINDOW / (predictor.omega * log.step)))
    moves = _smoothed(log, half)
    if len(moves) < _POSES // 4:
        return None
    pose = predictor.pose
    x = np.concatenate([pose.p, np.zeros(2), pose.q])
    plant.reset(x, pose)
    stiffness = plant.force_and_jacobians(pose.p, pose.q)[1]
    mass = plant.mass(pose.p, pose.q)[0]
    still, moving, tips = [], [], []
    for p, v, a, q, bend in moves:
        record = plant.record
        try:
            still.append(plant.force(p, q))
        except (PCRError, ValueError):
            plant.recall(record)
            continue
        tips.append(p)
        moving.append(mass[:2, :2] @ a + mass[:2, 2:] @ bend + plant.robot.drag * v)
    if len(tips) < _KNOWN * len(moves):
        return math.inf
    held, carried = (np.linalg.solve(stiffness, np.array(forces).T).T for forces in (still, moving))
    if _spread(np.hstack([tips, carried])) < _TIMES_NOISE * noise_of(log, plant.robot).tip:
        return None
    return min(_spread(held + by * carried) / _spread(np.hstack([tips, by * carried])) for by in _LIGHTER)


def _smoothed(log: Log, half: int) -> list[tuple[np.ndarray, ...]]:
    """Position, velocity, acceleration, angles and their second derivatives, by parabolas through windows."""
    rows = np.arange(-half, half + 1)
    basis = np.vander(log.step * rows, 3, increasing=True)
    fit = np.linalg.pinv(basis)
    seen = np.hstack([log.p, log.q])
    windows = np.lib.stride_tricks.sliding_window_view(seen, len(rows), axis=0).transpose(0, 2, 1)
    windows = windows[~np.isnan(windows).any(axis=(1, 2))]
    if not len(windows):
        return []
    # An outlier is no parabola.
    rest = np.linalg.norm((windows - basis @ (fit @ windows))[:, :, :2], axis=(1, 2))
    windows = windows[rest <= _CROOKED * np.median(rest)]
    found: list[tuple[np.ndarray, ...]] = []
    for place in np.unique(np.linspace(0, len(windows) - 1, _POSES).astype(int)):
        value, slope, bend = fit @ windows[place] * np.array([[1.0], [1.0], [2.0]])
        found.append((value[:2], slope[:2], bend[:2], value[2:], bend[2:]))
    return found


def _spread(values: np.ndarray) -> float:
    """Median distance from the middle."""
    return float(np.median(np.linalg.norm(values - np.median(values, axis=0), axis=1)))
