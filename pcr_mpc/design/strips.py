"""How much stiffer rods are out of the plane, which a robot does not know and its file may say."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..plant.robot import Robot
from ..toml_table import Table, read_toml


def stiffer_upright(robot: Robot, file: Path) -> float | None:
    """Times by which the rods of a robot are stiffer out of the plane than in it, by the sections that its file states.

    Of a strip it is the square of width over thickness, of a round rod or a tube one; the tip is held by all rods.

    Returns
    -------
    float or None
        None where the file states no section of some rod.
    """
    ratios = [_of_section(rod) for rod in read_toml(file).tables("rods")]
    if None in ratios:
        return None
    holds = robot.stiffnesses / robot.lengths**3
    return float(holds @ np.array(ratios, dtype=float) / holds.sum())


def _of_section(rod: Table) -> float | None:
    if rod.has("width") and rod.has("thickness"):
        return (rod.number("width") / rod.number("thickness")) ** 2
    return 1.0 if rod.has("diameter") else None
