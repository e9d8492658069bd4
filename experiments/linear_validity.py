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
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from tqdm import tqdm

from pcr_mpc import (
    Equilibrium,
    LinearMPC,
    PCRError,
    Plant,
    Reference,
    Robot,
    Scene,
    inverse_statics,
    linearise,
    load_robot,
    load_scene,
    load_tuning,
    make_controller,
    simulate,
    solve_statics,
)
from pcr_mpc.loop.controllers import Controller, Decision
from pcr_mpc.loop.feed_forward import feed_forward
from pcr_mpc.loop.parts import motor_limits
from pcr_mpc.loop.trajectory import Lemniscate
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import BLUE, GREY, RED, plt

MODELS = Path(__file__).parent.parent / "models"
ALLOWED = 0.01  # relative error at which validity ends
CENTRE = (0.0, 0.25)  # m; centre pose of the default robot, start of the lemniscate
SMALLEST = 1e-5  # m and rad; where the search for a radius begins
DIFFERENCE = 1e-6  # m and rad; step of the finite differences
DIRECTIONS = 16
PERIOD, HORIZONS, PLANT_STEP = 0.01, (10, 30), 2e-3  # s, periods, s
HORIZON_TIPS = ((0.0, 0.25), (0.06, 0.22), (0.0, 0.11), (0.2, 0.15), (0.0, 0.37))  # m
RATE_DIRECTIONS = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))
REACHES, LIMITED_REACHES = (0.6, 2.0, 6.0, 20.0, 60.0, 100.0, 150.0, 180.0), (60.0, 100.0, 150.0)  # mm
FREE = 100.0  # times the robot's limits on rate and acceleration: none
LAPS = {2.0: ("-", "o"), 1.0: ("--", "s")}  # s; line and marker
START_UP = 1.0  # s; the scene's ramp
RADIUS_TICKS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0)  # mm; of the colour bar

Row = dict[str, Any]


def poses_in_balance(robot: Robot, spacing: float) -> tuple[list[Equilibrium], list[Row]]:
    """Follow mode LR from the centre pose over a grid of tips, from neighbour to neighbour.

    Returns
    -------
    poses : list of Equilibrium
    failures : list of dict
        Tips next to a pose at which no neighbour led to a pose: x_m, y_m and the failure.
    """
    start = inverse_statics(robot, CENTRE, mode="LR")
    poses = {(0, 0): start}
    failures: dict[tuple[int, int], Row] = {}
    queue = deque(poses)
    while queue:
        i, j = queue.popleft()
        for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if cell in poses:
                continue
            tip = np.add(CENTRE, np.multiply(spacing, cell))
            try:
                poses[cell] = inverse_statics(robot, tip, guess=poses[i, j])
            except PCRError as error:
                failures[cell] = {"x_m": tip[0], "y_m": tip[1], "failure": failure_text(error)}
            else:
                failures.pop(cell, None)
                queue.append(cell)
    return list(poses.values()), list(failures.values())


def failure_text(error: PCRError) -> str:
    """Kind and message of a failure, for a CSV."""
    return f"{type(error).__name__}: {error}"


def circle(n_directions: int) -> np.ndarray:
    """Unit vectors all around, shape (n_directions, 2)."""
    angles = 2.0 * np.pi * np.arange(n_directions) / n_directions
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def tip_directions(n_directions: int = DIRECTIONS) -> np.ndarray:
    """Motions [dp, dq] of the tip alone, shape (n_directions, 4)."""
    return np.hstack([circle(n_directions), np.zeros((n_directions, 2))])


def motor_directions(n_directions: int = DIRECTIONS) -> np.ndarray:
    """Motions [dp, dq] of the motors alone, shape (n_directions, 4)."""
    return np.hstack([np.zeros((n_directions, 2)), circle(n_directions)])


def jacobian(pose: Equilibrium) -> np.ndarray:
    """[K G], shape (2, 4)."""
    return np.hstack([pose.dforce_dp, pose.dforce_dq])


def relative_error(force: np.ndarray, pose: Equilibrium, motion: np.ndarray) -> float:
    """Error of F0 + K dp + G dq against ``force``, over the change |K dp + G dq| that it predicts."""
    change = jacobian(pose) @ motion
    return float(np.linalg.norm(force - pose.force - change) / np.linalg.norm(change))


def radius_along(plant: Plant, pose: Equilibrium, direction: np.ndarray) -> tuple[float, str]:
    """Motion along ``direction`` up to which the linear force model is right to 1 %, by doubling and bisection.

    Returns
    -------
    radius : float
        In units of ``direction`` [m or rad].
    ended_by : str
        "1 % error", or why the rods could not follow.
    """

    def end(size: float) -> str:
        motion = size * direction
        try:
            force = plant.force(pose.p + motion[:2], pose.q + motion[2:])
        except PCRError as error:
            return failure_text(error)
        return "" if relative_error(force, pose, motion) <= ALLOWED else "1 % error"

    # The plant follows its branch from one call to the next: each ray starts at the pose.
    plant.reset(np.concatenate([pose.p, [0.0, 0.0], pose.q]), pose)
    inside, outside = 0.0, SMALLEST
    while not (ended_by := end(outside)):
        inside, outside = outside, 2.0 * outside
    while outside - inside > 1e-3 * max(outside, SMALLEST):
        middle = (inside + outside) / 2
        reason = end(middle)
        if reason:
            outside, ended_by = middle, reason
        else:
            inside = middle
    return inside, ended_by


def smallest_radius(plant: Plant, pose: Equilibrium, directions: np.ndarray) -> tuple[float, float, str]:
    """Radius of validity over all directions, the direction's angle in its plane [deg], and what ended it."""
    found = [radius_along(plant, pose, direction) for direction in directions]
    worst = int(np.argmin([radius for radius, _ in found]))
    return found[worst][0], 360.0 * worst / len(directions), found[worst][1]


def second_derivative(pose: Equilibrium) -> np.ndarray:
    """d2F_i / dz_j dz_k with z = [p, q] by central differences of [K G], shape (2, 4, 4)."""
    columns = []
    for motion in DIFFERENCE * np.eye(4):
        ahead, back = (
            jacobian(solve_statics(pose.robot, pose.p + s * motion[:2], pose.q + s * motion[2:], guess=pose))
            for s in (1, -1)
        )
        columns.append((ahead - back) / (2.0 * DIFFERENCE))
    return np.stack(columns, axis=2)


def predicted_radius(pose: Equilibrium, curvature: np.ndarray, directions: np.ndarray) -> float:
    """Smallest radius over the directions at which half the second derivative amounts to 1 % of the first."""
    change = np.linalg.norm(directions @ jacobian(pose).T, axis=1)
    bend = np.linalg.norm(np.einsum("ijk,nj,nk->ni", curvature, directions, directions), axis=1)
    return float(np.min(2.0 * ALLOWED * change / bend))


def measure_pose(plant: Plant, pose: Equilibrium) -> Row:
    """Row of the map: radii of tip and motors, each with its prediction."""
    row: Row = {"x_m": pose.p[0], "y_m": pose.p[1], "q0_rad": pose.q[0], "q1_rad": pose.q[1], "mode": pose.mode}
    row["softest_N_m"], row["stiffest_N_m"] = pose.stiffness_eigenvalues
    try:
        curvature = second_derivative(pose)
        for name, unit, per, directions in (
            ("tip", "mm", 1e3, tip_directions()),
            ("motor", "rad", 1.0, motor_directions()),
        ):
            radius, angle, ended_by = smallest_radius(plant, pose, directions)
            row[f"{name}_radius_{unit}"] = per * radius
            row[f"{name}_predicted_{unit}"] = per * predicted_radius(pose, curvature, directions)
            row[f"{name}_direction_deg"], row[f"{name}_ended_by"] = angle, ended_by
    except PCRError as error:
        row["failure"] = failure_text(error)
    return row


def measure_map(robot: Robot, spacing: float) -> list[Row]:
    """One row for each tip of the grid that was tried."""
    poses, failures = poses_in_balance(robot, spacing)
    plant = Plant(robot)
    return [measure_pose(plant, pose) for pose in tqdm(poses, desc="1 map", unit="pose")] + failures


def horizon_errors(robot: Robot, pose: Equilibrium, rates: np.ndarray) -> list[Row]:
    """Prediction by the linear model against the plant at the end of each horizon, for constant rates from rest."""
    plant = Plant(robot, integrator="rk4", dt=PLANT_STEP)
    x = np.concatenate([pose.p, [0.0, 0.0], pose.q])
    plant.reset(x, pose)
    model = linearise(plant, x, rates, PERIOD)
    predicted, failure = x.copy(), ""
    lower, upper = robot.angle_limits.T
    rows: list[Row] = []
    for period in range(1, max(HORIZONS) + 1):
        predicted = model(predicted, rates)
        # The plant's motors would halt there, which the model leaves to the controller's constraints.
        if not failure and ((predicted[4:] < lower) | (predicted[4:] > upper)).any():
            failure = f"a motor is at its stop after {period} periods"
        try:
            for _ in range(0 if failure else round(PERIOD / PLANT_STEP)):
                x = plant.step(x, rates)
        except PCRError as error:
            failure = failure_text(error)
        if period in HORIZONS:
            row: Row = {"x_m": pose.p[0], "y_m": pose.p[1], "periods": period, "rate_rad_s": np.abs(rates).max()}
            row["u0_rad_s"], row["u1_rad_s"] = rates
            if not failure:
                moved, error_m = np.linalg.norm(x[:2] - pose.p), np.linalg.norm(predicted[:2] - x[:2])
                row |= {"moved_mm": 1e3 * moved, "error_mm": 1e3 * error_m, "relative_error": error_m / moved}
            rows.append({**row, "failure": failure})
    return rows


def measure_horizon(robot: Robot, tips: Sequence[tuple[float, float]], rates: np.ndarray) -> list[Row]:
    """One row for each pose, rate, direction of the motors and horizon."""
    centre = inverse_statics(robot, CENTRE, mode="LR")
    poses = [inverse_statics(robot, tip, guess=centre) for tip in tips]
    return [
        row
        for pose in tqdm(poses, desc="2 horizon", unit="pose")
        for direction in RATE_DIRECTIONS
        for rate in rates
        for row in horizon_errors(robot, pose, rate * np.array(direction, dtype=float))
    ]


def passes_one_percent(rows: list[Row], tip: tuple[float, float], periods: int) -> tuple[float, float]:
    """Smallest motor rate [rad/s] and smallest distance moved [mm] at which the prediction errs by 1 %.

    Interpolated between the measured rates on logarithmic scales, NaN where no direction passes it.
    """
    crossings = [(np.nan, np.nan)]
    for direction in RATE_DIRECTIONS:
        mine = [
            [row["rate_rad_s"], row["moved_mm"], row["relative_error"]]
            for row in rows
            if (row["x_m"], row["y_m"], row["periods"], row["failure"]) == (*tip, periods, "")
            and (np.sign(row["u0_rad_s"]), np.sign(row["u1_rad_s"])) == direction
        ]
        rate, moved, error = np.log(np.array(mine, dtype=float).reshape(-1, 3)).T
        above = np.flatnonzero(error > np.log(ALLOWED))
        if above.size and above[0] > 0:
            pair = slice(above[0] - 1, above[0] + 1)
            crossings.append(tuple(np.exp(np.interp(np.log(ALLOWED), error[pair], y[pair])) for y in (rate, moved)))
    smallest_rate, smallest_moved = np.nanmin(crossings, axis=0) if len(crossings) > 1 else crossings[0]
    return float(smallest_rate), float(smallest_moved)


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
