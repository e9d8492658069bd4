"""What happens at a fold: the plant against the energy landscape.

Held tip: one motor winds its rod up. The energy of every stable shape is listed at each angle, and the plant, told to
jump, follows one of them until it ends and falls to another. Free tip: both motors turn slowly. The pose that the robot
is in ceases to exist, and the tip (a mass with drag on quasi-static rods) swings to another one.
Writes two CSVs and a picture.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pcr_mpc import (
    Equilibrium,
    PCRError,
    Plant,
    Robot,
    all_equilibria,
    forward_statics,
    inverse_statics,
    load_robot,
)
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import BLUE, GREEN, GREY, ORANGE, RED, plt

Row = dict[str, object]
WINDING = 5.0  # rad
DIRECTION = np.array([-1.0, 1.0])  # in which both motors turn
TURN, RATE = 1.5, 0.1  # rad, rad/s
ON_BRANCH = np.array([0.033, 0.056])  # tip of the pose, for the motor angles of the centre, whose branch ends [m]


def held_tip(robot: Robot, centre: Equilibrium, n_angles: int) -> list[Row]:
    """Energies of all stable shapes, and of the plant, as motor 0 winds up."""
    rows: list[Row] = []
    plants = {
        "closed_form": Plant(robot, on_snap="jump"),
        "multiple_shooting": Plant(robot, method="multiple_shooting", steps=4, on_snap="jump"),
    }
    for plant in plants.values():
        plant.reset(np.concatenate([centre.p, [0.0, 0.0], centre.q]), centre)
    for angle in tqdm(np.linspace(0.0, WINDING, n_angles), desc="held tip", unit="angle"):
        q = centre.q + [angle, 0.0]
        rows += [
            {"angle": angle, "what": "listed", "energy": eq.energy, "lost": "", "failure": ""}
            for eq in all_equilibria(robot, centre.p, q)
        ]
        for name, plant in plants.items():
            known = len(plant.snaps)
            row: Row = {"angle": angle, "what": name, "energy": "", "lost": "", "failure": ""}
            try:
                row["energy"] = plant.equilibrium(np.concatenate([centre.p, [0.0, 0.0], q])).energy
                row["lost"] = sum(snap.energy_lost for snap in plant.snaps[known:]) or ""
            except PCRError as error:
                row["failure"] = str(error)
            rows.append(row)
    return rows


def free_tip(robot: Robot, centre: Equilibrium, n_angles: int) -> list[Row]:
    """Tip and energy along the branch that ends and the one that it falls to, and of the moving robot."""
    rows: list[Row] = []
    start = min(all_equilibria(robot, q=centre.q), key=lambda eq: float(np.hypot(*(eq.p - ON_BRANCH))))
    for name, eq in (("branch that ends", start), ("branch it falls to", centre)):
        for angle in tqdm(np.linspace(0.0, TURN, n_angles), desc=name, unit="angle"):
            try:
                eq = forward_statics(robot, centre.q + angle * DIRECTION, guess=eq)
            except PCRError as error:
                rows.append({"angle": angle, "what": name, "failure": str(error)})
                break
            rows.append(_row(angle, name, eq))
    plant = Plant(robot, integrator="velocity_verlet", dt=5e-4, on_snap="jump")
    x = np.concatenate([start.p, [0.0, 0.0], start.q])
    plant.reset(x, start)
    every = max(1, round(TURN / RATE / plant.dt / 2000))
    for k in tqdm(range(round(TURN / RATE / plant.dt)), desc="moving robot", unit="step"):
        try:
            if k % every == 0:
                rows.append(_row(k * plant.dt * RATE, "moving robot", plant.equilibrium(x)))
            x = plant.step(x, RATE * DIRECTION)
        except PCRError as error:
            rows.append({"angle": k * plant.dt * RATE, "what": "moving robot", "failure": str(error)})
            break
    return rows


def _row(angle: float, what: str, eq: Equilibrium) -> Row:
    return {"angle": angle, "what": what, "x": eq.p[0], "y": eq.p[1], "energy": eq.energy,
            "stiffness": eq.stiffness_eigenvalues[0], "failure": ""}  # fmt: skip


def plot(held: list[Row], free: list[Row], path: Path) -> None:
    """Left: energies at the held tip; right: height of the free tip."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4))

    def series(rows: list[Row], what: str, key: str) -> tuple[np.ndarray, np.ndarray]:
        mine = [row for row in rows if row["what"] == what and row.get(key, "") != ""]
        return (np.array([row[name] for row in mine], dtype=float) for name in ("angle", key))  # type: ignore[return-value]

    left.plot(*series(held, "listed", "energy"), ".", color=GREY, ms=2.5, label="every stable shape")
    left.plot(*series(held, "closed_form", "energy"), color=BLUE, lw=3, alpha=0.8, label="plant, closed form")
    left.plot(*series(held, "multiple_shooting", "energy"), "--", color=ORANGE, label="plant, multiple shooting")
    angle, lost = series(held, "closed_form", "lost")
    for at, energy in zip(angle, lost, strict=True):
        left.annotate(f"{energy:.2f} J lost", (at, 3.0), xytext=(-8, 0), textcoords="offset points", ha="right")
    left.set(xlabel="turn of motor 0 [rad]", ylabel="elastic energy [J]", title="Tip held: a rod snaps")
    right.plot(*series(free, "branch that ends", "y"), color=GREY, lw=4, alpha=0.6, label="statics: branch that ends")
    right.plot(
        *series(free, "branch it falls to", "y"), color=GREEN, lw=4, alpha=0.6, label="statics: where it falls to"
    )
    right.plot(*series(free, "moving robot", "y"), color=RED, lw=1.0, label=f"moving robot, {RATE} rad/s")
    right.set(xlabel="turn of both motors [rad]", ylabel="tip y [m]", title="Tip free: the robot snaps")
    left.set_ylim(top=13)
    left.legend(loc="upper left")
    right.legend(loc="center left")
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def main() -> None:
    """Measure, write the CSVs, plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/snap"), help="folder for the results")
    parser.add_argument("--angles", type=int, default=126, help="motor angles along each motion (default: 126)")
    arguments = parser.parse_args()
    folder = arguments.out
    folder.mkdir(parents=True, exist_ok=True)
    robot = load_robot(Path(__file__).parents[2] / "models" / "planar_pair.toml")
    centre = inverse_statics(robot, (0.0, 0.25), mode="LR")
    # The motor stops would end the winding long before the rod snaps.
    held = held_tip(robot, centre, arguments.angles)
    free = free_tip(robot, centre, arguments.angles)
    for name, rows in (("snap_held", held), ("snap_free", free)):
        write_rows(folder / f"{name}.csv", rows)
    plot(held, free, folder / "snap.png")
    print(f"written to {folder}")


if __name__ == "__main__":
    main()
