"""What moves with the tip: its own mass, and the share of the rods."""

from __future__ import annotations

import numpy as np

from ..plant.motion.plant import Plant
from ..plant.statics.equilibrium import Equilibrium


def moving_mass(eq: Equilibrium) -> tuple[np.ndarray, float]:
    """Mass that moves with the tip, shape (2, 2) [kg], and the largest share of the rods in it."""
    robot = eq.robot
    tip = robot.tip_mass * np.eye(2)
    if not any(rod.line_density for rod in robot.rods):
        return tip, 0.0
    plant = Plant(robot, inertia="condensed")
    plant.reset(np.concatenate([eq.p, np.zeros(2), eq.q]), eq)
    mass = plant.mass(eq.p, eq.q)[0][:2, :2]
    largest = float(np.linalg.eigvalsh(mass)[-1])
    return mass, 1.0 - robot.tip_mass / largest
