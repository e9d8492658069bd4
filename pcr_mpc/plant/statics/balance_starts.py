"""Where a search for a tip in balance begins, if there is no pose to follow."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..robot import Robot
from ..rods.closed_form.chart import held_shapes

_OFFSETS = np.linspace(-2.6, 2.6, 40)  # clamp angle minus chord angle, of a cold inverse start [rad]
_CANDIDATES = 24
_COMBINATIONS = 100_000
_NARROW = 3  # angles between the stops that a cold inverse start needs at least


def tip_starts(robot: Robot, q: np.ndarray) -> list[np.ndarray]:
    """Tip positions to descend from: where the straight rods would end, drawn into reach, and points around it."""
    straight = robot.bases + robot.lengths[:, None] * np.stack([np.cos(q), np.sin(q)], axis=1)
    centre = robot.bases.mean(axis=0)
    radius = 0.5 * robot.lengths.min()
    starts = [straight.mean(axis=0)]
    starts += [centre + radius * np.array([np.cos(a), np.sin(a)]) for a in np.pi * np.arange(8) / 4 + np.pi / 2]
    # Of rods that only just meet, half of what is left between there and straight.
    closest = float((np.linalg.norm(centre - robot.bases, axis=1) / robot.lengths).max())
    reach = max(0.9, (1.0 + closest) / 2)
    inside = []
    for start in starts:
        for _ in range(60):
            if (np.linalg.norm(start - robot.bases, axis=1) < reach * robot.lengths).all():
                inside.append(start)
                break
            start = start + 0.1 * (centre - start)
    return inside


def angle_starts(robot: Robot, p: np.ndarray, force: np.ndarray, mode: str | None) -> list[np.ndarray]:
    """Motor angles within limits whose coarse shapes nearly carry ``force``, best first."""
    scale = robot.force_scale
    # The coarser, the more rods there are to combine.
    stride = math.ceil(len(_OFFSETS) / max(1, int(_COMBINATIONS ** (1 / robot.n_rods))))
    offsets = _OFFSETS[stride // 2 :: stride]
    per_rod: list[np.ndarray] = []
    scores = np.zeros((1, 3))  # mismatch of the force (2) and energy of every combination so far
    scores[0, :2] = -force / scale
    for i, rod in enumerate(robot.rods):
        dx, dy = (p - rod.base) / rod.length
        lower, upper = rod.angle_limits
        chord = np.arctan2(dy, dx)
        angles = lower + (chord + offsets - lower) % (2 * np.pi)
        angles = _nearest_turn(angles[angles <= upper], chord, lower, upper)
        if len(angles) < _NARROW:
            angles = np.linspace(lower, upper, _NARROW)
        unit = rod.bending_stiffness / rod.length**2 / scale
        rows = []
        for angle in angles:
            cos, sin = np.cos(angle), np.sin(angle)
            shape = held_shapes(cos * dx + sin * dy, cos * dy - sin * dx)[0]
            if mode is None or ("L" if shape.hand < 0 else "R") == mode[i]:
                n_x, n_y = shape.nodes(1, angle)[1:3, 0] * unit
                rows.append((angle, n_x, n_y, shape.energy))
        table = np.array(rows).reshape(-1, 4)
        per_rod.append(table[:, 0])
        scores = (scores[:, None] + table[:, 1:]).reshape(-1, 3)
    best = np.argsort(np.hypot(*scores.T[:2]) + 0.02 * scores[:, 2], kind="stable")[:_CANDIDATES]
    chosen = np.unravel_index(best, [len(angles) for angles in per_rod])
    return list(np.stack([angles[at] for angles, at in zip(per_rod, chosen, strict=True)], axis=1))


def unwound(robot: Robot, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Motor angles of the same shapes, each on the turn that is nearest to its rod's chord and between the stops."""
    chords = np.arctan2(*(p - robot.bases).T[::-1])
    return _nearest_turn(q, chords, *robot.angle_limits.T)


def _nearest_turn(angles: np.ndarray, wanted: Any, lower: Any, upper: Any) -> np.ndarray:
    """Add the whole turns by which angles come nearest to what is wanted and stay within limits, if they can."""
    turn = 2 * np.pi
    least, most = np.ceil((lower - angles) / turn), np.floor((upper - angles) / turn)
    turns = np.minimum(np.maximum(np.round((wanted - angles) / turn), least), most)
    return np.asarray(np.where(least <= most, angles + turn * turns, angles))
