"""A reference that is made while the robot moves: solved a little ahead, and open to change from the present on."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...control.qp.program import Reference
from ...errors import PCRError, UnreachableError, checked_vector
from ...plant.statics.equilibrium import Equilibrium
from ..references.trajectory import Trajectory, sampled
from .motions import Following, Motion, Pursuit
from .rows import QUICKNESS, Rows

_CHECKED = 10.0  # s of a path that is checked for reach before it is joined, if it does not say how long it is
_CHECKS = 400
_SHORTEST = 10  # periods of a blend or of a stop
_LONGER, _TRIES = 1.6, 7  # of blends that ask for too much
_TRIAL = 30  # rows by which a blend is tried
_USED = 0.8  # share of the motors' rate and of its change that a blend may ask for
_PEAK = 1.875  # of a quintic's speed over its mean
_LEAP = 1000  # periods at once over which no motion is followed
_STRIDE = 5  # rows from which to which the rods are followed along a reference that was solved before
_OF_JERK = 0.4  # share of the motors' change of rate that a pursuit's jerk asks for
_ACCELERATION, _JERK = 0.5, 0.31  # greatest ones of a pursuit, over speed times quickness, and times its square
_QUIET = 10  # periods after which it is said again that a target cannot go on
_FRESH = 0.8  # weight of the newest velocity of a point that moves

Event = tuple[str, str]


class LiveReference(Rows):
    """Rows of inverse dynamics from the present on, remade from there whenever the motion changes.

    Parameters
    ----------
    asked : Asked
    """

    def start(self, pose: Equilibrium, k: int) -> None:
        """Stand in a pose in period k, which may be under load: the motors are then where no load would have them."""
        self.first, self._motion = k, self._still(pose.p, k)
        self._point, self._blocked_in = None, None
        row = self._at(pose)
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
        rows, error = self._inverse.rows(self._at(pose), known.states[way, :2], known.forces[way])
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
        self._rows = [self._at(other.pose(k))]
        self._samples, self._states, self._forces = (
            each[i : i + 1] for each in (other._samples, other._states, other._forces)
        )
        self._require(k)

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
        error = self._extend(missing + self.block - 1) if missing > 0 else None
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
                return self._blocked(k, f"the target cannot go on: {error}; it brakes, and stays there")
        self._freeze()
        return self._blocked(k, f"the target cannot go on: {error}; it stays where it can be")

    def _blocked(self, k: int, why: str) -> list[Event]:
        """Say why the target does not go on; who jogs on against an edge hears it once."""
        before, self._blocked_in = self._blocked_in, k
        return [] if before is not None and 0 <= k - before <= _QUIET else [("refused", why)]

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
        return self._pursued(self._pursuit(k, self._samples[k - self.first, 0], np.zeros(2)), k)

    def jog(self, velocity: np.ndarray, k: int) -> list[Event]:
        """Move on at a velocity [m/s], until told otherwise or as far as can be."""
        self._point = None
        motion = self._pursuit(k, None, velocity)
        notes = self._pursued(motion, k)
        if math.hypot(*velocity) <= motion.speed or self._motion is not motion:
            return notes
        return [("warning", f"jogs at {motion.speed:.3g} m/s: the motors do not turn for {math.hypot(*velocity):.3g}")]

    def _pursued(self, motion: Pursuit, k: int) -> list[Event]:
        """Move so from period k on; brake where that cannot be had."""
        try:
            self._remake(motion, k)
        except PCRError as error:
            return [*self._blocked(k, f"the target cannot go there: {error}; it brakes, and stays"), *self.stop(k)]
        return []

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

    def _pursuit(self, k: int, point: np.ndarray | None, velocity: np.ndarray) -> Pursuit:
        asked = self.asked
        robot, period, rate = asked.robot, asked.period, QUICKNESS / asked.period
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
        shortest = max(_PEAK * math.hypot(*apart[0]), 2.0 * math.hypot(*apart[1]) / QUICKNESS * period * speed) / speed
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
