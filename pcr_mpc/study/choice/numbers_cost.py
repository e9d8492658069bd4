"""What a robot's numbers are worth: how far the tip may be elsewhere on a motion because they are not known better."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...errors import PCRError
from ...loop.run.run import Run
from ...plant.motion.plant import Plant
from ...plant.motion.rollout import rollout
from ...plant.motion.sensitivities import sensitivities
from ...plant.robot import Robot
from ...plant.statics.held_tip import default_method
from ...plant.uncertainty import Uncertainty
from ..episodes.scatter import drawn, is_place, numbers_about
from ..identification.parameters import DEFAULT, catalogue, robot_with
from ..identification.result import belongs_to_robot

# Steps of RK4 in radians of the tip's fastest swing; robots that are sampled, and how many of them must get to the end.
_SWING, _SAMPLES, _ARRIVED = 0.2, 48, 0.5
# A difference below this share of what the numbers cost is not worth its time.
WORTH = 1.0 / 3.0


@dataclass(frozen=True)
class NumbersCost:
    """Standard deviation of the tip on a motion whose motor rates are given, where it is largest.

    Attributes
    ----------
    error : float
        To first order, by exact sensitivities [m].
    sampled : float
        By robots that were drawn and moved [m]; NaN where most of them lost their rods.
    by_number : dict of str to float
        Of each number alone, the others known [m].
    assumed : bool
        Whether the robot's file has no [uncertainty], so that default ranges stand for it.
    """

    error: float
    sampled: float
    by_number: dict[str, float]
    assumed: bool

    @property
    def least(self) -> float:
        """Error of a model that is fine enough: a finer one is not worth its time [m]."""
        return WORTH * self.error


def assumed_uncertainty(robot: Robot) -> Uncertainty:
    """How well a robot's numbers are known where nobody says: the default priors of `identify`, independent."""
    found = [
        one for one in catalogue(robot, 1, 0.0, 1.0)
        if belongs_to_robot(one.name) and _in_default(one.last) and (is_place(one.name) or one.value > 0.0)
    ]  # fmt: skip
    sd = np.array([one.sd * (one.value if one.positive else 1.0) for one in found])
    return Uncertainty(tuple(one.name for one in found), sd, np.eye(len(found)))


def numbers_cost(run: Run, fastest: float, known: Uncertainty | None, *, seed: int = 0) -> NumbersCost | None:
    """Move a run's robot by the same motor rates with other numbers.

    The start is held, and the rods' mass is left out. None where it cannot be told: the tip picks up a payload, or the
    rods do not follow.

    Parameters
    ----------
    run : Run
        On a plant whose motor rates are taken.
    fastest : float
        Swing of the tip [rad/s].
    known : Uncertainty or None
        Of the robot's numbers; None: as assumed.
    seed : int
        Of the samples.

    Raises
    ------
    ModelError
        The robot has no such numbers.
    """
    if run.scene.payload is not None:
        return None
    robot, per = run.scene.robot, run.steps_per_period
    uncertainty = known or assumed_uncertainty(robot)
    numbers_about(robot, uncertainty)
    parts = max(1, math.ceil(fastest * run.scene.period / _SWING))
    while per % parts:
        parts += 1
    steps = len(run.applied) // (per // parts) * (per // parts)
    rates = run.applied[:steps].reshape(-1, per // parts, robot.n_rods).mean(axis=1)
    plant = Plant(robot, method=default_method(robot), integrator="rk4", dt=run.scene.period / parts)
    start = run.x[0]
    try:
        found = sensitivities(plant, start, rates, run.scene.force, guess=run.pose)
    except PCRError:
        return None
    columns = [found.names.index(name) for name in uncertainty.names]
    slopes = found.dx_dnumbers[:, :2, columns]
    variance = np.einsum("tin,nm,tim->t", slopes, uncertainty.covariance, slopes)
    alone = {
        name: float(sd * np.linalg.norm(slopes[:, :, j], axis=1).max())
        for j, (name, sd) in enumerate(zip(uncertainty.names, uncertainty.sd.tolist(), strict=True))
    }
    sampled = _sampled(plant, run, rates, found.x[:, :2], uncertainty, seed)
    return NumbersCost(math.sqrt(float(variance.max())), sampled, alone, known is None)


def _sampled(plant: Plant, run: Run, rates: np.ndarray, tips: np.ndarray, known: Uncertainty, seed: int) -> float:
    robot, rng = plant.robot, np.random.default_rng(seed)
    squares = []
    for _ in range(_SAMPLES):
        other = robot_with(robot, drawn(robot, known, rng))
        try:
            moved = rollout(plant.of(other), run.x[0], rates, run.scene.force, guess=run.pose)
        except PCRError:
            continue
        squares.append(np.sum((moved.x[:, :2] - tips) ** 2, axis=1))
    if len(squares) < _ARRIVED * _SAMPLES:
        return math.nan
    return math.sqrt(float(np.mean(squares, axis=0).max()))


def _in_default(last: str) -> bool:
    return any(last == word or last.startswith(f"{word}_") for word in DEFAULT)
