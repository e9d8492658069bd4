"""Points at which limits are kept, and a course whose points lie where the time is spent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import CubicSpline
from scipy.sparse.linalg import spsolve

from ....errors import PCRError
from .pace import constant_pace, duration, spline_of, times, unit_splines
from .timing import Timing, evaluated

PER_CELL = 3
FINE = 10 * PER_CELL  # points to a cell where the result is checked
_AT_ENDS = 8  # in the first and the last cell: there the tip hardly moves, and b is free to do much
_BY_TIME = 0.8  # of the new course goes by time, the rest as before
_SAMPLES = 4001
_NEAR_REST = 1e-3  # of the largest speed, below which nothing is learnt of the pace
_SMOOTHING = 1e-3
_SLOWEST = 0.05  # of the mean b
_SLOWER = (1.0, 1.5, 2.0, 4.0, 8.0)  # times as long


def points(cells: int, per_cell: int = PER_CELL) -> np.ndarray:
    """From 0 to 1, more of them at the ends."""
    ends = np.linspace(0.0, 1.0 / cells, max(_AT_ENDS, per_cell), endpoint=False)
    between = np.linspace(1.0 / cells, 1.0 - 1.0 / cells, per_cell * (cells - 2) + 1)
    return np.concatenate([ends, between, 1.0 - ends[::-1]])


def repaced(timing: Timing, cells: int, pieces: int) -> Timing:
    """Give a timing a course on which equal steps take about equal times, and more or fewer cells.

    Parameters
    ----------
    timing : Timing
    cells : int
        Of b.
    pieces : int
        Of the new course's pace; few, so that it is smooth: the rest is left to b.
    """
    old = timing.problem.course
    x = np.linspace(0.0, 1.0, _SAMPLES)
    when = times(timing.pace, x)
    place = old.nominal(x)
    share = _BY_TIME * when / when[-1] + (1.0 - _BY_TIME) * x
    course = old.repaced(x, share, pieces)
    fine = np.linspace(0.0, 1.0, 5 * _SAMPLES)
    there = course.nominal(fine)
    if (np.diff(there) <= 0.0).any():  # a pace that goes back is none
        course, there = old, old.nominal(fine)
    at = np.interp(place, there, fine)
    speed, nominal = old.nominal(x, nu=1) * np.sqrt(timing.pace(x)), course.nominal(at, nu=1)
    weights = nominal / nominal.max()
    known = weights > _NEAR_REST
    wanted = (speed[known] / nominal[known]) ** 2
    flat = constant_pace(cells, duration(timing.pace))
    basis = sparse.csr_array(unit_splines(flat)(at[known]))
    ties = sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(len(flat.c) - 1, len(flat.c)))
    # Least squares; what is not known, at the ends, is as its neighbours are.
    matrix: Any = basis.T @ sparse.diags_array(weights[known]) @ basis + _SMOOTHING * ties.T @ ties
    pace = spline_of(np.maximum(spsolve(matrix.tocsc(), basis.T @ (weights[known] * wanted)), _SLOWEST * flat.c))
    grid = points(cells)
    before = np.interp(course.nominal(grid), place, x)
    q = CubicSpline(timing.x, timing.turned.q.value)(before)
    problem = replace(timing.problem, course=course)
    # At the same pace, all but: where that is too fast for the rods, more slowly.
    for slower in _SLOWER[:-1]:
        try:
            return evaluated(problem, spline_of(slower**-2.0 * pace.c), grid, q, timing.near(before))
        except PCRError:
            continue
    return evaluated(problem, spline_of(_SLOWER[-1] ** -2.0 * pace.c), grid, q, timing.near(before))
