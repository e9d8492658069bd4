"""A release that is measured: the tip's way, how long that took, and how far it is from the yardstick's."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from experiments.charts.points import Row, times
from experiments.motion.rod_inertia import STEP, start
from pcr_mpc import Equilibrium, PCRError, Plant, Robot
from pcr_mpc.loop.run.simulated_plant import SimulatedPlant

_BLOCK = 1e-2  # s, whose wall time is one measurement
MODES, FINEST = 14, STEP / 2  # of the yardstick
_FEWER_MODES = 12


@lru_cache(maxsize=4)
def yardstick(robot: Robot, release: str, duration: float) -> tuple[np.ndarray, float, Row]:
    """Tips every half millisecond [m], how well they are known [mm], and the times."""
    pose, x = start(robot, release)

    def full(modes: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
        return swing(Plant(robot, inertia="full", modes=modes, integrator="gauss", dt=dt), pose, x, duration)

    tips, seconds = full(MODES, FINEST)
    by_step = _distance(tips[::2], full(MODES, STEP)[0])
    by_modes = _distance(tips, full(_FEWER_MODES, FINEST)[0])
    return tips, by_step + by_modes, times(seconds)


def swing(
    plant: SimulatedPlant,
    pose: Equilibrium,
    x: np.ndarray,
    duration: float,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[np.ndarray, np.ndarray]:
    """Tips after every step, shape (K + 1, 2) [m], and times of blocks, for a simulated second [s]."""
    plant.reset(x, pose)
    motors, per_block = np.zeros(pose.robot.n_rods), round(_BLOCK / plant.dt)
    plant.step(x, motors)  # warms up
    plant.reset(x, pose)
    tips, seconds = [x[:2]], []
    for _ in range(round(duration / _BLOCK)):
        began = clock()
        for _ in range(per_block):
            x = plant.step(x, motors)
            tips.append(x[:2])
        seconds.append((clock() - began) / _BLOCK)
    return np.array(tips), np.array(seconds)


def _distance(tips: np.ndarray, others: np.ndarray) -> float:
    return 1e3 * float(np.linalg.norm(tips - others, axis=1).max())


def error_of(robot: Robot, release: str, duration: float, tips: np.ndarray, dt: float) -> float:
    """Largest distance from the yardstick [mm] at multiples of the longer of dt and 1 ms."""
    right = yardstick(robot, release, duration)[0]
    every = max(1, round(STEP / dt))
    spacing = round(every * dt / FINEST)
    return _distance(tips[::every], right[::spacing])


def succeeded(robot: Robot, release: str, duration: float, error: float, remark: str = "", **others: object) -> Row:
    """Row of a release that went well; says so if it is closer than the yardstick is known."""
    unknown = yardstick(robot, release, duration)[1]
    if error < unknown:
        remark += f" closer than the yardstick is known, {unknown:.1e} mm"
    done: Row = {"ours": True, "success": 1, "attempts": 1, "error": error, "error_max": error}
    return done | others | {"remark": remark.strip()}


def failed(failure: PCRError, *, ours: bool) -> Row:
    """Row of a release that did not."""
    return {"ours": ours, "success": 0, "attempts": 1, "remark": f"{type(failure).__name__}: {failure}"}
