"""Whether a trajectory is smooth, and its velocity and acceleration are what they are said to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .blended import duration_of
from .reading import built_in
from .trajectory import Trajectory, sampled

# Jumps by less than this, relative to the largest speed or acceleration, are none: of that kind a smooth one is left
# with after so many halvings of an interval.
_LEAST = 1e-3
_HALVINGS = 24
_MOMENT = 1e-9  # s, to either side of an end
# By how much Simpson's rule on velocities may miss the way from sample to sample, relative to the largest way.
_MISSED = 0.02
_OFTEN = 0.1  # share of the ways that may be missed so: jumps do that, and are found elsewhere


@dataclass(frozen=True)
class Jump:
    """A jump of velocity or acceleration.

    Attributes
    ----------
    of : {"velocity", "acceleration"}
    t : float
        [s].
    change : tuple of float
        [m/s] or [m/s^2].
    count : int
        How many there are of the kind; this is the largest.
    """

    of: str
    t: float
    change: tuple[float, float]
    count: int

    @property
    def size(self) -> float:
        """[m/s] or [m/s^2]."""
        return float(np.hypot(*self.change))


def jumps(trajectory: Trajectory, t: np.ndarray, start_velocity: tuple[float, float]) -> list[Jump]:
    """Jumps of velocity and of acceleration, the start from rest or from ``start_velocity`` [m/s] among them.

    Parameters
    ----------
    trajectory : Trajectory
    t : ndarray
        Times between which they are looked for; of the toolkit's own trajectories only the ends can jump [s].
    start_velocity : (float, float)
    """
    samples = sampled(trajectory, t)
    scale = np.linalg.norm(samples, axis=2).max(axis=0)
    before = np.array([samples[0, 0], start_velocity, np.zeros(2)])
    end = duration_of(trajectory)
    found = []
    for order, name in ((1, "velocity"), (2, "acceleration")):
        moments = [np.zeros(1)]
        changes = [(samples[0, order] - before[order])[None]]
        if not built_in(trajectory):
            places, steps = _steps(trajectory, t, samples[:, order], order, _LEAST * scale[order])
            moments.append(places)
            changes.append(steps)
        elif end <= t[-1]:
            last = sampled(trajectory, np.array([end - _MOMENT, end + _MOMENT]))[:, order]
            moments.append(np.array([end]))
            changes.append(np.diff(last, axis=0))
        at, change = np.concatenate(moments), np.concatenate(changes)
        sizes = np.hypot(*change.T)
        if sizes.max() > _LEAST * scale[order]:
            i = int(sizes.argmax())
            x, y = change[i].tolist()
            found.append(Jump(name, float(at[i]), (x, y), int((sizes > _LEAST * scale[order]).sum())))
    return found


def _steps(
    trajectory: Trajectory, t: np.ndarray, values: np.ndarray, order: int, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """Where within the intervals of t something steps by more than ``least``, and by how much (K, 2).

    An interval is halved again and again, and the half with the larger step kept: what is smooth gets less.
    """
    low, high, first, last = t[:-1], t[1:], values[:-1], values[1:]
    for _ in range(_HALVINGS):
        keep = np.hypot(*(last - first).T) > least
        low, high, first, last = low[keep], high[keep], first[keep], last[keep]
        if not len(low):
            break
        middle = (low + high) / 2
        value = sampled(trajectory, middle)[:, order]
        early = np.hypot(*(value - first).T) > np.hypot(*(last - value).T)
        low, high = np.where(early, low, middle), np.where(early, middle, high)
        first, last = np.where(early[:, None], first, value), np.where(early[:, None], value, last)
    keep = np.hypot(*(last - first).T) > least
    return high[keep], (last - first)[keep]


def contradictions(trajectory: Trajectory, t: np.ndarray) -> list[str]:
    """Where velocities do not lead from position to position, or accelerations from velocity to velocity.

    Parameters
    ----------
    trajectory : Trajectory
    t : ndarray
        Times from one to the next of which the way is compared [s].
    """
    if built_in(trajectory):
        return []
    ends, middles = sampled(trajectory, t), sampled(trajectory, (t[:-1] + t[1:]) / 2)
    said = []
    for order, name, of, unit in ((0, "velocity", "position", "m/s"), (1, "acceleration", "velocity", "m/s^2")):
        h = np.diff(t)[:, None]
        went = np.diff(ends[:, order], axis=0) / h
        mean = (ends[:-1, order + 1] + 4 * middles[:, order + 1] + ends[1:, order + 1]) / 6
        off = np.hypot(*(went - mean).T)
        scale = max(np.hypot(*went.T).max(), np.hypot(*mean.T).max())
        if (off > _MISSED * scale).mean() > _OFTEN:
            k = int(off.argmax())
            said.append(
                f"the reference's {name} is not the derivative of its {of}: about t = {t[k]:.3f} s it is "
                f"({mean[k][0]:.4g}, {mean[k][1]:.4g}) {unit}, and its {of} changes at ({went[k][0]:.4g}, "
                f"{went[k][1]:.4g}) {unit}; the controller believes the {name}"
            )
    return said
