"""The record of a closed-loop run."""

from __future__ import annotations

import hashlib
import json
import zipfile
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ...control.tuning import Tuning
from ...errors import ModelError
from ...files import require_folder, results
from ...frozen import Frozen
from ...plain import plain
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ..learning.laps import Laps, laps_of
from ..scene.scene import Scene
from ..scene.settings import PlantSettings
from . import limits as run_limits
from . import summary as run_summary
from .record import ARRAYS, FORMAT, from_text, record, write_csv

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

    def laps(self) -> Laps | None:
        """Laps of the reference that were run; None where it does not come round."""
        return laps_of(self.scene.trajectory, float(self.t[-1]))

    def lap_errors(self) -> np.ndarray:
        """RMS distance of the tip from the reference in each lap at full speed, shape (laps,) [m]: whole laps, and what
        is left of the last one until the path is slowed down, if that is half of it."""
        laps = self.laps()
        if laps is None:
            return np.empty(0)
        edges = laps.judged(self.scene.period) * self.steps_per_period
        return np.array([np.sqrt(np.mean(self.error[a:b] ** 2)) for a, b in pairwise(edges.tolist())])

    def limit_violations(self) -> int:
        """Control periods in which a command broke the limit on rate, on its change, or on the angle."""
        return run_limits.limit_violations(self)

    @cached_property
    def pose_figures(self) -> np.ndarray:
        """Of the exact rods at the starts and ends of control periods: torques, strains, rod margin, stiffness.

        NaN from where the rods were lost, if they were: by a run that failed there, or by a snap.
        """
        return run_limits.pose_figures(self)

    @property
    def torques(self) -> np.ndarray:
        """Of the motors at the starts and ends of control periods, shape (M + 1, n) [N m]; NaN where rods were lost."""
        return self.pose_figures[:, : self.scene.robot.n_rods]

    @property
    def strains(self) -> np.ndarray:
        """Largest of each rod at the starts and ends of control periods, shape (M + 1, n) [-].

        NaN where rods were lost, or where no thickness is known.
        """
        return self.pose_figures[:, self.scene.robot.n_rods : -2]

    @property
    def peak_strain(self) -> float | None:
        """Largest strain of a rod, at the control periods, up to where the rods were lost; None if none is known."""
        known = self.strains[np.isfinite(self.strains)]
        return float(known.max()) if len(known) else None

    def overstrained(self) -> list[dict[str, Any]]:
        """Events of a rod that is strained beyond its limit: one for each stretch of time, with the largest strain."""
        return run_limits.overstrained(self)

    @property
    def peak_torque(self) -> float:
        """Largest torque that a motor had to supply, at the control periods, up to where the rods were lost [N m]."""
        return float(np.abs(self.torques).max(initial=0.0, where=np.isfinite(self.torques)))

    def pose_violations(self) -> dict[str, int]:
        """Starts and ends of control periods at which the robot was beyond a limit on poses, for each kind of limit.

        The controller keeps these limits where it can, and may leave the reference for it.
        """
        return run_limits.pose_violations(self)

    def deadline_misses(self) -> int:
        """Decisions that came after the scene's deadline, or took longer than the control period."""
        return int((self.decision_time > min(self.scene.deadline, self.scene.period)).sum())

    def verdict(self) -> str:
        """Why the run is no good, in one line; empty if it is not known to be bad.

        It ended early; or fewer than half of its decisions were solved as asked; or commands broke the motors' limits
        on rate or its change; or the tip left the reference by more than the scene allows.
        """
        found = [f"failed at t = {event['t']:.4g} s: {event['message']}" for event in self.events
                 if event["kind"] == "failure"]  # fmt: skip
        return "; ".join(found + run_summary.lost(self))

    def hash(self) -> str:
        """Digest of states and inputs: equal for runs that are equal bit for bit."""
        digest = hashlib.sha256()
        for array in (self.t, self.x, self.u):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:16]

    def summary(self) -> dict[str, Any]:
        """Figures of the run, ready for JSON; what does not apply is None."""
        return run_summary.summary(self)

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
            np.savez_compressed(staged / "run.npz", **record(self), need=json.dumps(plain(run_summary.need_of(self))))
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
