"""The default robot's tip let go in PyElastica, another code for rods; `mujoco_agreement` compares it.

PyElastica's rods stretch and shear, explicitly in time, so they get a thick section of soft, light matter with the
rods' bending stiffness and mass per length; the thinner, the stiffer and the slower. The clamp holds the middle of the
first element, so that is where the rod begins. The tip's mass and drag sit on the last nodes, shared by the rods, with
a stiff spring between them.
"""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any

import elastica
import numpy as np

from experiments.motion.rod_inertia import STEP, start
from pcr_mpc import Equilibrium, Robot, solve_statics
from pcr_mpc.plant.rods.equations import sample_rod

# Of the step, for waves that stretch an element and those that turn its section.
COURANT = 0.8
PIN_STIFFNESS = 1e6  # N/m
MOMENT = 1e-5  # of the difference that gives velocities [s]


class Simulator(elastica.BaseSystemCollection, elastica.Constraints, elastica.Connections, elastica.Forcing):  # type: ignore[misc]
    """PyElastica's parts that this needs."""


class TipDrag(elastica.NoForces):  # type: ignore[misc]
    """Viscous drag on the last node."""

    def __init__(self, drag: float) -> None:
        super().__init__()
        self.drag = drag

    def apply_forces(self, system: Any, time: float = 0.0) -> None:
        """Add the force."""
        system.external_forces[:, -1] -= self.drag * system.velocity_collection[:, -1]


def shapes(pose: Equilibrium, elements: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Nodes (elements + 1, 2) [m] of each rod and the angles (elements,) of its elements, in the shape of the pose."""
    found = []
    for rod, nodes, angle in zip(pose.robot.rods, pose.nodes, pose.q, strict=True):
        size = rod.length / (elements - 0.5)
        # Nodes at the middles of the pieces between the elements' middles, the first of which is the clamp.
        at = rod.base + rod.length * sample_rod(nodes, 2 * elements)[:2, 1::2].T
        at = np.vstack([at[0] - size * np.array([np.cos(angle), np.sin(angle)]), at])
        found.append((at, np.unwrap(np.arctan2(*np.diff(at, axis=0).T[::-1]))))
    return found


def build(robot: Robot, release: str, elements: int, radius: float) -> tuple[Simulator, list[Any], float]:
    """Simulator, its rods in the shape of the closed form and moving with the tip, and a stable step [s]."""
    pose, x = start(robot, release)
    ahead, behind = (
        shapes(solve_statics(robot, pose.p + sign * MOMENT * x[2:4], pose.q, guess=pose), elements)
        for sign in (0.5, -0.5)
    )
    simulator, rods, steps = Simulator(), [], []
    share = 1.0 / robot.n_rods
    for rod, (at, angles), after, before in zip(robot.rods, shapes(pose, elements), ahead, behind, strict=True):
        position = np.vstack([at.T, np.zeros(elements + 1)])
        directors = np.zeros((3, 3, elements))
        directors[0, 2] = 1.0
        directors[2, :2] = tangents = np.stack([np.cos(angles), np.sin(angles)])
        directors[1, :2] = tangents[1], -tangents[0]
        modulus = rod.bending_stiffness / (np.pi * radius**4 / 4)
        made = elastica.CosseratRod.straight_rod(
            elements, position[:, 0], directors[2, :, 0], directors[0, :, 0],
            rod.length * elements / (elements - 0.5), radius, rod.line_density / (np.pi * radius**2),
            youngs_modulus=modulus, position=position, directors=directors,
        )  # fmt: skip
        made.mass[-1] += share * robot.tip_mass
        made.velocity_collection[:2] = (after[0] - before[0]).T / MOMENT
        made.omega_collection[0] = (after[1] - before[1]) / MOMENT
        simulator.append(made)
        simulator.constrain(made).using(
            elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
        )
        simulator.add_forcing_to(made).using(TipDrag, drag=share * robot.drag)
        rods.append(made)
        speed = np.sqrt(modulus * np.pi * radius**2 / rod.line_density)
        steps.append(COURANT * min(rod.length / elements / 2, radius) / speed)
    for one, other in pairwise(rods):
        simulator.connect(one, other, first_connect_idx=-1, second_connect_idx=-1).using(
            elastica.FreeJoint, k=PIN_STIFFNESS, nu=0.0
        )
    simulator.finalize()
    return simulator, rods, min(steps)


def release_tip(robot: Robot, release: str, elements: int, radius: float, duration: float) -> tuple[np.ndarray, float]:
    """Tips at every millisecond [m], and wall time [s] without compilation."""
    simulator, rods, dt = build(robot, release, elements, radius)
    every = int(np.ceil(STEP / dt))
    stepper, now, dt = elastica.PositionVerlet(), 0.0, STEP / every

    def tip() -> np.ndarray:
        return np.asarray(np.mean([rod.position_collection[:2, -1] for rod in rods], axis=0))

    tips, began = [tip()], time.perf_counter()
    for _ in range(round(duration / STEP)):
        for _ in range(every):
            now = stepper.step(simulator, now, dt)
        tips.append(tip())
    return np.array(tips), time.perf_counter() - began
