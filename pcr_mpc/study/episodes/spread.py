"""What may be off between a robot and what is believed of it, and how far."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...errors import checked_integer, checked_number
from ...loop.hardware.motors import Motors
from ...loop.scene.scene import Scene
from ...plant.robot import Robot
from ...plant.uncertainty import Uncertainty
from .scatter import drawn, numbers_about

Row = dict[str, Any]


@dataclass(frozen=True)
class Mismatch:
    """What is off in one episode.

    Attributes
    ----------
    stiffness : tuple of float, one a rod
        True bending stiffness EI over the believed one.
    mass, drag : float
        True tip mass and drag over the believed ones.
    base_offset : tuple of (float, float), one a rod
        Where the motor really is, less where it is believed to be [m].
    delay : int
        Control periods of the scene by which commands come later than the controller knows.
    tip_noise : float
        Standard deviation of the measured tip position, beside the scene's own [m].
    angle_step : float
        Resolution of the encoders, if coarser than the scene's [rad]. It stands on the data sheet: the controller
        knows it, as it knows the scene's.
    force : (float, float)
        External force on the tip, beside the scene's own [N].
    length, line_density : tuple of float, one a rod
        True lengths and line densities over the believed ones. Empty: they are as believed.
    motor_lag : float
        First-order lag of the motors, beside the scene's own [s]; the controller does not know it.
    """

    stiffness: tuple[float, ...]
    mass: float
    drag: float
    base_offset: tuple[tuple[float, float], ...]
    delay: int
    tip_noise: float
    angle_step: float
    force: tuple[float, float]
    length: tuple[float, ...] = ()
    line_density: tuple[float, ...] = ()
    motor_lag: float = 0.0

    def applied_to(self, scene: Scene) -> Scene:
        """Return the scene as it really is."""
        as_believed = (1.0,) * scene.robot.n_rods
        rods = tuple(
            replace(
                rod,
                bending_stiffness=factor * rod.bending_stiffness,
                base=(rod.base[0] + offset[0], rod.base[1] + offset[1]),
                length=longer * rod.length,
                line_density=heavier * rod.line_density,
            )
            for rod, factor, offset, longer, heavier in zip(
                scene.robot.rods,
                self.stiffness,
                self.base_offset,
                self.length or as_believed,
                self.line_density or as_believed,
                strict=True,
            )
        )
        robot = replace(
            scene.robot, rods=rods, tip_mass=self.mass * scene.robot.tip_mass, drag=self.drag * scene.robot.drag
        )
        return replace(
            scene,
            robot=robot,
            delay=scene.delay + self.delay,
            tip_noise=math.hypot(scene.tip_noise, self.tip_noise),
            angle_step=max(scene.angle_step, self.angle_step),
            force=(scene.force[0] + self.force[0], scene.force[1] + self.force[1]),
            motors=self._motors(scene.motors),
        )

    def _motors(self, own: Motors | None) -> Motors | None:
        if not self.motor_lag:
            return own
        own = own or Motors()
        return replace(own, time_constant=own.time_constant + self.motor_lag)

    def row(self) -> Row:
        """Plain columns, with units in their names."""
        return {
            **{f"stiffness{i}": factor for i, factor in enumerate(self.stiffness)},
            "mass": self.mass,
            "drag": self.drag,
            **{f"base{i}_{axis}_m": offset[j] for i, offset in enumerate(self.base_offset)
               for j, axis in enumerate("xy")},
            "delay": self.delay,
            "tip_noise_m": self.tip_noise,
            "angle_step_rad": self.angle_step,
            "force_x_N": self.force[0],
            "force_y_N": self.force[1],
            **{f"length{i}": factor for i, factor in enumerate(self.length)},
            **{f"line_density{i}": factor for i, factor in enumerate(self.line_density)},
            **({"motor_lag_s": self.motor_lag} if self.motor_lag else {}),
        }  # fmt: skip


@dataclass(frozen=True)
class Spread:
    """How far off things may be. Uniform within the ranges, independent of each other.

    What a robot's file says of its numbers in [uncertainty] is better than assumed ranges: with ``known`` those numbers
    are drawn from that normal distribution, with all its correlations; positive ones in their logarithm, as `identify`
    has them. All else of a seed is as without.

    Attributes
    ----------
    stiffness : float
        EI of each rod is off by up to this fraction. Strip of 0.71 mm comes to 0.01 mm, which is 4 % of EI (t^3), and
        the modulus of carbon fibre differs by 5 % from one maker to another.
    mass : float
        Tip mass, by up to this fraction: a payload of 50 g on 250 g.
    drag : float
        Between 1/drag and drag times the believed value, uniform in its logarithm: of friction one knows the size only.
    base_offset : float
        Each coordinate of each motor, by up to this [m]: a bench drilled by hand.
    delay : int
        0 to this many control periods more than the controller was told: a bus or a camera that takes one longer.
    tip_noise : float
        Up to this standard deviation [m]; twice that of the good camera in the scene "sensors".
    angle_step : float
        Up to this resolution [rad]: encoders of 12 bits a turn and better.
    force : float
        Any direction, up to this [N]: 40 % of the weight of the tip mass, as in "hold_with_load".
    known : Uncertainty, optional
        How well numbers of the robot are known (see `load_uncertainty`); those that it does not name keep their ranges.
    believed : Robot, optional
        Whose numbers these are: with ``known``, the robot that the controller believes in.
    motor_lag : float
        0 to this first-order lag of the motors [s]: a hobby servo has 10 to 30 ms. All else of a seed is as without.
    """

    stiffness: float = 0.1
    mass: float = 0.2
    drag: float = 2.0
    base_offset: float = 1e-3
    delay: int = 1
    tip_noise: float = 1e-4
    angle_step: float = 2 * math.pi / 4096
    force: float = 1.0
    known: Uncertainty | None = None
    believed: Robot | None = None
    motor_lag: float = 0.0

    def __post_init__(self) -> None:
        for name in ("stiffness", "mass"):
            checked_number(name, getattr(self, name), minimum=0.0, maximum=0.99)
        for name in ("base_offset", "delay", "tip_noise", "angle_step", "force", "motor_lag"):
            checked_number(name, getattr(self, name), minimum=0.0)
        checked_number("drag", self.drag, minimum=1.0)
        if (self.known is None) != (self.believed is None):
            raise ValueError("known and believed go together: a distribution, and the robot about which it is")
        if self.known is not None and self.believed is not None:
            numbers_about(self.believed, self.known)

    def sample(self, n_rods: int, seed: int) -> Mismatch:
        """Draw what is off in the episode of a seed; depends on nothing else."""
        rng = np.random.default_rng(
            [checked_integer("seed", seed, minimum=0), 1]
        )  # not the stream of the measurement noise, default_rng(seed)
        stiffness = 1.0 + self.stiffness * rng.uniform(-1.0, 1.0, n_rods)
        offsets = self.base_offset * rng.uniform(-1.0, 1.0, (n_rods, 2))
        direction, size = rng.uniform(0.0, 2 * math.pi), self.force * rng.uniform()
        ranges = Mismatch(
            stiffness=tuple(stiffness.tolist()),
            mass=1.0 + self.mass * rng.uniform(-1.0, 1.0),
            drag=self.drag ** rng.uniform(-1.0, 1.0),
            base_offset=tuple((x, y) for x, y in offsets.tolist()),
            delay=int(rng.integers(0, self.delay, endpoint=True)),
            tip_noise=self.tip_noise * rng.uniform(),
            angle_step=self.angle_step * rng.uniform(),
            force=(size * math.cos(direction), size * math.sin(direction)),
            motor_lag=self.motor_lag * np.random.default_rng([seed, 4]).uniform() if self.motor_lag else 0.0,
        )
        return ranges if self.known is None else self._told(ranges, n_rods, seed)

    def _told(self, ranges: Mismatch, n_rods: int, seed: int) -> Mismatch:
        """Put what the robot's file tells in the place of assumed ranges."""
        assert self.known is not None
        assert self.believed is not None
        robot = self.believed
        if robot.n_rods != n_rods:
            raise ValueError(f"known is of a robot with {robot.n_rods} rods, the scene's has {n_rods}")
        true = drawn(robot, self.known, np.random.default_rng([seed, 2]))
        ours = numbers_about(robot, self.known)

        def factor(name: str, otherwise: float) -> float:
            return true[name] / ours[name] if name in true else otherwise

        def factors(name: str) -> tuple[float, ...]:
            names = [f"rods[{i}].{name}" for i in range(n_rods)]
            return tuple(factor(one, 1.0) for one in names) if any(one in true for one in names) else ()

        offsets = [
            [
                true[name] - ours[name] if (name := f"rods[{i}].base_{axis}") in true else offset[j]
                for j, axis in enumerate("xy")
            ]
            for i, offset in enumerate(ranges.base_offset)
        ]
        return replace(
            ranges,
            stiffness=tuple(factor(f"rods[{i}].bending_stiffness", of) for i, of in enumerate(ranges.stiffness)),
            mass=factor("tip_mass", ranges.mass),
            drag=factor("drag", ranges.drag),
            base_offset=tuple((x, y) for x, y in offsets),
            length=factors("length"),
            line_density=factors("line_density"),
        )


# Nothing is known but the ranges that are assumed.
ASSUMED = Spread()
# Everything is as the controller believes.
EXACT = Spread(stiffness=0.0, mass=0.0, drag=1.0, base_offset=0.0, delay=0, tip_noise=0.0, angle_step=0.0, force=0.0)
