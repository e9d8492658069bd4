"""A rod as data, by its numbers or by its material and cross-section."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import ModelError, check_numbers, checked_number, checked_vector
from ..toml_table import Table
from .materials import MATERIALS, Material, Section, check_unit, known_materials, nearest_material

# SI units; wide enough for DNA and for bridges, and no product of a few such numbers overflows.
POSITIVE = {"minimum": 1e-30, "maximum": 1e30}
NOT_NEGATIVE = {"minimum": 0.0, "maximum": 1e30}
ROD_NUMBERS = {"length": POSITIVE, "bending_stiffness": POSITIVE, "line_density": NOT_NEGATIVE}
MOST_CURVED = 1e30  # at rest, either way [1/m]
# Of EI along a rod, relative to EI.
STIFFNESS_RANGE = (1e-3, 1e3)
_MOST_KNOTS = 65  # of a property along a rod
# Angles beyond four turns are rather degrees [rad].
MANY_TURNS = 8.0 * math.pi
# Thickness over length from which a rod is not slender, and its thickness rather in millimetres.
_STOUT = 0.2
# EI or line density may be stated beside a section that gives another one by this much: sections have tolerances.
_AGREEMENT = 0.02
_SECTION = ("diameter", "inner_diameter", "width", "thickness")
_RUBBER = 1e7  # [Pa]; softer is rather a number of megapascals


@dataclass(frozen=True)
class Rod:
    """An elastic rod clamped to its motor; uniform, inextensible and straight at rest unless it says otherwise.

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
        Least and greatest motor angle [rad]; refused where they hold no angle within four turns of zero.
    curvature : float or tuple of float
        kappa0 at rest [1/m], positive to the left: one number, or values at equally spaced s from base to tip, linear
        in between.
    stiffness_factors : tuple of float
        EI(s)/EI, likewise.
    axial_stiffness : float
        EA [N]; infinite for a rod that does not stretch.
    thickness_ratio : float or None
        Distance of the outermost fibre from the neutral line over the length [-], the same all along the rod; its
        strain is ``|kappa - kappa0| L`` times that. None: not known, and no strain is. A ratio, so that a rod that is
        made longer or shorter keeps its proportions.
    strain_limit : float
        Largest strain that the material bears [-]; infinite if it is not known.
    """

    base: tuple[float, float]
    length: float
    bending_stiffness: float
    line_density: float
    angle_limits: tuple[float, float]
    curvature: float | tuple[float, ...] = 0.0
    stiffness_factors: tuple[float, ...] = (1.0,)
    axial_stiffness: float = math.inf
    thickness_ratio: float | None = None
    strain_limit: float = math.inf

    def __post_init__(self) -> None:
        check_numbers(self, ROD_NUMBERS)
        lowest, highest = STIFFNESS_RANGE
        _check_profile(self, "curvature", minimum=-MOST_CURVED, maximum=MOST_CURVED)
        _check_profile(self, "stiffness_factors", minimum=lowest, maximum=highest)
        if self.axial_stiffness != math.inf:
            check_numbers(self, {"axial_stiffness": POSITIVE})
        self._check_strain()
        for name in ("base", "angle_limits"):
            pair = checked_vector(name, getattr(self, name), 2)
            object.__setattr__(self, name, tuple(pair.tolist()))
        lower, upper = self.angle_limits
        if lower >= upper:
            raise ModelError(f"angle_limits: lower {lower} is not below upper {upper}", key="angle_limits")
        if lower > MANY_TURNS or upper < -MANY_TURNS:
            raise ModelError(
                f"angle_limits: {doubtful_limits(self)}; take off the whole turns, or write radians",
                key="angle_limits",
            )

    def _check_strain(self) -> None:
        if self.thickness_ratio is not None:
            check_numbers(self, {"thickness_ratio": POSITIVE})
            if 2.0 * self.thickness_ratio > _STOUT:
                thickness = 2.0 * self.thickness_ratio * self.length
                raise ModelError(_stout(thickness, self.length), key="thickness_ratio")
        if self.strain_limit != math.inf:
            check_numbers(self, {"strain_limit": {"above": 0.0}})
            check_unit("strain_limit", self.strain_limit)
            if self.thickness_ratio is None:
                raise ModelError(
                    "strain_limit: without the thickness of the rod no strain is known; state its section too",
                    key="strain_limit",
                )

    @classmethod
    def made_of(cls, material: Material, section: Section, **others: Any) -> Rod:
        """Rod of a material and a cross-section: EI = E I, line density = rho A; ``others`` as of a `Rod`."""
        own = {
            "bending_stiffness": material.youngs_modulus * section.second_moment,
            "line_density": material.density * section.area,
            "strain_limit": material.strain_limit,
        }
        length = checked_number("length", others.get("length"), **POSITIVE)
        return cls(**own | {"thickness_ratio": section.half_thickness / length} | others)

    @property
    def half_thickness(self) -> float | None:
        """Distance of the outermost fibre from the neutral line [m]; None if it is not known."""
        return None if self.thickness_ratio is None else self.thickness_ratio * self.length

    @property
    def curvatures(self) -> tuple[float, ...]:
        """kappa0 at its knots [1/m]."""
        return self.curvature if isinstance(self.curvature, tuple) else (self.curvature,)

    @property
    def stretches(self) -> bool:
        """Whether EA is finite."""
        return self.axial_stiffness != math.inf


def doubtful_limits(rod: Rod) -> str:
    """Say of motor angles many turns from zero what they would be as degrees."""
    low, high = rod.angle_limits
    degrees = [math.radians(angle) for angle in rod.angle_limits]
    return (
        f"[{low:g}, {high:g}] rad reach {max(-low, high) / (2 * math.pi):.3g} turns from zero; if these are degrees, "
        f"they are [{degrees[0]:.4g}, {degrees[1]:.4g}] rad"
    )


def _stout(thickness: float, length: float) -> str:
    return (
        f"the rod is {thickness:g} m thick and {length:g} m long, which is no slender rod; is the thickness in metres? "
        "1.5 mm are 0.0015"
    )


def _check_profile(rod: Rod, key: str, *, minimum: float, maximum: float) -> None:
    """Replace a property along the rod by a tuple of floats, or by a float if it is one number."""
    value = getattr(rod, key)
    try:
        if isinstance(value, tuple | list | np.ndarray):
            values = tuple(checked_number(key, v, minimum=minimum, maximum=maximum) for v in value)
            if not values or len(values) > _MOST_KNOTS:
                raise ValueError(f"{key}: expected 1 to {_MOST_KNOTS} numbers, found {len(values)}")
            object.__setattr__(rod, key, values)
        else:
            number = checked_number(key, value, minimum=minimum, maximum=maximum)
            object.__setattr__(rod, key, number if key == "curvature" else (number,))
    except ValueError as error:
        raise ModelError(str(error), key=key) from None


def read_rod(table: Table) -> Rod:
    """Take the keys of a ``[[rods]]`` table (see ``docs/robots.md``).

    EI and line density are stated, or follow from material and section, or both, and then they must agree.

    Raises
    ------
    ModelError
        A key is missing, of the wrong type, out of range or of another unit, or two of them contradict each other.
    """
    base, length = table.vector("base", 2), table.number("length", **POSITIVE)
    material = _read_material(table)
    section = _read_section(table, length)
    if section is None:
        table.refuse_misspelt(*_SECTION)
    if section is None and (given := [name for name, value in material.items() if value is not None]):
        raise table.fail(
            given[0],
            "says nothing without the rod's section; state diameter (of a tube inner_diameter too), or width and "
            "thickness",
        )
    second_moment, area, half_thickness = (
        (section.second_moment, section.area, section.half_thickness) if section else (None, None, None)
    )
    numbers = {
        "bending_stiffness": _product(material["youngs_modulus"], second_moment),
        "line_density": _product(material["density"], area),
    }
    return Rod(
        base=base,
        length=length,
        bending_stiffness=_stated(table, "bending_stiffness", numbers["bending_stiffness"], "youngs_modulus"),
        line_density=_stated(table, "line_density", numbers["line_density"], "density"),
        angle_limits=table.vector("angle_limits", 2),
        curvature=table.profile("curvature", 0.0),
        stiffness_factors=table.profile("stiffness_factors", (1.0,)),
        axial_stiffness=table.number("axial_stiffness", math.inf),
        thickness_ratio=None if half_thickness is None else half_thickness / length,
        strain_limit=material["strain_limit"] or math.inf,
    )


def _product(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else one * other


def _read_material(table: Table) -> dict[str, float | None]:
    """E, density and strain limit as stated, or of the material that is named; None where neither says."""
    name = table.text("material", "")
    if name and name not in MATERIALS:
        near = nearest_material(name)
        hint = f"did you mean {near!r}? " if near else ""
        raise table.fail(
            "material",
            f"{name!r} is not known; {hint}known are {known_materials()}; of another, state youngs_modulus [Pa], "
            "density [kg/m^3] and strain_limit",
        )
    found: dict[str, float | None] = {}
    for key in ("youngs_modulus", "density", "strain_limit"):
        found[key] = getattr(MATERIALS[name], key) if name else None
        if table.has(key):
            found[key] = number = table.number(key, above=0.0)
            check_unit(key, number)
    modulus = found["youngs_modulus"]
    if modulus is not None and modulus < _RUBBER:
        warnings.warn(
            f"{table.path}: {table.name}youngs_modulus is {modulus:g} Pa, as soft as rubber; if it was meant in MPa, "
            f"it is {modulus * 1e6:g} Pa",
            stacklevel=2,
        )
    return found


def _stated(table: Table, key: str, product: float | None, factor: str) -> float:
    """EI or line density as stated, or as the section gives it; both must agree."""
    if product is None:
        try:
            return table.number(key)
        except ModelError as error:
            if error.details.get("nearest") or table.has(key):
                raise
            raise table.fail(
                key,
                f"missing; state it, or {factor} (or a material) and the section (diameter, or width and thickness)",
            ) from None
    if not table.has(key):
        return product
    stated = table.number(key)
    if not abs(stated - product) <= _AGREEMENT * product:
        raise table.fail(
            key,
            f"is {stated:g}, but {factor} and section make it {product:.4g}; leave one of them out, or correct it "
            f"(a difference of {100 * _AGREEMENT:g} % is let pass, for sections have tolerances)",
            stated=stated,
            product=product,
        )
    return stated


def _read_section(table: Table, length: float) -> Section | None:
    """Round, tube or strip by the keys that are there; None if there are none."""
    found = {name: table.number(name, above=0.0, **POSITIVE) for name in _SECTION if table.has(name)}
    if not found:
        return None
    if set(found) not in ({"diameter"}, {"diameter", "inner_diameter"}, {"width", "thickness"}):
        table.refuse_misspelt(*(name for name in _SECTION if name not in found))
        raise table.fail(
            next(iter(found)),
            f"found {', '.join(found)}; a section is a diameter, diameter and inner_diameter, or width and thickness",
        )
    across = "diameter" if "diameter" in found else "thickness"
    if found[across] > _STOUT * length:
        raise table.fail(across, _stout(found[across], length))
    return Section.round(**found) if across == "diameter" else Section.strip(**found)
