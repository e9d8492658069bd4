"""How far a linear model holds: from a pose, in every direction, and along a horizon."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from pcr_mpc import (
    Equilibrium,
    PCRError,
    Plant,
    Robot,
    inverse_statics,
    linearise,
    solve_statics,
)

ALLOWED = 0.01  # relative error at which validity ends
CENTRE = (0.0, 0.25)  # m; centre pose of the default robot, start of the lemniscate
SMALLEST = 1e-5  # m and rad; where the search for a radius begins
DIFFERENCE = 1e-6  # m and rad; step of the finite differences
DIRECTIONS = 16
PERIOD, HORIZONS, PLANT_STEP = 0.01, (10, 30), 2e-3  # s, periods, s
RATE_DIRECTIONS = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))
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
