"""A robot's numbers as one vector: an input of the graphs, which are the same for all robots of a kind."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ...frozen import read_only
from ..robot import ROBOT_NUMBERS, Robot
from ..rod import MANY_TURNS, MOST_CURVED, POSITIVE, ROD_NUMBERS, STIFFNESS_RANGE
from .equations import Layout
from .physics import at_knots, normalised, robot_layout

# Of each rod in turn, then of the robot, with their units; what a rod that is not plain has more is listed in `Kind`.
_OF_ROD = {
    "bending_stiffness": "N m^2",
    "length": "m",
    "base_x": "m",
    "base_y": "m",
    "line_density": "kg/m",
    "angle_lower": "rad",
    "angle_upper": "rad",
}
_OF_ROBOT = {"tip_mass": "kg", "drag": "N s/m", "gravity_x": "m/s^2", "gravity_y": "m/s^2", "rate_limit": "rad/s"}
# What a `Robot` takes for them; any finite number for those that are not named.
_RANGES = {name: (bounds["minimum"], bounds["maximum"]) for name, bounds in (ROD_NUMBERS | ROBOT_NUMBERS).items()} | {
    "angle_lower": (-math.inf, MANY_TURNS),
    "angle_upper": (-MANY_TURNS, math.inf),
    "axial_compliance": (0.0, 1.0 / POSITIVE["minimum"]),
    "curvature": (-MOST_CURVED, MOST_CURVED),
    "stiffness_factors": STIFFNESS_RANGE,
}


@dataclass(frozen=True)
class RodNumbers:
    """Numbers of one rod as expressions; ``physics`` is what the graphs of rods that are not plain take."""

    bending_stiffness: Any
    length: Any
    base: Any
    line_density: Any
    physics: tuple[Any, ...]


@dataclass(frozen=True)
class Numbers:
    """The vector of a robot, taken apart into expressions."""

    rods: tuple[RodNumbers, ...]
    angle_lower: Any
    angle_upper: Any
    tip_mass: Any
    drag: Any
    gravity: Any
    rate_limit: Any


@dataclass(frozen=True)
class Kind:
    """What robots must have in common to share graphs.

    Attributes
    ----------
    n_rods : int
    layout : Layout or None
        Of what the rods have beyond plain ones; None: they are plain.

    Notes
    -----
    The vector holds, for each rod i in turn, ``rods[i].`` and

    ======================== ======= =====================================================
    bending_stiffness        N m^2   EI
    length                   m       L
    base_x, base_y           m
    line_density             kg/m
    angle_lower, angle_upper rad     stops of its motor
    axial_compliance         1/N     1/EA, if the layout stretches; 0 for a rod that does not
    curvature[j]             1/m     kappa0 at knot j of the layout, if there is one
    stiffness_factors[j]     -       EI(s)/EI at knot j, if the layout varies
    ======================== ======= =====================================================

    and then, of the robot, tip_mass [kg], drag [N s/m], gravity_x, gravity_y [m/s^2], rate_limit [rad/s].
    """

    n_rods: int
    layout: Layout | None = None

    @property
    def units(self) -> dict[str, str]:
        """Units of the numbers by their names, in their order."""
        of_rod = dict(_OF_ROD)
        if self.layout is not None:
            knots = range(self.layout.intervals + 1)
            of_rod |= {"axial_compliance": "1/N"} if self.layout.stretching else {}
            of_rod |= {f"curvature[{j}]": "1/m" for j in knots}
            of_rod |= {f"stiffness_factors[{j}]": "-" for j in knots} if self.layout.varying else {}
        return {f"rods[{i}].{name}": unit for i in range(self.n_rods) for name, unit in of_rod.items()} | _OF_ROBOT

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers, in their order."""
        return tuple(self.units)

    @property
    def ranges(self) -> np.ndarray:
        """Least and greatest value of each that a `Robot` takes, shape (size, 2); where infinite, any finite one.

        Besides, its bases must differ, and the stops of a motor be in order.
        """
        names = (name.partition("].")[2] or name for name in self.names)
        return np.array([_RANGES.get(name.partition("[")[0], (-math.inf, math.inf)) for name in names])

    @property
    def size(self) -> int:
        """How many numbers there are."""
        return len(self.names)

    def pack(self, robot: Robot) -> np.ndarray:
        """Numbers of a robot of this kind, shape (size,), in SI units.

        Raises
        ------
        ValueError
            The robot is of another kind.
        """
        # Weight alone makes no other kind: graphs of plain rods may know it by its potential, or leave it out.
        layout = robot_layout(robot.weightless())
        if robot.n_rods != self.n_rods or layout not in (None, self.layout):
            raise ValueError(
                f"{robot.name} has {robot.n_rods} rods of layout {layout}, expected {self.n_rods} of {self.layout}; "
                "it needs graphs of its own"
            )
        values: list[float] = []
        for rod in robot.rods:
            values += [rod.bending_stiffness, rod.length, *rod.base, rod.line_density, *rod.angle_limits]
            if self.layout is not None:
                values += [1.0 / rod.axial_stiffness] if self.layout.stretching else []
                values += at_knots(rod.curvatures, self.layout.intervals).tolist()
                if self.layout.varying:
                    values += at_knots(rod.stiffness_factors, self.layout.intervals).tolist()
        return read_only(np.array([*values, robot.tip_mass, robot.drag, *robot.gravity, robot.rate_limit]))

    def weightless(self, vector: Any) -> Any:
        """Return the expression of the same numbers without gravity."""
        return ca.vertcat(vector[:-3], ca.DM.zeros(2), vector[-1])

    def unpack(self, vector: Any) -> Numbers:
        """Take an expression of shape (size,) apart."""
        width = (self.size - len(_OF_ROBOT)) // self.n_rods
        tip_mass, drag, gravity, rate_limit = ca.vertsplit(vector[width * self.n_rods :], [0, 1, 2, 4, 5])
        rods, lower, upper = [], [], []
        for i in range(self.n_rods):
            own = vector[width * i : width * (i + 1)]
            stiffness, length, density = own[0], own[1], own[4]
            physics: tuple[Any, ...] = ()
            if self.layout is not None:
                first = len(_OF_ROD) + self.layout.stretching
                compliance = own[first - 1] if self.layout.stretching else 0.0
                curvature, factors = ca.vertsplit(own[first:], [0, self.layout.intervals + 1, width - first])
                values = normalised(stiffness, length, density, gravity, compliance, curvature, factors)
                physics = (ca.vertcat(*values),)
            rods.append(RodNumbers(stiffness, length, own[2:4], density, physics))
            lower.append(own[5])
            upper.append(own[6])
        return Numbers(tuple(rods), ca.vertcat(*lower), ca.vertcat(*upper), tip_mass, drag, gravity, rate_limit)
