"""The robot as data: rods, motors, and the mass at the joint."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ..errors import ModelError, UnreachableError
from ..frozen import read_only
from ..toml_table import read_toml


@dataclass(frozen=True)
class Rod:
    """A uniform, inextensible, naturally straight elastic rod clamped to its motor.

    Attributes
    ----------
    base : (float, float)
        Motor axis in the world frame [m].
    length : float
        Length L [m].
    bending_stiffness : float
        EI [N m^2].
    line_density : float
        Mass per length [kg/m]; the massless model of the paper does not use it.
    angle_limits : (float, float)
        Least and greatest motor angle [rad].
    """

    base: tuple[float, float]
    length: float
    bending_stiffness: float
    line_density: float
    angle_limits: tuple[float, float]


@dataclass(frozen=True)
class Robot:
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
    """

    name: str
    rods: tuple[Rod, ...]
    tip_mass: float
    drag: float
    rate_limit: float
    acceleration_limit: float
    torque_limit: float

    def __post_init__(self) -> None:
        bases = [rod.base for rod in self.rods]
        if len(self.rods) < 2 or len(set(bases)) < len(bases):
            raise ModelError(f"{self.name}: needs two or more rods at different bases, found {bases}", bases=bases)

    @property
    def n_rods(self) -> int:
        """Number of rods, equal to the number of motors."""
        return len(self.rods)

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
    def angle_limits(self) -> np.ndarray:
        """Least and greatest motor angles, shape (n, 2) [rad]."""
        return read_only(np.array([rod.angle_limits for rod in self.rods]))

    def require_reachable(self, p: np.ndarray) -> None:
        """Raise `UnreachableError` if some rod cannot reach ``p``, shape (2,) [m]."""
        for i, rod in enumerate(self.rods):
            distance = float(np.hypot(p[0] - rod.base[0], p[1] - rod.base[1]))
            if distance >= rod.length:
                raise UnreachableError(
                    f"tip ({p[0]:.6g}, {p[1]:.6g}) m is {distance:.6g} m from the base of rod {i}, whose length "
                    f"is {rod.length:.6g} m; move the tip at least {distance - rod.length:.3g} m closer",
                    rod=i,
                    distance=distance,
                    length=rod.length,
                )


def load_robot(path: str | Path) -> Robot:
    """Read a robot from TOML (see ``models/planar_pair.toml``).

    Raises
    ------
    ModelError
        A key is missing, misspelt, of the wrong type or out of range.
    """
    with read_toml(path) as file:
        name = file.text("name")
        rods = []
        for table in file.tables("rods"):
            with table:
                rods.append(
                    Rod(
                        base=table.vector("base", 2),
                        length=table.number("length", above=0.0),
                        bending_stiffness=table.number("bending_stiffness", above=0.0),
                        line_density=table.number("line_density", minimum=0.0),
                        angle_limits=table.vector("angle_limits", 2),
                    )
                )
                lower, upper = rods[-1].angle_limits
                if lower >= upper:
                    raise table.fail("angle_limits", f"lower {lower} is not below upper {upper}")
        with file.table("tip") as tip, file.table("motors") as motors:
            return Robot(
                name=name,
                rods=tuple(rods),
                tip_mass=tip.number("mass", above=0.0),
                drag=tip.number("drag", minimum=0.0),
                rate_limit=motors.number("rate_limit", above=0.0),
                acceleration_limit=motors.number("acceleration_limit", above=0.0),
                torque_limit=motors.number("torque_limit", above=0.0),
            )
