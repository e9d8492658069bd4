"""Does another engine's robot move as ours, and does a controller built on our models hold it?

Part one: the default robot's tip is let go with the motors at rest, in the two ways of `rod_inertia`, and MuJoCo's
hinge chains are compared for one second with rods of distributed mass in strain modes, `Plant(inertia="full")`: by
number of links, time step and scheme, with the time that they take. Explicit springs are MuJoCo's default; a blow-up is
a row. PyElastica's rods too, where it is installed (extra `peers`). Then the other way round: every inertia of `Plant`
against the chains of 40 and 80 links extrapolated to infinitely many, a yardstick of which nothing was written here but
the extrapolation.

Part two: closed loop on the lemniscate, and on one run through in half the time, against MuJoCo and against our own
robot; the controller's model without and with the rods' inertia, its observer on and off.

Writes a CSV for each part and a picture. Run as ``python -m experiments.motion.mujoco_agreement``.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
from tqdm import tqdm

from experiments.motion.rod_inertia import QUICK_DURATION, RELEASES, STEP, furthest, start, swing
from pcr_mpc import PCRError, Plant, Robot, load_robot, load_scene, make_controller, simulate
from pcr_mpc.plant.mujoco.hinge_chain import settled_chains
from pcr_mpc.plant.mujoco.mjcf import coordinates, mjcf
from pcr_mpc.plant.mujoco.plant import MuJoCoPlant
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import BLUE, GREEN, ORANGE, PURPLE, plt

Row = dict[str, object]
DURATION, MODES = 1.0, 12
LINKS = (10, 20, 40, 80)
# Links and step [s] of the engine on its own.
DISCRETE = ((20, 5e-5), (40, 2e-4), (40, 5e-5), (80, 5e-5))
EXPLICIT = ((10, 1e-4), (20, 1e-4), (20, 5e-5), (40, 2e-5), (40, 1e-5))
# Elements of a rod and radius of its section [m].
ELASTICA = ((20, 4e-3), (40, 4e-3), (40, 2.5e-3), (80, 2.5e-3))
LADDER = {"none": "rk4", "constant": "rk4", "condensed": "rk4", "full": "gauss"}
MODELS = Path(__file__).parents[2] / "models"


def engine_alone(
    robot: Robot, release: str, links: int, timestep: float, integrator: str, duration: float
) -> tuple[np.ndarray, float]:
    """Tips at every millisecond [m] as MuJoCo steps on its own, and wall time [s]."""
    pose, x = start(robot, release)
    text = mjcf(robot, links=links, timestep=timestep, visible=False)
    model = mujoco.MjModel.from_xml_string(text.replace('integrator="discrete"', f'integrator="{integrator}"'))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = coordinates(settled_chains(pose, x[2:4], links), x[:2], x[2:4])
    data.ctrl[:] = pose.q
    tips, began = [x[:2]], time.perf_counter()
    for _ in range(round(duration / STEP)):
        mujoco.mj_step(model, data, round(STEP / timestep))
        tips.append(data.qpos[-2:].copy())
        if any(warning.number for warning in data.warning):
            raise PCRError(f"blew up at {data.time:.4f} s")
    return np.array(tips), time.perf_counter() - began


def agreement(robot: Robot, release: str, duration: float) -> list[Row]:
    """Rows of part one."""
    pose, x = start(robot, release)
    ours, _ = swing(Plant(robot, inertia="full", modes=MODES, integrator="gauss", dt=STEP), pose, x, duration)
    rows: list[Row] = []
    chains = {}
    for links in LINKS:
        for substeps in (1, 2):
            plant = MuJoCoPlant(robot, links=links, dt=STEP, substeps=substeps)
            began = time.perf_counter()
            tips, _ = swing(plant, pose, x, duration)
            chains[links, substeps] = tips
            rows.append(
                {"release": release, "what": "discrete extrapolated", "links": links, "step_us": 1e6 * STEP / substeps}
                | {"error_mm": furthest(tips, ours), "s_per_s": (time.perf_counter() - began) / duration}
                | {"gap_um": 1e6 * plant.gap}
            )
    alone = [("discrete", *case) for case in DISCRETE] + [("implicitfast", *case) for case in EXPLICIT]
    for integrator, links, timestep in alone:
        row: Row = {"release": release, "what": integrator, "links": links, "step_us": 1e6 * timestep}
        try:
            tips, seconds = engine_alone(robot, release, links, timestep, integrator, duration)
            row |= {"error_mm": furthest(tips, ours), "s_per_s": seconds / duration}
        except PCRError as error:
            row |= {"error_mm": "", "failure": str(error)}
        rows.append(row)
    if find_spec("elastica"):
        from experiments.peers.pyelastica_release import release_tip

        release_tip(robot, release, ELASTICA[0][0], ELASTICA[0][1], STEP)  # compiles
        for elements, radius in ELASTICA:
            tips, seconds = release_tip(robot, release, elements, radius, duration)
            rows.append(
                {"release": release, "what": "PyElastica", "links": elements, "radius_mm": 1e3 * radius}
                | {"error_mm": furthest(tips, ours), "s_per_s": seconds / duration}
            )
    endless = (4 * chains[80, 2] - chains[40, 2]) / 3
    coarser = (4 * chains[40, 2] - chains[20, 2]) / 3
    rows.append(
        {"release": release, "what": "MuJoCo, endless links: change by the last doubling", "links": "inf"}
        | {"error_mm": furthest(endless, coarser)}
    )
    for inertia, integrator in LADDER.items():
        tips, _ = swing(Plant(robot, inertia=inertia, integrator=integrator, dt=STEP), pose, x, duration)
        rows.append(
            {"release": release, "what": f"{inertia} against MuJoCo", "links": "inf"}
            | {"error_mm": furthest(tips, endless)}
        )
    return rows


def loops(quick: bool) -> list[Row]:
    """Rows of part two."""
    lemniscate = load_scene(MODELS / "scenes" / "lemniscate.toml")
    assert lemniscate.tuning is not None
    fast = replace(lemniscate, name="lemniscate in 1 s", trajectory=replace(lemniscate.trajectory, period=1.0))  # type: ignore[type-var]
    rows: list[Row] = []
    for scene in (lemniscate, fast):
        scene = replace(scene, duration=1.5 if quick else scene.duration)
        for observer in (lemniscate.tuning.observer, None):
            for links in (40,) if quick else (None, 40, 80):
                plant = (
                    Plant(scene.robot, inertia="full", integrator="gauss", dt=2 * STEP)
                    if links is None
                    else MuJoCoPlant(scene.robot, links=links, dt=STEP)
                )
                row: Row = {"scene": scene.name, "plant": f"MuJoCo, {links} links" if links else "full"}
                row["observer"] = "on" if observer else "off"
                for inertia in ("none", "condensed"):
                    model = replace(lemniscate.tuning.model, inertia=inertia)
                    tuning = replace(lemniscate.tuning, observer=observer, model=model)
                    summary = simulate(scene, plant, make_controller(scene, tuning)).summary()
                    row[f"{inertia}_mm"] = summary["rms_after_1s_mm"]
                rows.append(row)
    return rows


def plot(rows: list[Row], path: Path) -> None:
    """Error of each scheme against the time that it takes, for each release."""
    figure, axes = plt.subplots(1, 2, figsize=(11, 4), sharey=True)
    schemes = {
        "discrete extrapolated": (BLUE, "o", "MuJoCo, discrete, extrapolated: links; 1 and 0.5 ms"),
        "discrete": (ORANGE, "s", "MuJoCo, discrete: links, step"),
        "implicitfast": (GREEN, "D", "MuJoCo, implicitfast: links, step"),
        "PyElastica": (PURPLE, "^", "PyElastica: elements, radius of section"),
    }
    for of_release, (release, title) in zip(axes, RELEASES.items(), strict=True):
        for scheme, (colour, marker, name) in schemes.items():
            mine = [row for row in rows if (row["release"], row["what"]) == (release, scheme)]
            mine = [row for row in mine if row["error_mm"] != ""]
            for row in mine:
                at, label = (float(str(row["s_per_s"])), float(str(row["error_mm"]))), str(row["links"])
                if scheme == "PyElastica":
                    label += f", {row['radius_mm']:g} mm"
                elif scheme != "discrete extrapolated":
                    label += f", {row['step_us']:g} us"
                elif row["step_us"] != 1e6 * STEP:
                    continue
                of_release.annotate(label, at, xytext=(5, 4), textcoords="offset points", fontsize=7, color=colour)
            cost, error = (np.array([row[key] for row in mine], dtype=float) for key in ("s_per_s", "error_mm"))
            of_release.loglog(cost, error, marker, ms=5, color=colour, label=name)
        of_release.set(xlabel="wall time per simulated second [s]", title=title)
    axes[0].set_ylabel("largest distance from distributed rods within 1 s [mm]")
    axes[1].legend(loc="upper right", fontsize=8)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def main() -> None:
    """Measure, write the CSVs, plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/mujoco_agreement"), help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="0.2 s and 1.5 s runs, to see it work")
    arguments = parser.parse_args()
    folder, duration = arguments.out, QUICK_DURATION if arguments.quick else DURATION
    folder.mkdir(parents=True, exist_ok=True)
    mujoco.set_mju_user_warning(lambda _: None)  # a blow-up is a row of the table, not a log file
    robot = load_robot(MODELS / "planar_pair.toml")
    rows = [row for release in tqdm(RELEASES, desc="releases") for row in agreement(robot, release, duration)]
    fields = ["release", "what", "links", "step_us", "radius_mm", "error_mm", "s_per_s", "gap_um", "failure"]
    write_rows(folder / "mujoco_agreement.csv", rows, fields, digits=6)
    plot(rows, folder / "mujoco_agreement.png")
    fields = ["scene", "plant", "observer", "none_mm", "condensed_mm"]
    write_rows(folder / "mujoco_loops.csv", loops(arguments.quick), fields, digits=6)
    print(f"written to {folder}")


if __name__ == "__main__":
    main()
