"""Where the motors must end up: the reference's angles, moved to carry the force that is observed."""

from __future__ import annotations

from operator import mul

import numpy as np

from ...errors import PCRError
from ...frozen import Remade
from ...plant.motion.plant import Plant
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium

_LARGEST_STEP = 0.1  # rad
_ROUGH = 1e-2
_SINGULAR = 1e-9  # det(G G') relative to its diagonal, below which the motors have lost a direction


class MotorTarget(Remade):
    """Shift of the motor angles at which the model's rods carry a given force and the tip's weight, by Newton's method.

    One iteration a call: the tip and the force change little from one control period to the next, and where they do not
    change it converges. This is what makes the controller free of offset under a constant load.

    Parameters
    ----------
    robot : Robot
        As the controller believes it to be.
    """

    def __init__(self, robot: Robot) -> None:
        self._plant = Plant(robot)
        self._shift = np.zeros(robot.n_rods)

    def start(self, pose: Equilibrium) -> None:
        """Begin at a pose on the branch of the reference, without a force."""
        self._plant.reset(np.concatenate([pose.p, [0.0, 0.0], pose.q]), pose)
        self._shift = np.zeros(len(pose.q))

    def angles(self, p: np.ndarray, q: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Angles q, moved so that F = force at p (see `shift`)."""
        return np.asarray(q + self.shift(p, q, force))

    def shift(self, p: np.ndarray, q: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Angles to add to q so that F = force at p; the last ones where the rods cannot follow."""
        try:
            found, _, g = self._plant.force_and_jacobians(p, q + self._shift, _ROUGH)
        except PCRError:
            return self._shift
        # The least motion: G'(G G')^-1, two by two however many motors there are.
        first, second = g.tolist()
        a, b, d = (sum(map(mul, one, other)) for one, other in ((first, first), (first, second), (second, second)))
        determinant = a * d - b * b
        if determinant < _SINGULAR * a * d:
            return self._shift
        x, y = (force + self._plant.tip_weight - found).tolist()
        along, across = (d * x - b * y) / determinant, (a * y - b * x) / determinant
        step = [along * one + across * other for one, other in zip(first, second, strict=True)]
        largest = max(map(abs, step))
        self._shift = self._shift + (1.0 if largest <= _LARGEST_STEP else _LARGEST_STEP / largest) * np.array(step)
        return self._shift
