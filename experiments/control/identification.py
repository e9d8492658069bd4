"""What are a robot's numbers worth, and does `pcr-mpc identify` find them?

In each episode a robot that is not as believed (`Spread`: stiffness, mass, drag, bases, delay, sensors, load are off)
runs a scene under a controller that believes the scene's robot. From that one log its numbers are identified. Then the
same robot runs the scene twice more, under controllers that have the identified numbers, and the true ones. Prints the
RMS errors after 1 s, how often 95 % intervals hold the truth, and what does not come out. Finished episodes are kept in
episodes.jsonl: the same command, given again, goes on.

    python -m experiments.control.identification --episodes 100
    python -m experiments.control.identification --plant mujoco --episodes 20
    python -m experiments.control.identification --logs data/logs --episodes 10      an open data set, with a data sheet
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pcr_mpc import PCRError, Robot, Run, Scene, load_scene, make_controller, simulate
from pcr_mpc.plant.mujoco.plant import MuJoCoPlant
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import BLUE, GREEN, GREY, ORANGE, plt, save_figure
from pcr_mpc.report.tables import table
from pcr_mpc.study.episodes.episodes import Spread, lighter
from pcr_mpc.study.episodes.parallel import collect, local_workers
from pcr_mpc.study.episodes.provenance import described, source_digest
from pcr_mpc.study.identification.identify import identify
from pcr_mpc.study.identification.logs.log import Log

Row = dict[str, Any]
MODELS = Path(__file__).parents[2] / "models"
DEFAULT_SCENE = MODELS / "scenes" / "lemniscate.toml"
LINKS = 40
ARMS = {"believed": ORANGE, "identified": BLUE, "true": GREEN}


def reality(scene: Scene, seed: int, spread: Spread) -> Scene:
    """The scene as it really is in the episode of a seed."""
    return spread.sample(scene.robot.n_rods, seed).applied_to(replace(scene, deadline=math.inf))


def drive(scene: Scene, true: Scene, plant: str, robot: Robot, delay: int, seed: int) -> Run:
    """Run a scene as it really is under a controller that believes in a robot and a delay."""
    believed = replace(scene, robot=robot, delay=delay, angle_step=true.angle_step, deadline=math.inf)
    controller = make_controller(believed, robot=robot)
    moved = MuJoCoPlant(true.robot, links=LINKS, dt=scene.plant.dt) if plant == "mujoco" else true.make_plant()
    return simulate(true, moved, controller, seed)


def log_of(run: Run, name: str) -> Log:
    """Log of a run: what was measured and told in each control period."""
    t = run.scene.period * np.arange(len(run.u))
    return Log(name, run.scene.period, t, run.measured[:, :2], run.measured[:, 4:], run.u)


def truth(true: Scene) -> dict[str, float]:
    """Numbers of a scene as it really is, by the names of `identify`."""
    robot = true.robot
    found = {"tip_mass": robot.tip_mass, "drag": robot.drag, "delay": float(true.delay)}
    found |= {"force_x": true.force[0], "force_y": true.force[1]}
    for i, rod in enumerate(robot.rods):
        found |= {f"rods[{i}].bending_stiffness": rod.bending_stiffness}
        found |= {f"rods[{i}].base_{axis}": rod.base[j] for j, axis in enumerate("xy")}
    return found


def model_of(scene: Scene, plant: str) -> Scene:
    """Scene whose physics identification assumes: with the rods' mass for a robot that is not our own."""
    if plant != "mujoco":
        return scene
    return replace(scene, plant=replace(scene.plant, inertia="condensed", integrator="rk4", dt=5e-3))


def rms_after_1s(run: Run) -> float:
    """RMS of the tracking error after the first second [mm]."""
    late = 1e3 * run.error[run.t >= 1.0]
    return float(np.sqrt(np.mean(late**2)))


def episode(scene: Scene, plant: str, spread: Spread, seed: int) -> Row:
    """One robot: its log, its numbers, and the loop with what was believed, found and true."""
    true = reality(scene, seed, spread)
    row: Row = {"seed": seed, **spread.sample(scene.robot.n_rods, seed).row(), "failure": ""}
    try:
        log_run = drive(scene, true, plant, scene.robot, scene.delay, seed)
        row["believed_mm"] = rms_after_1s(log_run)
        found = identify(model_of(scene, plant), [log_of(log_run, f"seed {seed}")])
        wanted = truth(true)
        row["inside"] = {one.name: bool(one.low <= wanted[one.name] <= one.high) for one in found.estimates}
        row["off"] = {one.name: (one.value - wanted[one.name]) / one.sd for one in found.estimates}
        row["told"] = {one.name: one.told for one in found.estimates}
        row["value"] = {one.name: one.value for one in found.estimates}
        row |= {"chi2": found.chi2_per_dof, "white": found.whiteness.white, "seconds": found.seconds}
        row |= {"residual_mm": 1e3 * (found.fits[0].rms() or 0.0), "loss": found.loss, "method": found.method}
        robot = replace(scene.robot, rods=found.robot.rods, tip_mass=found.robot.tip_mass, drag=found.robot.drag)
        row["identified_mm"] = rms_after_1s(drive(scene, true, plant, robot, max(0, round(found.delay)), seed))
        row["true_mm"] = rms_after_1s(drive(scene, true, plant, true.robot, true.delay, seed))
    except (PCRError, ValueError) as error:
        row["failure"] = f"{type(error).__name__}: {error}"
    return row


def summarise(rows: list[Row]) -> dict[str, Any]:
    """Figures of the study, ready for JSON."""
    good = [row for row in rows if not row["failure"]]
    if not good:
        return {"episodes": len(rows), "failed": len(rows)}
    believed, identified, true = (np.array([row[f"{arm}_mm"] for row in good]) for arm in ARMS)
    inside = [held for row in good for held in row["inside"].values()]
    names = list(good[0]["inside"])
    return {
        "episodes": len(rows),
        "failed": len(rows) - len(good),
        "failures": sorted({row["failure"] for row in rows if row["failure"]}),
        "rms_after_1s_mm": {
            arm: {"p5": float(np.quantile(v, 0.05)), "p50": float(np.median(v)), "p95": float(np.quantile(v, 0.95))}
            for arm, v in zip(ARMS, (believed, identified, true), strict=True)
        },
        "identified_within_1.1_of_true": float(np.mean(identified <= 1.1 * true)),
        "median_improvement": float(np.median(believed / identified)),
        "intervals_holding_truth": float(np.mean(inside)),
        "estimates": len(inside),
        "by_number": {name: float(np.mean([row["inside"][name] for row in good])) for name in names},
        "told_by_data": {name: float(np.mean([row["told"][name] == "data" for row in good])) for name in names},
        "chi2": {"p5": float(np.quantile([r["chi2"] for r in good], 0.05)),
                 "p50": float(np.median([r["chi2"] for r in good])),
                 "p95": float(np.quantile([r["chi2"] for r in good], 0.95))},
        "white": float(np.mean([row["white"] for row in good])),
        "residual_mm": float(np.median([row["residual_mm"] for row in good])),
        "seconds_p50": float(np.median([row["seconds"] for row in good])),
    }  # fmt: skip


def report(summary: dict[str, Any]) -> str:
    """Tables for the terminal."""
    if "rms_after_1s_mm" not in summary:
        return f"all {summary['episodes']} episodes failed"
    rows = [(arm, *(f"{value:.4g}" for value in q.values())) for arm, q in summary["rms_after_1s_mm"].items()]
    held = [
        (name, f"{100 * share:.0f}", f"{100 * summary['told_by_data'][name]:.0f}")
        for name, share in summary["by_number"].items()
    ]
    return "\n".join(
        [
            table(("RMS after 1 s [mm], numbers", "p5", "p50", "p95"), rows),
            "",
            table(("95 % intervals", "hold the truth [%]", "told by data [%]"), held),
            "",
            f"episodes               {summary['episodes']}, failed {summary['failed']}",
            f"within 1.1 of true     {100 * summary['identified_within_1.1_of_true']:.0f} %",
            f"median improvement     {summary['median_improvement']:.1f} times",
            f"intervals hold truth   {100 * summary['intervals_holding_truth']:.1f} % of {summary['estimates']}",
            f"chi^2                  {', '.join(f'{key} {value:.3g}' for key, value in summary['chi2'].items())}",
            f"white residuals        {100 * summary['white']:.0f} %; {summary['residual_mm']:.3g} mm RMS (median)",
            f"wall time of identify  {summary['seconds_p50']:.1f} s (median)",
        ]
    )


def plot(rows: list[Row], title: str, path: Path) -> None:
    """Distributions of the RMS error, and of the estimates' errors in their standard deviations."""
    good = [row for row in rows if not row["failure"]]
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.6), layout="constrained")
    share = 100 * (np.arange(len(good)) + 1) / len(good)
    for arm, colour in ARMS.items():
        left.step(
            np.sort([row[f"{arm}_mm"] for row in good]), share, where="post", color=colour, label=f"{arm} numbers"
        )
    left.set(xscale="log", xlabel="RMS error after 1 s [mm]", ylabel="robots [%]", title=title)
    left.legend(fontsize=9)
    names = list(good[0]["off"])
    right.axvspan(-1.96, 1.96, color=GREY, alpha=0.15, lw=0, label="95 %")
    for place, name in enumerate(reversed(names)):
        off = np.array([row["off"][name] for row in good])
        right.plot(off, np.full(len(off), place), "|", color=BLUE, ms=9, alpha=0.6)
    right.set_yticks(range(len(names)), list(reversed(names)), fontsize=8)
    right.set(xlabel="estimate less truth [standard deviations]", title="Errors of the estimates")
    right.legend(fontsize=9)
    save_figure(figure, path)


SHEET = """# Logs of planar parallel continuum robots

{count} logs of a pair of rods on a figure of eight, {plant}. Each robot is not as believed: its
numbers are drawn from its seed by `pcr_mpc.study.episodes.spread.Spread`. Made by
`python -m experiments.control.identification --logs FOLDER --plant {arm} --episodes {count} --duration {duration:g}`,
and again from the same seeds. MIT licence.

| column | is |
|---|---|
| `t_s` | time [s], every {period:g} ms |
| `p_x_m`, `p_y_m` | measured tip position [m], white noise |
| `q0_rad`, `q1_rad` | measured motor angles [rad], rounded to the encoder's step |
| `u0_rad_s`, `u1_rad_s` | commanded rates [rad/s], held from this row on; they reach the motors `delay` rows later |

truth.csv has, for each log, what was true: EI [N m^2], bases [m], tip mass [kg], drag [N s/m], delay [rows], force on
the tip [N], noise of the tip [m] and step of the encoders [rad]. Rods are 0.4 m long and of 0.0139 kg/m, as believed.
"""


def write_logs(scene: Scene, plant: str, spread: Spread, seeds: Sequence[int], folder: Path) -> None:
    """Write an open data set: a CSV file for each seed, what was true, and a data sheet."""
    facts = []
    for seed in seeds:
        true = reality(scene, seed, spread)
        run = drive(scene, true, plant, scene.robot, scene.delay, seed)
        name = f"{plant}_{seed}.csv"
        write_log(log_of(run, name), folder / name)
        facts.append({"log": name, **truth(true), "tip_noise_m": true.tip_noise, "angle_step_rad": true.angle_step})
    write_rows(folder / "truth.csv", facts, digits=9)
    engine = (
        "moved by MuJoCo with 40 links a rod" if plant == "mujoco" else "moved by the massless rods of this package"
    )
    sheet = SHEET.format(count=len(seeds), plant=engine, arm=plant, period=1e3 * scene.period, duration=scene.duration)
    (folder / "README.md").write_text(sheet, encoding="utf-8")


def write_log(log: Log, path: Path) -> None:
    """Write a log as CSV; what is missing is an empty cell."""
    names = ["t_s", "p_x_m", "p_y_m", *(f"q{i}_rad" for i in range(log.q.shape[1]))]
    names += [f"u{i}_rad_s" for i in range(log.q.shape[1])]
    rows = np.column_stack([log.t, log.p, log.q, log.u]).tolist()
    cells = [{n: "" if math.isnan(v) else v for n, v in zip(names, row, strict=True)} for row in rows]
    write_rows(path, cells, names, digits=8)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write rows and summary, plot; or write logs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=DEFAULT_SCENE, help="default: lemniscate")
    parser.add_argument("--plant", choices=("ours", "mujoco"), default="ours", help="whose robot moves (default ours)")
    parser.add_argument("--episodes", type=int, default=100, help="default 100")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode (default 0)")
    parser.add_argument("--duration", type=float, help="of an episode [s] (default: the scene's)")
    parser.add_argument("--jobs", type=int, help="processes on this machine (default: one a core)")
    parser.add_argument("--out", type=Path, help="folder for the results (default results/identification/SCENE_PLANT)")
    parser.add_argument("--logs", type=Path, metavar="FOLDER", help="write logs with a data sheet instead")
    parser.add_argument("--quick", action="store_true", help="2 episodes of 2 s")
    options = parser.parse_args(arguments)
    try:
        return _study(options)
    except (PCRError, ValueError, OSError) as error:
        print(f"identification: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as interrupt:
        print(f"identification: {interrupt}", file=sys.stderr)
        return 130


def _study(options: argparse.Namespace) -> int:
    scene = load_scene(options.scene)
    if scene.tuning is None:
        raise ValueError(f"scene {scene.name} has nothing to track")
    episodes, duration = (2, 2.0) if options.quick else (options.episodes, options.duration or scene.duration)
    scene = lighter(replace(scene, duration=duration))
    seeds, spread = range(options.seed, options.seed + episodes), Spread()
    if options.logs:
        write_logs(scene, options.plant, spread, seeds, options.logs)
        print(f"{episodes} logs and their data sheet are in {options.logs}")
        return 0
    folder = options.out or Path("results") / "identification" / f"{scene.name}_{options.plant}"
    folder.mkdir(parents=True, exist_ok=True)
    settings = {**described(scene, scene.tuning, spread), "plant": options.plant, "code": source_digest()}
    task = partial(episode, scene, options.plant, spread)
    with local_workers(options.jobs) as executor:
        rows = collect(executor, task, seeds, folder / "episodes.jsonl", settings, desc=scene.name)
    summary = summarise(rows)
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    if len(rows) > summary["failed"]:
        plot(rows, f"{scene.name}, robot: {options.plant}", folder / "identification.png")
    print(f"\n{report(summary)}\n\nwritten to {folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
