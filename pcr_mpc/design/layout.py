"""Where the motors stand, where the tip works, and how the rods are bowed."""

from __future__ import annotations

import math
from dataclasses import dataclass

_OUTWARD = 2.1  # to either side of pointing outward, up to where a clamp meets the base plate or the other motor [rad]
_TURN = 3.2  # a little more than half a turn to either side [rad]


@dataclass(frozen=True)
class Layout:
    """Motors and the middle of the workspace, rods alike.

    Attributes
    ----------
    bases : tuple of (float, float)
        Motor axes [m].
    angle_limits : tuple of (float, float)
        Stops of the motors [rad].
    centre : (float, float)
        At the same distance from all bases [m].
    mode : str
        Working mode.
    size : (float, float)
        Greatest width and height of a figure of eight at the centre [m].
    """

    bases: tuple[tuple[float, float], ...]
    angle_limits: tuple[tuple[float, float], ...]
    centre: tuple[float, float]
    mode: str
    size: tuple[float, float]


def pair(length: float, spacing: float, stretch: float) -> Layout:
    """Two motors side by side and the tip in front of them, rods bowed outward as those of ``planar_pair``."""
    half = spacing / 2
    return Layout(
        bases=((-half, 0.0), (half, 0.0)),
        angle_limits=((math.pi - _OUTWARD, math.pi + _OUTWARD), (-_OUTWARD, _OUTWARD)),
        centre=(0.0, math.sqrt((stretch * length) ** 2 - half**2)),
        mode="LR",
        size=(0.3 * length, 0.15 * length),
    )


def ring(count: int, length: float, spacing: float) -> Layout:
    """Motors on a circle with the tip in its middle, all rods bowed the same way round as those of ``three_rods``."""
    radius = spacing / (2 * math.sin(math.pi / count))
    at = [-math.pi / 2 - math.pi / count + 2 * math.pi * i / count for i in range(count)]
    bases = tuple((radius * math.cos(angle), radius * math.sin(angle)) for angle in at)
    inward = [math.atan2(-y, -x) for x, y in bases]
    return Layout(
        bases=bases,
        angle_limits=tuple((angle - _TURN, angle + _TURN) for angle in inward),
        centre=(0.0, 0.0),
        mode="L" * count,
        size=(0.15 * length, 0.075 * length),
    )


def layouts(count: int, length: float, spacing: float | None) -> list[Layout]:
    """Layouts to choose from, by how far the rods are stretched: the first bend them most and reach furthest."""
    if count == 2:
        apart = 0.5 * length if spacing is None else spacing
        stretches = (0.673, 0.72, 0.77, 0.82, 0.87, 0.91)
        return [pair(length, apart, stretch) for stretch in stretches if stretch * length > 0.5 * apart]
    per_radius = 2 * math.sin(math.pi / count)
    radii = [0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9] if spacing is None else [spacing / per_radius / length]
    return [ring(count, length, radius * length * per_radius) for radius in radii if radius < 0.95]
