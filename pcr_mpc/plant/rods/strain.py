"""Strain of a rod's outermost fibre: its curvature beyond that at rest times half its thickness, and its stretch."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.special import ellipkm1

from ..rod import Rod
from .equations import Layout, RodPhysics, sample_rod, unpacked

_TAUT = 1e-8  # k'^2 below which it cannot be told from the base of a rod
_LOG_TAUT = -15.0  # log tip angle below which K(k) is log(4 / k') to rounding
_FEWEST_POINTS = 32  # intervals along a rod that has no closed form: the largest strain is then right to 1e-5


def quarter_period(log_tip_angle: float) -> float:
    """K(k) of a plain rod with this tip angle (see `elastica`): beyond it its largest moment is not at the base."""
    half = math.exp(log_tip_angle) / 2
    return math.log(8.0) - log_tip_angle if log_tip_angle < _LOG_TAUT else float(ellipkm1(math.sin(half) ** 2))


def largest_moment(theta: Any, n_x: Any, n_y: Any, m: Any) -> Any:
    """Largest |m| along plain rods, exact, from their states at the base, normalised; numbers or arrays.

    The rod is the pendulum m'' = (n . t) m of energy H = m^2 / 2 + n . t. Where it swings through the lowest point,
    n . t = -lambda^2, the moment there is 2 lambda k with k^2 = (H / lambda^2 + 1) / 2; else it is largest at the base.
    """
    cos, sin, square = np.cos(theta), np.sin(theta), np.hypot(n_x, n_y)
    # Without a force the moment is the same all along, whatever is divided by.
    known = np.where(square > 0.0, square, 1.0)
    k_square = np.clip((m * m / 2 + n_x * cos + n_y * sin + square) / (2 * known), 0.0, 1.0)
    # Taut rods tell by the side to which the moment grows at the base: there, none has passed the point twice.
    taut = 1.0 - k_square <= _TAUT
    swings = np.sqrt(square) > ellipkm1(np.where(taut, 1.0, 1.0 - k_square))
    inside = (square > 0.0) & np.where(taut, m * (n_x * sin - n_y * cos) > 0, swings)
    return np.where(inside, 2.0 * np.sqrt(square * k_square), np.abs(m))


def strain_along(rod: Rod, nodes: np.ndarray, physics: RodPhysics | None, n_points: int) -> np.ndarray:
    """Largest strain over the cross-section at evenly spaced s from base to tip, shape (n_points,); NaN if not known.

    Parameters
    ----------
    rod : Rod
    nodes : ndarray, shape (4, N)
        See `sample_rod`.
    physics : RodPhysics or None
        None: a plain rod.
    n_points : int
    """
    if rod.thickness_ratio is None:
        return np.full(n_points, np.nan)
    _, _, theta, n_x, n_y, m = sample_rod(nodes, n_points, physics)
    if physics is None:
        return np.asarray(rod.thickness_ratio * np.abs(m))
    _, compliance, _, factors = unpacked(physics.layout, physics.values)
    bend = m
    if factors is not None:
        bend = m / np.interp(np.linspace(0.0, 1.0, n_points), np.linspace(0.0, 1.0, len(factors)), factors)
    stretch = compliance * (n_x * np.cos(theta) + n_y * np.sin(theta))
    return np.asarray(np.abs(stretch) + rod.thickness_ratio * np.abs(bend))


def strain_points(layout: Layout) -> int:
    """Pieces into which `largest_strain` divides a rod, all knots of its properties among their ends."""
    intervals = max(1, layout.intervals)
    return intervals * math.ceil(_FEWEST_POINTS / intervals)


def largest_strain(rod: Rod, nodes: np.ndarray, physics: RodPhysics) -> tuple[float, float]:
    """Where a rod that has no closed form is strained most, s in [0, 1], and how much.

    The largest sample of `strain_along` and a parabola through it and its neighbours.
    """
    intervals, count = max(1, physics.layout.intervals), strain_points(physics.layout)
    strain = strain_along(rod, nodes, physics, count + 1)
    at = int(strain.argmax())
    # At the ends, and at knots, where the slope of a property changes, the largest is a sample.
    if at in (0, count) or (at * intervals) % count == 0:
        return at / count, float(strain[at])
    before, here, after = strain[at - 1 : at + 2].tolist()
    bent = before - 2 * here + after
    if not bent < 0:
        return at / count, float(here)
    return (at - (after - before) / (2 * bent)) / count, float(here - (after - before) ** 2 / (8 * bent))
