"""The motors of a simulation: from commanded rates to those at which the clamps turn."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...plant.motion.plant import Plant
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ..hardware.lag import Lag
from ..hardware.motors import IDEAL, Motors
from ..scene.scene import Scene
from ..scene.settings import MOTORS

_SAME_STALL = 0.1  # s, within which a motor that is held back again tells nothing new

_SAME_RATE = 1e-9  # rad/s: a rate that was turned into an angle and back has lost digits


class Drive:
    """Simulated `Motors`; they stand between the commands and any plant, and begin at rest.

    Within a step of the plant the clamps turn at a constant rate, with which they end where the lag leads: angles are
    exact at the ends of the steps.

    Parameters
    ----------
    motors : Motors
    robot : Robot
        That moves: its limits are the motors' own.
    dt : float
        Step of the plant [s].
    pose : Equilibrium
        In which it starts; the clamps are in the middle of the play.

    Attributes
    ----------
    stalled : ndarray of bool, shape (n,)
        Which motors the torque limit has held back in the last step.
    """

    def __init__(self, motors: Motors, robot: Robot, dt: float, pose: Equilibrium) -> None:
        self._motors, self._robot, self._dt = motors, robot, dt
        self._lag, self._play = Lag.of(motors.time_constant, dt), motors.backlash / 2
        self._rate = np.zeros(robot.n_rods)
        self._shaft, self._wanted = pose.q.copy(), pose.q.copy()
        self.stalled = np.zeros(robot.n_rods, dtype=bool)
        self._stalled_at = np.full(robot.n_rods, -math.inf)
        self._rods: Plant | None = None
        if motors.saturated:
            # Of its own: other engines know no torque at the clamp, and the plant's memory stays its own.
            self._rods = Plant(robot, on_snap="jump", dt=dt)
            self._rods.reset(np.concatenate([pose.p, np.zeros(2), pose.q]), pose)

    def news(self, t: float) -> list[dict[str, Any]]:
        """Events of the step that begins at time t [s]: one for each motor that begins to be held back."""
        if self._rods is None:
            return []
        begin = self.stalled & (t - self._stalled_at > _SAME_STALL)
        self._stalled_at[self.stalled] = t
        return [
            {"t": t, "kind": "stall", "message": f"motor {i} is at its torque limit of "
             f"{self._robot.torque_limit:.4g} N m, and turns at the rate that this leaves"}
            for i in np.flatnonzero(begin).tolist()
        ]  # fmt: skip

    def angles(self, x: np.ndarray) -> np.ndarray:
        """Angles of the motors at a state of the robot, as encoders see them, shape (n,) [rad]."""
        return np.asarray(np.clip(self._shaft, x[4:] - self._play, x[4:] + self._play))

    def turn(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Rates of the clamps in the step that begins at state x, for commanded rates u, shape (n,) [rad/s]."""
        robot, dt, lag = self._robot, self._dt, self._lag
        shaft, clamp = self.angles(x), x[4:]
        told = np.clip(u, -robot.rate_limit, robot.rate_limit)
        if self._motors.command == "angle":
            behind = self._wanted - shaft
            lower, upper = robot.angle_limits.T
            self._wanted = np.clip(self._wanted + dt * told, lower, upper)
            if self._motors.time_constant > 0.0:
                self._rate = behind / self._motors.time_constant
            else:
                told = (self._wanted - shaft) / dt
        wanted = lag.mean_rate(told, self._rate)
        turning = robot.motor_rates(wanted, shaft, dt)
        shaft = shaft + dt * turning
        moved = np.clip(clamp, shaft - self._play, shaft + self._play)
        rates = (moved - clamp) / dt if self._play else turning
        if self._rods is not None:
            held = self._held(x, rates)
            self.stalled = held != rates
            # A motor that cannot turn its clamp leans against the side of the play.
            shaft = np.where(self.stalled, clamp + dt * held + np.sign(rates) * self._play, shaft)
            turning, rates = np.where(self.stalled, held, turning), held
        free = np.abs(turning - wanted) <= _SAME_RATE
        self._rate = np.where(free, lag.end_rate(told, self._rate), turning)
        self._shaft = shaft
        return rates

    def _held(self, x: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Rates that the torque limit leaves: at most such that the torque at the end of the step is the limit."""
        limit, dt = self._robot.torque_limit, self._dt
        ahead = x[:2] + dt * x[2:4]
        turned = self._torque(ahead, x[4:] + dt * rates)
        side = np.sign(turned)
        pushing = (np.abs(turned) > limit) & (side * rates > 0.0)
        if not pushing.any():
            return rates
        still = side * self._torque(ahead, x[4:])
        rise = side * turned - still
        share = np.where(rise > 0.0, (limit - still) / np.where(rise > 0.0, rise, 1.0), 0.0)
        return np.asarray(np.where(pushing, np.clip(share, 0.0, 1.0) * rates, rates))

    def _torque(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        assert self._rods is not None
        return self._rods.equilibrium(np.concatenate([p, np.zeros(2), q])).motor_torque


def drive_of(scene: Scene, dt: float, pose: Equilibrium) -> Drive | None:
    """Motors of a scene for a plant with step dt [s]; None: they follow their commands at once."""
    if scene.motors is None or scene.motors == IDEAL or scene.plant.motors == MOTORS[0]:
        return None
    return Drive(scene.motors, scene.robot.plain() if scene.plant.rods == "plain" else scene.robot, dt, pose)
