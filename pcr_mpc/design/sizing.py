"""A robot, a path and a controller that go together, from a few numbers of the rods."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..errors import InfeasibleError
from ..plant.motion.plant import Plant
from ..plant.robot import Robot
from ..plant.statics.equilibrium import Equilibrium
from .layout import Layout
from .motors import MOTORS, Motor, motor_named
from .placing import FARTHEST, TORQUE_USED, place, refusal
from .wish import LEAST_MASS, Wish, length_text, rounded

_USUAL_SWING = 0.4  # s, of the tip on its rods: slow enough for any motor, fast enough not to be boring
_SLOWEST_SWING, _FASTEST_SWING = 12.0, 0.02  # s
_DAMPING = 0.025  # of the tip's swing, relative to critical: that of planar_pair
_LAPS = 2.0
_LAP_SWINGS = 5.2  # swings of the tip in a lap: that of the lemniscate
_PERIODS_PER_SWING = 30.0
_CONTROL_PERIODS = (0.05, 0.02, 0.01, 0.005, 0.002, 0.001)  # s


@dataclass(frozen=True)
class Design:
    """What is chosen for a wish; times in s, the rest in SI units.

    Attributes
    ----------
    wish : Wish
    layout : Layout
    motor : Motor
    size : (float, float)
        Of the figure of eight [m].
    tip_mass, drag : float
        [kg], [N s/m].
    swing : float
        Slowest free swing of the tip on its rods, the motors held [s].
    lap : float
        Time of a figure of eight [s].
    control_period, plant_step : float
        [s].
    rods_share : float
        Of the mass that moves, what the rods add to the tip's.
    """

    wish: Wish
    layout: Layout
    motor: Motor
    size: tuple[float, float]
    tip_mass: float
    drag: float
    swing: float
    lap: float
    control_period: float
    plant_step: float
    rods_share: float

    @property
    def duration(self) -> float:
        """Start-up and laps, a whole number of control periods [s]."""
        return round((0.5 + _LAPS) * self.lap / self.control_period) * self.control_period


def design(wish: Wish) -> Design:
    """Choose all that a wish leaves open.

    Raises
    ------
    InfeasibleError
        No such robot can work: says by which numbers, and which nearest ones would do.
    """
    motors = [motor_named(wish.motor)] if wish.motor else list(MOTORS.values())
    placed, found = place(wish, motors[-1])
    if placed is None:
        raise refusal(wish, found, motors[-1])
    layout, share, poses = placed
    needed = max(float(np.abs(eq.motor_torque).max()) for eq in poses)
    motor = next(motor for motor in motors if needed <= TORQUE_USED * motor.torque_limit)
    bare = wish.robot(layout, motor)
    stiffness = poses[0].dforce_dp
    rods = _mass_of_rods(bare, poses[0])
    softest = float(np.linalg.eigvalsh(stiffness)[0])
    rod_mass = wish.rods * wish.length * bare.rods[0].line_density
    mass = wish.tip_mass or rounded(max(LEAST_MASS * rod_mass, softest * (_USUAL_SWING / (2 * math.pi)) ** 2))
    moving = mass * np.eye(2) + rods
    inverse = np.linalg.inv(np.linalg.cholesky(moving))
    rates = np.sqrt(np.linalg.eigvalsh(inverse @ stiffness @ inverse.T))
    slowest, fastest = (float(2 * math.pi / rate) for rate in rates)
    _require_swings(wish, mass, rod_mass, slowest, fastest, rods)
    wanted = min(slowest / _PERIODS_PER_SWING, fastest / (_PERIODS_PER_SWING / 2))
    period = next((one for one in _CONTROL_PERIODS if one <= wanted), _CONTROL_PERIODS[-1])
    return Design(
        wish, layout, motor, (rounded(share * layout.size[0]), rounded(share * layout.size[1])), mass,
        rounded(2 * _DAMPING * math.sqrt(softest * mass)), slowest, rounded(_LAP_SWINGS * slowest, up=True), period,
        period / 10, float(np.linalg.eigvalsh(rods)[-1] / (mass + np.linalg.eigvalsh(rods)[-1])),
    )  # fmt: skip


def _require_swings(wish: Wish, mass: float, rod_mass: float, slowest: float, fastest: float, rods: np.ndarray) -> None:
    """Refuse a tip whose free swing nothing can follow, or for which nobody would wait."""
    share = float(np.linalg.eigvalsh(rods)[0])
    if slowest > _SLOWEST_SWING:
        most = (mass + share) * (_SLOWEST_SWING / slowest) ** 2 - share
        # With the mass of the tip that of its rods, a swing takes a time as L^2/d.
        ratio = slowest / _SLOWEST_SWING
        advice = f"at most {rounded(most, down=True):.2g} kg (--tip-mass)"
        if most <= rod_mass / 2:
            advice = f"about {length_text(rounded(wish.length / math.sqrt(1.05 * ratio), down=True))} length"
            if ratio <= FARTHEST:
                thick = length_text(rounded(1.05 * ratio * wish.thick, up=True))
                advice = f"about {thick} {wish.across}, or {advice.removeprefix('about ')}"
        raise InfeasibleError(
            f"a tip of {mass:.3g} kg swings on these rods once in {slowest:.3g} s, and a path would take minutes; "
            f"nearest that works: {advice}",
            limit="tip_mass",
        )
    if fastest < _FASTEST_SWING:
        least = (mass + share) * (_FASTEST_SWING / fastest) ** 2 - share
        raise InfeasibleError(
            f"a tip of {mass:.3g} kg swings on these rods {1 / fastest:.3g} times a second, too fast for a control "
            f"period of {1e3 * _CONTROL_PERIODS[-1]:g} ms; nearest that works: at least about "
            f"{rounded(1.01 * least, up=True):.2g} kg (--tip-mass), or thinner or longer rods",
            limit="tip_mass",
        )
    if rod_mass > 2 * mass:
        raise InfeasibleError(
            f"a tip of {mass:.3g} kg is lighter than its rods, {rod_mass:.3g} kg in all: they would swing by "
            "themselves, which no model of the controller knows; nearest that works: at least "
            f"{rounded(rod_mass / 2, up=True):.2g} kg (--tip-mass)",
            limit="tip_mass",
        )


def _mass_of_rods(robot: Robot, eq: Equilibrium) -> np.ndarray:
    """What the rods add to the mass of the tip, shape (2, 2) [kg]."""
    # About as heavy as the rods, or the difference would be all rounding.
    robot = replace(robot, tip_mass=robot.n_rods * robot.rods[0].length * robot.rods[0].line_density)
    plant = Plant(robot, inertia="condensed")
    plant.reset(np.concatenate([eq.p, np.zeros(2), eq.q]), eq)
    return plant.mass(eq.p, eq.q)[0][:2, :2] - robot.tip_mass * np.eye(2)
