"""Which measurements a controller believes: those of places where the robot can be."""

from __future__ import annotations

import math
from operator import le, sub

import numpy as np

from ...control.motor_limits import Limits
from ...errors import MeasurementError
from ...plant.robot import Robot

Event = dict[str, str]

# How far from where it is expected a tip may be seen, as a fraction of the shortest rod: 5 mm on the default robot.
# There, one that swings by 90 mm, stiffnesses off by 40 % and commands two periods late, is seen within 4 mm.
_SURPRISE = 0.0125
# A surprise that was believed, right or wrong, leads to others, which must be believed too: of the tip to greater ones,
# for it makes velocity and force wrong, of an angle to the same on the way back.
_TIP_ECHO, _ANGLE_ECHO = 3.0, 1.0
_DEVIATIONS = 10.0  # of the sensor's noise, besides
_TOO_LONG = 0.02  # of a rod's length, by which a tip may seem out of its reach: bases and lengths are not exact
_OTHER_UNITS = 20.0  # of what surprises, or a quarter of a rod: so near would be a tip that is told in other units
# A sensor that has said the same for so many periods in a row is right, and the expectation is wrong.
PATIENCE = 30
_TURN = 2 * math.pi


class _Sensor:
    """For how long a sensor has told the same that was not believed, and how it has surprised lately."""

    def __init__(self) -> None:
        self.last: list[float] | None = None
        self.surprise = 0.0  # of what was believed, halved in every period since
        self._agreeing = 0

    def believed(self, surprise: float) -> None:
        self.last, self._agreeing = None, 0
        self.surprise = max(surprise, self.surprise / 2)

    def refused(self, reading: list[float], near: float) -> bool:
        """Count a reading that was not believed; return whether it has insisted long enough."""
        last, self.last, self.surprise = self.last, reading, self.surprise / 2
        # So written that NaN agrees with nothing.
        agrees = last is not None and all(abs(now - then) <= near for now, then in zip(reading, last, strict=True))
        self._agreeing = self._agreeing + 1 if agrees else 1
        return self._agreeing >= PATIENCE


class Gate:
    """Tells readings that the robot cannot have caused from the others, tip and motor angles each for itself.

    A tip is not believed out of a rod's reach, or further from the prediction than a fraction of the shortest rod and
    ten standard deviations of the sensor; motor angles are not, if the motors cannot have turned so far in a period.
    What is refused is to be bridged by the prediction. A sensor that insists for `PATIENCE` periods is believed, if the
    robot can be where it says. Then the estimate begins anew: an observer's gain, made for noise, would turn so large a
    surprise into an absurd velocity and force, however long ago the last measurement was.

    Parameters
    ----------
    robot : Robot
        As the controller believes it to be.
    limits : Limits
        Of its motors.
    dt : float
        Control period [s].
    tip_noise : float
        Standard deviation of the measured tip position [m].
    angle_step : float
        Resolution of the encoders [rad].
    wrapped : bool
        Measured angles are known up to whole turns only: of those that are possible the nearest to the prediction is
        meant.
    every : int
        Periods from one measured tip to the next; that there is none in between is no news.
    """

    def __init__(
        self, robot: Robot, limits: Limits, dt: float, tip_noise: float, angle_step: float, wrapped: bool,
        every: int = 1,
    ) -> None:  # fmt: skip
        self._reach = [(*rod.base, rod.length) for rod in robot.rods]
        self._beyond = [(x, y, length * (1.0 + _TOO_LONG)) for x, y, length in self._reach]
        self._near = _SURPRISE * float(robot.lengths.min()) + _DEVIATIONS * tip_noise
        self._turn = limits.rate * dt * (1 + 1e-9) + angle_step
        self._lower = (limits.angle_lower - angle_step).tolist()
        self._upper = (limits.angle_upper + angle_step).tolist()
        self._dt, self._wrapped, self._every = dt, wrapped, every
        self.start(np.zeros(robot.n_rods))

    def start(self, q: np.ndarray, *, first: bool = True) -> None:
        """Begin with motors that are at the angles q [rad]; ``first``: what is measured next is looked at for units."""
        self._tip, self._encoders = _Sensor(), _Sensor()
        self._before = q.tolist()
        self._first, self._without = first, 0

    def pass_by(self, count: int, q: np.ndarray) -> None:
        """Nothing was measured for so many periods, after which the motors are expected at q [rad]."""
        self._tip.surprise = max(self._tip.surprise, self._near * count / _TIP_ECHO)
        self._encoders.surprise = max(self._encoders.surprise, self._turn * count / _ANGLE_ECHO)
        self._before = q.tolist()

    def sift(self, k: int, x: np.ndarray, expected: np.ndarray, with_velocity: bool) -> Sifted:
        """What of a measurement is to be believed.

        Parameters
        ----------
        k : int
            Control period.
        x : ndarray, shape (4 + n,)
            Measured state.
        expected : ndarray, shape (4 + n,)
            Predicted state.
        with_velocity : bool
            The tip's velocity is measured too; else x[2:4] means nothing.

        Raises
        ------
        MeasurementError
            The very first measurement is in other units: its tip is out of reach, and would be near in millimetres or
            centimetres, or its angles are degrees or whole turns off.
        """
        found = Sifted()
        told, due = x.tolist(), expected.tolist()  # on a few floats Python is faster than NumPy
        if self._wrapped:
            told[4:] = map(_unwrapped, told[4:], due[4:])
        p, q, at = told[:2], told[4:], due[4:]
        angles_why, tip_why = self._odd_angles(q, at), self._odd_tip(told, due, with_velocity)
        if angles_why is None:
            self._encoders.believed(max(map(abs, map(sub, q, at))))
            found.q = q
        else:
            text, unit = angles_why
            if self._first and unit:
                raise MeasurementError(f"first measurement: {text}")
            insists = self._encoders.refused(q, self._turn)
            if insists and not unit and all(map(le, self._lower, q)) and all(map(le, q, self._upper)):
                found.q = q
                found.note("reinitialised", k, f"{text}; told so {PATIENCE} times in a row, and believed now")
                self._encoders.believed(self._turn)
            else:
                found.note("measurement", k, f"{text}; bridged by the prediction")
        self._without = self._without + 1 if p[0] != p[0] else 0
        is_due = not 0 < self._without < self._every
        if is_due and tip_why is None:
            self._tip.believed(math.hypot(p[0] - due[0], p[1] - due[1]))
            found.p = p
        elif is_due and tip_why is not None:
            text, unit = tip_why
            if self._first and unit:
                raise MeasurementError(f"first measurement: {text}")
            before = self._tip.last
            insists = self._tip.refused(p, 2 * self._near)
            if insists and before is not None and not self._too_far(p[0], p[1], 0.0):
                between = self._every * self._dt
                found.p, found.velocity = p, [(now - then) / between for now, then in zip(p, before, strict=True)]
                found.note("reinitialised", k, f"{text}; told so {PATIENCE} times in a row, and believed now")
                self._tip.believed(self._near)
            else:
                found.note("measurement", k, f"{text}; bridged by the prediction")
        self._first = False
        self._before = at if found.q is None else q
        return found

    def _odd_tip(self, x: list[float], expected: list[float], with_velocity: bool) -> tuple[str, bool] | None:
        """Why a tip is not to be believed, and whether other units may explain it."""
        px, py, vx, vy = x[:4]
        ex, ey, evx, evy = expected[:4]
        near = self._near + _TIP_ECHO * self._tip.surprise
        away = math.hypot(px - ex, py - ey)
        # So written that NaN is odd.
        if away <= near:
            for base_x, base_y, length in self._beyond:
                if not math.hypot(px - base_x, py - base_y) < length:
                    break
            else:
                if not with_velocity or self._dt * math.hypot(vx - evx, vy - evy) <= near:
                    return None
                return f"tip velocity ({vx:.6g}, {vy:.6g}) m/s, expected ({evx:.6g}, {evy:.6g}) m/s", False
        text = f"tip ({px:.6g}, {py:.6g}) m"
        if px != px and py != py:
            return "no tip was measured", False
        if not math.isfinite(away):
            return f"{text} is not finite", False
        if math.hypot(px / 1e3 - ex, py / 1e3 - ey) <= near:
            return f"{text}, expected ({ex:.6g}, {ey:.6g}) m: millimetres? give metres", True
        far = self._too_far(px, py, _TOO_LONG)
        if far:
            # A reading that is merely wrong is bridged; in other units it would be somewhere near.
            other = any(math.hypot(px / f - ex, py / f - ey) <= _OTHER_UNITS * self._near for f in (1e2, 1e3))
            return f"{text} is out of reach{', are these centimetres or millimetres?' * other}: {far}", other
        return (
            f"{text} is {away:.3g} m from the expected ({ex:.6g}, {ey:.6g}) m, and cannot be further than {near:.3g} m",
            False,
        )

    def _too_far(self, px: float, py: float, tolerance: float) -> str:
        """Which rod cannot reach p; empty if all can."""
        for i, (x, y, length) in enumerate(self._reach):
            if not math.hypot(px - x, py - y) < length * (1.0 + tolerance):
                return f"{math.hypot(px - x, py - y):.4g} m from the base of rod {i}, whose length is {length:.4g} m"
        return ""

    def _odd_angles(self, q: list[float], expected: list[float]) -> tuple[str, bool] | None:
        """Why motor angles are not to be believed, and whether other units explain them."""
        turn = self._turn + _ANGLE_ECHO * self._encoders.surprise
        # So written that NaN is odd.
        for now, before in zip(q, self._before, strict=True):
            if not -turn <= now - before <= turn:
                break
        else:
            return None
        jumps = list(map(sub, q, self._before))
        text = f"motor angles {_listed(q)} rad"
        if all(map(math.isnan, q)):
            return "no motor angles were measured", False
        if not all(map(math.isfinite, q)):
            return f"{text} are not finite", False
        text += f", expected {_listed(expected)} rad"
        turns = [_TURN * round(jump / _TURN) for jump in jumps]
        if any(turns) and all(abs(jump - whole) <= turn for jump, whole in zip(jumps, turns, strict=True)):
            return f"{text}: angles jump by 2 pi: encoders that wrap? set [sensor] wrapped = true", True
        if all(abs(math.radians(now) - then) <= turn for now, then in zip(q, self._before, strict=True)):
            return f"{text}: degrees? give radians", True
        return f"{text}: the motors turn by at most {turn:.3g} rad in a period", False


class Sifted:
    """What of a measurement is believed.

    Attributes
    ----------
    p : list of 2 floats, or None
        Tip position [m].
    velocity : list of 2 floats, or None
        Of the tip, where the estimate has to begin anew [m/s].
    q : list of n floats, or None
        Motor angles [rad].
    events : tuple of dict
        What was not believed, and why: ``kind`` and ``message``.
    """

    p: list[float] | None = None
    velocity: list[float] | None = None
    q: list[float] | None = None
    events: tuple[Event, ...] = ()

    def note(self, kind: str, k: int, message: str) -> None:
        """Add an event of period k."""
        self.events += ({"kind": kind, "message": f"period {k}: {message}"},)


def _unwrapped(angle: float, expected: float) -> float:
    """The angle by whole turns nearest to what is expected."""
    return angle + _TURN * round((expected - angle) / _TURN) if math.isfinite(angle) else angle


def _listed(values: list[float]) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in values) + ")"
