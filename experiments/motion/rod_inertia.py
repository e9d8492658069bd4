"""How wrong is the tip when the rods' mass is left out, or kept in one of three ways?

The default robot's tip is let go with the motors at rest, in two ways: with the velocity of models/scenes/release.toml
from its centre pose, and from rest 30 mm to the right of that pose and 20 mm above it. For one second the tip is
compared with that of the robot whose rods have distributed mass in strain modes; the rods weigh 0.1 to 10 times what
they do. All integrators take 1 ms: RK4 for the comparison, so that the model alone is on trial; times per step also
for velocity Verlet. The uncertainty of the yardstick is what two modes fewer and half the step change in it. Failures
are rows with the reason. Writes a CSV and a picture.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pcr_mpc import Equilibrium, PCRError, Plant, Robot, inverse_statics, load_robot, solve_statics
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import BLUE, GREEN, GREY, ORANGE, PURPLE, plt

Row = dict[str, object]
MASSES = (0.1, 1.0, 3.0, 10.0)  # of the rods, in those of the default robot
CENTRE, VELOCITY, DISPLACEMENT = (0.0, 0.25), (0.3, -0.2), (0.03, 0.02)  # m, m/s, m
RELEASES = {"velocity": "let go with (0.3, -0.2) m/s", "displaced": "let go (30, 20) mm off balance"}
LADDER = {"none": BLUE, "constant": ORANGE, "condensed": GREEN}
STEP, DURATION, QUICK_DURATION = 1e-3, 1.0, 0.2  # s
MODES, FEWER_MODES = 14, 12
WARM_UP = 20  # steps that are not timed


def with_rods_of(robot: Robot, mass: float) -> Robot:
    """The robot with its rods' mass multiplied."""
    return replace(robot, rods=tuple(replace(rod, line_density=mass * rod.line_density) for rod in robot.rods))


def start(robot: Robot, release: str) -> tuple[Equilibrium, np.ndarray]:
    """Pose and state in which the tip is let go."""
    pose = inverse_statics(robot, CENTRE, mode="LR")
    if release == "velocity":
        return pose, np.concatenate([pose.p, VELOCITY, pose.q])
    pose = solve_statics(robot, pose.p + DISPLACEMENT, pose.q, guess=pose)
    return pose, np.concatenate([pose.p, [0.0, 0.0], pose.q])


def swing(plant: Plant, pose: Equilibrium, x: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Tips at every millisecond, shape (K + 1, 2) [m], and times of the plant's steps [s]."""
    plant.reset(x, pose)
    motors, every = np.zeros(plant.robot.n_rods), round(STEP / plant.dt)
    tips, times = [x[:2]], []
    for k in range(round(duration / plant.dt)):
        began = time.perf_counter()
        x = plant.step(x, motors)
        times.append(time.perf_counter() - began)
        if (k + 1) % every == 0:
            tips.append(x[:2])
    return np.array(tips), np.array(times[WARM_UP:])


def furthest(tips: np.ndarray, others: np.ndarray) -> float:
    """Largest distance at any one time [mm]."""
    return 1e3 * float(np.linalg.norm(tips - others, axis=1).max())


def compare(robot: Robot, release: str, mass: float, duration: float) -> list[Row]:
    """One row for each inertia."""
    heavy = with_rods_of(robot, mass)
    pose, x = start(heavy, release)

    def full(modes: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
        return swing(Plant(heavy, inertia="full", modes=modes, integrator="gauss", dt=dt), pose, x, duration)

    tips, times = full(MODES, STEP)
    by_modes = furthest(tips, full(FEWER_MODES, STEP)[0])
    by_step = furthest(tips, full(MODES, STEP / 2)[0])
    common: Row = {"release": release, "mass": mass}
    rows = [
        common
        | {"inertia": "full", "error_mm": by_modes + by_step, "by_modes_mm": by_modes, "by_step_mm": by_step}
        | {"gauss_us": 1e6 * float(np.median(times)), "swing_mm": furthest(tips, tips[:1])}
    ]
    for inertia in LADDER:
        row = common | {"inertia": inertia}
        try:
            for integrator in ("velocity_verlet", "rk4"):
                plant = Plant(heavy, inertia=inertia, integrator=integrator, dt=STEP)
                others, times = swing(plant, pose, x, duration)
                row |= {"error_mm": furthest(others, tips), f"{integrator}_us": 1e6 * float(np.median(times))}
        except PCRError as error:
            row |= {"error_mm": "", "failure": f"{type(error).__name__}: {error}"}
        rows.append(row)
    return rows


def plot(rows: list[Row], path: Path) -> None:
    """Errors against the rods' mass for each release, and times per step."""
    figure, (*errors, times) = plt.subplots(1, 3, figsize=(13, 4), width_ratios=(1, 1, 0.9))
    for axes, (release, title) in zip(errors, RELEASES.items(), strict=True):
        for (inertia, colour), marker in zip([*LADDER.items(), ("full", GREY)], "osDx", strict=True):
            mine = [row for row in rows if (row["release"], row["inertia"]) == (release, inertia)]
            mine = [row for row in mine if row["error_mm"] != ""]
            mass, error = (np.array([row[key] for row in mine], dtype=float) for key in ("mass", "error_mm"))
            axes.loglog(mass, error, "--" if inertia == "full" else "-", marker=marker, ms=5, color=colour)
            label, at, offset = (
                (inertia, 1, (-6, 8)) if inertia in LADDER else ("full: its own uncertainty", -1, (6, -32))
            )
            style = {"color": colour, "ha": "right", "textcoords": "offset points"}
            axes.annotate(label, (mass[at], error[at]), xytext=offset, **style)
        axes.set(xlabel="mass of the rods / 5.6 g each", title=title, ylim=(1e-7, 1e2))
        axes.set_xticks(MASSES, [f"{mass:g}" for mass in MASSES])
        axes.minorticks_off()
    errors[0].set_ylabel("largest error of the tip within 1 s [mm]")

    names, integrators = [*LADDER, "full"], {"velocity_verlet": BLUE, "rk4": ORANGE, "gauss": PURPLE}
    for shift, (integrator, colour) in zip((-0.2, 0.2, 0.0), integrators.items(), strict=True):
        for at, name in enumerate(names):
            key = f"{integrator}_us"
            measured = [float(row[key]) for row in rows if row["inertia"] == name and key in row]  # type: ignore[arg-type]
            if measured:
                label = integrator.replace("_", " ") if name in ("none", "full") else None
                median = float(np.median(measured))
                times.bar(at + shift, median, 0.38, color=colour, label=label)
                times.annotate(f"{median:.0f}", (at + shift, median), ha="center", va="bottom", fontsize=8)
    times.set_xticks(range(len(names)), names)
    times.set(yscale="log", ylabel="time per step of 1 ms, p50 [us]", title="Cost", ylim=(10, 1e4))
    times.grid(axis="x", visible=False)
    times.legend(loc="upper left", fontsize=8)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def main() -> None:
    """Measure, write the CSV, plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/rod_inertia"), help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="0.2 s instead of 1 s, to see it work")
    arguments = parser.parse_args()
    folder, duration = arguments.out, QUICK_DURATION if arguments.quick else DURATION
    folder.mkdir(parents=True, exist_ok=True)
    robot = load_robot(Path(__file__).parents[2] / "models" / "planar_pair.toml")
    cases = [(release, mass) for release in RELEASES for mass in MASSES]
    rows = [row for case in tqdm(cases, desc="releases", unit="case") for row in compare(robot, *case, duration)]
    fields = ["release", "mass", "inertia", "error_mm", "by_modes_mm", "by_step_mm", "swing_mm"]
    fields += ["velocity_verlet_us", "rk4_us", "gauss_us", "failure"]
    write_rows(folder / "rod_inertia.csv", rows, fields)
    plot(rows, folder / "rod_inertia.png")
    print(f"written to {folder}")


if __name__ == "__main__":
    main()
