"""What the rods of a robot have beyond the plain rod, as the numbers that the shooting graphs take."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from ...errors import ModelError
from ...frozen import read_only
from ..robot import Robot
from ..rod import Rod
from .equations import Layout, RodPhysics

_MOST_INTERVALS = 128


@lru_cache(maxsize=64)
def robot_layout(robot: Robot) -> Layout | None:
    """Return the layout that all rods of a robot share; None if all are plain and the closed form holds.

    Raises
    ------
    ModelError
        The lists along the rods have no common grid of a reasonable size.
    """
    if robot.needs_shooting is None:
        return None
    lists = [values for rod in robot.rods for values in (rod.curvatures, rod.stiffness_factors)]
    intervals = math.lcm(*(max(1, len(values) - 1) for values in lists))
    # Properties that do not change along the rods need one knot, which `interpolated` takes for a constant.
    constant = all(len(set(values)) == 1 for values in lists)
    if intervals > _MOST_INTERVALS:
        raise ModelError(
            f"{robot.name}: lists of {sorted({len(values) for values in lists})} values along the rods have no common "
            f"grid of at most {_MOST_INTERVALS} intervals; give lists of equal length",
            key="curvature",
        )
    return Layout(
        intervals=0 if constant else intervals,
        varying=any(set(rod.stiffness_factors) != {1.0} for rod in robot.rods),
        stretching=any(rod.stretches for rod in robot.rods),
    )


@lru_cache(maxsize=64)
def robot_physics(robot: Robot) -> tuple[RodPhysics, ...] | None:
    """Physics of each rod, all of one layout; None if all rods are plain. Errors as `robot_layout`."""
    layout = robot_layout(robot)
    return None if layout is None else in_layout(robot, layout)


def in_layout(robot: Robot, layout: Layout) -> tuple[RodPhysics, ...]:
    """Physics of each rod in a layout that has room for it."""
    return tuple(_of_rod(rod, robot.gravity, layout) for rod in robot.rods)


def require_plain(robot: Robot, what: str) -> None:
    """Raise `ModelError` if ``what``, which holds for plain rods only, is asked of others."""
    if robot.needs_shooting is not None:
        raise ModelError(
            f"{what} is for uniform, straight, inextensible, weightless rods, and {robot.needs_shooting}; "
            "use method 'multiple_shooting'",
            reason=robot.needs_shooting,
        )


def plain_physics(layout: Layout) -> np.ndarray:
    """Values of a plain rod in a layout: where a continuation to the real rod begins."""
    values = np.zeros(layout.size)
    if layout.varying:
        values[-(layout.intervals + 1) :] = 1.0
    return values


def normalised(
    stiffness: Any, length: Any, density: Any, gravity: Any, axial_compliance: Any, curvature: Any, factors: Any
) -> tuple[Any, ...]:
    """Values of `RodPhysics` in the order of its layout, from numbers in SI units or from expressions."""
    weight = density * length**3 / stiffness * gravity
    return weight, stiffness / length**2 * axial_compliance, length * curvature, factors


def at_knots(values: tuple[float, ...], intervals: int) -> np.ndarray:
    """A property at equally spaced knots along the rod, shape (intervals + 1,)."""
    given = np.linspace(0.0, 1.0, len(values)) if len(values) > 1 else np.zeros(1)
    return np.interp(np.linspace(0.0, 1.0, intervals + 1), given, values)


def _of_rod(rod: Rod, gravity: tuple[float, float], layout: Layout) -> RodPhysics:
    factors = at_knots(rod.stiffness_factors, layout.intervals) if layout.varying else np.empty(0)
    curvature = at_knots(rod.curvatures, layout.intervals)
    own = rod.bending_stiffness, rod.length, rod.line_density, np.array(gravity), 1.0 / rod.axial_stiffness
    return RodPhysics(layout, read_only(np.hstack(normalised(*own, curvature, factors))))
