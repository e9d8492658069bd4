"""A course whose path between way-points is free too."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline

from ...errors import ModelError
from ...loop.references.blended import Blended
from ...loop.references.trajectory import PickAndPlace, Trajectory
from .course import Course
from .pace import local_basis
from .path import fitted

_DEGREE, _FLAT = 7, 4  # at each end so many coefficients are alike: three derivatives vanish there
_SAMPLES = 4001
_MOST_POINTS = 100  # more are samples of a path, and no way-points


class FreeCourse:
    """P(x) is a spline, of which each coefficient may move across the path; the way-points stay.

    Along the path they do not move: that would be another pace, which b is already.

    Parameters
    ----------
    spline : BSpline
        P on equal pieces, with its first and its last four coefficients alike.
    fixed : ndarray
        The x of the way-points between the ends.
    unit : float
        Of the unknowns, by which coefficients move [m].
    """

    def __init__(self, spline: BSpline, fixed: np.ndarray, unit: float) -> None:
        self.spline, self.fixed, self.unit = spline, fixed, unit
        inner = np.arange(_FLAT, len(spline.c) - _FLAT)
        middles = np.array([spline.t[k + 1 : k + 1 + _DEGREE].mean() for k in inner])
        tangents = spline(middles, nu=1)
        tangents = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
        self._across = np.zeros((len(spline.c), 2))
        self._across[inner] = unit * np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)

    @property
    def unknowns(self) -> int:
        """See `Course`."""
        return len(self.spline.c) - 2 * _FLAT

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """See `Course`."""
        return np.stack([self.spline(x, nu=order) for order in range(5)])

    def basis(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Course`."""
        columns, values = local_basis(self.spline, x, 5)
        both = np.concatenate([values * self._across[columns, axis] for axis in (0, 1)])
        # Those at the ends do not move: their values are zero, whatever their number.
        return np.clip(columns - _FLAT, 0, self.unknowns - 1), both

    def held(self) -> Any | None:
        """See `Course`."""
        if not len(self.fixed):
            return None
        columns, both = self.basis(self.fixed)
        rows = np.repeat(np.arange(len(self.fixed)), columns.shape[1])
        shape = (len(self.fixed), self.unknowns)
        parts = [sparse.coo_array((both[5 * axis].ravel(), (rows, columns.ravel())), shape) for axis in (0, 1)]
        return sparse.vstack(parts).tocsr()

    def moved(self, change: np.ndarray) -> FreeCourse:
        """See `Course`."""
        coefficients = self.spline.c.copy()
        coefficients[_FLAT:-_FLAT] += change[:, None] * self._across[_FLAT:-_FLAT]
        return FreeCourse(BSpline(self.spline.t, coefficients, _DEGREE), self.fixed, self.unit)


def freed(course: Course, points: np.ndarray, pieces: int, unit: float) -> FreeCourse:
    """Let go of a course between way-points.

    Parameters
    ----------
    course : Course
    points : ndarray, shape (W, 2)
        In their order [m]; the ends of the course are kept anyway.
    pieces : int
        Of the spline.
    unit : float
        See `FreeCourse`.
    """
    x = np.linspace(0.0, 1.0, _SAMPLES)
    p = course(x)[0]
    spline = fitted(x, p, np.linspace(0.0, 1.0, pieces + 1), _DEGREE, flat=_FLAT)
    fixed: list[float] = []
    first = 0
    for point in points[1:-1]:
        # The nearest place that comes after the one before: a path may cross itself.
        away = np.linalg.norm(p[first:] - point, axis=1)
        first += _first_valley(away)
        fixed.append(float(x[first]))
    return FreeCourse(spline, np.array(fixed), unit)


def _first_valley(away: np.ndarray) -> int:
    """Index of the first local minimum that is hardly higher than the least of all."""
    low = np.flatnonzero(away < away.min() + 0.02 * np.ptp(away))
    last = low[0] + int(np.argmax(np.append(np.diff(low), 2) > 1)) if len(low) else 0
    return int(low[0] + away[low[0] : last + 1].argmin())


def way_points(trajectory: Trajectory) -> np.ndarray:
    """Way-points of a reference, shape (W, 2) [m].

    Raises
    ------
    ModelError
        It has none.
    """
    while isinstance(trajectory, Blended):
        trajectory = trajectory.path
    if isinstance(trajectory, PickAndPlace):
        return np.array([trajectory.pick, trajectory.place])
    points, closed = getattr(trajectory, "points", None), getattr(trajectory, "closed", False)
    if points is None or closed or len(points) > _MOST_POINTS:
        kind = f"{'closed ' if closed else ''}{type(trajectory).__name__}"
        raise ModelError(
            f"a {kind} has no way-points between which its path could be free; give a spline or waypoints that are "
            f"open (closed = false), at most {_MOST_POINTS}, or plan its timing alone",
            key="reference",
        )
    return np.array(points)
