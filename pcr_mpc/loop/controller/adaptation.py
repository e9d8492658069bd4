"""Slow numbers of the robot in the observer: the tip's mass, and the stiffness of its rods, while it moves.

The Kalman filter of `DisturbanceObserver` gets one more state for each number, its relative deviation z, that walks at
random. Off by z, the model lacks the force J z on the tip: -m (a - g) z of a mass, -F z of a stiffness. J changes along
the motion, which is what tells numbers from a force; so this filter's gain is not steady, and is computed in each
period.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ...control.observer import ObserverTuning
from ...control.tuning import Tuning
from ...errors import ModelError
from ...linearisation.linear_model import LinearModel
from ...plant.robot import Robot
from ..demand.feed_forward import InverseDynamics
from ..demand.track import Track
from ..live.reference import LiveReference
from ..parts.foresight import Foresight
from ..scene.scene import Scene

# What is believed of z at the start, one standard deviation; and how far it may go.
_BELIEVED, _LEAST, _MOST = 0.05, -0.75, 4.0
_SETTLING = 300  # periods at rest, after which the filter is as at the start of a run
_LAWS = ("linear_mpc", "lqr", "pd", "feed_forward")


class Adaptation:
    """The filter, and what its numbers change: linear models, the motor target and the feed-forward.

    Parameters
    ----------
    tuning : ObserverTuning
        With something to adapt.
    tip_noise : float
        Standard deviation of the measured tip [m].
    robot : Robot
        As it is believed to be.
    resting : LinearModel
        About the start.

    Attributes
    ----------
    z : ndarray, shape (A,)
        Relative deviations of the numbers, in the order of ``tuning.adapts``.
    """

    def __init__(self, tuning: ObserverTuning, tip_noise: float, robot: Robot, resting: LinearModel) -> None:
        self.tuning, self.robot, self._dt = tuning, robot, resting.dt
        self._gravity = np.array(robot.gravity)
        noise = max(tip_noise, tuning.tip_noise)
        count = len(tuning.adapts)
        # As `DisturbanceObserver` does, in units in which the filter is well scaled.
        push = noise / float(np.linalg.norm(resting.E[:2], 2))
        self._units = np.array([noise] * 2 + [noise / resting.dt] * 2 + [push] * 2 + [1.0] * count)
        self._walks = np.array([tuning.force_walk / push] * 2 + [tuning.adapt_walk] * count) ** 2
        self._force_noise = (tuning.force_noise / push) ** 2
        self._lacks = np.zeros((2, count))
        self._p = np.eye(6 + count)
        self._p[6:, 6:] = 0.0
        for _ in range(_SETTLING):
            self._update()
            self._move(resting, self._lacks, 0.0)
        self._p[6:, 6:] = _BELIEVED**2 * np.eye(count)
        self._start = self._p.copy()
        self.reset()

    def reset(self) -> None:
        """Believe what was believed at the start."""
        self.z = np.zeros(len(self.tuning.adapts))
        self._p = self._start.copy()
        self._lacks = np.zeros((2, len(self.z)))

    def deviation(self, name: str) -> float:
        """z of a number; 0 where it is not adapted."""
        return float(self.z[self.tuning.adapts.index(name)]) if name in self.tuning.adapts else 0.0

    def correct(self, foresight: Foresight, *, seen: bool) -> None:
        """Take in the measured tip, if it is ``seen``, and write gain and numbers for this period's look ahead."""
        given = foresight.inputs
        given["gain"][:] = 0.0
        if seen:
            gain = self._update()
            surprise = given["measured"][:2] - given["estimate"][:2]
            self.z = np.clip(self.z + gain[6:] @ surprise, _LEAST, _MOST)
            given["gain"][:] = gain[:6]
        self.write(foresight)

    def write(self, foresight: Foresight) -> None:
        """Write the numbers that models and motor target have from now on."""
        given = foresight.inputs
        mass, stiffness = 1.0 + self.deviation("tip_mass"), 1.0 + self.deviation("stiffness")
        for numbers, kind in ((given["numbers"], foresight.kinds[0]), (given["target_numbers"], foresight.kinds[1])):
            numbers[kind.names.index("tip_mass")] = mass * self.robot.tip_mass
            for i, rod in enumerate(self.robot.rods):
                numbers[kind.names.index(f"rods[{i}].bending_stiffness")] = stiffness * rod.bending_stiffness

    def predict(self, model: LinearModel, estimate: np.ndarray, ahead: np.ndarray, force: np.ndarray) -> None:
        """Move on by a period in which the model leads from an estimate to the state ``ahead`` under a force [N]."""
        robot, mass = self.robot, (1.0 + self.deviation("tip_mass")) * self.robot.tip_mass
        pull = (ahead[2:4] - estimate[2:4]) / self._dt - self._gravity
        rods = force - mass * pull - robot.drag * estimate[2:4]
        lacks = {"tip_mass": -robot.tip_mass * pull, "stiffness": -rods / (1.0 + self.deviation("stiffness"))}
        self._lacks = np.stack([lacks[name] for name in self.tuning.adapts], axis=1)
        self._move(model, self._lacks, 1.0)

    def _update(self) -> np.ndarray:
        """Gain of this period's measurement, shape (6 + A, 2), which is then known."""
        p = self._p
        gain = p[:, :2] @ np.linalg.inv(p[:2, :2] + np.eye(2))
        kept = np.eye(len(p))
        kept[:, :2] -= gain
        # Joseph's form: it stays symmetric and positive.
        self._p = kept @ p @ kept.T + gain @ gain.T
        return np.asarray(self._units[:, None] / self._units[0] * gain)

    def _move(self, model: LinearModel, lacks: np.ndarray, walks: float) -> None:
        count = len(self._p)
        a = np.eye(count)
        a[:4, :4], a[:4, 4:6], a[:4, 6:] = model.A[:4, :4], model.E[:4], model.E[:4] @ lacks
        a = a * self._units / self._units[:, None]
        pushed = model.E[:4] * self._units[4] / self._units[:4, None]
        noise = np.zeros((count, count))
        noise[:4, :4] = self._force_noise * pushed @ pushed.T
        noise[range(4, count), range(4, count)] = self._walks * np.array([1.0] * 2 + [walks] * (count - 6))
        self._p = a @ self._p @ a.T + noise


class AdaptedTrack(Track):
    """Windows of a reference whose rods carry what the numbers make of it.

    Parameters
    ----------
    track : Track
        For the numbers that are believed.
    adaptation : Adaptation
    period : float
        [s].
    """

    def __init__(self, track: Track, adaptation: Adaptation, period: float) -> None:
        self.__dict__.update(track.__dict__)
        self.inner, self._adaptation = track, adaptation
        robot, reference = adaptation.robot, track.reference
        weight = robot.tip_mass * np.array(robot.gravity)
        pull = robot.tip_mass * np.gradient(reference.states[:, 2:4], period, axis=0, edge_order=2)
        self._added = {
            "tip_mass": _rows(reference, weight - pull, -pull, period),
            # As stiffer rods carry the same force, softer ones carried as much less.
            "stiffness": _rows(reference, -(reference.forces + weight), np.zeros_like(pull), period),
        }

    def window(self, k: int, delay: int) -> np.ndarray:
        """See `Track`; the end that is held is as it was."""
        plain = self.inner.window(k, delay)
        if k >= self._last:
            return plain
        at = slice(k + delay, k + delay + self._horizon)
        mass, stiffness = self._adaptation.deviation("tip_mass"), self._adaptation.deviation("stiffness")
        return plain + mass * self._added["tip_mass"][at] + stiffness / (1.0 + stiffness) * self._added["stiffness"][at]


def _rows(reference: InverseDynamics, carried: np.ndarray, told: np.ndarray, period: float) -> np.ndarray:
    """Rows of a window by which rods carry more, of which the reference's own force shows a part."""
    angles = np.einsum("kij,kj->ki", reference.angles_per_force, carried)
    states = np.hstack([np.zeros((len(angles), 4)), angles])
    return np.hstack([states[1:], np.diff(angles, axis=0) / period, told[1:]])


class Work(Protocol):
    """What of a controller's work has to do with numbers that change."""

    robot: Robot
    foresight: Foresight
    track: Track | LiveReference
    adaptation: Adaptation | None


def adapt(work: Work, tuning: Tuning, scene: Scene, resting: LinearModel) -> None:
    """Let a controller's work adapt what its tuning says; what adapted the same until now goes on.

    Raises
    ------
    ModelError
        The law or the model of the controller has its numbers built in.
    """
    old, observer = work.adaptation, tuning.observer
    if observer is None or not observer.adapts:
        work.adaptation = None
    elif tuning.law not in _LAWS or tuning.model.inertia == "constant":
        what = f"law {tuning.law!r}" if tuning.law not in _LAWS else "model.inertia 'constant'"
        raise ModelError(
            f"tuning {tuning.name}: observer.adapts = {list(observer.adapts)} has no use with {what}, whose numbers "
            "are built in; leave it out, or take another",
            key="observer.adapts",
        )
    elif old is None or old.tuning != observer:
        work.adaptation = Adaptation(observer, scene.tip_noise, work.robot, resting)
    if old is not None and old is not work.adaptation:
        old.reset()
        old.write(work.foresight)
    if isinstance(work.track, Track):
        track = work.track.inner if isinstance(work.track, AdaptedTrack) else work.track
        work.track = track if work.adaptation is None else AdaptedTrack(track, work.adaptation, scene.period)
