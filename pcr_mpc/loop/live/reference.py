"""A reference that is made while the robot moves: solved a little ahead, and open to change from the present on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...control.qp import Reference
from ...errors import PCRError, UnreachableError, checked_vector
from ...plant.motion.plant import Plant
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ..settings import Payload
from ..trajectory import Trajectory, sampled
from .inverse import BLOCK, OnlineInverse, Row
from .motions import Following, Motion, Pursuit

_LOOK_AHEAD = 0.25  # s, beyond the controller's horizon: there is time to brake before what cannot be had
_LOOK_AHEAD_OF_JOG, _LOOK_AHEAD_OF_PURSUIT = 0.08, 0.03  # s; a pursuit may be made anew in every period
_CHECKED = 10.0  # s of a path that is checked for reach before it is joined, if it does not say how long it is
_CHECKS = 400
_SHORTEST = 10  # periods of a blend or of a stop
_LONGER, _TRIES = 1.6, 7  # of blends that ask for too much
_TRIAL = 30  # rows by which a blend is tried
_USED = 0.8  # share of the motors' rate and of its change that a blend may ask for
_PEAK = 1.875  # of a quintic's speed over its mean
_LEAP = 1000  # periods at once over which no motion is followed
_STRIDE = 5  # rows from which to which the rods are followed along a reference that was solved before
_QUICKNESS = 0.3  # poles of a pursuit, times the period
_OF_JERK = 0.4  # share of the motors' change of rate that a pursuit's jerk asks for
_ACCELERATION, _JERK = 0.5, 0.31  # greatest ones of a pursuit, over speed times quickness, and times its square
_FRESH = 0.8  # weight of the newest velocity of a point that moves

Event = tuple[str, str]


@dataclass(frozen=True)
class Asked:
    """What a reference is asked to be for.

    Attributes
    ----------
    robot : Robot
    period : float
        [s].
    delay, horizon : int
        Periods until a decision acts, and that a controller looks ahead from there.
    inertia : str
        Of the rods in its model.
    payload : Payload or None
        That the tip picks up.
    compiled : bool
    """

    robot: Robot
    period: float
    delay: int
    horizon: int
    inertia: str
    payload: Payload | None
    compiled: bool

    @property
    def rows(self) -> int:
        """That a controller reads from any period on."""
        return self.delay + self.horizon + 2

    def carried(self, k: int, count: int) -> np.ndarray:
        """Payload in ``count`` periods from k on [kg]."""
        t = self.period * (k + np.arange(count))
        return np.zeros(count) if self.payload is None else self.payload.carried(t)


class LiveReference:
    """Rows of inverse dynamics from the present on, remade from there whenever the motion changes.

    Parameters
    ----------
    asked : Asked
    """

    def __init__(self, asked: Asked) -> None:
        self.asked = asked
        robot = asked.robot
        self._inverse = OnlineInverse(robot, compiled=asked.compiled)
        self._inverse.prepare()
        self._mass = Plant(robot, inertia=asked.inertia) if asked.inertia != "none" else None
        self.first = 0  # period of the first row
        self._rows: list[Row] = []
        self._samples = np.empty((0, 3, 2))
        self._states = np.empty((0, 4 + robot.n_rods))
        self._forces = np.empty((0, 2))
        self._motion: Motion = self._still((0.0, 0.0), 0)
        self._point: tuple[int, np.ndarray, np.ndarray] | None = None
        self._refused = ""  # the point that was refused last

    def start(self, pose: Equilibrium, k: int) -> None:
        """Stand in a pose in period k, which may be under load: the motors are then where no load would have them."""
        self.first, self._motion = k, self._still(pose.p, k)
        self._point = None
        row = self._inverse.at(pose)
        state = np.zeros((1, 3, 2))
        state[0, 0] = pose.p
        force = self._force(state, k, row)
        rows, error = self._inverse.rows(row, pose.p[None], force)
        if error is not None:
            raise error
        self._rows = rows
        self._samples, self._forces = state, force
        self._states = np.hstack([pose.p, np.zeros(2), rows[0].q])[None]
        self._require(k)

    def go_on(self, known: Reference, pose: Equilibrium, k: int, path: Trajectory | None) -> None:
        """Go on from period k of a reference that was solved from ``pose`` on, along its path."""
        at = min(k, len(known.states) - 1)
        way = np.unique([*range(0, at, _STRIDE), at])
        rows, error = self._inverse.rows(self._inverse.at(pose), known.states[way, :2], known.forces[way])
        if error is not None:
            raise error
        last = rows[-1]
        sample = np.zeros((1, 3, 2))
        sample[0, 0] = last.p
        self._motion = self._still(last.p, k)
        if path is not None and at == k:
            sample = sampled(path, np.array([k * self.asked.period]))
            self._motion = Following(path, self.asked.period, 0, np.zeros((3, 2)), 0, 1)
        self.first, self._point = k, None
        self._rows = [last]
        self._samples, self._states, self._forces = sample, known.states[at : at + 1], known.forces[at : at + 1]
        self._require(k)

    def go_on_from(self, other: LiveReference, k: int) -> None:
        """Go on from period k of another one."""
        i = k - other.first
        self.first, self._motion, self._point = k, other._motion, other._point
        self._rows = other._rows[i : i + 1]
        self._samples, self._states, self._forces = (
            each[i : i + 1] for each in (other._samples, other._states, other._forces)
        )
        self._require(k)

    def state(self, k: int) -> np.ndarray:
        """Target in period k: position [m], velocity, acceleration, shape (3, 2)."""
        return np.array(self._samples[k - self.first])

    def window(self, k: int, delay: int) -> np.ndarray:
        """See `Track`; call `advance` first."""
        i, horizon = k + delay - self.first, self.asked.horizon
        states = self._states[i : i + horizon + 1]
        rates = (states[1:, 4:] - states[:-1, 4:]) / self.asked.period
        return np.hstack([states[1:], rates, self._forces[i + 1 : i + 1 + horizon]])

    @property
    def carries(self) -> bool:
        """Whether the tip ever carries anything."""
        return self.asked.payload is not None

    def payloads(self, k: int, count: int) -> np.ndarray:
        """That the tip carries from period k on."""
        return self.asked.carried(k, count)

    def pose(self, k: int) -> Equilibrium:
        """Pose of the target in period k."""
        return self._inverse.pose(self._rows[k - self.first])

    def advance(self, k: int) -> list[Event]:
        """Have the rows from period k on; where the motion leads to what cannot be had, brake before it, and say so."""
        drop = k - self.first
        if drop > _LEAP:  # of a clock that was set: nothing is where it was
            self._motion, drop = self._still(self._rows[-1].p, k), len(self._rows) - 1
            self._samples[-1, 1:] = 0.0
        elif drop >= len(self._rows):
            self._extend(drop - len(self._rows) + 1)
            drop = len(self._rows) - 1
        if drop > 0:
            self._rows = self._rows[drop:]
            self._samples, self._states, self._forces = (
                each[drop:].copy() for each in (self._samples, self._states, self._forces)
            )
        self.first = k
        missing = self._ahead(self._motion) - len(self._rows)
        # A block of rows at once costs less than one after the other.
        error = self._extend(missing + BLOCK - 1) if missing > 0 else None
        if error is None:
            return []
        left = len(self._rows)
        for periods in (left, left // 2, left // 4):
            if periods >= 2:
                motion = self._motion.stopped(k, periods)
                try:
                    self._remake(motion, k)
                except PCRError:
                    continue
                return [("refused", f"the target cannot go on: {error}; it brakes, and stays there")]
        self._freeze()
        return [("refused", f"the target cannot go on: {error}; it stays where it can be")]

    def follow(self, path: Trajectory, k: int, start: int, fading: float | None) -> list[Event]:
        """Join a path, whose time begins in period ``start``, from period k on, in ``fading`` seconds if that is said.

        Raises
        ------
        UnreachableError
            Of the path; says when and by how much.
        PCRError
            No blend leads from the target to it.
        """
        self._require_reach(path)
        best: tuple[float, Following] | None = None
        failure: PCRError | None = None
        for periods in self._blends(path, k, start, fading):
            motion = Following.joining(path, self.asked.period, start, self.state(k), k, periods)
            try:
                excess = self._excess(motion, k, periods)
            except PCRError as error:
                failure = error
                continue
            if best is None or excess < best[0]:
                best = excess, motion
            if excess <= 1.0:
                break
        if best is None:
            assert failure is not None
            raise type(failure)(f"the path cannot be joined from {self.state(k)[0]} m: {failure}", **failure.details)
        self._remake(best[1], k)
        self._point = None
        if best[0] <= 1.0:
            return []
        return [("warning", f"joining the path asks for {_USED * best[0]:.3g} times the motors' rate or its change")]

    def stop(self, k: int) -> list[Event]:
        """Brake, along the path if there is one, as fast as the motors may, and stay there."""
        self._point = None
        if not np.abs(self._samples[k - self.first, 1:]).any():
            self._remake(self._still(self._samples[k - self.first, 0], k), k)
            return []
        periods, failure = self._braking(k), None
        for _ in range(4):
            motion = self._motion.stopped(k, periods)
            try:
                if self._excess(motion, k, periods) <= 1.0 / _USED:
                    self._remake(motion, k)
                    return []
            except PCRError as error:
                failure = error
            periods = math.ceil(_LONGER * periods)
        try:
            self._remake(motion, k)
        except PCRError as error:
            failure = error
            self._freeze()
        return [("refused", f"no way to brake keeps within the motors' limits and the rods' reach: {failure}")]

    def hold(self, k: int) -> list[Event]:
        """Come to rest where the target is in period k."""
        self._point = None
        self._remake(self._pursuit(k, self._samples[k - self.first, 0], np.zeros(2)), k)
        return []

    def jog(self, velocity: np.ndarray, k: int) -> list[Event]:
        """Move on at a velocity [m/s], until told otherwise or as far as can be."""
        self._point = None
        motion = self._pursuit(k, None, velocity)
        self._remake(motion, k)
        if math.hypot(*velocity) <= motion.speed:
            return []
        return [("warning", f"jogs at {motion.speed:.3g} m/s: the motors do not turn for {math.hypot(*velocity):.3g}")]

    def pursue(self, point: Any, k: int) -> list[Event]:
        """Go to a point [m], or after it if it moves from call to call; what cannot be had is refused, and told."""
        try:
            point = checked_vector("target", point, 2)
            self.asked.robot.require_reachable(point)
        except (PCRError, ValueError) as error:
            return self._refuse(point, str(error))
        velocity, fresh = np.zeros(2), np.zeros(2)
        if self._point is not None and k > self._point[0]:
            before, last, velocity = self._point
            fresh = (point - last) / ((k - before) * self.asked.period)
            # A point that jumps does not move so fast.
            fresh = fresh if math.hypot(*fresh) <= self._speed(k) else np.zeros(2)
            velocity = velocity + _FRESH * (fresh - velocity) if fresh.any() else np.zeros(2)
        try:
            self._remake(self._pursuit(k, point, velocity), k)
        except PCRError as error:
            return self._refuse(point, f"target ({point[0]:.4g}, {point[1]:.4g}) m: {error}")
        self._point, self._refused = (k, point, velocity), ""
        return []

    def _refuse(self, point: Any, why: str) -> list[Event]:
        """Say why a point is no target, once for each point."""
        if self._refused == repr(point):
            return []
        self._refused = repr(point)
        return [("refused", f"{why}; the target that was goes on")]

    def _still(self, point: Any, k: int) -> Pursuit:
        return Pursuit(self.asked.period, tuple(point), (0.0, 0.0), k, _QUICKNESS / self.asked.period, 1.0, 1.0, 1.0)

    def _pursuit(self, k: int, point: np.ndarray | None, velocity: np.ndarray) -> Pursuit:
        asked = self.asked
        robot, period, rate = asked.robot, asked.period, _QUICKNESS / asked.period
        at = None if point is None else (float(point[0]), float(point[1]))
        # A jerk asks for a rate of the motors at once, an acceleration for one that lasts.
        change = min(robot.acceleration_limit * period, robot.rate_limit)
        per_force = float(np.linalg.norm(np.linalg.pinv(self._rows[k - self.first].coupling), axis=1).max())
        jerk = _OF_JERK * change / (robot.tip_mass * per_force)
        # In these ratios nothing overshoots, however far the point is.
        speed = min(fastest := self._speed(k), jerk / (_JERK * rate**2))
        acceleration, jerk = _ACCELERATION * rate * speed, _JERK * rate**2 * speed
        if at is None:
            speed = fastest
        return Pursuit(period, at, (float(velocity[0]), float(velocity[1])), k, rate, speed, acceleration, jerk)

    def _speed(self, k: int) -> float:
        """Speed of the tip that the motors surely give at the target in period k [m/s]."""
        # Of each motor, in the direction in which it has most to do.
        most = np.linalg.norm(self._rows[k - self.first].levers, axis=1).max()
        return _USED * self.asked.robot.rate_limit / float(most)

    def _braking(self, k: int) -> int:
        """Periods in which the motors, and the poles of a pursuit, bring the target to a stand."""
        asked, i = self.asked, k - self.first
        rates = float(np.abs(self._states[i + 1, 4:] - self._states[i, 4:]).max()) / asked.period
        braking = _PEAK * rates / (_USED * asked.robot.acceleration_limit) / asked.period
        return max(_SHORTEST, math.ceil(braking))

    def _blends(self, path: Trajectory, k: int, start: int, fading: float | None) -> list[int]:
        """Numbers of periods in which a path might be joined, shortest first."""
        period = self.asked.period
        if fading is not None:
            return [max(2, round(fading / period))]
        apart = self.state(k) - sampled(path, np.array([max(k - start, 0) * period]))[0]
        speed = self._speed(k)
        shortest = max(_PEAK * math.hypot(*apart[0]), 2.0 * math.hypot(*apart[1]) / _QUICKNESS * period * speed) / speed
        first = max(_SHORTEST, math.ceil(shortest / period))
        return [math.ceil(first * _LONGER**j) for j in range(_TRIES)]

    def _require_reach(self, path: Trajectory) -> None:
        """Raise if a rod is too short for the path, which costs no statics to see."""
        own = getattr(path, "duration", None)
        whole = float(own) if isinstance(own, int | float) and 0 < own < math.inf else _CHECKED
        t = np.linspace(0.0, whole, _CHECKS)
        p = sampled(path, t)[:, 0]
        for i, rod in enumerate(self.asked.robot.rods):
            over = np.linalg.norm(p - rod.base, axis=1) - rod.length
            if not rod.stretches and over.max() >= 0.0:
                j = int(over.argmax())
                raise UnreachableError(
                    f"the path at t = {t[j]:.3f} s: tip ({p[j, 0]:.6g}, {p[j, 1]:.6g}) m is "
                    f"{over[j] + rod.length:.6g} m from the base of rod {i}, whose length is {rod.length:.6g} m; "
                    f"move it at least {over[j]:.3g} m closer",
                    rod=i,
                    distance=float(over[j] + rod.length),
                    length=rod.length,
                    t=float(t[j]),
                )

    def _excess(self, motion: Motion, k: int, periods: int) -> float:
        """Share of what blends may ask of the motors' rate and its change that a motion asks for in so many periods."""
        asked, i = self.asked, k - self.first
        stride = max(1, math.ceil(periods / _TRIAL))
        samples = motion.ahead(self._samples[i], k, periods + stride)[stride - 1 :: stride]
        row = self._rows[i]
        forces = self._force(samples, k + stride, row)
        rows, error = self._inverse.rows(row, samples[:, 0], forces)
        if error is not None:
            raise error
        rates = np.diff([row.q, *(each.q for each in rows)], axis=0) / (stride * asked.period)
        before = self._states[i, 4:] - self._states[i - 1, 4:] if i else self._states[i + 1, 4:] - row.q
        change = np.diff(np.vstack([before / asked.period, rates]), axis=0) / (stride * asked.period)
        robot = asked.robot
        return (
            float(max(np.abs(rates).max() / robot.rate_limit, np.abs(change).max() / robot.acceleration_limit)) / _USED
        )

    def _ahead(self, motion: Motion) -> int:
        look = _LOOK_AHEAD
        if isinstance(motion, Pursuit):
            look = _LOOK_AHEAD_OF_JOG if motion.point is None else _LOOK_AHEAD_OF_PURSUIT
        return int(self.asked.rows + math.ceil(look / self.asked.period))

    def _remake(self, motion: Motion, k: int) -> None:
        """Let another motion take effect from period k on; raise, and leave all as it was, if it cannot be had."""
        kept = self._rows, self._samples, self._states, self._forces, self._motion
        count = k - self.first + 1
        self._rows, self._motion = self._rows[:count], motion
        self._samples, self._states, self._forces = (
            each[:count] for each in (self._samples, self._states, self._forces)
        )
        error = self._extend(self._ahead(motion) - 1)
        if error is not None:
            self._rows, self._samples, self._states, self._forces, self._motion = kept
            raise error

    def _require(self, k: int) -> None:
        error = self._extend(self._ahead(self._motion) - len(self._rows))
        if error is not None:
            raise error

    def _extend(self, count: int) -> PCRError | None:
        """Add so many rows; return why there are fewer, if there are."""
        if count <= 0:
            return None
        last, k = self._rows[-1], self.first + len(self._rows) - 1
        samples = self._motion.ahead(self._samples[-1], k, count)
        if self._mass is None:
            forces = self._force(samples, k + 1, last)
            rows, error = self._inverse.rows(last, samples[:, 0], forces)
        else:
            rows, error, found = [], None, []
            for j in range(count):  # the rods' inertia is that of the row before
                found.append(self._force(samples[j : j + 1], k + 1 + j, rows[-1] if rows else last))
                more, error = self._inverse.rows(rows[-1] if rows else last, samples[j : j + 1, 0], found[-1])
                rows += more
                if error is not None:
                    break
            forces = np.vstack(found)
        done = len(rows)
        if done:
            q = np.array([row.q for row in rows])
            velocities = self._velocities(samples[:done], rows)
            self._rows = self._rows + rows
            self._samples = np.concatenate([self._samples, samples[:done]])
            self._states = np.vstack([self._states, np.hstack([samples[:done, 0], velocities, q])])
            self._forces = np.vstack([self._forces, forces[:done]])
        return error

    def _freeze(self) -> None:
        """Stay at the last row that there is."""
        self._samples = self._samples.copy()
        self._samples[-1, 1:] = 0.0
        self._motion = self._still(self._rows[-1].p, self.first + len(self._rows) - 1)
        missing = self._ahead(self._motion) - len(self._rows)
        if missing > 0:
            self._rows = self._rows + [self._rows[-1]] * missing
            self._samples, self._states, self._forces = (
                np.concatenate([each, np.repeat(each[-1:], missing, axis=0)])
                for each in (self._samples, self._states, self._forces)
            )

    def _force(self, samples: np.ndarray, k: int, row: Row) -> np.ndarray:
        """Force that the rods carry at samples from period k on, shape (K, 2) [N], beside the tip's own weight."""
        robot = self.asked.robot
        v, a = samples[:, 1], samples[:, 2]
        carried = self.asked.carried(k, len(samples))[:, None]
        forces = carried * (np.array(robot.gravity) - a) - robot.tip_mass * a - robot.drag * v
        if self._mass is not None:
            own, coupled, levers = self._inertia(row)
            # The motors turn with the tip as at rest; terms of second order in the velocities are left out.
            forces -= a @ (own + coupled @ levers).T - robot.tip_mass * a
        return np.asarray(forces)

    def _inertia(self, row: Row) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """M_pp, M_pq and dq/dp at a row."""
        assert self._mass is not None
        self._mass.reset(np.concatenate([row.p, np.zeros(2), row.q]), self._inverse.pose(row))
        mass = self._mass.mass(row.p, row.q)[0]
        return mass[:2, :2], mass[:2, 2:], row.levers

    def _velocities(self, samples: np.ndarray, rows: list[Row]) -> np.ndarray:
        """Velocities of the state: the momentum over M_pp (see `Plant`)."""
        if self._mass is None:
            return samples[:, 1]
        found = samples[:, 1].copy()
        for velocity, row in zip(found, rows, strict=True):
            own, coupled, levers = self._inertia(row)
            velocity += np.linalg.solve(own, coupled @ levers @ velocity)
        return found
