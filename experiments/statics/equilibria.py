"""What else could the robot snap to? Every equilibrium for the motor angles of the centre pose, tip free."""

from __future__ import annotations

import argparse
from pathlib import Path

from pcr_mpc import all_equilibria, inverse_statics, load_robot
from pcr_mpc.report.plots import plot_equilibria
from pcr_mpc.report.tables import equilibria_table


def main() -> None:
    """Search, print the list, draw it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/equilibria"), help="folder for picture and list")
    folder = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    robot = load_robot(Path(__file__).parents[2] / "models" / "planar_pair.toml")
    centre = inverse_statics(robot, (0.0, 0.25), mode="LR")
    found = all_equilibria(robot, q=centre.q)
    listing = equilibria_table(found)
    print(listing)
    (folder / "equilibria.txt").write_text(listing + "\n", encoding="utf-8")
    plot_equilibria(found, folder / "equilibria.png")
    print(f"written to {folder}")


if __name__ == "__main__":
    main()
