"""How good is the linear MPC? Every controller in every case, error against time per step.

From open loop to nonlinear MPC, and do-mpc where it is installed (extra "peers"), with the same weights (the frozen
MPC weights its inputs ten times less), horizon, limits and estimates. (do-mpc has no observer here: it is given the
true velocity, knows no load and no delay, and raises where it fails.) In the cases with something off by 20 % the
controllers believe in the nominal robot. Failures are rows.

Writes controllers.csv and controllers.png.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from pcr_mpc import Robot, Scene, SimulationError, Tuning, load_scene, load_tuning, make_controller, simulate
from pcr_mpc.errors import PCRError
from pcr_mpc.loop.parts.controllers import Controller
from pcr_mpc.report.style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, plt
from pcr_mpc.report.tables import table

ROOT = Path(__file__).parents[2]
SCENES = ROOT / "models" / "scenes"
# Label, tuning under controllers/, colour and marker.
CONTROLLERS = {
    "open loop": ("open_loop", GREY, "x"),
    "PD": ("pd", ORANGE, "v"),
    "LQR": ("lqr", SKY, "^"),
    "linear MPC, frozen": ("frozen", BLUE, "o"),
    "linear MPC, along the plan": ("default", GREEN, "s"),
    "nonlinear MPC": ("nonlinear", RED, "D"),
    "do-mpc": ("nonlinear", PURPLE, "P"),
}
_LOST = 100.0  # mm: more is no tracking, and drawn at this height
_SECONDS_QUICK = 1.5


@dataclass(frozen=True)
class Case:
    """One row of the comparison.

    Attributes
    ----------
    panel : str
        Of the picture; the worst of its cases is drawn.
    scene : Scene
        What really happens.
    believed : Robot
        By the controller.
    """

    panel: str
    scene: Scene
    believed: Robot


def general(name: str) -> Scene:
    """Scene with a general tuning instead of its own: period and horizon are to be the same for every controller."""
    tuning = "slow_motors" if name == "limited" else "default"
    return load_scene(SCENES / f"{name}.toml").tuned(load_tuning(ROOT / "controllers" / f"{tuning}.toml"))


def cases() -> dict[str, Case]:
    """All cases by name."""
    lemniscate = general("lemniscate")
    robot = lemniscate.robot

    def stiffer(factor: float) -> Robot:
        return replace(
            robot,
            rods=tuple(replace(rod, bending_stiffness=factor * rod.bending_stiffness) for rod in robot.rods),
        )

    def on_lemniscate(panel: str, **changes: Any) -> Case:
        return Case(panel, replace(lemniscate, **changes), robot)

    def scene_of(name: str) -> Case:
        scene = general(name)
        return Case(name.replace("_", " "), scene, scene.robot)

    off = "EI or mass off by 20 %"
    return {
        "nominal": on_lemniscate("nominal"),
        "limited": scene_of("limited"),
        "unknown load": on_lemniscate("unknown load", force=(0.5, -1.0)),
        "EI -20 %": on_lemniscate(off, robot=stiffer(0.8)),
        "EI +20 %": on_lemniscate(off, robot=stiffer(1.2)),
        "mass -20 %": on_lemniscate(off, robot=replace(robot, tip_mass=0.8 * robot.tip_mass)),
        "mass +20 %": on_lemniscate(off, robot=replace(robot, tip_mass=1.2 * robot.tip_mass)),
        "noise 0.05 mm": on_lemniscate("noise 0.05 mm", tip_noise=5e-5, angle_step=1.534e-3),
        "delay of 2 periods": on_lemniscate("delay of 2 periods", delay=2),
        "pick and place": scene_of("pick_and_place"),
    }


def build(label: str, case: Case) -> Controller:
    """Controller by its label, with the horizon of the scene's tuning."""
    assert case.scene.tuning is not None
    tuning: Tuning = load_tuning(ROOT / "controllers" / f"{CONTROLLERS[label][0]}.toml")
    if tuning.law.endswith("mpc"):
        tuning = replace(tuning, horizon=case.scene.tuning.horizon)
    if label == "do-mpc":
        from experiments.peers.do_mpc_controller import DoMPC

        return DoMPC(case.scene, tuning, case.believed)
    return make_controller(case.scene, tuning, case.believed)


def measure(name: str, case: Case, label: str) -> dict[str, Any]:
    """One row: error [mm], CPU time of a step [ms], and how the answers came about."""
    failure = ""
    try:
        controller = build(label, case)
        run = simulate(case.scene, case.scene.make_plant(), controller)
    except SimulationError as error:
        failure, run = str(error), error.run
    except PCRError as error:
        return {"case": name, "controller": label, "failure": f"{type(error).__name__}: {error}"}
    summary = run.summary()
    late = run.t >= min(1.0, run.t[-1] / 2)
    error_mm = 1e3 * run.error[late] if case.panel != "pick and place" else 1e3 * run.error
    rungs = {rung: count for rung, count in summary["control_rungs"].items() if rung != "solved" and count}
    return {
        "case": name,
        "controller": label,
        "rms_mm": float(np.sqrt(np.mean(error_mm**2))),
        "max_mm": float(error_mm.max()),
        **{f"step_{key}_ms": (summary["control_cpu_us"][key] or math.nan) / 1e3 for key in ("p50", "p99", "max")},
        "fallbacks": " ".join(f"{rung}:{count}" for rung, count in rungs.items()),
        "limit_violations": summary["limit_violations"],
        "failure": failure,
    }


def plot(rows: list[dict[str, Any]], found: dict[str, Case], path: Path) -> None:
    """Error against time per step, a panel for each kind of case; the bar leads from the median to p99."""
    panels = list(dict.fromkeys(case.panel for case in found.values()))
    figure, axes = plt.subplots(2, 4, figsize=(14, 6.6), sharex=True, sharey=True, layout="constrained")
    for at, panel in zip(axes.flat, panels, strict=False):
        for label, (_, colour, marker) in CONTROLLERS.items():
            mine = [r for r in rows if r["controller"] == label and found[r["case"]].panel == panel]
            failed = [r for r in mine if r["failure"]]
            done = [r for r in mine if "rms_mm" in r and math.isfinite(r["step_p50_ms"])]
            if not done:
                continue
            worst = max(done, key=lambda r: r["rms_mm"])
            lost = bool(failed) or worst["rms_mm"] > _LOST
            height = _LOST if lost else worst["rms_mm"]
            at.plot([worst["step_p50_ms"], worst["step_p99_ms"]], [height] * 2, color=colour, lw=1.5)
            at.plot(worst["step_p50_ms"], height, marker, color=colour, ms=8, mfc="none" if lost else colour, mew=1.8)
            if lost:
                at.annotate("failed", (worst["step_p50_ms"], height), (0, -13), textcoords="offset points",
                            ha="center", fontsize=8, color=colour)  # fmt: skip
        at.set(xscale="log", yscale="log", title=panel)
    for at in axes[:, 0]:
        at.set_ylabel("RMS tracking error [mm]")
    for at in axes[1]:
        at.set_xlabel("CPU time per control step, p50 to p99 [ms]")
    handles = [plt.Line2D([], [], color=c, marker=m, ls="-", ms=8, label=label)
               for label, (_, c, m) in CONTROLLERS.items()]  # fmt: skip
    last = axes.flat[len(panels)] if len(panels) < axes.size else None
    if last is not None:
        last.axis("off")
        last.legend(handles=handles, loc="center", fontsize=11)
    figure.savefig(path)
    plt.close(figure)


def show(rows: list[dict[str, Any]]) -> str:
    """Table of all rows."""

    def number(row: dict[str, Any], key: str) -> str:
        return f"{row[key]:.3g}" if key in row else "-"

    cells = [
        (row["case"], row["controller"], number(row, "rms_mm"), number(row, "max_mm"), number(row, "step_p50_ms"),
         number(row, "step_p99_ms"), row.get("fallbacks") or "-", "FAILED" if row["failure"] else "ok")
        for row in rows
    ]  # fmt: skip
    return table(("case", "controller", "RMS [mm]", "max [mm]", "p50 [ms]", "p99 [ms]", "fall-backs", ""), cells)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, write the CSV file and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{_SECONDS_QUICK} s of every scene")
    parser.add_argument("--out", type=Path, default=Path("results/controllers"), help="folder for the results")
    options = parser.parse_args(arguments)
    found = cases()
    if options.quick:
        found = {
            name: replace(case, scene=replace(case.scene, duration=min(_SECONDS_QUICK, case.scene.duration)))
            for name, case in found.items()
        }
    labels = [label for label in CONTROLLERS if label != "do-mpc" or importlib.util.find_spec("do_mpc")]
    if "do-mpc" not in labels:
        print("do-mpc is not installed, and left out: pip install 'pcr_mpc[peers]'")
    rows: list[dict[str, Any]] = []
    options.out.mkdir(parents=True, exist_ok=True)
    fields = ["case", "controller", "rms_mm", "max_mm", "step_p50_ms", "step_p99_ms", "step_max_ms", "fallbacks",
              "limit_violations", "failure"]  # fmt: skip
    with open(options.out / "controllers.csv", "w", newline="", encoding="utf-8") as handle:
        writer = csv.DictWriter(handle, fieldnames=fields)
        writer.writeheader()
        for name, label in tqdm([(name, label) for name in found for label in labels], unit="run"):
            rows.append(measure(name, found[name], label))
            writer.writerow(rows[-1])
            handle.flush()
    print(show(rows))
    for row in rows:
        if row["failure"]:
            print(f"{row['case']}, {row['controller']}: {row['failure']}")
    plot(rows, found, options.out / "controllers.png")
    print(f"written to {options.out}")


if __name__ == "__main__":
    main()
