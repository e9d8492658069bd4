"""What somebody wants of a robot."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from ..errors import ModelError, check_numbers
from ..files import name_problem
from ..plant.materials import MATERIALS, Material, Section, known_materials, nearest_material
from ..plant.robot import Robot
from ..plant.rod import Rod
from .layout import Layout
from .motors import Motor

LEAST_MASS = 6.0  # of the tip that is chosen, in rods: what light rods are
_MOST_RODS = 4
_THREAD = 2e4  # length over thickness from which a rod is a thread, or its length in millimetres
_SLENDER = 50.0  # length over diameter from which a rod is a beam that bends and does nothing else


@dataclass(frozen=True)
class Wish:
    """What is known of a robot that is to be; None for what is to be chosen.

    Attributes
    ----------
    name : str
    rods : int
        2 to 4.
    material : str
        A key of `MATERIALS`.
    diameter, length : float
        Of the rods [m]; a strip has no diameter.
    width, thickness : float or None
        Of rods that are strips, which bend in the plane of their thickness [m]; both or neither.
    spacing : float or None
        Between neighbouring motors [m].
    tip_mass : float or None
        [kg].
    motor : str or None
        A key of `MOTORS`.
    """

    name: str
    rods: int = 2
    material: str = "nitinol"
    diameter: float = 1e-3
    length: float = 0.5
    spacing: float | None = None
    tip_mass: float | None = None
    motor: str | None = None
    width: float | None = None
    thickness: float | None = None

    def __post_init__(self) -> None:
        if problem := name_problem(self.name):
            raise ModelError(f"name: {problem}", key="name")
        if not 2 <= self.rods <= _MOST_RODS:
            raise ModelError(f"rods is {self.rods}, expected 2 to {_MOST_RODS}", key="rods")
        given = [key for key in ("spacing", "tip_mass", "width", "thickness") if getattr(self, key) is not None]
        check_numbers(self, {key: {"above": 0.0} for key in ("diameter", "length", *given)})
        if self.material not in MATERIALS:
            near = nearest_material(self.material)
            hint = f"did you mean {near}? " if near else ""
            known = known_materials()
            raise ModelError(f"material {self.material!r} is not known; {hint}known are {known}", key="material")
        if (self.width is None) != (self.thickness is None):
            missing = "width" if self.width is None else "thickness"
            raise ModelError(f"{missing} is missing: a strip has a width and a thickness", key=missing)
        if self.width is not None and self.width < self.thick:
            raise ModelError(
                f"width is {length_text(self.width)}, less than the thickness, {length_text(self.thick)}, across which "
                "a strip bends; exchange them",
                key="width",
            )
        if self.length < _SLENDER * self.thick:
            raise ModelError(
                f"rods {length_text(self.length)} long and {length_text(self.thick)} thick are no slender rods: "
                f"they are to be at least {_SLENDER:g} {'diameters' if self.width is None else 'times as'} long, "
                f"{length_text(_SLENDER * self.thick)}. Numbers are in metres",
                key="length",
            )
        if self.length > _THREAD * self.thick:
            raise ModelError(
                f"rods {length_text(self.length)} long and {length_text(self.thick)} thick are threads, "
                f"{self.length / self.thick:.2g} times as long as thick, and at most {_THREAD:g} times is expected. "
                "Numbers are in metres: 500 mm are 0.5",
                key="length",
            )

    @property
    def across(self) -> str:
        """Which of its numbers says how thick a rod is."""
        return "diameter" if self.thickness is None else "thickness"

    @property
    def thick(self) -> float:
        """In the plane of the robot [m]."""
        return self.diameter if self.thickness is None else self.thickness

    @property
    def stuff(self) -> Material:
        """What the rods are made of."""
        return MATERIALS[self.material]

    @property
    def section(self) -> Section:
        """Of the rods."""
        if self.width is None or self.thickness is None:
            return Section.round(self.diameter)
        return Section.strip(self.width, self.thickness)

    @property
    def upright(self) -> float:
        """How many times stiffer the rods are out of the plane of the robot than in it."""
        return 1.0 if self.width is None or self.thickness is None else (self.width / self.thickness) ** 2

    def robot(self, layout: Layout, motor: Motor, tip_mass: float = 1.0, drag: float = 0.0) -> Robot:
        """Robot of these rods."""
        material, section = self.stuff, self.section
        rods = tuple(
            Rod(
                base=base,
                length=self.length,
                bending_stiffness=material.youngs_modulus * section.second_moment,
                line_density=material.density * section.area,
                angle_limits=stops,
                thickness_ratio=section.half_thickness / self.length,
                strain_limit=material.strain_limit,
            )
            for base, stops in zip(layout.bases, layout.angle_limits, strict=True)
        )
        limits = motor.rate_limit, motor.acceleration_limit, motor.torque_limit
        return Robot(self.name, rods, tip_mass, drag, *limits)


def rounded(value: float, *, up: bool = False, down: bool = False) -> float:
    """Round to two digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    turn: Callable[[float], float] = (
        (lambda x: math.ceil(x - 1e-9)) if up else (lambda x: math.floor(x + 1e-9)) if down else round
    )
    return float(f"{turn(value / unit) * unit:.6g}")


def length_text(length: float) -> str:
    """Write a length in mm or m."""
    return f"{1e3 * length:.3g} mm" if length < 1.0 else f"{length:.3g} m"
