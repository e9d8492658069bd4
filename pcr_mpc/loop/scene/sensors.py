"""What is known of the sensors of a loop."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ...errors import ModelError, check_numbers, checked_integer
from .scene import Scene


@dataclass(frozen=True)
class Sensors:
    """Sensors and bus of a real loop, as their data sheets have them.

    Attributes
    ----------
    tip_noise : float
        Standard deviation of the measured tip position [m].
    angle_step : float
        Resolution of the encoders: measured angles are whole multiples of it [rad]. Zero: exact.
    wrapped : bool
        Encoders tell angles up to whole turns only.
    delay : int
        Control periods that pass before a command reaches the motors.
    bridge : float
        For how long the prediction stands in for a sensor that says nothing believable [s]; then the robot is brought
        to rest. Infinite: for ever.
    """

    tip_noise: float = 0.0
    angle_step: float = 0.0
    wrapped: bool = False
    delay: int = 0
    bridge: float = 0.3

    def __post_init__(self) -> None:
        check_numbers(self, {"tip_noise": {"minimum": 0.0}, "angle_step": {"minimum": 0.0}})
        try:
            object.__setattr__(self, "delay", checked_integer("delay", self.delay, minimum=0))
        except ValueError as error:
            raise ModelError(str(error), key="delay") from None
        if self.bridge != math.inf:
            check_numbers(self, {"bridge": {"minimum": 0.0}})


EXACT_SENSORS = Sensors()


def sensors_of(scene: Scene) -> Sensors:
    """What a scene says of them."""
    return Sensors(scene.tip_noise, scene.angle_step, scene.wrapped, scene.delay)
