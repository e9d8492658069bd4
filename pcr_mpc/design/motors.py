"""Motors that a robot may be built with: small servos that turn all round and tell their angle."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass

from ..errors import ModelError

_TORQUE_SHARE = 0.5  # of the stall torque, which a motor bears for seconds only
_RATE_SHARE = 0.75  # of the no-load speed, which it has without load only
_RISE = 0.02  # time to its greatest rate [s]; no data sheet has it, measure it
_SOURCE = "ROBOTIS e-Manual"


@dataclass(frozen=True)
class Motor:
    """A servo by its data sheet.

    Attributes
    ----------
    name : str
    stall_torque : float
        [N m].
    no_load_speed : float
        [rev/min].
    voltage : float
        At which that holds [V].
    source : str
    """

    name: str
    stall_torque: float
    no_load_speed: float
    voltage: float
    source: str = _SOURCE

    @property
    def torque_limit(self) -> float:
        """Torque to count with in motion, half of the stall torque [N m]."""
        return _TORQUE_SHARE * self.stall_torque

    @property
    def rate_limit(self) -> float:
        """Rate to count with under load, 75 % of the no-load speed [rad/s]."""
        return _RATE_SHARE * self.no_load_speed * 2.0 * math.pi / 60.0

    @property
    def acceleration_limit(self) -> float:
        """Change of the rate with which it is there in 20 ms [rad/s^2]."""
        return self.rate_limit / _RISE


# By torque.
MOTORS = {
    motor.name: motor
    for motor in (
        Motor("XL330-M288", 0.52, 103.0, 5.0),
        Motor("XC330-M288", 0.93, 81.0, 5.0),
        Motor("XL430-W250", 1.5, 61.0, 12.0),
        Motor("XM430-W210", 3.0, 77.0, 12.0),
        Motor("XM540-W150", 7.3, 53.0, 12.0),
        Motor("XM540-W270", 10.6, 30.0, 12.0),
    )
}


def motor_named(name: str) -> Motor:
    """Motor of a name, in whatever case.

    Raises
    ------
    ModelError
        There is none; says which is nearest.
    """
    known = {one.upper(): motor for one, motor in MOTORS.items()}
    if name.upper() in known:
        return known[name.upper()]
    near = difflib.get_close_matches(name.upper(), known, n=1)
    hint = f"did you mean {near[0]}? " if near else ""
    raise ModelError(
        f"motor {name!r} is not known; {hint}known are {', '.join(MOTORS)}; for another take the nearest, and put its "
        "limits under [motors] of the robot that is written",
        key="motor",
    )
