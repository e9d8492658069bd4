"""What the rows of a table say of their own accuracy."""

from __future__ import annotations

import numpy as np

_WINDOW = 5
_DENSE, _FINE = 50, 3e-2  # rows; resolution over the path's extent
_WITHIN, _MOST = 1.2, 0.9  # units of resolution that rounding explains, for so many of the rows
# Noise changes its sign from row to row: the correlation of neighbours is -0.8; and it is more than a trace.
_ALTERNATING, _TRACE, _CLIPPED = -0.4, 1e-6, 3.0
_SIGMA = 1.4826  # standard deviation over median of the absolute value, of noise


def rounding(times: np.ndarray, points: np.ndarray, resolution: float) -> float:
    """Standard deviation of what rounding has done to the positions [m]; zero where it hardly shows.

    It shows where there are many rows, the digits are fine in comparison with the path, and but for few rows the
    positions are cubic from row to row within their last digit.

    Parameters
    ----------
    times : ndarray, shape (K,)
        [s].
    points : ndarray, shape (K, 2)
        [m].
    resolution : float
        Of the last digit that is given [m].
    """
    extent = float(np.ptp(points, axis=0).max())
    if len(times) < _DENSE or resolution > _FINE * extent:
        return 0.0
    explained = np.abs(_departures(times, points)) <= _WITHIN * resolution
    return resolution / np.sqrt(12) if explained.mean() >= _MOST else 0.0


def scatter(times: np.ndarray, points: np.ndarray) -> float:
    """Standard deviation of a coordinate's noise from row to row [m]; zero where there is none to be seen.

    Parameters
    ----------
    times : ndarray, shape (K,)
        [s].
    points : ndarray, shape (K, 2)
        [m].
    """
    if len(times) < _DENSE:
        return 0.0
    departures = _departures(times, points)
    size = _SIGMA * float(np.median(np.abs(departures)))
    if size <= _TRACE * float(np.ptp(points, axis=0).max()):
        return 0.0
    clipped = np.clip(departures, -_CLIPPED * size, _CLIPPED * size)
    correlation = float((clipped[1:] * clipped[:-1]).sum() / (clipped**2).sum())
    return size if correlation < _ALTERNATING else 0.0


def _departures(times: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Fourth divided differences, each in units in which noise of one metre gives one: zero on cubics, (K - 4, 2)."""
    windows = np.lib.stride_tricks.sliding_window_view(times, _WINDOW)
    gaps = windows[:, :, None] - windows[:, None, :] + np.eye(_WINDOW)
    weights = 1.0 / gaps.prod(axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    return np.asarray(
        np.einsum("kj,kcj->kc", weights, np.lib.stride_tricks.sliding_window_view(points, _WINDOW, axis=0))
    )
