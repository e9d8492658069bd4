"""What a run rests on, as text from which the same objects are made again, to the last bit."""

from __future__ import annotations

import csv
import json
import platform
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from ...control.observer import ObserverTuning
from ...control.tuning import LearningTuning, Model, Tuning
from ...errors import ModelError
from ...linearisation.pose_limits import PoseLimits
from ...plant.robot import Robot
from ...plant.rod import Rod
from ...plant.statics.equilibrium import Equilibrium
from ..hardware.camera import Camera
from ..hardware.motors import Motors
from ..references.reading import KINDS, built_in
from ..scene.scene import Scene
from ..scene.settings import Finding, Need, Payload, PlantSettings

# Arrays of a run, and what run.npz says of them.
ARRAYS = {
    "t": "times of the plant's steps, K + 1 [s]",
    "x": "states at t: tip position (2) [m], tip velocity (2) [m/s], motor angles (n) [rad]",
    "reference": "wanted tip positions at t [m]",
    "applied": "motor rates that each of the K plant steps got, after the scene's delays and lateness [rad/s]; "
    "where the scene has [motors], those at which these turn the clamps; a motor at its stop does not follow them",
    "u": "motor rates as decided in each of the M control periods; the motors get them the scene's delay later "
    "(see applied) [rad/s]",
    "measured": "states as the sensors gave them to the controller in each control period, noise and all, as x",
    "estimate": "states that the controller took for true in each control period, as x; NaN where it gave none",
    "estimated_force": "unknown force on the tip as estimated in each control period [N]; NaN where it was not",
    "decision_time": "time that each decision is taken to have cost [s]",
    "plant_time": "wall time of each plant step [s]",
    "control_time": "of each control step: total, linearisation, QP update, QP solution, of that inside the solver "
    "(all wall time), and CPU time of its thread [s]",
    "iterations": "of the solver in each control period",
}
_DERIVED = {
    "torques": "of the motors at the M + 1 starts and ends of control periods, by the exact rods [N m]; NaN where "
    "they were lost",
    "strains": "largest of each rod, likewise [-]; NaN where no thickness is known, too",
}
_OTHERS = ("scene", "controller", "plant", "seed", "pose", "dt", "active_limits", "slack", "rungs", "events", "rung",
           "tuning", "believed", "versions", "asked")  # fmt: skip
FORMAT = 1


@dataclass(frozen=True, eq=False)
class Recorded:
    """A trajectory of one's own as a record keeps it: samples, and straight lines in between.

    Attributes
    ----------
    t : ndarray, shape (K,)
        [s].
    samples : ndarray, shape (K, 3, 2)
        Position [m], velocity [m/s] and acceleration [m/s^2].
    """

    t: np.ndarray
    samples: np.ndarray

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """See `Trajectory`."""
        columns = [np.interp(t, self.t, column) for column in self.samples.reshape(len(self.t), 6).T]
        return np.stack(columns, axis=1).reshape(len(t), 3, 2)


_KINDS: tuple[type, ...] = (
    Scene, Robot, Rod, PlantSettings, Payload, Need, Finding, PoseLimits, Motors, Camera, Tuning, Model, ObserverTuning,
    LearningTuning, *KINDS, Recorded, Equilibrium,
)  # fmt: skip
_BY_NAME = {kind.__name__: kind for kind in _KINDS}


def to_text(thing: Any) -> str:
    """JSON of scenes, robots, tunings and equilibria, of their parts, and of what holds them."""
    return json.dumps(_plain(thing))


def from_text(text: str) -> Any:
    """Make again what `to_text` wrote.

    Raises
    ------
    ModelError
        It holds a class that is not the toolkit's.
    """
    return _made(json.loads(text))


def record(run: Any) -> dict[str, Any]:
    """Everything that a `Run` holds, as arrays and text."""
    scene, tuning = run.scene, run.tuning
    if scene.trajectory is not None and not (built_in(scene.trajectory) or type(scene.trajectory) is Recorded):
        # As far as a controller with this tuning looks ahead, too.
        ahead = (1 if tuning is None else tuning.horizon) + scene.delay + 1
        t = run.dt * np.arange(round((scene.duration + ahead * scene.period) / run.dt) + 1)
        scene = replace(scene, trajectory=Recorded(t, np.asarray(scene.trajectory(t), dtype=float)))
    others = {name: getattr(run, name) for name in _OTHERS} | {"scene": scene}
    return {
        **{name: getattr(run, name) for name in ARRAYS},
        "torques": run.torques,
        "strains": run.strains,
        "about": json.dumps(ARRAYS | _DERIVED),
        "format": FORMAT,
        "record": to_text(others),
        "rung": json.dumps(run.rung and asdict(run.rung)),
    }


def write_csv(run: Any, path: Path) -> None:
    """Write a row for each plant step of a `Run` (see `Run.save`)."""
    n, per = run.scene.robot.n_rods, run.steps_per_period
    thick = [i for i, rod in enumerate(run.scene.robot.rods) if rod.half_thickness is not None]
    state = ["p_x_m", "p_y_m", "v_x_m_s", "v_y_m_s", *(f"q{i}_rad" for i in range(n))]
    names = ["t_s", *state, "ref_x_m", "ref_y_m", *(f"u{i}_rad_s" for i in range(n)),
             *(f"u{i}_applied_rad_s" for i in range(n)), *(f"measured_{name}" for name in state),
             *(f"estimated_{name}" for name in state), "estimated_force_x_N", "estimated_force_y_N",
             *(f"torque{i}_Nm" for i in range(n)), *(f"strain{i}" for i in thick)]  # fmt: skip
    # What there is none of, in a run that failed at once, is NaN.
    applied = run.applied if len(run.applied) else np.full((1, n), np.nan)
    decided = np.hstack([run.u, run.measured, run.estimate, run.estimated_force])
    decided = decided if len(decided) else np.full((1, decided.shape[1]), np.nan)
    k = np.arange(len(run.t))
    period = np.minimum(k // per, len(decided) - 1)
    rows = np.hstack(
        [run.t[:, None], run.x, run.reference, decided[period, :n], applied[np.minimum(k, len(applied) - 1)],
         decided[period, n:], run.torques[k // per], run.strains[k // per][:, thick]]
    )  # fmt: skip
    with open(path, "w", newline="", encoding="utf-8") as handle:
        writer = csv.writer(handle)
        writer.writerow(names)
        writer.writerows([f"{value:.9g}" for value in row] for row in rows.tolist())


@lru_cache(maxsize=1)
def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in ("pcr_mpc", "casadi", "numpy", "osqp"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # used from its folder, not installed
            found[name] = "unknown"
    return found


def versions() -> dict[str, str]:
    """Versions of the toolkit and of what does its arithmetic."""
    return dict(_versions())


def _plain(thing: Any) -> Any:
    if isinstance(thing, np.ndarray):
        return {"array": thing.ravel().tolist(), "shape": list(thing.shape)}
    if isinstance(thing, np.generic):
        return thing.item()
    if isinstance(thing, tuple):
        return {"tuple": [_plain(value) for value in thing]}
    if isinstance(thing, list):
        return [_plain(value) for value in thing]
    if isinstance(thing, dict):
        return {"dict": [[_plain(key), _plain(value)] for key, value in thing.items()]}
    if type(thing) in _KINDS:
        return {"class": type(thing).__name__} | {
            field.name: _plain(getattr(thing, field.name)) for field in fields(thing)
        }
    if thing is None or isinstance(thing, bool | int | float | str):
        return thing
    return {"class": type(thing).__qualname__, "unknown": repr(thing)}


def _made(plain: Any) -> Any:
    if isinstance(plain, list):
        return [_made(value) for value in plain]
    if not isinstance(plain, dict):
        return plain
    if "array" in plain:
        return np.array(plain["array"], dtype=float).reshape(plain["shape"])
    if "tuple" in plain:
        return tuple(_made(value) for value in plain["tuple"])
    if "dict" in plain:
        return {_made(key): _made(value) for key, value in plain["dict"]}
    kind = _BY_NAME.get(plain["class"])
    if kind is None:
        raise ModelError(f"the record holds a {plain['class']}, which is no class of pcr_mpc: {plain.get('unknown')}")
    return kind(**{key: _made(value) for key, value in plain.items() if key != "class"})
