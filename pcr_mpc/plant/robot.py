"""The robot as data: rods, motors, and the mass at the joint."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ModelError, UnreachableError, check_numbers, checked_vector
from ..files import name_problem
from ..frozen import Frozen, read_only
from ..toml_table import read_toml
from .rod import MANY_TURNS, NOT_NEGATIVE, POSITIVE, Rod, doubtful_limits, read_rod
from .uncertainty import read_uncertainty

# Strain of a rod that can stretch beyond which no rod is elastic.
_LARGEST_STRAIN = 0.01
ROBOT_NUMBERS = {
    "tip_mass": POSITIVE,
    "drag": NOT_NEGATIVE,
    "rate_limit": POSITIVE,
    "acceleration_limit": POSITIVE,
    "torque_limit": POSITIVE,
}
# Fraction of the length by which a rod must fall short of straight: closer, the rounding of the tip position alone
# decides the force.
_LEAST_SLACK = 1e-9
# Beyond it the rounding of an angle, 1e-10 rad, shows in the shape of a rod [rad].
_LARGEST_ANGLE = 1e6

_FAR = 100.0  # times as long as the motors are apart, or the other way round: one of them is in another unit


@dataclass(frozen=True)
class Robot(Frozen):
    """A planar parallel continuum robot: rods joined at their tips by a pin that carries a mass.

    Attributes
    ----------
    name : str
        For reports.
    rods : tuple of Rod
        One per motor, n in total.
    tip_mass : float
        m [kg].
    drag : float
        c, viscous drag of the tip [N s/m].
    rate_limit : float
        Greatest motor rate [rad/s].
    acceleration_limit : float
        Greatest change of the motor rate [rad/s^2].
    torque_limit : float
        Greatest motor torque [N m].
    gravity : (float, float)
        In the plane of the robot [m/s^2]; zero for a robot that lies flat.
    """

    name: str
    rods: tuple[Rod, ...]
    tip_mass: float
    drag: float
    rate_limit: float
    acceleration_limit: float
    torque_limit: float
    gravity: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if problem := name_problem(self.name):
            raise ModelError(f"name: {problem}", key="name")
        check_numbers(self, ROBOT_NUMBERS)
        object.__setattr__(self, "gravity", tuple(checked_vector("gravity", self.gravity, 2).tolist()))
        object.__setattr__(self, "rods", tuple(self.rods))
        for rod in self.rods:
            if not isinstance(rod, Rod):
                raise TypeError(f"rods holds {rod!r}, expected a Rod")
        bases = [rod.base for rod in self.rods]
        if len(self.rods) < 2 or len(set(bases)) < len(bases):
            raise ModelError(f"{self.name}: needs two or more rods at different bases, found {bases}", bases=bases)

    @property
    def n_rods(self) -> int:
        """Number of rods, equal to the number of motors."""
        return len(self.rods)

    @cached_property
    def needs_shooting(self) -> str | None:
        """Why the closed form does not hold for these rods, or None where it does: then it is exact."""
        reasons = {
            "is curved at rest": any(any(rod.curvatures) for rod in self.rods),
            "changes its stiffness along its length": any(set(rod.stiffness_factors) != {1.0} for rod in self.rods),
            "stretches": any(rod.stretches for rod in self.rods),
            "has weight": any(self.gravity) and any(rod.line_density for rod in self.rods),
        }
        return next((f"a rod of {self.name} {reason}" for reason, holds in reasons.items() if holds), None)

    @cached_property
    def tip_weight(self) -> np.ndarray:
        """m g, shape (2,) [N]."""
        return read_only(self.tip_mass * np.array(self.gravity))

    def weightless(self) -> Robot:
        """Return the same robot without gravity."""
        return replace(self, gravity=(0.0, 0.0))

    def plain(self) -> Robot:
        """Return the same robot with rods that are straight, uniform and inextensible; they keep their weight."""
        rods = (replace(r, curvature=0.0, stiffness_factors=(1.0,), axial_stiffness=math.inf) for r in self.rods)
        return replace(self, rods=tuple(rods))

    @cached_property
    def bases(self) -> np.ndarray:
        """Motor axes, shape (n, 2) [m]."""
        return read_only(np.array([rod.base for rod in self.rods]))

    @cached_property
    def lengths(self) -> np.ndarray:
        """Rod lengths, shape (n,) [m]."""
        return read_only(np.array([rod.length for rod in self.rods]))

    @cached_property
    def stiffnesses(self) -> np.ndarray:
        """Bending stiffnesses EI, shape (n,) [N m^2]."""
        return read_only(np.array([rod.bending_stiffness for rod in self.rods]))

    @cached_property
    def strain_limits(self) -> np.ndarray:
        """Largest strains that the rods' materials bear, shape (n,) [-]; infinite where that is not known."""
        return read_only(np.array([rod.strain_limit for rod in self.rods]))

    @cached_property
    def force_scale(self) -> float:
        """Sum of EI/L^2, the size of the rods' forces [N]."""
        return float((self.stiffnesses / self.lengths**2).sum())

    @cached_property
    def angle_limits(self) -> np.ndarray:
        """Least and greatest motor angles, shape (n, 2) [rad]."""
        return read_only(np.array([rod.angle_limits for rod in self.rods]))

    def checked_angles(self, name: str, value: Any) -> np.ndarray:
        """Return motor angles as a float64 vector, shape (n,) [rad], or say what is wrong with them."""
        q = checked_vector(name, value, len(self.rods))
        angles = q.tolist()
        if max(angles) > _LARGEST_ANGLE or min(angles) < -_LARGEST_ANGLE:
            raise ValueError(f"{name} is {q} rad, expected at most {_LARGEST_ANGLE:g} rad; take off the whole turns")
        return q

    def motor_rates(self, u: np.ndarray, q: np.ndarray, dt: float) -> np.ndarray:
        """Rates [rad/s] at which motors at the angles q that are told to turn at u do turn during a step."""
        limit, lower, upper = self.rate_limit, self.angle_limits[:, 0], self.angle_limits[:, 1]
        # A motor that would pass its stop within the step arrives there at the end of it; one that is beyond
        # its stop comes back no faster than it can.
        rate = np.minimum(np.maximum(u, -limit), limit)
        rate = (np.minimum(np.maximum(q + dt * rate, lower), upper) - q) / dt
        return np.asarray(np.minimum(np.maximum(rate, -limit), limit))

    def slacks(self, p: np.ndarray) -> list[float]:
        """``1 - |p - base| / length`` of every rod: 0 where it is straight, negative out of reach."""
        x, y = p.tolist()
        return [1.0 - math.hypot(x - x_base, y - y_base) / length for x_base, y_base, length, _ in self._reach]

    @cached_property
    def _reach(self) -> tuple[tuple[float, float, float, float], ...]:
        """Base, length and least slack of every rod."""
        return tuple((*rod.base, rod.length, -_LARGEST_STRAIN if rod.stretches else _LEAST_SLACK) for rod in self.rods)

    def require_reachable(self, p: np.ndarray) -> None:
        """Raise `UnreachableError` if some rod cannot reach ``p``, shape (2,) [m], or is straight there."""
        x, y = p.tolist()
        for i, (x_base, y_base, length, least) in enumerate(self._reach):
            slack = 1.0 - math.hypot(x - x_base, y - y_base) / length
            # Written so that NaN is out of reach.
            if not slack >= least:
                distance = length * (1.0 - slack)
                advice = (
                    "straight, it has no definite force; move the tip closer to its base"
                    if abs(slack) < _LEAST_SLACK
                    else f"move the tip at least {distance - length:.3g} m closer"
                )
                raise UnreachableError(
                    f"tip ({p[0]:.6g}, {p[1]:.6g}) m is {distance:.6g} m from the base of rod {i}, whose length is "
                    f"{length:.6g} m; {advice}",
                    rod=i,
                    distance=distance,
                    length=length,
                )


def load_robot(path: str | Path) -> Robot:
    """Read a robot from TOML (see ``models/planar_pair.toml``).

    Raises
    ------
    ModelError
        A key is missing, misspelt, of the wrong type or out of range.

    Warns
    -----
    UserWarning
        A motor may turn more than four turns from zero: its limits look like degrees. Rods are a hundred times as long
        as the motors are apart, or the other way round: one of them looks like millimetres.
    """
    with read_toml(path) as file:
        name = file.text("name")
        rods: list[Rod] = []
        for table in file.tables("rods"):
            with table:
                rods.append(read_rod(table))
            if max(map(abs, rods[-1].angle_limits)) > MANY_TURNS:
                warnings.warn(f"{path}: rods.angle_limits: {doubtful_limits(rods[-1])}", stacklevel=2)
        with file.table("world", {}) as world:
            gravity = world.vector("gravity", 2, (0.0, 0.0))
        read_uncertainty(file)  # how well the numbers are known is nothing of the robot's, but must be right
        with file.table("tip") as tip, file.table("motors") as motors:
            numbers = {
                "tip_mass": tip.number("mass", **ROBOT_NUMBERS["tip_mass"]),
                "drag": tip.number("drag", **ROBOT_NUMBERS["drag"]),
                **{key: motors.number(key, **ROBOT_NUMBERS[key])
                   for key in ("rate_limit", "acceleration_limit", "torque_limit")},
            }  # fmt: skip
        robot = Robot(name=name, rods=tuple(rods), gravity=gravity, **numbers)
    if doubt := _doubtful_lengths(robot):
        warnings.warn(f"{path}: {doubt}", stacklevel=2)
    return robot


def _doubtful_lengths(robot: Robot) -> str:
    """Say of lengths that do not go with where the motors are what they would be as millimetres."""
    apart = float(np.linalg.norm(robot.bases[:, None] - robot.bases, axis=2).max())
    longest = float(robot.lengths.max())
    if longest > _FAR * apart:
        i = int(robot.lengths.argmax())
        return (
            f"rods[{i}].length is {longest:g} m, {longest / apart:.2g} times as far as the motors are apart, "
            f"{apart:g} m; if it is in millimetres, it is {longest / 1e3:g} m"
        )
    if apart > _FAR * longest:
        return (
            f"rods.base: motors are {apart:g} m apart, where the longest rod has {longest:g} m; if it is in "
            f"millimetres, they are {apart / 1e3:g} m apart"
        )
    return ""
