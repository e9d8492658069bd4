"""The robot's side of a loop over a wire: a plant by the clock."""

from __future__ import annotations

import os
import select
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from tqdm import tqdm

from .. import interrupt
from ..errors import PCRError, SimulationError
from ..loop.scene.scene import Scene
from .happened import Arrival, Happened
from .hardware import Hardware
from .packet import RESTING, Command, command_size, pack_measurement, unpack_command

_GREETING = 10.0  # s, until the first measurement is answered
_SPIN = 1e-4  # s before a step ends, in which sleeping is too coarse


@dataclass(frozen=True, eq=False)
class PlantLog:
    """What the robot's side has seen.

    Attributes
    ----------
    states : ndarray, shape (K + 1, 4 + n)
    late : ndarray, shape (K,)
        How much later than due each step of the plant was done [s].
    round_trip : ndarray, shape (M,)
        From a measurement to its command, as far as they came [s]; NaN for those that did not come within their period.
    rungs : ndarray, shape (M,)
        Of the commands, -1 for those that did not come.
    happened : Happened
    stood : float
        For how long the robot's clock stood still, for its process was held up by more than a step [s].
    """

    states: np.ndarray
    late: np.ndarray
    round_trip: np.ndarray
    rungs: np.ndarray
    happened: Happened = field(default_factory=Happened)
    stood: float = 0.0


@contextmanager
def preferred() -> Iterator[str]:
    """Be scheduled before all that is not in real time, where that is allowed; says which priority it is."""
    try:
        before = os.sched_getscheduler(0)
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except (AttributeError, OSError):  # another system, or not allowed
        yield "normal"
        return
    try:
        yield "real-time"
    finally:
        os.sched_setscheduler(0, before, os.sched_param(0))


def run_plant(scene: Scene, address: tuple[str, int], *, progress: bool) -> PlantLog:
    """Step a scene's plant by the clock, with the commands of a server, which act when they come or as the scene says.

    Raises
    ------
    PCRError
        The first measurement is not answered.
    SimulationError
        The plant failed.
    """
    robot, n = Hardware(scene), scene.robot.n_rods
    dt, per = robot.dt, round(scene.period / robot.dt)
    late, happened, stood = np.empty(robot.steps), Happened(), 0.0
    sent = np.full(scene.n_periods, np.nan)
    round_trip, rungs = np.full(scene.n_periods, np.nan), np.full(scene.n_periods, -1)

    def take(command: Command, at: float) -> None:
        arrival = Arrival.of(command, at)
        happened.arrivals.append(arrival)
        robot.told(command.u, at, arrival.since(per))

    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire,
        tqdm(total=scene.n_periods, desc=scene.name, unit="period", disable=not progress) as bar,
    ):
        wire.connect(address)
        wire.setblocking(False)
        take(_greeted(wire, pack_measurement(robot.measured(0)), n), 0.0)
        began = time.perf_counter()
        for step in range(robot.steps):
            if step % per == 0:
                interrupt.check()
                if k := step // per:
                    data = pack_measurement(robot.measured(k))
                    sent[k] = time.perf_counter()
                    _quietly(wire.send, data)
                bar.update()
            for data, now in _until(began + (step + 1) * dt, wire, command_size(n) + 1):
                command = unpack_command(data, n)
                if command is None or command.sequence * per > step:
                    continue
                take(command, min(max((now - began) / dt, step), step + 1))
                k = command.sequence
                if command.rung != RESTING and k == step // per:
                    round_trip[k], rungs[k] = now - sent[k], command.rung
            late[step] = time.perf_counter() - began - (step + 1) * dt
            if late[step] > dt:
                # A burst of steps, to be in time again, would be faster than any robot.
                stood, began = stood + late[step], began + late[step]
            try:
                robot.step()
            except PCRError as error:
                raise SimulationError(
                    f"{scene.name}: the plant failed at {step * dt:.3f} s: {error}", t=step * dt
                ) from error
    return PlantLog(robot.states, late, round_trip, rungs, happened, stood)


def _greeted(wire: socket.socket, first: bytes, n: int) -> Command:
    """The answer to the first measurement: the reference begins with it, so the robot rests until it comes."""
    _quietly(wire.send, first)
    end = time.perf_counter() + _GREETING
    while time.perf_counter() < end:
        interrupt.check()
        select.select([wire], [], [], 0.1)
        data = _quietly(wire.recv, command_size(n) + 1)
        command = None if data is None else unpack_command(data, n)
        if command is not None and command.rung != RESTING:
            return command
    raise PCRError(f"the first measurement is not answered for {_GREETING:g} s; try `pcr-mpc serve` to see why")


def _until(due: float, wire: socket.socket, size: int) -> Iterator[tuple[bytes, float]]:
    """Datagrams that come until a time, and when each came; the last moments are waited for awake."""
    while True:
        data = _quietly(wire.recv, size)
        now = time.perf_counter()
        if data is not None:
            yield data, now
        elif now >= due:
            return
        elif due - now > _SPIN:
            select.select([wire], [], [], due - now - _SPIN)


def _quietly(call: Any, *arguments: Any) -> Any:
    """Result of a call of a socket that does not wait; None where there is nothing, or nobody there."""
    try:
        return call(*arguments)
    except OSError:
        return None
