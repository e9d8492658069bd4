"""The record of a closed-loop run."""

from __future__ import annotations

import csv
import hashlib
import json
import math
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import PCRError
from ..frozen import freeze
from ..plain import plain
from ..plant.dynamics import Plant
from ..plant.equilibrium import Equilibrium
from .finding import verified
from .scene import Scene
from .settings import PlantSettings

# Commands within this of a limit keep it: rounding for rates, the QP's tolerance for angles.
_LIMIT_SLACK = 1e-9
_ANGLE_SLACK = 1e-5


@dataclass(frozen=True, eq=False)
class Run:
    """Everything that happened, at the plant's steps (K + 1 times) and at control periods (M).

    Attributes
    ----------
    scene : Scene
    controller, plant : str
        What ran.
    seed : int
        Of the measurement noise.
    pose : Equilibrium
        In which the robot started.
    dt : float
        Step of the plant [s].
    t : ndarray, shape (K + 1,)
        [s].
    x : ndarray, shape (K + 1, 4 + n)
        States of the plant.
    reference : ndarray, shape (K + 1, 2)
        Wanted tip positions [m]; NaN if there is nothing to track.
    u : ndarray, shape (M, n)
        Commanded motor rates [rad/s].
    plant_time : ndarray, shape (K,)
        Wall time of each plant step [s].
    control_time : ndarray, shape (M, 6)
        Wall time of each control step: total, linearisation, QP update, QP solution, of that inside the solver; and
        CPU time of its thread [s].
    iterations : ndarray, shape (M,)
        Of the solver.
    active_limits : dict
        In how many control periods each kind of limit shaped the plan.
    slack : dict
        By how much each kind of limit had to give at most, in its own unit (see `Plan`).
    rungs : dict
        How many poses of the plant each rung of the statics' ladder has solved (see `RodSolver`).
    events : list of dict
        Fall-backs, missed deadlines, snaps and failures: time, kind, message.
    rung : PlantSettings or None
        Physics and discretisation of the plant. None: it was another engine's.
    """

    scene: Scene
    controller: str
    plant: str
    seed: int
    pose: Equilibrium
    dt: float
    t: np.ndarray
    x: np.ndarray
    reference: np.ndarray
    u: np.ndarray
    plant_time: np.ndarray
    control_time: np.ndarray
    iterations: np.ndarray
    active_limits: dict[str, int]
    slack: dict[str, float]
    rungs: dict[str, int]
    events: list[dict[str, Any]] = field(default_factory=list)
    rung: PlantSettings | None = None

    def __post_init__(self) -> None:
        freeze(self)

    @property
    def steps_per_period(self) -> int:
        """Plant steps in a control period."""
        return round(self.scene.period / self.dt)

    @property
    def error(self) -> np.ndarray:
        """Distance of the tip from the reference, shape (K + 1,) [m]."""
        return np.asarray(np.hypot(*(self.x[:, :2] - self.reference).T))

    def limit_violations(self) -> int:
        """Control periods in which a command broke the limit on rate, on its change, or on the angle."""
        robot, period = self.scene.robot, self.scene.period
        change = np.diff(self.u, axis=0, prepend=np.zeros((1, robot.n_rods)))
        # Where the command leads from when it arrives, not where the motor's stop lets it get.
        starts = self.x[self.scene.delay * self.steps_per_period :: self.steps_per_period, 4:][: len(self.u)]
        angles = starts + period * self.u[: len(starts)]
        lower, upper = robot.angle_limits.T
        broken = np.abs(self.u).max(axis=1, initial=0.0) > robot.rate_limit + _LIMIT_SLACK
        broken |= np.abs(change).max(axis=1, initial=0.0) > robot.acceleration_limit * period + _LIMIT_SLACK
        outside = ((angles < lower - _ANGLE_SLACK) | (angles > upper + _ANGLE_SLACK)).any(axis=1)
        broken[: len(outside)] |= outside
        return int(broken.sum())

    @cached_property
    def peak_torque(self) -> float:
        """Largest torque that a motor had to supply, by the exact rods at the control periods [N m].

        The MPC keeps the robot's torque limit where it can; this is what to hold against it. Up to where the rods were
        lost, if they were: by a run that failed there, or by a snap.
        """
        plant = Plant(self.scene.robot, dt=self.dt)
        plant.reset(self.x[0], self.pose)
        largest = 0.0
        for x in self.x[:: self.steps_per_period]:
            try:
                largest = max(largest, float(np.abs(plant.equilibrium(x).motor_torque).max()))
            except PCRError:
                break
        return largest

    def _need(self) -> dict[str, Any] | None:
        """What the scene asks of the simulation, and what is known of that."""
        need, finding = self.scene.need, self.scene.finding
        if need is None:
            return None
        holds = self.rung is not None and verified(self.scene)
        steps = float(np.median(self.plant_time)) if len(self.plant_time) else math.inf
        control = float(np.median(self.control_time[:, 0])) if len(self.control_time) else 0.0
        return {
            "tip_accuracy_mm": 1e3 * need.tip_accuracy,
            "tip_error_mm": 1e3 * finding.tip_error if finding is not None and holds else None,
            "verified": holds,
            "plant_step_us": 1e6 * need.plant_step,
            "plant_step_met": steps <= need.plant_step,
            "control_step_us": 1e6 * need.control_step,
            "control_step_met": control <= need.control_step,
        }

    def hash(self) -> str:
        """Digest of states and inputs: equal for runs that are equal bit for bit."""
        digest = hashlib.sha256()
        for array in (self.t, self.x, self.u):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:16]

    def summary(self) -> dict[str, Any]:
        """Figures of the run, ready for JSON; what does not apply is None."""
        tracked = bool(np.isfinite(self.reference).all()) and len(self.t) > 0
        error_mm = 1e3 * self.error
        late = error_mm[self.t >= 1.0]
        kinds = [event["kind"] for event in self.events]
        rungs = Counter(event["rung"] for event in self.events if event["kind"] == "fallback")
        return {
            "scene": self.scene.name,
            "controller": self.controller,
            "plant": self.plant,
            "rung": plain(self.rung),
            "need": plain(self._need()),
            "seed": self.seed,
            "duration_s": float(self.t[-1]),
            "rms_mm": _rms(error_mm) if tracked else None,
            "rms_after_1s_mm": _rms(late) if tracked and len(late) else None,
            "max_mm": float(error_mm.max()) if tracked else None,
            "final_error_mm": float(error_mm[-1]) if tracked else None,
            "final_tip_m": self.x[-1, :2].tolist(),
            "plant_step_us": percentiles(1e6 * self.plant_time),
            "control_step_us": percentiles(1e6 * self.control_time[:, 0]),
            "control_cpu_us": percentiles(1e6 * self.control_time[:, 5]),
            "control_parts_us": {
                name: percentiles(1e6 * self.control_time[:, 1 + i])
                for i, name in enumerate(("linearise", "update", "solve", "solver"))
            },
            "solver_share": _share(self.control_time[:, 4], self.control_time[:, 0]),
            "plant_budget_us": 1e6 * self.dt,
            "control_budget_us": 1e6 * self.scene.period,
            "qp_iterations": {
                "p50": int(np.median(self.iterations)) if len(self.iterations) else None,
                "max": int(self.iterations.max(initial=0)),
            },
            "peak_torque_Nm": self.peak_torque,
            "torque_limit_Nm": self.scene.robot.torque_limit,
            "statics_rungs": self.rungs,
            "limit_violations": self.limit_violations(),
            "control_steps": len(self.u),
            "active_limits": self.active_limits,
            "slack": self.slack,
            "fallbacks": kinds.count("fallback"),
            "control_rungs": {"solved": len(self.u) - kinds.count("fallback"), **rungs},
            "deadline_misses": kinds.count("late"),
            "snaps": kinds.count("snap"),
            "failures": kinds.count("failure"),
            "events": self.events,
            "run_hash": self.hash(),
        }

    def save(self, folder: str | Path) -> dict[str, str]:
        """Write run.npz, run.csv and summary.json; return their paths by name."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        files = {name: str(folder / name) for name in ("run.npz", "run.csv", "summary.json")}
        np.savez_compressed(
            files["run.npz"], t=self.t, x=self.x, u=self.u, reference=self.reference, plant_time=self.plant_time,
            control_time=self.control_time, iterations=self.iterations,
            rung=json.dumps(plain(self.rung)), need=json.dumps(plain(self._need())),
        )  # fmt: skip
        n = self.scene.robot.n_rods
        per = self.steps_per_period
        with open(files["run.csv"], "w", newline="", encoding="utf-8") as handle:
            writer = csv.writer(handle)
            writer.writerow(["t_s", "p_x_m", "p_y_m", "v_x_m_s", "v_y_m_s", *(f"q{i}_rad" for i in range(n)),
                             "ref_x_m", "ref_y_m", *(f"u{i}_rad_s" for i in range(n))])  # fmt: skip
            for k, (t, x, reference) in enumerate(zip(self.t, self.x, self.reference, strict=True)):
                period = min(k // per, len(self.u) - 1)
                rates = self.u[period] if len(self.u) else np.full(n, math.nan)
                writer.writerow(f"{value:.9g}" for value in (t, *x, *reference, *rates))
        Path(files["summary.json"]).write_text(json.dumps({**self.summary(), "files": files}, indent=2) + "\n")
        return files


def percentiles(values: np.ndarray) -> dict[str, float | None]:
    """p50, p95, p99 and maximum; None where there is nothing to count."""
    if not len(values):
        return dict.fromkeys(("p50", "p95", "p99", "max"))
    p50, p95, p99 = np.percentile(values, [50, 95, 99])
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99), "max": float(values.max())}


def _share(part: np.ndarray, whole: np.ndarray) -> float | None:
    return float(part.sum() / whole.sum()) if whole.sum() else None


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
