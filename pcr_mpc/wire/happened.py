"""What happened in a loop over a wire, and the same once more without one: what a wire adds is latency."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from .. import interrupt
from ..loop.scene.scene import Scene
from .decider import Decider, at_rest
from .hardware import Hardware
from .packet import RESTING, Command, Measurement


class Arrival(NamedTuple):
    """A command that has come to the robot.

    Attributes
    ----------
    at : float
        When [steps of the plant].
    sequence : int
        Of the measurement that it answers.
    rests : bool
        It brings the motors to rest, for silence or a failure: it is none of the controller's.
    """

    at: float
    sequence: int
    rests: bool

    @classmethod
    def of(cls, command: Command, at: float) -> Arrival:
        """Note a command that comes at a time [steps]."""
        return cls(at, command.sequence, command.rung == RESTING)

    def since(self, per: int) -> float:
        """From when on a scene's delay counts [steps of the plant], ``per`` of which are a period."""
        return self.at if self.rests else float(per * self.sequence)


@dataclass
class Happened:
    """Commands in the order in which they came: that is all of a run that depends on clocks and processes.

    Attributes
    ----------
    arrivals : list of Arrival
    """

    arrivals: list[Arrival] = field(default_factory=list)

    def lateness(self, per: int, delay: int) -> np.ndarray:
        """How much later than told the commands act [steps of the plant], shape (M - 1,).

        Told are ``delay`` periods of ``per`` steps. The first command is left out: the clock waits for it.
        """
        late = [each.at - per * (each.sequence + delay) for each in self.arrivals if not each.rests]
        return np.maximum(late[1:], 0.0)


def replayed(scene: Scene, decider: Decider, happened: Happened) -> np.ndarray:
    """States of the plant where the same measurements are answered, and the commands act when they did.

    Nothing is sent: the same controller decides anew, on what is measured anew.

    Parameters
    ----------
    scene : Scene
    decider : Decider
        Starts anew.
    happened : Happened

    Returns
    -------
    ndarray, shape (K + 1, 4 + n)

    Raises
    ------
    PCRError, ValueError
        The plant or the controller failed where it had not.
    """
    robot, per = Hardware(scene), round(scene.period / scene.plant.dt)
    decider.stop()
    measured: list[Measurement] = []
    coming, n = 0, len(happened.arrivals)
    for step in range(robot.steps):
        interrupt.check()
        if step % per == 0:
            measured.append(robot.measured(step // per))
        while coming < n and happened.arrivals[coming].at < step + 1:
            each = happened.arrivals[coming]
            robot.told(_decided(decider, each, measured), each.at, each.since(per))
            coming += 1
        robot.step()
    return robot.states


def _decided(decider: Decider, arrival: Arrival, measured: list[Measurement]) -> np.ndarray:
    found = measured[arrival.sequence]
    if not arrival.rests:
        return decider.answer(found).u
    command = decider.rest(found.sequence, found.time)
    if at_rest(command):
        decider.stop()
    return command.u
