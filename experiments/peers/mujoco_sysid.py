"""The numbers of a robot from one log: `identify` beside mujoco.sysid.

A robot that is not as believed (`Spread`) runs the figure of eight for six seconds. Its numbers are found twice from
the same log: by `pcr_mpc.identify`, and by Gauss-Newton of mujoco.sysid with hinge chains of MuJoCo as the model. Both
are told the delay and take the same numbers for unknown, with the same priors; mujoco.sysid is also given the true
start. Once the robot is our own plant, once MuJoCo's: each method knows the physics of one of them and not of the
other. Shown are the CPU time, the estimates, and what the loop comes to with them.
Needs ``pip install "pcr_mpc[peers,mujoco]"``.

    python -m experiments.peers.mujoco_sysid
    python -m experiments.peers.mujoco_sysid --plants ours --seed 3
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments.control.identification import (
    DEFAULT_SCENE,
    LINKS,
    drive,
    log_of,
    model_of,
    reality,
    rms_after_1s,
    truth,
)
from pcr_mpc import PCRError, Robot, Run, Scene, load_scene
from pcr_mpc.plant.mujoco.plant import MuJoCoPlant
from pcr_mpc.report.tables import table
from pcr_mpc.study.episodes.episodes import Spread, lighter
from pcr_mpc.study.identification.identify import identify
from pcr_mpc.study.identification.parameters import Parameters, catalogue, chosen

PLANTS = ("ours", "mujoco")
STEP = 5e-3  # s, of MuJoCo: within 15 um of a fifth of it, and ten times as fast
EPS, TOLERANCE = 1e-4, 1e-4  # of its finite differences [standard deviations], and of its steps, relative
FURTHEST = 6.0  # standard deviations that an estimate may be from what is believed


def tips(run: Run, robot: Robot, force: tuple[float, float]) -> np.ndarray:
    """Tip that MuJoCo predicts in each control period of a run for a robot's numbers, shape (K, 2) [m]."""
    plant = MuJoCoPlant(robot, links=LINKS, dt=STEP, substeps=1)
    x = run.x[0]
    plant.reset(x, run.pose)
    found = np.empty((len(run.u), 2))
    per, steps = round(run.scene.period / STEP), round(STEP / run.dt)
    for k in range(len(found)):
        found[k] = x[:2]
        for j in range(per):
            x = plant.step(x, run.applied[(k * per + j) * steps], force)
    return found


def by_sysid(scene: Scene, run: Run, parameters: Parameters) -> tuple[np.ndarray, int]:
    """Parameters in standard deviations from what is believed, as mujoco.sysid finds them, and simulations it took."""
    from mujoco import sysid

    noise, measured, count = run.scene.tip_noise, run.measured[:, :2], [0]
    with tqdm(desc="mujoco.sysid", unit="simulation", mininterval=2.0) as bar:

        def residual(z: np.ndarray, _: Any) -> tuple[list[np.ndarray], None, None]:
            """What is left of the log, and of what is believed; a column for each point that is asked for."""
            columns = []
            for each in z.reshape(len(parameters.free), -1).T:
                values = parameters.values(each)
                off = tips(run, parameters.robot_at(each), (values["force_x"], values["force_y"])) - measured
                columns.append(np.concatenate([off.ravel() / noise, parameters.root @ each]))
                count[0] += 1
                bar.update()
            return [np.stack(columns, axis=1) if z.ndim > 1 else columns[0]], None, None

        start = sysid.ParameterDict()
        for one in parameters.free:
            start.add(sysid.Parameter(one.name, 0.0, -FURTHEST, FURTHEST))
        found, _ = sysid.optimize(
            start, residual, optimizer="mujoco", verbose=False, eps=EPS, xtol=TOLERANCE, output=io.StringIO()
        )
    return np.asarray(found.as_vector(), dtype=float), count[0]


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """What work comes to, and the CPU time that it took [s]."""
    began = time.process_time()
    return work(), time.process_time() - began


def compare(scene: Scene, plant: str, seed: int) -> dict[str, Any]:
    """One log, both ways."""
    true = reality(scene, seed, Spread())
    run = drive(scene, true, plant, scene.robot, scene.delay, seed)
    log, wanted = log_of(run, f"seed {seed}"), truth(true)
    told = {"delay": float(true.delay)}
    parameters = chosen(scene.robot, catalogue(scene.robot, 1, told["delay"], told["delay"] + 1.0), fixed=told)
    ours, our_time = timed(lambda: identify(model_of(scene, plant), [log], fixed=told))
    (z, simulations), their_time = timed(lambda: by_sysid(scene, run, parameters))
    theirs = parameters.values(z)
    arms = {"ours": ours.robot, "mujoco_sysid": parameters.robot_at(z)}
    loops = {}
    for name, robot in (arms | {"true": true.robot}).items():
        known = replace(scene.robot, rods=robot.rods, tip_mass=robot.tip_mass, drag=robot.drag)
        loops[name] = rms_after_1s(drive(scene, true, plant, known, true.delay, seed))
    estimates = [
        {"name": one.name, "true": wanted[one.name], "ours": one.value, "mujoco_sysid": theirs[one.name],
         "prior_sd": one.prior_sd}
        for one in ours.estimates
    ]  # fmt: skip
    off = {arm: float(np.sqrt(np.mean([((e[arm] - e["true"]) / e["prior_sd"]) ** 2 for e in estimates])))
           for arm in ("ours", "mujoco_sysid")}  # fmt: skip
    return {
        "plant": plant, "seed": seed, "tip_noise_mm": 1e3 * true.tip_noise, "estimates": estimates, "rms_off_sd": off,
        "cpu_s": {"ours": our_time, "mujoco_sysid": their_time}, "ratio": their_time / our_time,
        "simulations": simulations, "loop_rms_mm": {"believed": rms_after_1s(run), **loops},
    }  # fmt: skip


def report(found: dict[str, Any]) -> str:
    """Tables for the terminal."""
    rows = [(e["name"], *(f"{e[arm]:.5g}" for arm in ("true", "ours", "mujoco_sysid"))) for e in found["estimates"]]
    rows.append(("off, RMS [prior sd]", "", *(f"{value:.3g}" for value in found["rms_off_sd"].values())))
    loops = found["loop_rms_mm"]
    rows.append(("loop, RMS after 1 s [mm]", *(f"{loops[arm]:.3g}" for arm in ("true", "ours", "mujoco_sysid"))))
    rows.append(("CPU time [s]", "", *(f"{value:.3g}" for value in found["cpu_s"].values())))
    title = f"robot: {found['plant']}, seed {found['seed']}, tip noise {found['tip_noise_mm']:.3g} mm"
    body = table(("", "true", "ours", "mujoco.sysid"), rows)
    return f"{title}; ours is {found['ratio']:.0f} times as fast\n\n{body}\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare, print, and write a record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plants", nargs="+", choices=PLANTS, default=PLANTS, help="whose robot moves (default: both)")
    parser.add_argument("--seed", type=int, default=1, help="of the robot (default 1)")
    parser.add_argument("--duration", type=float, default=6.0, help="of the log [s] (default 6)")
    parser.add_argument("--out", type=Path, default=Path("results") / "mujoco_sysid.json", help="record to write")
    options = parser.parse_args(arguments)
    try:
        scene = lighter(replace(load_scene(DEFAULT_SCENE), duration=options.duration))
        found = {}
        for plant in options.plants:
            found[plant] = compare(scene, plant, options.seed)
            print(report(found[plant]), flush=True)
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    except ImportError as error:
        print(f'mujoco_sysid: {error}; pip install "pcr_mpc[peers,mujoco]"', file=sys.stderr)
        return 1
    except (PCRError, ValueError, OSError) as error:
        print(f"mujoco_sysid: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
