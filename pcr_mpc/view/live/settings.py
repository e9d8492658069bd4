"""What may be turned while a robot runs, and how far."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

from ...errors import checked_number
from ...loop.hardware.motors import Motors
from ...loop.scene.scene import Scene


@dataclass(frozen=True)
class Dial:
    """One number that may be turned.

    Attributes
    ----------
    label, unit : str
        As a page shows it.
    scale : float
        Shown numbers over SI units.
    least, most : float
        SI units.
    told : bool
        Whether the controller knows: motors and sensors have data sheets, loads and delays have none.
    """

    label: str
    unit: str
    scale: float
    least: float
    most: float
    told: bool


@dataclass(frozen=True)
class Settings:
    """What surrounds plant and controller, in SI units.

    Attributes
    ----------
    load : float
        That the tip carries beside what the scene lets it carry [kg].
    noise : float
        Standard deviation of the measured tip [m].
    delay : float
        By which commands come later than the controller was told [s].
    lag : float
        Time constant of the motors [s].
    rate : float
        Greatest rate of the motors [rad/s].
    acceleration : float
        Greatest change of it [rad/s^2].
    """

    load: float
    noise: float
    delay: float
    lag: float
    rate: float
    acceleration: float

    def turned(self, name: str, value: Any, dials: dict[str, Dial]) -> Settings:
        """Return them with one number changed.

        Raises
        ------
        ValueError
            There is no such number, or it is beyond its dial.
        """
        if name not in dials:
            raise ValueError(f"there is no setting {name!r}, but {', '.join(dials)}")
        dial = dials[name]
        number = checked_number(name, value, minimum=dial.least * (1 - 1e-9), maximum=dial.most * (1 + 1e-9))
        return replace(self, **{name: number})

    def of(self, scene: Scene) -> Scene:
        """Return a scene with these settings; the load is not the scene's business."""
        robot = replace(scene.robot, rate_limit=self.rate, acceleration_limit=self.acceleration)
        motors = replace(scene.motors or Motors(), time_constant=self.lag)
        return replace(
            scene,
            robot=robot,
            tip_noise=self.noise,
            untold_delay=self.delay,
            motors=None if scene.motors is None and not self.lag else motors,
        )


def settings_of(scene: Scene) -> Settings:
    """What a scene says."""
    return Settings(
        load=0.0,
        noise=scene.tip_noise,
        delay=scene.untold_delay,
        lag=0.0 if scene.motors is None else scene.motors.time_constant,
        rate=scene.robot.rate_limit,
        acceleration=scene.robot.acceleration_limit,
    )


def dials_of(scene: Scene) -> dict[str, Dial]:
    """How far each setting may be turned in a scene."""
    robot, now = scene.robot, settings_of(scene)
    length = float(robot.lengths.min())
    return {
        "load": Dial("load", "g", 1e3, 0.0, 2.0 * robot.tip_mass, told=False),
        "noise": Dial("tip noise", "mm", 1e3, 0.0, max(2.5e-3 * length, now.noise), told=True),
        "delay": Dial("extra delay", "ms", 1e3, 0.0, max(0.08, now.delay), told=False),
        "lag": Dial("motor lag", "ms", 1e3, 0.0, max(0.08, now.lag), told=False),
        "rate": Dial("motor rate limit", "rad/s", 1.0, _finite(now.rate) / 20, 2 * _finite(now.rate), told=True),
        "acceleration": Dial("acceleration limit", "rad/s²", 1.0, _finite(now.acceleration) / 20,
                             2 * _finite(now.acceleration), told=True),
    }  # fmt: skip


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 100.0


NAMES = tuple(field.name for field in fields(Settings))
