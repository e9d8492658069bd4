"""Iterative learning: what a lap of the reference was off by is taken off the next one's feed-forward.

The tip follows its reference but for what the controller does not know, and that comes round with the lap. So the
reference is moved against the error: by d(j+1) = Q (d(j) - gain e(j)), with Q the harmonics of a lap up to a bandwidth.
It is zero-phase, for the whole lap is known. Where the tip is moved by d, exact linear models say what else changes:
the rods carry dF = -M d'' - c d', and the motors turn by the least dq with K d + G dq = dF.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from ...control.tuning import LearningTuning, Tuning
from ...errors import ModelError
from ...plant.motion.plant import Plant
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ..demand.feed_forward import InverseDynamics
from ..demand.track import Track
from ..parts.assembled import make_model
from ..references.trajectory import smooth_step
from ..scene.scene import Scene
from .harmonics import Harmonics
from .laps import Laps, laps_of

# A harmonic of the error counts as far as it stands out of noise: its power less this many times that of noise.
_CLEAR = 4.0
# A lap that is worse than the best by this factor, noise aside, is gone back on, and the next change is smaller.
_WORSE, _SMALLER = 1.05, 0.5
# Power of error beyond the first lap's, over that of all of that, at which a lap is gone back on before it ends; and
# beyond so many standard deviations of noise.
_TOO_MUCH, _DEVIATIONS = 0.08, 3.0
_FADE = 0.15  # s, at most, and at most this part of a lap:
_FADE_SHARE = 0.1
_MOST_OF_RATE = 0.1  # of the control rate, as bandwidth
# Share of a lap's measurements that is enough to learn from it; or the longest time between two, over that of the
# fastest turn that is learnt.
_SEEN, _OFTEN = 0.8, 0.25


@dataclass(eq=False)
class _Best:
    """The best lap so far, what was added to it, and its error."""

    power: float = math.inf
    added: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), complex))
    off: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), complex))
    rest: float = 0.0


class Learner:
    """Adds what was learnt to the rows of a reference.

    Parameters
    ----------
    tuning : LearningTuning
    laps : Laps
    reference : InverseDynamics
        Not changed by learning.
    plant : Plant
        Of the robot as it is believed, for the linear models along the reference.
    pose : Equilibrium
        At the start of the reference.
    period : float
        [s].
    lead : int
        Periods from a decision until it shows in the tip: what comes earlier cannot be changed any more.
    noise : float
        Standard deviation of a measured coordinate [m].
    carried : ndarray, shape (K,)
        Payload that is known [kg].

    Attributes
    ----------
    rows : ndarray, shape (K - 1, 6 + 2n)
        To be added to the reference's, as `Track` has them.
    powers : list of float
        Mean square of the measured error in each lap that is done [m^2].
    """

    def __init__(
        self,
        tuning: LearningTuning,
        laps: Laps,
        reference: InverseDynamics,
        plant: Plant,
        pose: Equilibrium,
        period: float,
        lead: int,
        noise: float,
        carried: np.ndarray,
    ) -> None:
        self.tuning, self.reference, self.lead, self._period = tuning, reference, lead, period
        self._harmonics = Harmonics(laps.duration, tuning.bandwidth)
        self._edges, self._noise = laps.edges(period), 2.0 * noise**2
        count = len(reference.states)
        self._clock = laps.clock(period * np.arange(count))
        self._drag, self._n = plant.robot.drag, plant.robot.n_rods
        self._stiffness, self._mass = np.empty((2, count, 2, 2))
        plant.reset(np.concatenate([pose.p, np.zeros(2), pose.q]), pose)
        for k, x in enumerate(reference.states):
            self._stiffness[k] = plant.force_and_jacobians(x[:2], x[4:])[1]
            self._mass[k] = plant.mass(x[:2], x[4:])[0][:2, :2] + carried[k] * np.eye(2)
        self._fade = max(1, round(min(_FADE, _FADE_SHARE * laps.duration) / period))
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        count, harmonics = len(self.reference.states), len(self._harmonics.passed)
        self.rows = np.zeros((count - 1, 6 + 2 * self._n))
        self.powers: list[float] = []
        self._added = np.zeros((count, 3, 2))  # to position, velocity and acceleration
        self._off = np.full((count, 2), np.nan)
        self._best = _Best(added=np.zeros((harmonics, 2), complex))
        self._share, self._spoilt = 1.0, False
        self._first: np.ndarray = np.empty(0)  # power of the error, summed up over the first lap that was all seen

    def see(self, k: int, p: ArrayLike | None) -> None:
        """Take in the measured tip of period k, shape (2,) [m]; None: it was not believed.

        At the end of a lap it is learnt from; what is known of the next periods is in ``rows`` then.
        """
        edges = self._edges
        lap = int(np.searchsorted(edges, k, side="right")) - 1
        if lap < 0 or lap > len(edges) - 1:
            return
        if k == edges[lap] and lap:
            self._learn(lap - 1)
        if lap == len(edges) - 1:
            return
        if p is not None:
            self._off[k] = np.asarray(p) - self.reference.states[k, :2]
        if len(self._first) and not self._spoilt and k > edges[lap]:
            self._look_out(k, int(edges[lap]))

    def _look_out(self, k: int, begin: int) -> None:
        """Go back to the best lap within one that gets much worse than the first."""
        power = float(np.nansum(self._off[begin : k + 1] ** 2))
        done = min(k - begin, len(self._first) - 1)
        noise = self._noise * math.sqrt(2.0 * (done + 1))
        whole = max(self._first[-1] - self._noise * len(self._first), 0.0)
        if power > self._first[done] + _TOO_MUCH * whole + _DEVIATIONS * noise:
            self._spoilt = True
            self._share *= _SMALLER
            self._change(k, self._best.added)

    def _learn(self, lap: int) -> None:
        """Learn from a lap that is done."""
        begin, end = self._edges[lap : lap + 2].tolist()
        off, seen = self._off[begin:end], ~np.isnan(self._off[begin:end, 0])
        spoilt, self._spoilt = self._spoilt, False
        self.powers.append(float(np.mean(np.sum(off[seen] ** 2, axis=1))) if seen.any() else math.nan)
        if not self._enough(seen):
            return
        if not len(self._first):
            self._first = np.cumsum(np.nansum(off**2, axis=1))
        power, best = self.powers[-1] - self._noise, self._best
        # The mean power of noise is known to no better than this.
        slack = _DEVIATIONS * self._noise * math.sqrt(2.0 / int(seen.sum()))
        if not spoilt and power <= _WORSE**2 * max(best.power, 0.0) + slack:
            places = self._clock[0][begin:end][seen]
            added, _ = self._harmonics.found(places, self._added[begin:end, 0][seen])
            self._best = best = _Best(min(power, best.power), added, *self._harmonics.found(places, off[seen]))
        elif not spoilt:
            self._share *= _SMALLER
        pairs = np.sum(np.abs(best.off) ** 2, axis=1)
        noise = _CLEAR * 2.0 * best.rest / int(seen.sum())
        clear = np.clip(1.0 - noise / np.maximum(pairs, 1e-300), 0.0, 1.0) * self._harmonics.passed
        step = self.tuning.gain * self._share * clear[:, None] * best.off
        if step.any() or spoilt:
            self._change(end, best.added - step)

    def _enough(self, seen: np.ndarray) -> bool:
        """Whether a lap was seen well enough: nearly always, or often enough for what is learnt."""
        at = np.flatnonzero(np.concatenate([[True], seen, [True]]))
        return bool(seen.mean() >= _SEEN or np.diff(at).max() * self._period * self.tuning.bandwidth <= _OFTEN)

    def _change(self, k: int, coefficients: np.ndarray) -> None:
        """Go over to other harmonics, from the first period on that a decision in period k can change."""
        first = k + self.lead
        if first >= len(self._added) - 1:
            return
        later = slice(first, None)
        new = self._harmonics.at(coefficients, *(each[later] for each in self._clock))
        old = self._added[later]
        time = self._fade * self._period
        s, slope, bend = smooth_step(np.arange(len(new)) / self._fade)
        apart = new - old
        s, slope, bend = s[:, None], slope[:, None] / time, bend[:, None] / time**2
        self._added[later] = np.stack(
            [
                old[:, 0] + s * apart[:, 0],
                old[:, 1] + s * apart[:, 1] + slope * apart[:, 0],
                old[:, 2] + s * apart[:, 2] + 2.0 * slope * apart[:, 1] + bend * apart[:, 0],
            ],
            axis=1,
        )
        self._write(first)

    def _write(self, first: int) -> None:
        """Write what is added from a period on as rows of states, rates and forces."""
        d, rate, change = np.moveaxis(self._added[first:], 1, 0)
        force = -np.einsum("kij,kj->ki", self._mass[first:], change) - self._drag * rate
        short = force - np.einsum("kij,kj->ki", self._stiffness[first:], d)
        angles = np.einsum("kij,kj->ki", self.reference.angles_per_force[first:], short)
        states = np.hstack([d, rate, angles])
        self.rows[first:] = np.hstack([states[1:], np.diff(angles, axis=0) / self._period, force[1:]])
        # The rate that leads to the first angles that differ.
        n = self._n
        if first:
            before = self.rows[first - 2, 4 : 4 + n] if first > 1 else np.zeros(n)
            self.rows[first - 1, 4 + n : 4 + 2 * n] = (angles[0] - before) / self._period
            self.rows[first - 1, : 4 + n], self.rows[first - 1, 4 + 2 * n :] = states[0], force[0]


class LearntTrack(Track):
    """Windows of a reference with what was learnt.

    Parameters
    ----------
    track : Track
        Of the reference alone.
    learner : Learner
    """

    def __init__(self, track: Track, learner: Learner) -> None:
        self.__dict__.update(track.__dict__)
        self.learner = learner

    def window(self, k: int, delay: int) -> np.ndarray:
        """See `Track`; the end that is held is as it was."""
        plain = super().window(k, delay)
        first = k + delay
        return plain if k >= self._last else plain + self.learner.rows[first : first + self._horizon]


class Believed(Protocol):
    """What a controller believes: the robot, its pose at the start, and the periods that are predicted over."""

    robot: Robot
    pose: Equilibrium
    delay: int


def learning_on(
    track: Track, scene: Scene, tuning: Tuning, believed: Believed, reference: InverseDynamics, old: Learner | None
) -> tuple[Track, Learner | None]:
    """A reference with what learns from its laps, if a tuning wants that.

    Parameters
    ----------
    track : Track
        Of the reference alone.
    scene : Scene
    tuning : Tuning
    believed : Believed
    reference : InverseDynamics
        Of the scene for the robot as it is believed to be.
    old : Learner or None
        Of the controller until now; goes on if it fits.

    Raises
    ------
    ModelError
        The reference does not come round, or more is to be learnt than a control period can tell.
    """
    if tuning.learning is None:
        return track, None
    if old is not None and old.tuning == tuning.learning and old.reference is reference:
        old.lead = believed.delay + 1
        return LearntTrack(track, old), old
    laps = laps_of(scene.trajectory, scene.duration)
    if laps is None:
        raise ModelError(
            f"tuning {tuning.name} learns from lap to lap, but the reference of scene {scene.name} does not come "
            "round; give [reference] repeat = K, or leave out [learning]",
            key="learning",
        )
    if tuning.learning.bandwidth * scene.period > _MOST_OF_RATE:
        raise ModelError(
            f"learning.bandwidth is {tuning.learning.bandwidth:g} Hz, expected at most {_MOST_OF_RATE:g} of the "
            f"control rate, {_MOST_OF_RATE / scene.period:g} Hz",
            key="learning.bandwidth",
        )
    carried = scene.carried(scene.period * np.arange(len(reference.states)))
    model, lead = make_model(believed.robot, tuning.model), believed.delay + 1
    new = Learner(tuning.learning, laps, reference, model, believed.pose, scene.period, lead, scene.tip_noise, carried)
    return LearntTrack(track, new), new
