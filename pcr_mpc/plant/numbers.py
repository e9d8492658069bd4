"""A robot's numbers as one vector: an input of the graphs, which are the same for all robots of a kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ..frozen import read_only
from .robot import Robot
from .rod import Layout
from .rod_physics import at_knots, normalised, robot_layout

# Of each rod in turn, then of the robot, in SI units; a rod that is not plain adds 1/EA and its values at the knots.
_OF_ROD = ("bending_stiffness", "length", "base_x", "base_y", "line_density", "angle_lower", "angle_upper")
_OF_ROBOT = ("tip_mass", "drag", "gravity_x", "gravity_y", "rate_limit")


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
    """

    n_rods: int
    layout: Layout | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers, in their order: ``rods[0].bending_stiffness`` [N m^2] to ``rate_limit`` [rad/s]."""
        of_rod = list(_OF_ROD)
        if self.layout is not None:
            knots = range(self.layout.intervals + 1)
            of_rod += ["axial_compliance", *(f"curvature[{j}]" for j in knots)]
            of_rod += [f"stiffness_factors[{j}]" for j in knots] if self.layout.varying else []
        return (*(f"rods[{i}].{name}" for i in range(self.n_rods) for name in of_rod), *_OF_ROBOT)

    @property
    def size(self) -> int:
        """How many numbers there are."""
        return len(self.names)

    def pack(self, robot: Robot) -> np.ndarray:
        """Numbers of a robot of this kind, shape (size,), in SI units; 1/EA [1/N] is 0 for a rod that does not stretch.

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
                values += [1.0 / rod.axial_stiffness, *at_knots(rod.curvatures, self.layout.intervals)]
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
                knots = 8 + self.layout.intervals + 1
                factors = own[knots:]
                physics = (ca.vertcat(*normalised(stiffness, length, density, gravity, own[7], own[8:knots], factors)),)
            rods.append(RodNumbers(stiffness, length, own[2:4], density, physics))
            lower.append(own[5])
            upper.append(own[6])
        return Numbers(tuple(rods), ca.vertcat(*lower), ca.vertcat(*upper), tip_mass, drag, gravity, rate_limit)
