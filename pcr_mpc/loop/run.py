"""The record of a closed-loop run."""

from __future__ import annotations

import hashlib
import json
import math
import zipfile
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..control.tuning import Tuning
from ..errors import ModelError, PCRError
from ..files import require_folder, results
from ..frozen import Frozen, read_only
from ..linearisation.linear_limits import KINDS
from ..plain import plain
from ..plant.motion.plant import Plant
from ..plant.robot import Robot
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.stability import least_rod_margin
from .finding import verified
from .record import ARRAYS, FORMAT, from_text, record, write_csv
from .scene import Scene
from .settings import PlantSettings
from .untold_delay import UntoldDelay

# Commands within this of a limit keep it: rounding for rates, relative to it, the QP's tolerance for angles [rad].
_LIMIT_SLACK = 1e-9
_ANGLE_SLACK = 1e-5
# Of a limit on poses, relative to it: the controller keeps them to its solver's tolerance.
_POSE_SLACK = 1e-3
RECORD = ("run.npz", "run.csv", "summary.json")


@dataclass(frozen=True, eq=False)
class Run(Frozen):
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
        Motor rates as decided [rad/s]: they reach the motors a delay later, see ``applied``.
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
        Warnings, fall-backs, missed deadlines, measurements that were not believed, snaps and failures: time, kind,
        message.
    rung : PlantSettings or None
        Physics and discretisation of the plant. None: it was another engine's.
    measured : ndarray, shape (M, 4 + n)
        States as the sensors gave them to the controller.
    estimate : ndarray, shape (M, 4 + n)
        States that the controller took for true; NaN where it did not say.
    estimated_force : ndarray, shape (M, 2)
        Unknown force on the tip as it was estimated [N]; NaN where it was not.
    applied : ndarray, shape (K, n)
        Motor rates that each plant step got [rad/s]; a motor at its stop does not follow them.
    decision_time : ndarray, shape (M,)
        Time that each decision is taken to have cost [s]: measured, or as ``spent`` of `simulate` says.
    tuning : Tuning or None
        Of the controller, where it has one.
    believed : Robot or None
        What the controller took the robot for, where it says so.
    versions : dict
        Of the toolkit and of what does its arithmetic.
    asked : dict or None
        What the reference asks of motors and tip at most (see `reference_demand`), where the controller knows it.
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
    measured: np.ndarray = field(kw_only=True)
    estimate: np.ndarray = field(kw_only=True)
    estimated_force: np.ndarray = field(kw_only=True)
    applied: np.ndarray = field(kw_only=True)
    decision_time: np.ndarray = field(kw_only=True)
    tuning: Tuning | None = field(kw_only=True)
    believed: Robot | None = field(kw_only=True)
    versions: dict[str, str] = field(kw_only=True)
    asked: dict[str, Any] | None = field(default=None, kw_only=True)

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
        later = UntoldDelay(self.scene.untold_delay, self.dt, robot.n_rods)
        first = self.scene.delay * self.steps_per_period + later.steps
        starts = self.x[first :: self.steps_per_period, 4:][: len(self.u)]
        lower, upper = robot.angle_limits.T
        if later.fraction:  # the command before has the rest of a step
            before = np.vstack([np.zeros(robot.n_rods), self.u])[: len(starts)]
            moved = starts + later.fraction * self.dt * before
            starts = np.clip(moved, np.minimum(lower, starts), np.maximum(upper, starts))
        angles = starts + period * self.u[: len(starts)]
        broken = np.abs(self.u).max(axis=1, initial=0.0) > (1 + _LIMIT_SLACK) * robot.rate_limit
        broken |= np.abs(change).max(axis=1, initial=0.0) > (1 + _LIMIT_SLACK) * robot.acceleration_limit * period
        # Coming back from beyond a stop breaks nothing.
        outside = (angles < lower - _ANGLE_SLACK) & (angles <= starts) | (angles > upper + _ANGLE_SLACK) & (
            angles >= starts
        )
        broken[: len(outside)] |= outside.any(axis=1)
        return int(broken.sum())

    @cached_property
    def _poses(self) -> np.ndarray:
        """Of the exact rods at the starts and ends of control periods: torques, strains, rod margin, stiffness.

        NaN from where the rods were lost, if they were: by a run that failed there, or by a snap.
        """
        plant, states = Plant(self.scene.robot, dt=self.dt), self.x[:: self.steps_per_period]
        plant.reset(self.x[0], self.pose)
        found = np.full((len(states), 2 * self.scene.robot.n_rods + 2), np.nan)
        for k, x in enumerate(states):
            try:
                eq = plant.equilibrium(x)
            except (PCRError, ValueError):
                break
            found[k] = *eq.motor_torque, *eq.max_strain, least_rod_margin(eq), eq.stiffness_eigenvalues[0]
        return read_only(found)

    @property
    def torques(self) -> np.ndarray:
        """Of the motors at the starts and ends of control periods, shape (M + 1, n) [N m]; NaN where rods were lost."""
        return self._poses[:, : self.scene.robot.n_rods]

    @property
    def strains(self) -> np.ndarray:
        """Largest of each rod at the starts and ends of control periods, shape (M + 1, n) [-].

        NaN where rods were lost, or where no thickness is known.
        """
        return self._poses[:, self.scene.robot.n_rods : -2]

    @property
    def peak_strain(self) -> float | None:
        """Largest strain of a rod, at the control periods, up to where the rods were lost; None if none is known."""
        known = self.strains[np.isfinite(self.strains)]
        return float(known.max()) if len(known) else None

    def overstrained(self) -> list[dict[str, Any]]:
        """Events of a rod that is strained beyond its limit: one for each stretch of time, with the largest strain."""
        limits, period = self.scene.strain_limits, self.scene.period
        found = []
        for i, (strains, limit) in enumerate(zip(self.strains.T, limits.tolist(), strict=True)):
            # Written so that NaN is no excess.
            beyond = np.concatenate([[False], strains > (1 + _POSE_SLACK) * limit, [False]])
            for first, after in np.flatnonzero(np.diff(beyond)).reshape(-1, 2).tolist():
                worst = first + int(strains[first:after].argmax())
                found.append(
                    {
                        "t": first * period,
                        "kind": "strain",
                        "message": f"rod {i} is strained by up to {100 * strains[worst]:.3g} % (at t = "
                        f"{worst * period:.3f} s), beyond its limit of {100 * limit:.3g} %, for {after - first} of "
                        f"{len(strains)} starts and ends of periods",
                    }
                )
        return sorted(found, key=lambda event: float(event["t"]))

    @property
    def peak_torque(self) -> float:
        """Largest torque that a motor had to supply, at the control periods, up to where the rods were lost [N m]."""
        return float(np.abs(self.torques).max(initial=0.0, where=np.isfinite(self.torques)))

    def pose_violations(self) -> dict[str, int]:
        """Starts and ends of control periods at which the robot was beyond a limit on poses, for each kind of limit.

        The controller keeps these limits where it can, and may leave the reference for it.
        """
        limits, tips = self.scene.pose_limits, self.x[:: self.steps_per_period, :2]
        margins, stiffness = self._poses[:, -2:].T
        strained = True if np.isfinite(self.scene.strain_limits).any() else None
        given = dict(zip(KINDS, (True, limits.tip_lower, limits.rod_margin, limits.stiffness, strained), strict=True))
        broken = {"torque": (np.abs(self.torques) > (1 + _POSE_SLACK) * self.scene.torque_limit).any(axis=1)}
        if limits.tip_lower is not None and limits.tip_upper is not None:
            lower, upper = np.array(limits.tip_lower), np.array(limits.tip_upper)
            slack = _POSE_SLACK * (upper - lower)
            broken["tip region"] = ((tips < lower - slack) | (tips > upper + slack)).any(axis=1)
        if limits.rod_margin is not None:
            broken["rod margin"] = margins < limits.rod_margin - _POSE_SLACK
        if limits.stiffness is not None:
            broken["stiffness"] = stiffness < (1 - _POSE_SLACK) * limits.stiffness
        broken["strain"] = (self.strains > (1 + _POSE_SLACK) * self.scene.strain_limits).any(axis=1)
        return {kind: int(broken[kind].sum()) for kind, limit in given.items() if limit is not None}

    def deadline_misses(self) -> int:
        """Decisions that came after the scene's deadline, or took longer than the control period."""
        return int((self.decision_time > min(self.scene.deadline, self.scene.period)).sum())

    def verdict(self) -> str:
        """Why the run is no good, in one line; empty if it is not known to be bad.

        It ended early; or fewer than half of its decisions were solved as asked; or the tip left the reference by more
        than the scene allows.
        """
        found = [f"failed at t = {event['t']:.4g} s: {event['message']}" for event in self.events
                 if event["kind"] == "failure"]  # fmt: skip
        return "; ".join(found + self._lost())

    def _lost(self) -> list[str]:
        """What makes a run that may have come to its end a failure."""
        found = []
        solved = len(self.u) - sum(event["kind"] == "fallback" for event in self.events)
        if 2 * solved < len(self.u):
            found.append(f"only {solved} of {len(self.u)} decisions were solved")
        if np.isfinite(self.reference).all() and len(self.t):
            worst = int(self.error.argmax())
            if not self.error[worst] <= self.scene.allowed_error:  # so written that NaN is lost
                found.append(
                    f"tip lost: {1e3 * self.error[worst]:.1f} mm from the reference at t = {self.t[worst]:.3f} s, "
                    f"allowed are {1e3 * self.scene.allowed_error:g} mm"
                )
        return found

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
        least = float(self.scene.strain_limits.min())
        return {
            "scene": self.scene.name,
            "verdict": self.verdict(),
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
            "asked": self.asked,
            "peak_torque_Nm": self.peak_torque,
            "torque_limit_Nm": self.scene.torque_limit,
            "peak_strain": self.peak_strain,
            "strain_limit": least if math.isfinite(least) else None,
            "pose_violations": self.pose_violations(),
            "statics_rungs": self.rungs,
            "limit_violations": self.limit_violations(),
            "control_steps": len(self.u),
            "active_limits": self.active_limits,
            "slack": self.slack,
            "fallbacks": kinds.count("fallback"),
            "control_rungs": {"solved": len(self.u) - kinds.count("fallback"), **rungs},
            "deadline_misses": self.deadline_misses(),
            "snaps": kinds.count("snap"),
            "warnings": kinds.count("warning"),
            "refused_measurements": kinds.count("measurement"),
            "failures": kinds.count("failure") or len(self._lost()),
            "events": sorted([*self.events, *self.overstrained()], key=lambda event: float(event["t"])),
            "run_hash": self.hash(),
        }

    def save(self, folder: str | Path, *, force: bool = False) -> dict[str, str]:
        """Write run.npz, run.csv and summary.json; return their paths by name.

        They replace what an earlier run has left in the folder, its pictures too.

        run.npz holds everything, for `load_run`; its ``about`` says as JSON what each array is, with units. run.csv has
        a row for each plant step, with what the controller was given, took for true and decided (``u0_rad_s``) in the
        control period that the step is in, what the motors got in the step (``u0_applied_rad_s``), and the torques at
        the start of the period.

        Raises
        ------
        OutputError
            A file of this name was not written here, or was changed since, and ``force`` is not given.
        """
        folder = Path(folder)
        files = {name: str(folder / name) for name in RECORD}
        require_folder(folder, files, force=force)
        with results(folder) as staged:
            np.savez_compressed(staged / "run.npz", **record(self), need=json.dumps(plain(self._need())))
            write_csv(self, staged / "run.csv")
            text = json.dumps({**self.summary(), "files": files}, indent=2)
            (staged / "summary.json").write_text(text + "\n", encoding="utf-8")
        return files


def load_run(folder: str | Path) -> Run:
    """Bring back a run from the folder that `Run.save` wrote it into, to the last bit.

    A trajectory that is not one of the toolkit's comes back as samples at the plant's steps.

    Raises
    ------
    FileNotFoundError
        There is no run.npz in the folder.
    ModelError
        The file is no run, or one of another version of the toolkit.
    """
    path = Path(folder) / "run.npz"
    try:
        with open(path, "rb") as handle, np.load(handle) as stored:  # a file that is no archive is closed, too
            if "format" not in stored or int(stored["format"]) != FORMAT:
                found = int(stored["format"]) if "format" in stored else "none"
                raise ModelError(
                    f"{path}: format of the record is {found}, expected {FORMAT}; read its arrays with numpy.load, or "
                    "load it with the version that wrote it",
                    file=str(path),
                )
            return Run(**{name: stored[name] for name in ARRAYS}, **from_text(str(stored["record"])))
    except (zipfile.BadZipFile, ValueError, KeyError, TypeError, EOFError) as error:
        if isinstance(error, ModelError) and "file" in error.details:
            raise
        raise ModelError(f"{path}: no complete record of a run: {error}; run it again", file=str(path)) from error


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
