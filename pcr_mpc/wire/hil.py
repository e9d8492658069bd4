"""A plant in real time in this process, its controller in another one, and the loop closed over loopback."""

from __future__ import annotations

import math
import multiprocessing
import os
import select
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from tqdm import tqdm

from .. import interrupt
from ..errors import PCRError, SimulationError
from ..loop.controller.make_controller import make_controller
from ..loop.run.simulate import simulate
from ..loop.scene.scene import Scene
from ..study.episodes.parallel import follow_the_parent
from .hardware import Hardware
from .packet import RESTING, command_size, pack_measurement, unpack_command

_PATIENCE = 120.0  # s, until the controller's process has ended
_GREETING = 10.0  # s, until the first measurement is answered
_SILENCE, _SILENCE_TIME = 5, 0.25  # periods at least, and s
_SPIN = 1e-4  # s before a step is due, in which sleeping is too coarse


@dataclass(frozen=True, eq=False)
class HilRun:
    """What was measured.

    Attributes
    ----------
    scene : Scene
    dt : float
        Step of the plant [s].
    t, error : ndarray, shape (K + 1,)
        Times, and the tip's distance from the reference [s], [m].
    late : ndarray, shape (K,)
        How much later than due each plant step began [s].
    round_trip : ndarray, shape (M,)
        From a measurement to its command, as far as they came [s]; NaN for those that did not come within their period.
        The first period is left out: the clock starts when its command has come.
    rungs : ndarray, shape (M,)
        Of the commands, -1 for those that did not come.
    simulated : float
        RMS error of the simulated loop whose commands come later than told by the mean of what these did [m].
    simulated_delay : float
        That delay [s].
    counts : dict
        Of the server.
    priority : {"real-time", "normal"}
        With which both processes were scheduled.
    """

    scene: Scene
    dt: float
    t: np.ndarray
    error: np.ndarray
    late: np.ndarray
    round_trip: np.ndarray
    rungs: np.ndarray
    simulated: float
    simulated_delay: float
    counts: dict[str, int]
    priority: str

    @property
    def missed(self) -> int:
        """Periods without a command."""
        return int(np.isnan(self.round_trip).sum())

    def summary(self) -> dict[str, Any]:
        """Figures of the run, times in us."""
        came = self.round_trip[~np.isnan(self.round_trip)]
        rms = 1e3 * float(np.sqrt(np.mean(self.error**2)))
        return {
            "scene": self.scene.name,
            "duration_s": float(self.t[-1]),
            "period_s": self.scene.period,
            "plant_step_s": self.dt,
            "rms_mm": rms,
            "max_mm": 1e3 * float(self.error.max()),
            "simulated_rms_mm": 1e3 * self.simulated,
            "simulated_delay_ms": 1e3 * self.simulated_delay,
            "round_trip_us": _percentiles(came),
            "plant_late_us": _percentiles(self.late),
            "periods": len(self.round_trip),
            "missed": self.missed,
            "fallbacks": int((self.rungs > 0).sum()),
            "priority": self.priority,
            "server": self.counts,
        }


def _percentiles(times: np.ndarray) -> dict[str, float]:
    """p50 to max [us]."""
    if not len(times):
        return {}
    shares = {"p50": 50, "p95": 95, "p99": 99, "p99.9": 99.9, "max": 100}
    return {name: 1e6 * float(np.percentile(times, share)) for name, share in shares.items()}


def run_hil(scene: Scene, *, generated: bool = False, progress: bool = False) -> HilRun:
    """Run a scene in real time, the controller behind UDP, in Python or as generated C.

    Raises
    ------
    PCRError
        The controller's process does not come up.
    SimulationError
        The plant failed.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_controller, args=(scene, generated, theirs), daemon=True)
    with interrupt.held_back():  # until it follows the parent
        process.start()
    try:
        # As long as it takes: C of a long scene is generated and compiled.
        address = _expected(ours, process, math.inf)
        with _preferred() as priority:
            plant_log = _plant(scene, address, progress=progress)
        ours.send("end")
        counts = _expected(ours, process, _PATIENCE)
    finally:
        if process.is_alive():
            process.join(2.0)
        if process.is_alive():
            process.terminate()
    t, error, late, round_trip, rungs, dt = plant_log
    came = round_trip[~np.isnan(round_trip)]
    # A command acts at the first step that begins after it has come.
    delay = dt * float(np.mean(np.ceil(came / dt))) if len(came) else 0.0
    return HilRun(scene, dt, t, error, late, round_trip, rungs, _simulated(scene, delay), delay, counts, priority)


@contextmanager
def _preferred() -> Iterator[str]:
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


def _expected(pipe: Connection, process: Any, patience: float) -> Any:
    end = time.monotonic() + patience
    while time.monotonic() < end:
        if pipe.poll(0.1):
            found = pipe.recv()
            if isinstance(found, BaseException):
                raise found
            return found
        interrupt.check()
        if not process.is_alive():
            break
    raise PCRError("the controller's process has ended or does not answer; try `pcr-mpc serve` to see why")


def _controller(scene: Scene, generated: bool, pipe: Connection) -> None:
    """The other process."""
    from .decider import make_decider
    from .server import Server

    follow_the_parent()
    # A process that is kept waiting by others, a tenth of a second now and then, has not fallen silent.
    silence = max(_SILENCE, math.ceil(_SILENCE_TIME / scene.period))
    try:
        server = Server(make_decider(scene, generated=generated), ("127.0.0.1", 0), silence=silence)
    except Exception as error:  # whatever it is, who waits is told
        pipe.send(error)
        return
    with _preferred():
        pipe.send(server.address)
        server.serve(lambda text: print(f"{scene.name}: {text}", file=sys.stderr), until=pipe.poll)
    server.close()
    pipe.send(dict(server.counts))


def _plant(scene: Scene, address: tuple[str, int], *, progress: bool) -> tuple[Any, ...]:
    """Step the plant by the clock; commands act at the first step after they have come, or as much later as the scene
    says."""
    robot, n = Hardware(scene), scene.robot.n_rods
    count, per = robot.steps, round(scene.period / robot.dt)
    t, late = robot.dt * np.arange(count + 1), np.empty(count)
    assert scene.trajectory is not None
    wanted = scene.trajectory(t)[:, 0]
    sent = np.full(scene.n_periods, np.nan)
    round_trip, rungs = np.full(scene.n_periods, np.nan), np.full(scene.n_periods, -1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.connect(address)
        wire.setblocking(False)
        robot.told(_greeted(wire, pack_measurement(robot.measured(0)), n))
        bar = tqdm(total=scene.n_periods, desc=scene.name, unit="period", disable=not progress)
        began = time.perf_counter()
        for step in range(count):
            due = began + step * robot.dt
            for data, now in _until(due, wire, command_size(n) + 1):
                command = unpack_command(data, n)
                if command is None or command.sequence >= len(sent):
                    continue
                robot.told(command.u)
                k = command.sequence
                if command.rung != RESTING and k == (step - 1) // per:
                    round_trip[k], rungs[k] = now - sent[k], command.rung
            late[step] = time.perf_counter() - due
            if step % per == 0:
                interrupt.check()
                if k := step // per:
                    data = pack_measurement(robot.measured(k))
                    sent[k] = time.perf_counter()
                    _quietly(wire.send, data)
                bar.update()
            try:
                robot.step()
            except PCRError as error:
                raise SimulationError(
                    f"{scene.name}: the plant failed at {t[step]:.3f} s: {error}", t=t[step]
                ) from error
        bar.close()
    return t, np.hypot(*(robot.states[:, :2] - wanted).T), late, round_trip[1:], rungs[1:], robot.dt


def _greeted(wire: socket.socket, first: bytes, n: int) -> np.ndarray:
    """Rates that answer the first measurement: the reference begins with it, so the robot rests until they come."""
    _quietly(wire.send, first)
    end = time.perf_counter() + _GREETING
    while time.perf_counter() < end:
        interrupt.check()
        select.select([wire], [], [], 0.1)
        data = _quietly(wire.recv, command_size(n) + 1)
        command = None if data is None else unpack_command(data, n)
        if command is not None and command.rung != RESTING:
            return command.u
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


def _simulated(scene: Scene, delay: float) -> float:
    """RMS error of the simulated loop with commands that come so late [m]."""
    late = replace(scene, untold_delay=scene.untold_delay + delay)
    run = simulate(late, late.make_plant(), make_controller(late), 0, spent=lambda k, measured: 0.0)
    return 1e-3 * float(run.summary()["rms_mm"])
