"""At which time step does each integrator blow up, and is that where linear theory says?

For tip positions from gently bent to nearly straight rods, the default robot rests in balance without drag and is
nudged by 1 um; the largest dt at which 400 steps stay bounded is found by bisection and compared with the prediction
omega dt = 2 (semi-implicit Euler, velocity Verlet) or 2 sqrt(2) (RK4), omega^2 the largest eigenvalue of K/m.
Poses for which no balance is found are rows too. Then the energy of two seconds of free swinging, which no integrator
keeps exactly, against dt. Writes two CSVs and two pictures.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pcr_mpc import Equilibrium, PCRError, Plant, Robot, inverse_statics, load_robot
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import BLUE, GREEN, GREY, ORANGE, plt

PREDICTED = {"semi_implicit_euler": 2.0, "velocity_verlet": 2.0, "rk4": 2.0 * np.sqrt(2.0)}
COLOURS = {"semi_implicit_euler": BLUE, "velocity_verlet": ORANGE, "rk4": GREEN}
ORDERS = {"semi_implicit_euler": 1, "velocity_verlet": 2, "rk4": 5}  # of the energy (RK4 damps)
SWING, DURATION = (0.3, -0.2), 2.0  # tip velocity [m/s] and length [s] of the swing
STEPS, NUDGE, BOUND = 400, 1e-6, 1e-4  # number, m, m


def stays_bounded(robot: Robot, pose: Equilibrium, integrator: str, dt: float) -> bool:
    """Whether the nudged tip stays within 0.1 mm for all steps."""
    plant = Plant(robot, integrator=integrator, dt=dt)
    stiffest = np.linalg.eigh(pose.dforce_dp)[1][:, -1]
    x = np.concatenate([pose.p + NUDGE * stiffest, [0.0, 0.0], pose.q])
    try:
        plant.reset(x, pose)
        for _ in range(STEPS):
            x = plant.step(x, np.zeros(robot.n_rods))
            if np.linalg.norm(x[:2] - pose.p) > BOUND:
                return False
    except PCRError:
        return False
    return True


def measure(robot: Robot, heights: np.ndarray) -> list[dict[str, object]]:
    """One row for each pose and integrator."""
    rows: list[dict[str, object]] = []
    pose: Equilibrium | None = inverse_statics(robot, (0.0, 0.25), mode="LR")
    for height in tqdm(heights, desc="poses", unit="pose"):
        stretch = float(np.hypot(0.1, height) / 0.4)
        try:
            pose = inverse_statics(robot, (0.0, height), guess=pose)
        except PCRError as error:
            rows.append(
                {"stretch": stretch, "integrator": "", "omega": "", "dt": "", "omega_dt": "", "failure": str(error)}
            )
            continue
        omega = float(np.sqrt(pose.stiffness_eigenvalues[-1] / robot.tip_mass))
        for integrator, predicted in PREDICTED.items():
            low, high = 0.8 * predicted / omega, 1.25 * predicted / omega
            for _ in range(7):
                middle = (low + high) / 2
                low, high = (middle, high) if stays_bounded(robot, pose, integrator, middle) else (low, middle)
            limit = {"omega": omega, "dt": low, "omega_dt": omega * low}
            rows.append({"stretch": stretch, "integrator": integrator, **limit, "failure": ""})
    return rows


def swing(robot: Robot, integrator: str, dt: float) -> dict[str, object]:
    """Largest and final change of the energy of a swinging tip, relative to what it swings with."""
    pose = inverse_statics(robot, (0.0, 0.25), mode="LR")
    plant = Plant(robot, integrator=integrator, dt=dt)
    x = np.concatenate([pose.p, SWING, pose.q])
    plant.reset(x, pose)
    row: dict[str, object] = {"integrator": integrator, "dt": dt, "largest": "", "final": "", "failure": ""}
    given = 0.5 * robot.tip_mass * float(np.dot(SWING, SWING))
    changes = []
    try:
        for _ in range(round(DURATION / dt)):
            x = plant.step(x, np.zeros(robot.n_rods))
            kinetic = 0.5 * robot.tip_mass * float(x[2:4] @ x[2:4])
            changes.append((kinetic + plant.equilibrium(x).energy - pose.energy) / given - 1.0)
    except PCRError as error:
        row["failure"] = str(error)
    else:
        row |= {"largest": float(np.abs(changes).max()), "final": abs(changes[-1])}
    return row


def plot_energy(rows: list[dict[str, object]], path: Path) -> None:
    """Largest change of the energy against dt, with the slopes of theory."""
    figure, axes = plt.subplots(figsize=(6, 4))
    for integrator, order in ORDERS.items():
        mine = [row for row in rows if row["integrator"] == integrator and row["largest"] != ""]
        dt = 1e3 * np.array([row["dt"] for row in mine], dtype=float)
        largest = np.array([row["largest"] for row in mine], dtype=float)
        axes.loglog(dt, largest, "o-", color=COLOURS[integrator], ms=4, label=integrator.replace("_", " "))
        axes.loglog(dt, largest[-1] * (dt / dt[-1]) ** order, ":", color=GREY)
        axes.annotate(f"order {order}", (dt[-2], largest[-2]), xytext=(0, -14), textcoords="offset points", color=GREY)
    axes.set(
        xlabel="dt [ms]", ylabel="largest change of energy / energy of the swing", title="Free swing of 2 s, no drag"
    )
    axes.set_xticks(dt, [f"{value:g}" for value in dt])
    axes.minorticks_off()
    axes.legend()
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def plot(rows: list[dict[str, object]], path: Path) -> None:
    """Left: the limit in ms; right: observed over predicted."""
    figure, (limit, ratio) = plt.subplots(1, 2, figsize=(10, 4))
    for integrator, predicted in PREDICTED.items():
        mine = [row for row in rows if row["integrator"] == integrator]
        slack = 1 - np.array([row["stretch"] for row in mine], dtype=float)
        dt = np.array([row["dt"] for row in mine], dtype=float)
        observed = np.array([row["omega_dt"] for row in mine], dtype=float)
        label, style = (
            integrator.replace("_", " "),
            {"color": COLOURS[integrator], "ms": 4 if integrator != "semi_implicit_euler" else 7},
        )
        line = "o--" if integrator == "velocity_verlet" else "o-"  # it coincides with semi-implicit Euler
        limit.loglog(slack, 1e3 * dt, line, label=label, **style)
        ratio.semilogx(slack, observed / predicted, line, label=label, **style)
    limit.axhline(1.0, color=GREY, ls=":", label="1 ms")
    ratio.axhline(1.0, color=GREY, ls=":")
    limit.set(
        xlabel="1 - |p - base| / L   (straight rods to the left)",
        ylabel="largest stable dt [ms]",
        title="Where each integrator blows up",
    )
    ratio.set(
        xlabel="1 - |p - base| / L   (straight rods to the left)",
        ylabel="observed / predicted",
        title="Against linear theory",
        ylim=(0.8, 1.2),
    )
    limit.legend()
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def main() -> None:
    """Measure, write the CSV, plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/time_step_limits"), help="folder for the results")
    folder = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    robot = replace(load_robot(Path(__file__).parents[2] / "models" / "planar_pair.toml"), drag=0.0)
    stretches = np.concatenate([np.linspace(0.45, 0.9, 7), [0.93, 0.96, 0.98, 0.99, 0.995, 0.998, 0.999]])
    rows = measure(robot, np.sqrt((0.4 * stretches) ** 2 - 0.1**2))
    steps = [2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3, 8e-3]
    swings = [swing(robot, integrator, dt) for dt in tqdm(steps, desc="swings", unit="dt") for integrator in PREDICTED]
    for name, table in (("time_step_limits", rows), ("energy_drift", swings)):
        write_rows(folder / f"{name}.csv", table)
    plot(rows, folder / "time_step_limits.png")
    plot_energy(swings, folder / "energy_drift.png")
    print(f"written to {folder}")


if __name__ == "__main__":
    main()
