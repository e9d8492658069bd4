"""A path of the tip without its timing: a spline that can be differentiated four times."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.sparse.linalg import splu

from ....errors import ModelError, cause, checked_array
from ....frozen import Frozen
from ....loop.references.blended import Blended
from ....loop.references.tabulated import Tabulated
from ....loop.references.trajectory import Trajectory, sampled

_DEGREE = 7  # a motor's acceleration holds the fourth derivative, which is to have no kinks
_SAMPLES = 4001  # of the motion whose path is taken
_FEWEST, _MOST = 8, 512  # pieces of the spline, alike; where the path turns sharply there may be as many again
_POINTS_OF_TWO = 8
_FEW = 0.125  # of all pieces, or samples
_SPARE = 0.1  # of the tolerance, which a plain fit may use
_PENALTIES, _BISECTIONS = (1e-30, 1e-8), 14  # to one part in a hundred
_STILL = 1e-9  # of the path's length: a step between samples that is none
_SHARP, _CLOSER = 0.05, 3  # turn from step to step beyond which samples are taken closer [rad]; how often
_CORNER, _AT_REST = 0.02, 1e-2  # turn from step to step where the tip rests [rad]; share of its largest speed


@dataclass(frozen=True, eq=False)
class TipPath(Frozen):
    """Where the tip is to go, whenever.

    Attributes
    ----------
    spline : BSpline
        Position [m] by the length from the start [m]; of degree 7.
    length : float
        [m].
    deviation : float
        Greatest distance from what it was made of [m].
    """

    spline: BSpline
    length: float
    deviation: float

    def derivatives(self, s: np.ndarray) -> np.ndarray:
        """Position and its first four derivatives by s, shape (5, len(s), 2)."""
        s = np.clip(s, 0.0, self.length)
        return np.stack([self.spline(s, nu=order) for order in range(5)])


def paths_of(trajectory: Trajectory, duration: float, tolerance: float) -> list[TipPath]:
    """Take the path of a motion, and leave its timing and its rests; where it rests in a corner another path begins.

    Parameters
    ----------
    trajectory : Trajectory
    duration : float
        [s].
    tolerance : float
        Greatest distance between the motion's path and its spline [m].

    Raises
    ------
    ModelError
        The tip does not move, or it does not rest in a corner of its path.
    """
    points, speeds = _sampled(trajectory, duration)
    ends = [0, *_corners(points, speeds), len(points) - 1]
    rows = trajectory.path if isinstance(trajectory, Blended) else trajectory
    measured = isinstance(rows, Tabulated)  # what turns sharply in a file may be noise
    try:
        return [path_through(points[first : last + 1], tolerance, sharp=not measured) for first, last in pairwise(ends)]
    except ModelError as error:
        if not isinstance(rows, Tabulated) or "deviation" not in error.details:
            raise
        said = (
            f"{cause(error)}, and the rows of the reference scatter by about {1e3 * rows.scatter:.2g} mm; if that is "
            f"noise, say so in [reference]: smoothing = {rows.scatter:.2g}"
            if rows.scatter
            else f"{error}, or take more smoothing of the rows than {rows.smoothing:g} m"
        )
        raise ModelError(said, **error.details) from None


def _sampled(trajectory: Trajectory, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Points of a motion, closer together where its path turns sharply, and the speeds there."""
    t = np.linspace(0.0, duration, _SAMPLES)
    samples = sampled(trajectory, t)
    for _ in range(_CLOSER):
        moving, turns = _turns(samples[:, 0])
        sharp = np.unique(np.concatenate([moving[:-1][turns > _SHARP], moving[1:][turns > _SHARP]]))
        if not 0 < sharp.size < _FEW * len(t):
            break
        between = t[sharp, None] + (t[sharp + 1] - t[sharp])[:, None] * np.array([0.25, 0.5, 0.75])
        t = np.sort(np.concatenate([t, between.ravel()]))
        samples = sampled(trajectory, t)
    return samples[:, 0], np.linalg.norm(samples[:, 1], axis=1)


def _turns(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Steps from point to point that are any, shape (K,), and the angles from each to the next, (K - 1,) [rad]."""
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    moving = np.flatnonzero(lengths > _STILL * lengths.sum())
    along = steps[moving] / lengths[moving, None]
    return moving, np.arccos(np.clip((along[1:] * along[:-1]).sum(axis=1), -1.0, 1.0))


def _corners(points: np.ndarray, speeds: np.ndarray) -> list[int]:
    """Samples at which the tip rests in a corner, or next to its rest there."""
    moving, turns = _turns(points)
    corners: list[int] = []
    for before, after in zip(moving[:-1][turns > _CORNER], moving[1:][turns > _CORNER], strict=True):
        at = int(before + 1 + speeds[before + 1 : after + 1].argmin())
        if speeds[at] > _AT_REST * speeds.max():
            continue
        # The step that cuts a corner turns at both its ends.
        if corners and before <= corners[-1]:
            at = min(at, corners.pop(), key=lambda sample: speeds[sample])
        corners.append(at)
    return corners


def path_through(points: np.ndarray, tolerance: float, *, sharp: bool = False) -> TipPath:
    """Fit a path to points that lie close together; see `paths_of`.

    Parameters
    ----------
    points : array_like, shape (K, 2)
        [m].
    tolerance : float
        [m].
    sharp : bool
        Whether they may turn sharply in some places.
    """
    points = checked_array("points", points, (len(points), 2))
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if not steps.sum() > tolerance:
        raise ModelError(
            f"the path is {1e3 * steps.sum():.3g} mm long, and has nothing to plan; give one that moves the tip by "
            f"more than {1e3 * tolerance:.3g} mm",
            key="reference",
        )
    moving = np.concatenate([[True], steps > _STILL * steps.sum()])
    points = np.vstack([points[moving][:-1], points[-1]])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    spline, away = _smoothest(s, points, tolerance, sharp)
    at = int(away.argmax())
    if away[at] <= tolerance:
        return TipPath(spline, float(s[-1]), float(away[at]))
    raise ModelError(
        f"the path has a corner or is rough: its smooth spline is still {1e3 * away[at]:.3g} mm away at p = "
        f"{points[at]} m, {1e3 * s[at]:.4g} mm along, where {1e3 * tolerance:.3g} mm are allowed; round the corner, or "
        "allow more (--tolerance, tolerance)",
        key="reference",
        deviation=float(away[at]),
        s=float(s[at]),
    )


def _smoothest(s: np.ndarray, points: np.ndarray, tolerance: float, sharp: bool) -> tuple[BSpline, np.ndarray]:
    """Spline of least fourth derivative that stays within the tolerance of points, and its distances from them.

    A change of a motor's rate holds that derivative: what is left of the tolerance is used to make it small.
    """
    breaks, most = np.linspace(0.0, s[-1], _FEWEST + 1), min(_MOST, len(s) // 4)
    while True:
        fit = _Fit(s, points, breaks)
        spline, away = fit(0.0)
        pieces = len(breaks) - 1
        halves = np.ones(pieces, dtype=bool)
        if 2 * pieces <= most:
            if away.max() <= _SPARE * tolerance:
                break
        else:  # no more everywhere, but where it is needed
            halves = _poor(s, away, breaks, tolerance)
            if not sharp or not 0 < halves.sum() < _FEW * most:
                break
        breaks = np.sort(np.concatenate([breaks, (breaks[:-1] + breaks[1:])[halves] / 2]))
    low, high = _PENALTIES
    for _ in range(_BISECTIONS if away.max() <= tolerance else 0):
        middle = math.sqrt(low * high)
        smoother, further = fit(middle)
        if further.max() <= tolerance:
            low, spline, away = middle, smoother, further
        else:
            high = middle
    return spline, away


def _poor(s: np.ndarray, away: np.ndarray, breaks: np.ndarray, tolerance: float) -> np.ndarray:
    """Which pieces of a spline are too far from the points at s, or next to one that is, and have points for two."""
    pieces = len(breaks) - 1
    which = np.clip(np.searchsorted(breaks, s, side="right") - 1, 0, pieces - 1)
    poor = np.bincount(which[away > tolerance], minlength=pieces) > 0
    poor[1:] |= poor[:-1].copy()
    poor[:-1] |= poor[1:].copy()
    return np.asarray(poor & (np.bincount(which, minlength=pieces) >= _POINTS_OF_TWO))


class _Fit:
    """Least squares to points, with a penalty on differences of fourth order; the ends are kept.

    Parameters
    ----------
    s : ndarray, shape (K,)
    points : ndarray, shape (K, 2)
    breaks : ndarray
        Ends of the spline's pieces.
    """

    def __init__(self, s: np.ndarray, points: np.ndarray, breaks: np.ndarray) -> None:
        self._s, self._points = s, points
        self._knots = np.concatenate([[breaks[0]] * _DEGREE, breaks, [breaks[-1]] * _DEGREE])
        self._design = BSpline.design_matrix(s, self._knots, _DEGREE).tocsc()
        count = self._design.shape[1]
        self._inner = self._design[:, 1:-1]
        self._ends = np.stack([points[0], points[-1]])
        # Samples may crowd where the motion was slow: each counts for the length that it stands for.
        weighted = self._inner.T @ sparse.diags_array(np.gradient(s) / s[-1])
        rest = points - self._design[:, [0, count - 1]] @ self._ends
        self._gram, self._right = weighted @ self._inner, weighted @ rest

    @cached_property
    def _roughness(self) -> tuple[Any, np.ndarray]:
        """Gram matrix of fourth derivatives, at more points than the spline has freedom, and its right-hand side."""
        count, length = self._design.shape[1], self._s[-1]
        units, breaks = BSpline(self._knots, np.eye(count), _DEGREE), self._knots[_DEGREE:-_DEGREE]
        pieces = np.diff(breaks)
        at = np.concatenate([breaks[:-1] + share * pieces for share in (0.25, 0.75)])
        weights = np.sqrt(np.tile(pieces, 2) / (2.0 * length))
        bend = sparse.csc_array(units(at, nu=4) * length**4 * weights[:, None])
        inner = bend[:, 1:-1]
        return inner.T @ inner, -(inner.T @ (bend[:, [0, count - 1]] @ self._ends))

    def __call__(self, penalty: float) -> tuple[BSpline, np.ndarray]:
        """Spline, and its distances from the points [m]."""
        matrix, right = self._gram, self._right
        if penalty > 0.0:
            gram, towards = self._roughness
            matrix, right = matrix + penalty * gram, right + penalty * towards
        solved = splu(matrix.tocsc()).solve(np.ascontiguousarray(right))
        coefficients = np.concatenate([self._ends[:1], solved, self._ends[1:]])
        return BSpline(self._knots, coefficients, _DEGREE), np.linalg.norm(
            self._design @ coefficients - self._points, axis=1
        )


def fitted(x: np.ndarray, y: np.ndarray, breaks: np.ndarray, degree: int, flat: int = 1) -> BSpline:
    """Least-squares spline through the first and the last point, with ``flat`` coefficients alike at each end.

    Parameters
    ----------
    x : ndarray, shape (K,)
    y : ndarray, shape (K, d)
    breaks : ndarray
        Ends of its pieces.
    degree, flat : int
        With flat = 4 three derivatives vanish at both ends.
    """
    knots = np.concatenate([[breaks[0]] * degree, breaks, [breaks[-1]] * degree])
    design = BSpline.design_matrix(x, knots, degree).tocsc()
    count = design.shape[1]
    held = np.concatenate([np.repeat(y[:1], flat, axis=0), np.repeat(y[-1:], flat, axis=0)])
    ends = [*range(flat), *range(count - flat, count)]
    inner = design[:, flat : count - flat]
    rest = y - design[:, ends] @ held
    solved = splu((inner.T @ inner).tocsc()).solve(np.asarray(inner.T @ rest))
    return BSpline(knots, np.concatenate([held[:flat], solved, held[flat:]]), degree)
