"""A plant in real time in this process, its controller in another one, and the loop closed over loopback."""

from __future__ import annotations

import math
import multiprocessing
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import Any, TypeVar

import numpy as np

from .. import interrupt
from ..errors import PCRError
from ..loop.controller.make_controller import make_controller
from ..loop.run.simulate import simulate
from ..loop.scene.scene import Scene
from ..study.episodes.parallel import follow_the_parent
from .happened import replayed
from .real_time import preferred, run_plant

_T = TypeVar("_T")
_ENDING = 2.0  # s
_PATIENCE = 120.0  # s, until the controller's process has ended
_SILENCE, _SILENCE_TIME = 5, 0.25  # periods at least, and s


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
        How much later than due each plant step was done [s].
    round_trip : ndarray, shape (M,)
        From a measurement to its command, as far as they came [s]; NaN for those that did not come within their period.
        The first period is left out: the clock starts when its command has come.
    rungs : ndarray, shape (M,)
        Of the commands, -1 for those that did not come.
    stood : float
        For how long the robot's clock stood still, for its process was held up [s].
    simulated : float
        RMS error of the simulated loop whose commands come later than told by the mean of what these did [m].
    simulated_delay : float
        That delay [s].
    replayed : ndarray, shape (K + 1,)
        Error of the loop without a wire in which the same measurements are answered and commands act when they did [m].
    apart : float
        How far its tip came from that of the loop over the wire [m].
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
    stood: float
    simulated: float
    simulated_delay: float
    replayed: np.ndarray
    apart: float
    counts: dict[str, int]
    priority: str

    @property
    def missed(self) -> int:
        """Periods without a command."""
        return int(np.isnan(self.round_trip).sum())

    def summary(self) -> dict[str, Any]:
        """Figures of the run, times in us; None for what could not be simulated."""
        came = self.round_trip[~np.isnan(self.round_trip)]
        return {
            "scene": self.scene.name,
            "duration_s": float(self.t[-1]),
            "period_s": self.scene.period,
            "plant_step_s": self.dt,
            "told_delay": self.scene.delay,
            "rms_mm": _rms_mm(self.error),
            "max_mm": 1e3 * float(self.error.max()),
            "simulated_rms_mm": _number(1e3 * self.simulated),
            "simulated_delay_ms": 1e3 * self.simulated_delay,
            "replayed_rms_mm": _number(_rms_mm(self.replayed)),
            "replayed_apart_mm": _number(1e3 * self.apart),
            "round_trip_us": _percentiles(came),
            "plant_late_us": _percentiles(self.late),
            "periods": len(self.round_trip),
            "missed": self.missed,
            "stood_still_s": self.stood,
            "fallbacks": int((self.rungs > 0).sum()),
            "priority": self.priority,
            "server": self.counts,
        }


def _rms_mm(error: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(np.mean(error**2)))


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return value if math.isfinite(value) else None


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
        with preferred() as priority:
            log = run_plant(scene, address, progress=progress)
        ours.send("end")
        counts = _expected(ours, process, _PATIENCE)
        # In that process, which has the controller, while the other simulation runs in this one.
        ours.send(log.happened)
        late = scene.plant.dt * log.happened.lateness(round(scene.period / scene.plant.dt), scene.delay)
        delay = float(late.mean()) if len(late) else 0.0
        simulated = _tried(lambda: _simulated(scene, delay), math.nan)
        states = _tried(lambda: _expected(ours, process, math.inf), np.full_like(log.states, np.nan))
        process.join(_ENDING)
    finally:
        process.terminate()  # and the compiler that it may wait for
        process.join(_ENDING)
        process.kill()
    t = scene.plant.dt * np.arange(len(log.states))
    assert scene.trajectory is not None
    wanted = scene.trajectory(t)[:, 0]
    error, again = (np.hypot(*(each[:, :2] - wanted).T) for each in (log.states, states))
    apart = float(np.hypot(*(log.states - states)[:, :2].T).max())
    return HilRun(scene, scene.plant.dt, t, error, log.late, log.round_trip[1:], log.rungs[1:], log.stood, simulated,
                  delay, again, apart, counts, priority)  # fmt: skip


def _tried(call: Callable[[], _T], instead: _T) -> _T:
    """What a simulation comes to: where it fails, the run that it is compared with is not lost."""
    try:
        return call()
    except (PCRError, ValueError) as error:
        interrupt.pass_on(error)
        print(f"warning: there is nothing to compare with: {error}", file=sys.stderr)
        return instead


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
    """The other process; told to end, it takes away what it has made."""
    with interrupt.listening(), suppress(KeyboardInterrupt):
        follow_the_parent()
        _serve(scene, generated, pipe)


def _serve(scene: Scene, generated: bool, pipe: Connection) -> None:
    from .decider import make_decider
    from .server import Server

    # A process that is kept waiting by others, a tenth of a second now and then, has not fallen silent.
    silence = max(_SILENCE, math.ceil(_SILENCE_TIME / scene.period))
    try:
        decider = make_decider(scene, generated=generated)
        server = Server(decider, ("127.0.0.1", 0), silence=silence)
    except Exception as error:  # whatever it is, who waits is told
        pipe.send(error)
        return
    with preferred():
        pipe.send(server.address)
        server.serve(lambda text: print(f"{scene.name}: {text}", file=sys.stderr), until=pipe.poll)
    server.close()
    pipe.recv()
    pipe.send(dict(server.counts))
    try:
        pipe.send(replayed(scene, decider, pipe.recv()))
    except Exception as error:
        pipe.send(error)


def _simulated(scene: Scene, delay: float) -> float:
    """RMS error of the simulated loop with commands that come so late [m]."""
    late = replace(scene, untold_delay=scene.untold_delay + delay)
    run = simulate(late, late.make_plant(), make_controller(late), 0, spent=lambda k, measured: 0.0)
    return 1e-3 * float(run.summary()["rms_mm"])
