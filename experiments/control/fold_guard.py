"""Does the controller drive the robot through a fold? Down to where the branch all but ends, under an unknown load.

The reference goes to 20 mm above the base line, where it is stable without a load. Nobody tells the controller of the
load, and the observer's remedy, to turn the motors further, leads through a fold. Once with the limits on the stability
margins and once without. Writes fold_guard.csv and fold_guard.png.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pcr_mpc import Plant, Run, SimulationError, assess_stability, load_scene, make_controller, simulate
from pcr_mpc.linearisation.pose_limits import PoseLimits
from pcr_mpc.loop.references.trajectory import PickAndPlace
from pcr_mpc.report.style import BLUE, GREY, RED, plt

SCENE = Path(__file__).parents[2] / "models" / "scenes" / "lemniscate.toml"
_STOPS = ((0.3, 6.3), (-3.15, 2.85))  # rad; those of the default robot would end the motion before the fold does
LIMITS = PoseLimits(rod_margin=0.1, stiffness=20.0)
_LOAD = (5.0, 5.0)  # N


def run(limits: PoseLimits) -> tuple[Run, str]:
    """The motion under limits, as far as it gets, and what ended it."""
    scene = load_scene(SCENE)
    rods = tuple(replace(rod, angle_limits=stops) for rod, stops in zip(scene.robot.rods, _STOPS, strict=True))
    scene = replace(
        scene,
        robot=replace(scene.robot, rods=rods),
        duration=2.5,
        trajectory=PickAndPlace((0.0, 0.25), (0.0, 0.02), 0.0, 0.2, 1.5),
        force=_LOAD,
        pose_limits=limits,
    )
    try:
        return simulate(scene, scene.make_plant(), make_controller(scene)), ""
    except SimulationError as error:
        return error.run, str(error)


def margins(found: Run) -> np.ndarray:
    """Time [s], least eigenvalue of K [N/m] and least rod margin at every control period, shape (M, 3)."""
    plant = Plant(found.scene.robot)
    plant.reset(found.x[0], found.pose)
    rows = []
    for t, x in zip(found.t[:: found.steps_per_period], found.x[:: found.steps_per_period], strict=True):
        stability = assess_stability(plant.equilibrium(x))
        rows.append((t, stability.stiffness_eigenvalues[0], stability.rod_margins.min()))
    return np.array(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run both, print, write the CSV file and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/fold_guard"), help="folder for the results")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    figure, (above, left, right) = plt.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
    kept = []
    for name, limits, colour in (("margins limited", LIMITS, BLUE), ("not limited", PoseLimits(), RED)):
        found, ended = run(limits)
        values = margins(found)
        kept.append(np.column_stack([np.full(len(values), name == "margins limited"), values]))
        print(
            f"{name}: least K {values[:, 1].min():.3g} N/m, least rod margin {values[:, 2].min():.3g}; {ended or 'ok'}"
        )
        above.plot(found.t, 1e3 * found.x[:, 1], color=colour, label=name)
        left.plot(values[:, 0], values[:, 1], color=colour)
        right.plot(values[:, 0], values[:, 2], color=colour)
        if ended:
            for axes, end in ((above, 1e3 * found.x[-1, 1]), (left, values[-1, 1]), (right, values[-1, 2])):
                axes.plot(found.t[-1], end, "x", color=colour, ms=10, mew=2.5)
            above.annotate("a rod snaps", (found.t[-1], 1e3 * found.x[-1, 1]), (6, 8), textcoords="offset points",
                           color=colour)  # fmt: skip
        elif found.scene.pose_limits.stiffness:
            above.plot(found.t, 1e3 * found.reference[:, 1], color=GREY, lw=3, alpha=0.5, zorder=0, label="reference")
    left.axhline(LIMITS.stiffness or 0.0, color=GREY, ls="--")
    right.axhline(LIMITS.rod_margin or 0.0, color=GREY, ls="--")
    above.set(xlabel="time [s]", ylabel="tip height y [mm]", title="Tip")
    left.set(xlabel="time [s]", ylabel="least eigenvalue of K [N/m]", title="Stiffness (limit dashed)", ylim=(0, None))
    right.set(
        xlabel="time [s]", ylabel="least rod margin 1 - λ/λ$_c$", title="Rod margin (limit dashed)", ylim=(0, None)
    )
    above.legend(loc="lower left")
    figure.savefig(options.out / "fold_guard.png")
    np.savetxt(options.out / "fold_guard.csv", np.vstack(kept), delimiter=",", fmt="%.6g", comments="",
               header="limited,t_s,least_K_N_m,least_rod_margin")  # fmt: skip


if __name__ == "__main__":
    main()
