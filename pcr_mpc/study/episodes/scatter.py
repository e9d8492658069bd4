"""A robot's numbers as they may be: drawn from how well they are known."""

from __future__ import annotations

import math
import re

import numpy as np

from ...errors import ModelError
from ...plant.robot import Robot
from ...plant.uncertainty import Uncertainty

_OF_ROD = ("bending_stiffness", "length", "base_x", "base_y", "line_density")
_OF_ROBOT = ("tip_mass", "drag")


def numbers_about(robot: Robot, known: Uncertainty) -> dict[str, float]:
    """Values of a robot's numbers by the names of an uncertainty.

    Raises
    ------
    ModelError
        The robot has no such number, or has it at zero.
    """
    found: dict[str, float] = {}
    for name in known.names:
        of_rod = re.fullmatch(r"rods\[(\d+)\]\.(\w+)", name)
        if of_rod and of_rod[2] in _OF_ROD and int(of_rod[1]) < robot.n_rods:
            rod = robot.rods[int(of_rod[1])]
            base = {"base_x": rod.base[0], "base_y": rod.base[1]}
            found[name] = base[of_rod[2]] if of_rod[2] in base else float(getattr(rod, of_rod[2]))
        elif name in _OF_ROBOT:
            found[name] = float(getattr(robot, name))
        else:
            names = ", ".join([f"rods[i].{one}" for one in _OF_ROD] + list(_OF_ROBOT))
            raise ModelError(
                f"uncertainty names {name!r}, which {robot.name} with {robot.n_rods} rods has not; it has {names}",
                key="names",
            )
        if not is_place(name) and not found[name] > 0.0:
            raise ModelError(
                f"uncertainty names {name!r}, which {robot.name} has at {found[name]:g}: nothing is a part of that; "
                "give it a value, or leave it out of the table",
                key="names",
            )
    return found


def drawn(robot: Robot, known: Uncertainty, rng: np.random.Generator) -> dict[str, float]:
    """Draw numbers of a robot, by their names; positive ones in their logarithm, as `identify` has them.

    Raises
    ------
    ModelError
        As `numbers_about`.
    """
    values, vectors = np.linalg.eigh(known.correlation)
    standard = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(known.names)))
    return {
        name: value + sd * z if is_place(name) else value * math.exp(sd / value * z)
        for (name, value), sd, z in zip(
            numbers_about(robot, known).items(), known.sd.tolist(), standard.tolist(), strict=True
        )
    }


def is_place(name: str) -> bool:
    """Whether a number is a coordinate, which may have any sign."""
    return name.endswith(("base_x", "base_y"))
