"""Motors as hardware has them, as a scene describes them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ...errors import ModelError, check_numbers
from ...toml_table import Table

COMMANDS = ("rate", "angle")
_NUMBERS = {"time_constant": {"minimum": 0.0}, "backlash": {"minimum": 0.0, "maximum": math.pi}}


@dataclass(frozen=True)
class Motors:
    """What stands between a command and the clamp of a rod.

    Attributes
    ----------
    time_constant : float
        First-order lag of the rate behind the command [s].
    backlash : float
        Play between motor and clamp, from one side to the other [rad]. A clamp stays where friction holds it until the
        motor has crossed the play; encoders sit on the motor's side, and do not see it.
    saturated : bool
        Whether a motor has no more than the scene's torque limit: it then turns at the rate that this leaves, and where
        none is left it holds, as a geared motor does.
    command : {"rate", "angle"}
        What the motors take. "angle": position servos, whose set point runs through the period as the commanded rate
        says; what such a motor has lost, to a stall or to its rate limit, it makes up for.
    """

    time_constant: float = 0.0
    backlash: float = 0.0
    saturated: bool = False
    command: str = COMMANDS[0]

    def __post_init__(self) -> None:
        check_numbers(self, _NUMBERS)
        object.__setattr__(self, "saturated", bool(self.saturated))
        if self.command not in COMMANDS:
            raise ModelError(f"command is {self.command!r}, expected one of {', '.join(COMMANDS)}", key="command")


IDEAL = Motors()  # that follow their commands at once


def read_motors(file: Table) -> Motors | None:
    """Take a scene's [motors] table, if it has one."""
    if not file.has("motors"):
        return None
    with file.table("motors") as table:
        return Motors(
            time_constant=table.number("time_constant", 0.0, **_NUMBERS["time_constant"]),
            backlash=table.number("backlash", 0.0, **_NUMBERS["backlash"]),
            saturated=table.boolean("saturated", False),
            command=table.text("command", COMMANDS[0], choices=COMMANDS),
        )
