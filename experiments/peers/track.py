"""How far from the best possible is the linear MPC? The same scene by it, by nonlinear MPC, and by do-mpc.

Same weights, horizon, limits and reference for all. Nonlinear MPC predicts with the exact model; do-mpc does the same
with its own transcription and takes the measured state for the true one, so its figures are for scenes without noise,
delay or load. Writes track_SCENE.csv: a row for each controller, with the reason where it failed.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pcr_mpc import Equilibrium, Scene, SimulationError, TrackingMPC, Tuning, load_scene, simulate
from pcr_mpc.loop.controllers import Controller, motor_limits
from pcr_mpc.loop.nonlinear import make_nonlinear_mpc

SCENE = Path(__file__).parent.parent.parent / "models" / "scenes" / "lemniscate.toml"


class TrackingNonlinearMPC(TrackingMPC):
    """The tracking controller with the nonlinear MPC in place of the linear one."""

    def start(self, pose: Equilibrium) -> None:
        """See `Controller`."""
        limits = motor_limits(self._scene.robot, self._scene.period)
        self.mpc = make_nonlinear_mpc(self.robot, pose, self._tuning, limits)
        super().start(pose)


def along_plan(scene: Scene, tuning: Tuning) -> Controller:
    """Linear MPC by real-time iteration."""
    return TrackingMPC(scene, replace(tuning, model=replace(tuning.model, linearise="along_plan")))


def do_mpc(scene: Scene, tuning: Tuning) -> Controller:
    """The outside reference, which need not be installed."""
    from experiments.peers.do_mpc_controller import DoMPC

    return DoMPC(scene, tuning)


CONTROLLERS: dict[str, Callable[[Scene, Tuning], Controller]] = {
    "linear": TrackingMPC,
    "along plan": along_plan,
    "nonlinear": TrackingNonlinearMPC,
    "do-mpc": do_mpc,
}


def measure(scene: Scene, name: str) -> dict[str, Any]:
    """One row: tracking errors [mm], times of a control step [ms], iterations, and what went wrong."""
    assert scene.tuning is not None
    controller, failure = CONTROLLERS[name](scene, scene.tuning), ""
    try:
        run = simulate(scene, scene.make_plant(), controller)
    except SimulationError as error:
        run, failure = error.run, str(error)
    summary = run.summary()
    iterations = getattr(controller, "iterations", run.iterations)
    return {
        "controller": name,
        **{key: summary[key] for key in ("rms_mm", "rms_after_1s_mm", "max_mm", "final_error_mm")},
        **{f"step_{key}_ms": value / 1e3 for key, value in summary["control_step_us"].items()},
        "iterations_p50": float(np.median(iterations)),
        "iterations_max": int(np.max(iterations)),
        **{key: summary[key] for key in ("limit_violations", "fallbacks", "failures")},
        "failure": failure,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, write the CSV file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, nargs="?", default=SCENE)
    parser.add_argument("--duration", type=float, help="instead of the scene's [s]")
    parser.add_argument("--out", type=Path, default=Path("results/peers"), help="folder for the results")
    options = parser.parse_args(arguments)
    scene = load_scene(options.scene)
    if options.duration is not None:
        scene = replace(scene, duration=options.duration)
    rows = []
    for name in CONTROLLERS:
        if name == "do-mpc" and importlib.util.find_spec("do_mpc") is None:
            print("do-mpc is not installed: pip install -e '.[peers]'")
            continue
        row = measure(scene, name)
        rows.append(row)
        print(
            "  ".join(
                f"{key} {value:.3g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()
            )
        )
    options.out.mkdir(parents=True, exist_ok=True)
    with open(options.out / f"track_{scene.name}.csv", "w", newline="", encoding="utf-8") as handle:
        writer = csv.DictWriter(handle, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
