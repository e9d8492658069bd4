"""b = theta^2 as a spline, theta = dx/dt: how fast a course is gone along."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline, CubicHermiteSpline

_DEGREE = 4  # the motors' acceleration, with b''' in it, is continuous
_POINTS = 6  # of Gauss, for times
_LEGENDRE = np.polynomial.legendre.leggauss(_POINTS)
_NEWTON = 4


def spline_of(coefficients: np.ndarray) -> BSpline:
    """Spline on as many equal cells as its coefficients are for."""
    cells = len(coefficients) - _DEGREE
    breaks = np.linspace(0.0, 1.0, cells + 1)
    return BSpline(np.concatenate([np.zeros(_DEGREE), breaks, np.ones(_DEGREE)]), coefficients, _DEGREE)


def constant_pace(cells: int, seconds: float) -> BSpline:
    """Go along the course as its nominal motion does, in so many seconds."""
    return spline_of(np.full(cells + _DEGREE, seconds**-2.0))


def cells_of(pace: BSpline) -> int:
    """Number of cells."""
    return len(pace.c) - _DEGREE


def unit_splines(pace: BSpline) -> BSpline:
    """All its basis functions."""
    return BSpline(pace.t, np.eye(len(pace.c)), pace.k)


def local_basis(spline: BSpline, x: np.ndarray, orders: int) -> tuple[np.ndarray, np.ndarray]:
    """Basis functions that are not zero at the points x, of a spline on equal pieces from 0 to 1.

    Returns
    -------
    columns : ndarray of int, shape (len(x), degree + 1)
        Their numbers.
    values : ndarray, shape (orders, len(x), degree + 1)
        Their derivatives, from the function itself on.
    """
    pieces = len(spline.c) - spline.k
    first = np.clip((x * pieces).astype(int), 0, pieces - 1)
    columns = first[:, None] + np.arange(spline.k + 1)
    unit = unit_splines(spline)
    return columns, np.stack([np.take_along_axis(unit(x, nu=order), columns, axis=1) for order in range(orders)])


def quadrature(pace: BSpline) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points and weights, _POINTS to a cell."""
    return _gauss(np.linspace(0.0, 1.0, cells_of(pace) + 1))


def duration(pace: BSpline) -> float:
    """int dx / theta [s]."""
    x, weights = quadrature(pace)
    return float(weights @ pace(x) ** -0.5)


def times(pace: BSpline, x: np.ndarray) -> np.ndarray:
    """When the points x, increasing from 0, are passed [s]."""
    nodes, weights = _gauss(x)
    steps = (weights * pace(nodes) ** -0.5).reshape(len(x) - 1, _POINTS).sum(axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def places(pace: BSpline, t: np.ndarray) -> np.ndarray:
    """Which x are passed at the times t [s], from 0 to the duration."""
    known = np.linspace(0.0, 1.0, 10 * cells_of(pace) + 1)
    when = times(pace, known)
    t = np.clip(t, 0.0, when[-1])
    at = np.clip(np.searchsorted(when, t, side="right") - 1, 0, len(known) - 2)
    x = CubicHermiteSpline(when, known, np.sqrt(pace(known)))(t)
    node, weight = _LEGENDRE
    for _ in range(_NEWTON):
        half = (x - known[at]) / 2
        passed = when[at] + half * (pace((known[at] + half)[:, None] + half[:, None] * node) ** -0.5 @ weight)
        x = np.clip(x - (passed - t) * np.sqrt(pace(x)), known[at], known[at + 1])
    return np.asarray(x)


def _gauss(breaks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    nodes, weights = _LEGENDRE
    half = np.diff(breaks)[:, None] / 2
    return (breaks[:-1, None] + half + half * nodes).ravel(), (half * weights).ravel()
