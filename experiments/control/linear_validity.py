"""How far from its linearisation point may the MPC trust the linear model, and what happens beyond?

1. Map: with the default robot in balance (mode LR) at each tip of a grid, the tip is displaced with the motors held,
   and the motors are turned with the tip held, until the linear force model F0 + K dp + G dq is wrong by 1 % of the
   change that it predicts. The smallest such displacement over 16 directions is the radius of validity: "tip radius"
   [mm] and "motor radius" [rad]. A rod that cannot follow ends the validity too. The second derivative of F predicts
   the radii independently: r = 0.01 * 2 |J u| / |d2F[u, u]| with J = [K G] and d2F by central differences of J.
2. Horizon: the discretised model over 10 and 30 periods of 10 ms against the nonlinear plant, for constant motor rates
   from rest: error of the tip at the end, relative to the distance it moved.
3. Loop: the lemniscate scene from tiny to as large as the workspace, in 2 s and in 1 s a lap, tracked by the MPC that
   linearises at every step and by one whose model was linearised once, at the start pose. The motors' limits on rate
   and acceleration are lifted, so that the model alone is on trial; the large ones also with the robot's own limits.

Everything that fails (no pose, rod unstable, motor at its stop, reference out of reach) is a row with the reason.
Writes linear_validity_map.csv, _horizon.csv, _loop.csv and the picture linear_validity.png.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from tqdm import tqdm

from experiments.control.linear_validity_radius import (
    CENTRE,
    HORIZONS,
    Row,
    failure_text,
    measure_horizon,
    measure_map,
    passes_one_percent,
)
from pcr_mpc import (
    Equilibrium,
    LinearMPC,
    PCRError,
    Reference,
    Scene,
    linearise,
    load_robot,
    load_scene,
    load_tuning,
    make_controller,
    simulate,
)
from pcr_mpc.loop.demand.feed_forward import feed_forward
from pcr_mpc.loop.parts.assembled import motor_limits
from pcr_mpc.loop.parts.controllers import Controller, Decision
from pcr_mpc.loop.references.trajectory import Lemniscate
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import BLUE, GREY, RED, plt

MODELS = Path(__file__).parents[2] / "models"
HORIZON_TIPS = ((0.0, 0.25), (0.06, 0.22), (0.0, 0.11), (0.2, 0.15), (0.0, 0.37))  # m
REACHES, LIMITED_REACHES = (0.6, 2.0, 6.0, 20.0, 60.0, 100.0, 150.0, 180.0), (60.0, 100.0, 150.0)  # mm
FREE = 100.0  # times the robot's limits on rate and acceleration: none
LAPS = {2.0: ("-", "o"), 1.0: ("--", "s")}  # s; line and marker
START_UP = 1.0  # s; the scene's ramp
RADIUS_TICKS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0)  # mm; of the colour bar


class LinearisedOnce:
    """The tracking MPC with the linear model of its start pose for the whole run; its feed-forward stays exact.

    Parameters
    ----------
    scene : Scene
        With a trajectory and a tuning.
    """

    name = "linearised once"

    def __init__(self, scene: Scene) -> None:
        assert scene.tuning is not None
        self._scene = scene
        self._mpc = LinearMPC(scene.tuning, motor_limits(scene.robot, scene.period))

    def start(self, pose: Equilibrium) -> None:
        """See `Controller`."""
        scene, plant = self._scene, self._scene.make_plant()
        self._reference = feed_forward(scene, scene.robot, pose, self._mpc.tuning.horizon)
        x = np.concatenate([pose.p, [0.0, 0.0], pose.q])
        plant.reset(x, pose)
        self._u = np.zeros(scene.robot.n_rods)
        self._model = linearise(plant, x, self._u, scene.period)
        self._mpc.prepare(self._model)

    def step(self, k: int, x: np.ndarray) -> Decision:
        """See `Controller`."""
        horizon = self._mpc.tuning.horizon
        reference = self._reference
        window = Reference(reference.states[k + 1 : k + 1 + horizon], reference.inputs[k : k + horizon])
        plan = self._mpc.solve(x, self._model, window, self._u)
        self._u = plan.inputs[0]
        return Decision(self._u, plan)


def every_step(scene: Scene) -> Controller:
    """Controller of the scene without its observer, which would take the model's errors for a force."""
    assert scene.tuning is not None
    return make_controller(scene, replace(scene.tuning, observer=None))


def scaled(scene: Scene, reach: float, lap: float, limits: float) -> Scene:
    """Start-up and one lap of ``lap`` seconds on a lemniscate that reaches ``reach`` [m] from its centre.

    ``limits`` multiplies the motors' limits on rate and acceleration.
    """
    assert isinstance(scene.trajectory, Lemniscate)
    width, height = scene.trajectory.size
    trajectory = replace(scene.trajectory, size=(2.0 * reach, 2.0 * reach * height / width), period=lap)
    robot = replace(
        scene.robot,
        rate_limit=limits * scene.robot.rate_limit,
        acceleration_limit=limits * scene.robot.acceleration_limit,
    )
    return replace(scene, robot=robot, trajectory=trajectory, duration=START_UP + lap)


def track(scene: Scene, controller: Controller) -> Row:
    """Tracking error after the start-up and the rates applied, or the failure."""
    assert scene.trajectory is not None
    assert scene.tuning is not None
    path = scene.trajectory(scene.period * np.arange(scene.n_periods))[:, 0]
    ahead = np.linalg.norm(path[scene.tuning.horizon :] - path[: -scene.tuning.horizon], axis=1)
    row: Row = {"in_horizon_mm": 1e3 * ahead.max()}
    try:
        run = simulate(scene, scene.make_plant(), controller)
    except PCRError as error:
        return {**row, "failure": failure_text(error)}
    late = 1e3 * run.error[run.t >= START_UP]
    rate = np.abs(run.u).max(axis=1)
    return {
        **row, "rms_mm": np.sqrt(np.mean(late**2)), "max_mm": late.max(), "max_rate_rad_s": rate.max(),
        "at_rate_limit": np.mean(rate > scene.robot.rate_limit - 1e-3), "fallbacks": run.summary()["fallbacks"],
        "failure": "",
    }  # fmt: skip


def measure_loop(scene: Scene, cases: Sequence[tuple[float, float, float]]) -> list[Row]:
    """Two rows, one for each controller, for each case of lap time [s], reach [mm] and factor on the limits."""
    rows: list[Row] = []
    for lap, reach, limits in tqdm(cases, desc="3 loop", unit="case"):
        case = scaled(scene, 1e-3 * reach, lap, limits)
        for name, controller in (("every step", every_step(case)), ("once", LinearisedOnce(case))):
            row: Row = {"linearised": name, "lap_s": lap, "reach_mm": reach, "limits": limits}
            rows.append(row | track(case, controller))
    return rows


def column(rows: list[Row], name: str) -> np.ndarray:
    """A column as numbers, NaN where a row has none."""
    return np.array([row.get(name, np.nan) for row in rows], dtype=float)


def radius_at_centre(rows: list[Row]) -> float:
    """Tip radius of the map at the centre pose [mm]."""
    distance = np.hypot(column(rows, "x_m") - CENTRE[0], column(rows, "y_m") - CENTRE[1])
    return float(column(rows, "tip_radius_mm")[np.argmin(distance)])


def plot(map_rows: list[Row], spacing: float, loop_rows: list[Row], scene: Scene, path: Path) -> None:
    """Left: the map of the tip radius; right: closed-loop error against the size of the lemniscate."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.4), width_ratios=(1.15, 1))
    x, y, radius = (column(map_rows, name) for name in ("x_m", "y_m", "tip_radius_mm"))
    i, j = (np.rint((values - values.min()) / spacing).astype(int) for values in (x, y))
    grid = np.full((j.max() + 1, i.max() + 1), np.nan)
    grid[j, i] = np.where(radius > 0, radius, np.nan)
    columns, lines = (1e3 * (v.min() + spacing * np.arange(n)) for v, n in ((x, grid.shape[1]), (y, grid.shape[0])))
    mesh = left.pcolormesh(
        columns, lines, grid, norm=LogNorm(*np.nanquantile(grid, [0, 1])), cmap="viridis", shading="nearest"
    )
    failed = np.isnan(radius)
    left.plot(1e3 * x[failed], 1e3 * y[failed], "x", color=GREY, ms=4, label="no pose")
    assert scene.trajectory is not None
    eight = 1e3 * scene.trajectory(np.linspace(1.0, 3.0, 200))[:, 0]
    left.plot(*eight.T, color="white", lw=1.2)
    left.plot(*(1e3 * scene.robot.bases.T), "^", color="black", ms=7, label="motor")
    left.grid(False)
    left.set(xlabel="x [mm]", ylabel="y [mm]", title="Tip radius with 1 % force error (white: lemniscate)", aspect=1)
    left.legend(loc="upper left", fontsize=9, handletextpad=0.2)
    bar = figure.colorbar(mesh, ax=left, label="tip radius [mm]", shrink=0.9, ticks=RADIUS_TICKS, format="%g")
    bar.minorticks_off()

    for name, colour in (("once", RED), ("every step", BLUE)):
        for lap, (line, marker) in LAPS.items():
            mine = [row for row in loop_rows if (row["linearised"], row["lap_s"]) == (name, lap)]
            reach, rms, limits = (column(mine, key) for key in ("reach_mm", "rms_mm", "limits"))
            free = limits == FREE
            label = f"linearised {name}, {lap:g} s a lap"
            right.loglog(reach[free], rms[free], marker + line, color=colour, ms=4, label=label)
            right.loglog(reach[~free], rms[~free], marker, color=colour, mfc="none", ms=8)
    right.plot([], [], "o", color=GREY, mfc="none", ms=8, label="open: with the robot's motor limits")
    failed_at = column([row for row in loop_rows if row["failure"]], "reach_mm")
    top = right.get_xaxis_transform()
    right.plot(failed_at, np.full(len(failed_at), 0.98), "x", color=GREY, transform=top, label="reference out of reach")
    right.axvline(radius_at_centre(map_rows), color=GREY, ls=":", label="1 % radius at the start pose")
    right.set(
        xlabel="largest distance from the start pose = half width [mm]",
        ylabel="RMS tracking error after 1 s [mm]",
        title="Closed loop on the lemniscate",
    )
    right.set_ylim(bottom=1e-8)  # room for the legend
    right.legend(loc="lower right", fontsize=8.5)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def report(map_rows: list[Row], horizon_rows: list[Row], loop_rows: list[Row]) -> None:
    """Print the main figures."""
    print(f"map: {np.isfinite(column(map_rows, 'tip_radius_mm')).sum()} poses, {len(map_rows)} tips tried")
    for name, unit in (("tip", "mm"), ("motor", "rad")):
        radius, predicted = (column(map_rows, f"{name}_{what}_{unit}") for what in ("radius", "predicted"))
        low, middle, high = np.nanquantile(radius, [0.0, 0.5, 1.0])
        ratio = radius / predicted
        print(f"  {name} radius {low:.3g} to {high:.3g} {unit}, median {middle:.3g}; measured / predicted "
              f"{np.nanmin(ratio):.4f} to {np.nanmax(ratio):.4f}, median {np.nanmedian(ratio):.4f}")  # fmt: skip
    print(f"  tip radius at the centre pose {radius_at_centre(map_rows):.3g} mm")
    print("horizon: smallest motor rate and distance moved with 1 % error of the predicted tip")
    for tip in dict.fromkeys((row["x_m"], row["y_m"]) for row in horizon_rows):
        for periods in HORIZONS:
            rate, moved = passes_one_percent(horizon_rows, tip, periods)
            print(f"  tip ({tip[0]}, {tip[1]}) m, {periods} periods: {rate:.3g} rad/s, {moved:.3g} mm")
    print("loop: RMS after the start-up")
    for row in loop_rows:
        case = f"{row['lap_s']} s a lap, reach {row['reach_mm']} mm, limits x {row['limits']:g}"
        result = row["failure"] or f"{row['rms_mm']:.3g} mm"
        print(f"  {case}, linearised {row['linearised']}: {result}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, write the CSV files, plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/linear_validity"), help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="coarse grids: seconds instead of minutes")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    robot, scene = load_robot(MODELS / "planar_pair.toml"), load_scene(MODELS / "scenes" / "lemniscate.toml")
    # The question is about one linear model for the whole horizon.
    scene = scene.tuned(load_tuning(MODELS.parent / "controllers" / "frozen.toml"))
    quick = options.quick
    spacing = 0.15 if quick else 0.02
    map_rows = measure_map(robot, spacing)
    rates = np.geomspace(0.01, robot.rate_limit, 2 if quick else 7)
    horizon_rows = measure_horizon(robot, HORIZON_TIPS[:1] if quick else HORIZON_TIPS, rates)
    cases = [(lap, reach, FREE) for lap in LAPS for reach in REACHES]
    cases += [(lap, reach, 1.0) for lap in LAPS for reach in LIMITED_REACHES]
    loop_rows = measure_loop(scene, [(1.0, 60.0, FREE)] if quick else cases)
    for name, rows in (("map", map_rows), ("horizon", horizon_rows), ("loop", loop_rows)):
        write_rows(options.out / f"linear_validity_{name}.csv", rows, digits=6)
    plot(map_rows, spacing, loop_rows, scene, options.out / "linear_validity.png")
    report(map_rows, horizon_rows, loop_rows)
    print(f"written to {options.out}")


if __name__ == "__main__":
    main()
