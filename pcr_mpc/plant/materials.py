"""What rods are made of, and the shape of their cross-sections: from these follow EI, line density and strain."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass

from ..errors import ModelError, check_numbers

# Numbers outside of these are of another unit: solids are stiffer than gels, and lighter than thrice lead.
_SOFTEST, _STIFFEST = 1e4, 2e12  # [Pa]
_LIGHTEST, _HEAVIEST = 25.0, 4e4  # [kg/m^3]
_LARGEST_STRAIN = 0.2  # beyond it no slender rod is a beam


@dataclass(frozen=True)
class Material:
    """A linearly elastic material, as far as it is one.

    Attributes
    ----------
    name : str
    youngs_modulus : float
        E in bending along the rod [Pa].
    density : float
        [kg/m^3].
    strain_limit : float
        Strain up to which it is taken to be linear and to last [-].
    source : str
        Of the numbers.
    """

    name: str
    youngs_modulus: float
    density: float
    strain_limit: float
    source: str = ""

    def __post_init__(self) -> None:
        check_numbers(self, {name: {"above": 0.0} for name in ("youngs_modulus", "density", "strain_limit")})
        for name in ("youngs_modulus", "density", "strain_limit"):
            check_unit(name, getattr(self, name))


@dataclass(frozen=True)
class Section:
    """A cross-section, bent in the plane of the robot; make it by `round`, `tube` or `strip`.

    Attributes
    ----------
    area : float
        A [m^2].
    second_moment : float
        I about the neutral line [m^4].
    half_thickness : float
        Distance of the outermost fibre from the neutral line [m]: strain is curvature times it.
    """

    area: float
    second_moment: float
    half_thickness: float

    def __post_init__(self) -> None:
        check_numbers(self, {name: {"above": 0.0} for name in ("area", "second_moment", "half_thickness")})

    @classmethod
    def round(cls, diameter: float, inner_diameter: float = 0.0) -> Section:
        """Solid rod, or tube: A = pi (D^2 - d^2) / 4, I = pi (D^4 - d^4) / 64, lengths in m."""
        if not 0.0 <= inner_diameter < diameter:
            raise ModelError(
                f"inner_diameter is {inner_diameter:g} m, expected from 0 to less than the diameter {diameter:g} m",
                key="inner_diameter",
            )
        area, moment = math.pi * (diameter**2 - inner_diameter**2) / 4, math.pi * (diameter**4 - inner_diameter**4) / 64
        return cls(area, moment, diameter / 2)

    @classmethod
    def strip(cls, width: float, thickness: float) -> Section:
        """Rectangle that bends in the plane of its thickness: A = w t, I = w t^3 / 12, lengths in m."""
        return cls(width * thickness, width * thickness**3 / 12, thickness / 2)


def check_unit(name: str, value: float) -> None:
    """Raise `ModelError` where a number of a material can only be one of another unit."""
    if name == "youngs_modulus" and not _SOFTEST <= value <= _STIFFEST:
        advice = "is it in pascals? 206 GPa are 206e9"
    elif name == "density" and not _LIGHTEST <= value <= _HEAVIEST:
        advice = "is it in kg/m^3? 7.85 g/cm^3 are 7850"
    elif name in ("strain_limit", "strain") and value > _LARGEST_STRAIN:
        advice = "it is a ratio, not per cent: 1 % is 0.01"
    else:
        return
    raise ModelError(f"{name} is {value:g}: {advice}", key=name)


MATERIALS = {
    material.name: material
    for material in (
        Material(
            "spring_steel",
            youngs_modulus=206e9,
            density=7850.0,
            strain_limit=0.007,
            source="E and density: EN 10270-1 (patented cold-drawn spring wire). Limit: elastic limit of music wire of "
            "1.5 mm, 70 % of a strength of 2211 MPa / 1.5^0.145 = 2085 MPa (Shigley, Mechanical Engineering Design, "
            "tables 10-4 and 10-5), over E. Thicker wire is weaker",
        ),
        Material(
            "nitinol",
            youngs_modulus=75e9,
            density=6450.0,
            strain_limit=0.008,
            source="Superelastic Ni-Ti as austenite: E 75 GPa (83 GPa: SMA Inc., Selected Properties of NiTi; 48 GPa "
            "measured on fine wire: Advanced Materials & Processes, October 2019, p. 49), density 6.45 g/cm^3 (SMA "
            "Inc.). Limit: its upper plateau, 450 to 650 MPa with temperature and heat treatment (650 MPa: Fort Wayne "
            "Metals, R&D update, 2021), over E. The plateau begins near 1 %; up to 8 % the wire comes back, but is "
            "neither linear nor free of hysteresis, which no model here knows",
        ),
        Material(
            "nitinol_linear",
            youngs_modulus=35e9,
            density=6450.0,
            strain_limit=0.02,
            source="Ni-Ti cold-worked and not heat-treated, martensite without a plateau: E 28 to 41 GPa, density 6.45 "
            "g/cm^3 (SMA Inc., Selected Properties of NiTi). Limit: half of the 4 % up to which it is called linear "
            "(guide wires); measure E of the wire at hand",
        ),
        Material(
            "titanium",
            youngs_modulus=113.8e9,
            density=4430.0,
            strain_limit=0.0065,
            source="Ti-6Al-4V ELI, annealed: E 113.8 GPa, 4.43 g/cm^3, yield 790 MPa, 0.69 % over E (ASM, MatWeb "
            "MTP643; Fort Wayne Metals give 795 MPa for wire)",
        ),
        Material(
            "gfrp",
            youngs_modulus=41.4e9,
            density=2020.0,
            strain_limit=0.012,
            source="Pultruded E-glass rod: flexural modulus 6.0e6 psi, flexural strength 120 ksi (2.0 % over E), 0.073 "
            "lb/in^3 (Goodwinds, technical material specifications; Tencom: 20.6 to 41.4 GPa). Limit: 60 % of the "
            "strain at strength, for it creeps",
        ),
        Material(
            "cfrp",
            youngs_modulus=127e9,
            density=1500.0,
            strain_limit=0.0085,
            source="Pultruded carbon rod and strip, 60 % fibres: flexural modulus 127 GPa, flexural strength 1.37 GPa "
            "(1.08 % over E), density 1.5 g/cm^3 (Goodwinds, technical material specifications). Limit: strain at "
            "which unidirectional carbon fails in compression, 0.85 % (Performance Composites, mechanical properties "
            "of carbon fibre composite materials)",
        ),
        Material(
            "peek",
            youngs_modulus=4.0e9,
            density=1300.0,
            strain_limit=0.01,
            source="PEEK without filler: E 4.0 GPa, strength 97 MPa, 1.3 g/cm^3 (MakeItFrom; Victrex 450G). Limit: "
            "below half of its strength; it creeps",
        ),
    )
}

# What the names mean, and other words for it.
_MEANING = {
    "spring_steel": "steel wire and strip",
    "nitinol": "superelastic, Ni-Ti",
    "nitinol_linear": "cold-worked, NiTi without a plateau",
    "titanium": "Ti-6Al-4V",
    "gfrp": "glass fibre, fibreglass, fiberglass",
    "cfrp": "carbon fibre, carbon",
    "peek": "plastic",
}


def known_materials() -> str:
    """Names of all materials, each with what it means."""
    return ", ".join(f"{name} ({_MEANING[name].split(', ')[0]})" for name in MATERIALS)


def nearest_material(name: str) -> str | None:
    """Which one may be meant by a name that none has, by its letters or by another word for it."""
    words = {word: key for key, meaning in _MEANING.items() for word in (key, key.split("_")[-1], *meaning.split(", "))}
    asked = name.lower().replace("_", " ").replace("-", " ")
    near = difflib.get_close_matches(asked, words, n=1) or difflib.get_close_matches(name, MATERIALS, n=1)
    return words.get(near[0], near[0]) if near else None
