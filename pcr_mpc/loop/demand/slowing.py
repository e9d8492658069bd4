"""How much slower a reference must be for the motors to keep up with it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...errors import PCRError
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ..references.trajectory import sampled
from ..scene.scene import Scene
from .feed_forward import InverseDynamics, poses_along

# Slower by up to so much, in such steps, to such a fraction.
_SLOWEST, _STEP, _RESOLUTION = 64.0, 1.25, 1e-3
# What is found is made larger by a hundredth: sampled at other places, peaks differ.
_MARGIN = 1.01
_LESS, _MOST_SOLUTIONS = 0.98, 8  # what is so much less is tried, too
KINDS = ("rate", "change of rate", "torque")


@dataclass(frozen=True, eq=False)
class Slowed:
    """A reference at any fraction of its speed.

    What accelerates the tip goes with the square of the speed, drag in proportion, and what the rods carry at rest
    stays. Angles and torques go with these forces to first order about the speed for which they are solved.

    Attributes
    ----------
    scene : Scene
        With the reference at full speed.
    drag, inertial : ndarray, shape (K, 2)
        Forces at full speed [N].
    solved : float
        How many times as slow as at full speed the rest is, in each of its periods.
    angles, torques : ndarray, shape (K, n)
        [rad], [N m].
    angles_per_force, torques_per_force : ndarray, shape (K, n, 2)
    """

    scene: Scene
    drag: np.ndarray
    inertial: np.ndarray
    solved: float
    angles: np.ndarray
    torques: np.ndarray
    angles_per_force: np.ndarray
    torques_per_force: np.ndarray

    @classmethod
    def of(cls, scene: Scene, robot: Robot, reference: InverseDynamics) -> Slowed:
        """The reference of a scene, whose inverse dynamics are known for a robot."""
        kept = slice(scene.n_periods + 1)
        states, forces = reference.states[kept], reference.forces[kept]
        carried = scene.carried(scene.period * np.arange(len(states)))
        resting = carried[:, None] * np.array(robot.gravity)
        drag = -robot.drag * states[:, 2:4]
        return cls(
            scene, drag, forces - resting - drag, 1.0, states[:, 4:], reference.torques[kept],
            reference.angles_per_force[kept], reference.torques_per_force[kept],
        )  # fmt: skip

    def motors(self, slower: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rates [rad/s], changes of rate [rad/s^2] and torques [N m] where all takes ``slower`` times as long."""
        more = (1 / slower**2 - 1 / self.solved**2) * self.inertial + (1 / slower - 1 / self.solved) * self.drag
        angles = self.angles + np.einsum("kij,kj->ki", self.angles_per_force, more)
        torques = self.torques + np.einsum("kij,kj->ki", self.torques_per_force, more + np.array(self.scene.force))
        step = slower / self.solved * self.scene.period
        rates = np.diff(angles, axis=0) / step
        # A first rate that is there at once is a jump, within a period however slow the rest is.
        changes = np.concatenate([rates[:1] / self.scene.period, np.diff(rates, axis=0) / step])
        return rates, changes, torques

    def solved_for(self, robot: Robot, pose: Equilibrium, slower: float) -> Slowed:
        """Solve for the poses at that speed, of tips whose rods have no mass.

        Raises
        ------
        PCRError
            The rods cannot follow.
        """
        scene = self.scene
        assert scene.trajectory is not None
        own = scene.period / slower * np.arange(math.ceil(slower * scene.n_periods) + 1)
        p, v, a = np.moveaxis(sampled(scene.trajectory, own), 1, 0)
        carried = scene.carried(own)[:, None]
        drag, inertial = -robot.drag * v, -(robot.tip_mass + carried) * a
        resting = carried * np.array(robot.gravity)
        forces = resting + inertial / slower**2 + drag / slower
        poses = poses_along(robot, pose, slower * own, p, forces, resting, a / slower**2)
        levers = np.linalg.pinv(poses.dforce_dq)
        return Slowed(
            scene, drag, inertial, slower, poses.q, poses.motor_torque, levers,
            poses.dtorque_dq[:, :, None] * levers,
        )  # fmt: skip

    def factor(self, kind: int, limit: float) -> float:
        """From what on a limit is kept, to first order; infinite if slower does not help."""

        def broken(slower: float) -> bool:
            return bool(np.abs(self.motors(slower)[kind]).max() > limit)

        steps = _STEP ** np.arange(math.ceil(math.log(_SLOWEST, _STEP)) + 1)
        kept = 1 + max((i for i, slower in enumerate(steps) if broken(slower)), default=-1)
        if kept in (0, len(steps)):
            return math.inf if kept else 1.0
        low, high = float(steps[kept - 1]), float(steps[kept])
        while high - low > _RESOLUTION * low:
            middle = (low + high) / 2
            low, high = (middle, high) if broken(middle) else (low, middle)
        return high


def advice(slowed: Slowed, kind: int, limit: float, robot: Robot, pose: Equilibrium | None) -> str:
    """By how much slower the reference keeps a limit of the motors.

    Parameters
    ----------
    slowed : Slowed
    kind : int
        Of the limit, in `KINDS`.
    limit : float
    robot : Robot
        That it is solved for.
    pose : Equilibrium or None
        In which the reference starts: the answer is solved for, not estimated. None: it is estimated to first order.
    """
    stated = _stated(slowed.factor(kind, limit))
    if pose is not None and math.isfinite(stated):
        stated = _tried(slowed, kind, limit, robot, pose, stated)
    if math.isinf(stated):
        at_rest = f": at rest it takes {np.abs(slowed.motors(math.inf)[kind]).max():.4g} N m" if kind == 2 else ""
        return f"slower does not help{at_rest}"
    about = "about " if pose is None else ""
    # What is between the periods is not seen: a spike there shows in the periods of another time_scale.
    return f"made {about}{stated:g} times as slow (time_scale) it does not, at the control periods"


def _tried(slowed: Slowed, kind: int, limit: float, robot: Robot, pose: Equilibrium, stated: float) -> float:
    """A factor that is known to do, and hardly larger than it must be."""
    broken, kept = 1.0, math.inf
    for _ in range(_MOST_SOLUTIONS):
        try:
            slowed = slowed.solved_for(robot, pose, stated)
        except PCRError:
            broken, stated = stated, _STEP * stated
            continue
        following = _stated(slowed.factor(kind, limit))
        if np.abs(slowed.motors(stated)[kind]).max() > limit:
            broken = stated
            following = max(following, _stated(stated))
        else:
            kept = stated
        if not broken < following < _LESS * kept:
            break
        stated = following
    return kept


def _stated(factor: float) -> float:
    """A little more, in hundredths."""
    return math.ceil(100 * _MARGIN * factor) / 100 if math.isfinite(factor) else factor
