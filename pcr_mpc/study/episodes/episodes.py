"""Episodes under mismatch: the robot that moves is not quite the one that the controller believes in."""

from __future__ import annotations

import hashlib
import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from ... import interrupt
from ...control.tuning import Tuning
from ...errors import SimulationError, checked_integer
from ...loop.controller.make_controller import make_controller
from ...loop.controller.own_controller import built
from ...loop.demand.feed_forward import InverseDynamics, feed_forward
from ...loop.parts.controllers import Controller
from ...loop.references.reading import built_in
from ...loop.references.trajectory import Trajectory, sampled
from ...loop.run.run import Run
from ...loop.run.simulate import simulate
from ...loop.scene.scene import Scene
from .spread import ASSUMED, EXACT, Mismatch, Spread

__all__ = ["ASSUMED", "EXACT", "Mismatch", "Spread", "lighter", "run_episode", "simulate_episode"]

Row = dict[str, Any]
Maker = Callable[..., Controller]
# An episode fails if the tip is further than this from its reference [m]: a third of the lemniscate's height, and
# almost four times as far as the largest load of a `Spread` moves the resting tip.
ALLOWED_ERROR = 0.02
# The loads strike at t = 0; from then on the loop has this long to make up for them [s].
SETTLING = 1.0
# A cluster's worker may have several threads, but the rods' graphs of a process share their memory.
_ONE_AT_A_TIME = threading.Lock()


def lighter(scene: Scene) -> Scene:
    """Return the scene with velocity Verlet for RK4: a third of the cost, and an error that no mismatch notices."""
    if scene.plant.integrator != "rk4":
        return scene
    return replace(scene, plant=replace(scene.plant, integrator="velocity_verlet"))


def simulate_episode(
    scene: Scene, tuning: Tuning | Maker, seed: int, spread: Spread = ASSUMED, *, progress: bool = False
) -> Run:
    """Run the episode of a seed: the sampled robot moves, the controller knows the scene's.

    Late decisions are not simulated, even where the scene has a deadline: an episode must not depend on how busy the
    machine is.

    Parameters
    ----------
    scene : Scene
    tuning : Tuning or callable
        Of the controller; or what makes one of one's own (see `built`), a class for example, which is handed the scene
        as it is believed to be.
    seed : int
    spread : Spread
    progress : bool

    Raises
    ------
    SimulationError
        As `simulate`.
    """
    believed = replace(scene if not isinstance(tuning, Tuning) else scene.tuned(tuning), deadline=math.inf)
    mismatch = spread.sample(scene.robot.n_rods, seed)
    # A tuning with a shorter period does not make the bus faster.
    delay = math.ceil(mismatch.delay * scene.period / believed.period - 1e-9)
    true = replace(mismatch, delay=delay).applied_to(believed)
    if not isinstance(tuning, Tuning):
        mine = built(tuning, replace(believed, angle_step=true.angle_step))
        return simulate(true, true.make_plant(), mine, seed, progress=progress)
    reference = None
    if believed.trajectory is not None:
        tail = tuning.horizon + believed.delay
        payload = believed.payload if tuning.model.payload else None
        known = replace(believed, tuning=None, payload=payload, trajectory=_comparable(believed, tail))
        reference = _reference(known, tail, tuning.model.inertia)
    controller = make_controller(
        replace(believed, angle_step=true.angle_step), robot=believed.robot, reference=reference
    )
    return simulate(true, true.make_plant(), controller, seed, progress=progress)


@dataclass(frozen=True)
class _BySamples:
    """A trajectory of one's own, which may not be hashed, and in a worker is another object with every task."""

    digest: str
    trajectory: Trajectory = field(compare=False)

    def __call__(self, t: np.ndarray) -> np.ndarray:
        return self.trajectory(t)


def _comparable(believed: Scene, horizon: int) -> Trajectory | None:
    trajectory = believed.trajectory
    if trajectory is None or built_in(trajectory):
        return trajectory
    samples = sampled(trajectory, believed.period * np.arange(believed.n_periods + horizon + 1))
    return _BySamples(hashlib.sha256(samples.tobytes()).hexdigest(), trajectory)


@lru_cache(maxsize=8)
def _reference(believed: Scene, horizon: int, inertia: str) -> InverseDynamics:
    """Inverse dynamics of the reference: what is believed is the same in all episodes, so they are solved once."""
    return feed_forward(believed, believed.robot, believed.start(), horizon, inertia)


def run_episode(scene: Scene, tuning: Tuning | Maker, seed: int, spread: Spread = ASSUMED) -> Row:
    """Run the episode of a seed and judge it; a failing one is a row like the others.

    Parameters
    ----------
    scene, tuning, seed, spread
        As for `simulate_episode`.

    Returns
    -------
    dict
        Ready for JSON: ``seed``; what was off (see `Mismatch.row`); ``failure``, empty if there was none; ``rms_mm``,
        ``rms_after_1s_mm``, ``max_mm``, ``final_error_mm``; ``effort_rad_s2``, the RMS change of the commanded rates;
        ``limit_violations``; ``fallbacks`` and ``rungs``, how the decisions came about where not by a solved QP;
        ``run_hash``. What there was no run to tell of is None. All this repeats bit for bit on one machine;
        ``timing`` does not: ``control_cpu_us``, the median CPU time of a control step, ``late``, the share of control
        steps whose CPU time exceeds the period, and ``episode_s``.
    """
    began = time.perf_counter()
    seed = checked_integer("seed", seed, minimum=0)
    row: Row = {"seed": seed, **spread.sample(scene.robot.n_rods, seed).row(), "failure": ""}
    run: Run | None = None
    with _ONE_AT_A_TIME:
        try:
            run = simulate_episode(scene, tuning, seed, spread)
        except SimulationError as error:
            interrupt.pass_on(error)
            run, row["failure"] = error.run, str(error)
        except Exception as error:  # before the first step, as a reference that the believed robot cannot follow
            row["failure"] = f"{type(error).__name__}: {error}"
    row |= _figures(run)
    if run is not None:
        row["failure"] = row["failure"] or _verdict(run, row["limit_violations"])
    row["timing"] = {**_timing(run), "episode_s": time.perf_counter() - began}
    return row


def _verdict(run: Run, violations: int) -> str:
    """Why a run that came to its end is a failure; empty if it is none."""
    if violations:
        return f"limits violated in {violations} of {len(run.u)} periods"
    first = int(np.searchsorted(run.t, min(SETTLING, run.t[-1])))
    worst = first + int(run.error[first:].argmax())
    if not run.error[worst] <= ALLOWED_ERROR:  # so written that NaN fails
        return f"strayed {1e3 * run.error[worst]:.1f} mm from the reference at t = {run.t[worst]:.3f} s"
    return ""


def _figures(run: Run | None) -> Row:
    if run is None or not len(run.u):
        names = ("rms_mm", "rms_after_1s_mm", "max_mm", "final_error_mm", "effort_rad_s2")
        return {**dict.fromkeys(names), "limit_violations": 0, "fallbacks": 0, "rungs": "", "run_hash": ""}
    error = 1e3 * run.error
    late = error[run.t >= 1.0]
    change = np.diff(run.u, axis=0, prepend=np.zeros((1, run.u.shape[1]))) / run.scene.period
    rungs = Counter(event["rung"] for event in run.events if event["kind"] == "fallback")
    return {
        "rms_mm": _rms(error),
        "rms_after_1s_mm": _rms(late) if len(late) else None,
        "max_mm": float(error.max()),
        "final_error_mm": float(error[-1]),
        "effort_rad_s2": _rms(change),
        "limit_violations": run.limit_violations(),
        "fallbacks": rungs.total(),
        "rungs": ", ".join(f"{name} {count}" for name, count in sorted(rungs.items())),
        "run_hash": run.hash(),
    }


def _timing(run: Run | None) -> Row:
    if run is None or not len(run.u):
        return {"control_cpu_us": None, "late": None}
    cpu = run.control_time[:, 5]
    return {"control_cpu_us": 1e6 * float(np.median(cpu)), "late": float(np.mean(cpu > run.scene.period))}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
