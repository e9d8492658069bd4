"""A controller in a loop of one's own: what is measured, and when, in; motor rates and events out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from ...control.qp.program import Reference
from ...errors import PCRError, checked_number, checked_vector, measured_vector
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.held_tip import solve_statics
from ..parts.controllers import Decision
from ..parts.start_pose import StartPose, find_start
from ..references.trajectory import Trajectory
from ..scene.sensors import Sensors
from .clock import Clock
from .motions import as_trajectory
from .reference import Event, LiveReference
from .rows import Asked

# Without a call for so many periods, and so many seconds, they are reckoned; after more, whatever is expected is worth
# nothing.
_PAUSE, _PAUSE_TIME = 10, 0.1
# Complete readings in a row, agreeing with each other, after which the robot is believed to be there again.
_RETURNED = 3


class Core(Protocol):
    """What a live loop needs of the controller that it is for."""

    robot: Robot

    @property
    def expected(self) -> np.ndarray:
        """State that is expected at the next step."""

    @property
    def turning(self) -> np.ndarray:
        """Rates at which the motors turn now [rad/s]."""

    @property
    def believed(self) -> tuple[bool, bool]:
        """Whether the last tip and the last angles were."""

    def period_step(self, k: int, x: np.ndarray) -> Decision:
        """Decide on period k."""

    def stand(self, k: int, x: np.ndarray, pose: Equilibrium, force: np.ndarray) -> None:
        """Begin the estimates anew: state x, rods in ``pose``, a load ``force``; the last rates are kept."""

    def pass_by(self, count: int) -> None:
        """Reckon so many periods in which the last rates were held."""

    def coast(self) -> np.ndarray:
        """Bring the motors to rest, whatever is measured; rates of this period."""


@dataclass(frozen=True, eq=False)
class Wish:
    """What the target was last told to do, for when it has to be told again.

    Attributes
    ----------
    path : Trajectory or None
    start : int
        Period in which the path's time began.
    point : ndarray or None
        To go to [m].
    """

    path: Trajectory | None = None
    start: int = 0
    point: np.ndarray | None = None


class LiveLoop:
    """Periods from times, a reference that changes on the fly, and what to do when sensors fail.

    Parameters
    ----------
    core : Core
    asked : Asked
        Of the reference.
    sensors : Sensors

    Attributes
    ----------
    k : int
        The last period that was decided on.
    notes : list of (kind, message)
        To be told with the next decision.
    """

    def __init__(self, core: Core, asked: Asked, sensors: Sensors) -> None:
        self._core, self._asked, self._sensors = core, asked, sensors
        self._clock = Clock(asked.period)
        self.reference = LiveReference(asked)
        self._bridge = math.inf if sensors.bridge == math.inf else round(sensors.bridge / asked.period)
        self._pause = max(_PAUSE, round(_PAUSE_TIME / asked.period))
        self._near = 0.05 * float(asked.robot.lengths.min()) + 10.0 * sensors.tip_noise
        self.k = -1  # the last period that was decided on
        self._wish = Wish()
        self.notes: list[Event] = []
        self._resting = False
        self._said: set[str] = set()  # of the measurements in the last period
        self._silent = [0, 0]  # periods in which nothing that the tip's sensor, and the encoders, said was believed
        self._seen: deque[tuple[int, np.ndarray, np.ndarray]] = deque(maxlen=_RETURNED)
        self._last: Decision | None = None

    def start(self, found: StartPose, k: int = 0, velocity: np.ndarray | None = None) -> None:
        """Stand in a pose, or pass it at a velocity of the tip [m/s]; the next call of `step` is for period k."""
        self._clock.start()
        self.k = k - 1
        self._wish, self.notes, self._resting, self._silent, self._said = Wish(), [], False, [0, 0], set()
        self._seen.clear()
        self._last = None
        self._stand(k, found, np.zeros(2) if velocity is None else velocity)

    def take_over(self, known: Reference, k: int, pose: Equilibrium, path: Trajectory | None) -> None:
        """Go on after period k with a reference that was solved from ``pose`` on."""
        self.k = k
        self.reference.go_on(known, pose, max(k, 0), path)
        if path is not None:
            self._wish = Wish(path=path)

    def fits(self, asked: Asked) -> bool:
        """Whether the reference is for such a controller."""
        return bool(asked == self._asked)

    def ask(self, asked: Asked) -> None:
        """Let the reference be for another controller, from the present on."""
        if asked == self._asked:
            return
        reference = LiveReference(asked)
        reference.go_on_from(self.reference, self._now())
        self._asked, self.reference = asked, reference

    def _stand(self, k: int, found: StartPose, velocity: np.ndarray) -> None:
        self.reference.start(found.pose, k)
        x = np.concatenate([found.pose.p, velocity, found.pose.q])
        self._core.stand(k, x, found.pose, found.force)

    def target(self) -> np.ndarray:
        """Position [m], velocity and acceleration of the target in the period that was decided on, shape (3, 2)."""
        return self.reference.state(max(self.k, self.reference.first))

    def follow(self, path: Any, fading: float | None) -> None:
        """See `TrackingController.follow`."""
        trajectory, next_one = as_trajectory(path), self.k + 1
        if fading is not None:
            checked_number("blend", fading, above=0.0)
        self.notes += self.reference.follow(trajectory, self._now(), next_one, fading)
        self._wish = Wish(path=trajectory, start=next_one)

    def stop(self) -> None:
        """See `TrackingController.stop`."""
        self.notes += self.reference.stop(self._now())
        self._wish = Wish()

    def hold(self) -> None:
        """See `TrackingController.hold`."""
        k = self._now()
        point = self.reference.state(k)[0]
        self.notes += self.reference.hold(k)
        self._wish = Wish(point=point)

    def jog(self, velocity: Any) -> None:
        """See `TrackingController.jog`."""
        self.notes += self.reference.jog(checked_vector("velocity", velocity, 2), self._now())
        self._wish = Wish()

    def _now(self) -> int:
        """Period from which on the target may be changed."""
        return max(self.k, self.reference.first)

    def step(self, tip: Any, angles: Any, time: Any, target: Any) -> Decision:
        """See `TrackingController.step`."""
        reading = self._reading(tip, angles)
        tick = self._clock.tick(None if time is None else _number("time", time))
        notes = [*self.notes, *tick.events]
        self.notes = []
        if not tick.periods:
            # The rates go on, and with them all that was decided.
            assert self._last is not None
            self._last = replace(self._last, events=_told(self.k, notes))
            return self._last
        missed = tick.periods - 1 if self._last is not None else 0
        self.k += 1 + missed
        if missed and not self._resting:
            notes += self._missed(missed)
        notes += self.reference.advance(self.k)
        if target is not None:
            notes += self._pursue(target)
        self._last = self._rest(reading, notes) if self._resting else self._decide(reading, tick.late, notes)
        return self._last

    def decide(self, k: int, x: np.ndarray) -> Decision:
        """Decide on period k from a measured state, in a loop that counts its periods itself."""
        notes, self.notes = self.notes, []
        if k <= self.k or k < self.reference.first:
            raise PCRError(f"period {k} comes after period {self.k}, on the fly a reference only goes on; call start")
        self.k = k
        notes += self.reference.advance(k)
        self._last = self._core.period_step(k, x)
        self._last = replace(self._last, events=(*self._last.events, *_told(k, notes)))
        return self._last

    def _reading(self, tip: Any, angles: Any) -> tuple[np.ndarray, np.ndarray]:
        return _measured("tip", tip, 2), _measured("angles", angles, self._asked.robot.n_rods)

    def _missed(self, count: int) -> list[Event]:
        said = f"{count} period{'s' if count > 1 else ''} passed without a call"
        if count > self._pause:
            self._lose()
            return [("pause", f"{said}: the estimates begin anew when the robot is seen; the motors brake until then")]
        self._core.pass_by(count)
        return [("late", f"{said}; the rates were held, and are reckoned with")]

    def _lose(self) -> None:
        self._resting = True
        self._seen.clear()

    def _pursue(self, target: Any) -> list[Event]:
        notes = self.reference.pursue(target, self.k)
        if not notes:
            self._wish = Wish(point=np.array(target, dtype=float))
        return notes

    def _decide(self, reading: tuple[np.ndarray, np.ndarray], late: float, notes: list[Event]) -> Decision:
        core, expected = self._core, self._core.expected
        p, q = reading
        # Back to where it was when the period began; what one encoder does not say the commands do.
        p, q = p - late * expected[2:4], q - late * core.turning
        missing = np.isnan(q)
        some = bool(missing.any() and not missing.all())
        if some:
            q = np.where(missing, expected[4:], q)
            which = ", ".join(str(i) for i in np.flatnonzero(missing))
            notes.append(("measurement", f"no angle of motor {which}; bridged by the commands"))
        decision = core.period_step(self.k, np.concatenate([p, np.zeros(2), q]))
        heard = core.believed[0], core.believed[1] and not some
        self._silent = [0 if each else count + 1 for each, count in zip(heard, self._silent, strict=True)]
        if max(self._silent) > self._bridge:
            who = "the tip's sensor" if self._silent[0] > self._bridge else "the encoders"
            notes.append(("rest", f"{who} said nothing believable for {self._sensors.bridge:.3g} s: the motors are "
                          "brought to rest until the robot is seen again"))  # fmt: skip
            self._lose()
        return replace(decision, events=self._news((*decision.events, *_told(self.k, notes))))

    def _news(self, events: tuple[dict[str, str], ...]) -> tuple[dict[str, str], ...]:
        """Events without what was said of a measurement in the last period too, as that a sensor is silent."""
        texts = [each["message"].partition(": ")[2] if each["kind"] == "measurement" else "" for each in events]
        before, self._said = self._said, set(texts) - {""}
        return tuple(each for each, text in zip(events, texts, strict=True) if text not in before)

    def _rest(self, reading: tuple[np.ndarray, np.ndarray], notes: list[Event]) -> Decision:
        """Brake and stay; go on when the robot is seen again."""
        p, q = reading
        if np.isfinite(p).all() and np.isfinite(q).all():
            self._seen.append((self.k, p, self._unwound(q)))
        else:
            self._seen.clear()
        if self._agree():
            try:
                self._resume()
            except (PCRError, ValueError) as error:
                notes.append(("rest", f"the robot is seen, and cannot be taken up again: {error}"))
                self._seen.clear()
            else:
                notes.append(("resumed", f"the robot is seen again, at p = {p} m, q = {q} rad: the estimates begin "
                              "anew there"))  # fmt: skip
                notes += self._take_up()
                self._resting, self._silent = False, [0, 0]
                return self._decide(reading, 0.0, notes)
        return Decision(self._core.coast(), events=_told(self.k, notes))

    def _agree(self) -> bool:
        """Whether the last readings are of one robot that moves as robots do."""
        if len(self._seen) < _RETURNED:
            return False
        turn = self._asked.robot.rate_limit * self._asked.period + self._sensors.angle_step
        pairs = zip(list(self._seen)[:-1], list(self._seen)[1:], strict=True)
        return all(
            later - earlier <= 2 * _RETURNED
            and math.hypot(*(there - here)) <= self._near
            and np.abs(turned - angles).max() <= (later - earlier) * turn
            for (earlier, here, angles), (later, there, turned) in pairs
        )

    def _unwound(self, q: np.ndarray) -> np.ndarray:
        if not self._sensors.wrapped:
            return q
        turn = 2 * math.pi
        return np.asarray(q + turn * np.round((self._core.expected[4:] - q) / turn))

    def _resume(self) -> None:
        """Begin anew where the robot is seen; the branch of its rods is the one that it was on, if that leads there."""
        (first, before, _), *_, (last, p, q) = self._seen
        found = self._pose(p, q)
        self._stand(self.k, found, (p - before) / ((last - first) * self._asked.period))

    def _pose(self, p: np.ndarray, q: np.ndarray) -> StartPose:
        robot = self._asked.robot
        robot.require_reachable(p)
        try:
            last = self.reference.pose(max(self.k, self.reference.first))
            eq = solve_statics(robot, p, robot.checked_angles("q", q), guess=last)
        except PCRError:
            return find_start(robot, p, q, sensors=self._sensors, load=math.inf)
        if not eq.stable:
            return find_start(robot, p, q, sensors=self._sensors, load=math.inf)
        # It may still swing: what the rods carry is no load.
        return StartPose(eq, np.zeros(2))

    def _take_up(self) -> list[Event]:
        """Let the target do again what it was told to."""
        wish, k = self._wish, self.k
        again: Callable[[], list[Event]] | None = None
        if wish.path is not None:
            path = wish.path
            again = lambda: self.reference.follow(path, k, wish.start, None)  # noqa: E731
        elif wish.point is not None:
            again = lambda: self.reference.pursue(wish.point, k)  # noqa: E731
        if again is None:
            return []
        try:
            return again()
        except PCRError as error:
            return [("refused", f"{error}; the robot stays where it is")]


def _told(k: int, notes: list[Event]) -> tuple[dict[str, str], ...]:
    return tuple({"kind": kind, "message": f"period {k}: {message}"} for kind, message in notes)


def _measured(name: str, value: Any, size: int) -> np.ndarray:
    """A vector that was measured; NaN where it was not, which None says too, of all or of one entry."""
    if value is None:
        return np.full(size, np.nan)
    if isinstance(value, list | tuple):
        value = [np.nan if entry is None else entry for entry in value]
    return measured_vector(name, value, size)


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {value!r}, expected a number of seconds") from None
