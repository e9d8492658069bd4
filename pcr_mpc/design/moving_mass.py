"""What moves with the tip: its own mass, and the share of the rods."""

from __future__ import annotations

import numpy as np

from ..plant.motion.mass_matrix import CondensedMass
from ..plant.motion.plant import Plant
from ..plant.rods.method import closed_form_method
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.state import columns


def moving_mass(eq: Equilibrium) -> tuple[np.ndarray, float]:
    """Mass that moves with the tip, shape (2, 2) [kg], and the largest share of the rods in it."""
    robot = eq.robot
    if not any(rod.line_density for rod in robot.rods):
        return robot.tip_mass * np.eye(2), 0.0
    if eq.record is not None and eq.method == "closed_form":
        mass = CondensedMass(robot, closed_form_method())(columns(eq.record, robot.n_rods).unknowns, eq.q)[0][:2, :2]
    else:
        plant = Plant(robot, inertia="condensed")
        plant.reset(np.concatenate([eq.p, np.zeros(2), eq.q]), eq)
        mass = plant.mass(eq.p, eq.q)[0][:2, :2]
    largest = float(np.linalg.eigvalsh(mass)[-1])
    return mass, 1.0 - robot.tip_mass / largest
