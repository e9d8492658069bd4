"""What the motors get of the commands of a log that come late: rates of a zero-order hold that is shifted in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .log import Log


@dataclass(frozen=True, eq=False)
class Commands:
    """Mean rates in steps of the model, and how they change.

    Attributes
    ----------
    rates : ndarray, shape (T, n)
        [rad/s].
    by_delay : ndarray, shape (T, n)
        Their derivative in the delay [rad/s per row].
    by_missing : ndarray, shape (T, B)
        And in each missing command of the log, the same for all motors.
    """

    rates: np.ndarray
    by_delay: np.ndarray
    by_missing: np.ndarray


def commands(log: Log, u: np.ndarray, delay: float, first: int, last: int, substeps: int) -> Commands:
    """Mean rates from row ``first`` to row ``last`` of a log.

    The angle that the commands add up to is linear between rows, so that the mean rate in a step is exact, whether a
    command changes within it or not.

    Parameters
    ----------
    log : Log
    u : ndarray, shape (M, n)
        Its commands, with values where they are missing [rad/s].
    delay : float
        In rows; what comes before the first row was as its command.
    substeps : int
        Steps of the model from row to row.
    """
    times = first + np.arange((last - first) * substeps + 1) / substeps - delay  # in rows
    angle = _angle(u, times)
    rates = substeps * np.diff(angle, axis=0)
    # Where a command changes just at the end of a step, the mean of both sides.
    by_delay = -substeps * np.diff((_rate(u, times - 1e-9) + _rate(u, times + 1e-9)) / 2.0, axis=0)
    missing = log.missing
    reached = np.clip(times[:, None] - missing, 0.0, 1.0)
    return Commands(rates, by_delay, substeps * np.diff(reached, axis=0))


def told_angles(log: Log, delay: float) -> np.ndarray:
    """What the commands add up to by each row, shape (M, n) [rad]; missing ones are taken for those before."""
    return log.step * _angle(filled(log), np.arange(len(log.t)) - delay)


def filled(log: Log) -> np.ndarray:
    """Commands of a log, shape (M, n); on straight lines where they are missing [rad/s]."""
    rows, u = np.arange(len(log.t)), log.u.copy()
    for column in u.T:
        known = ~np.isnan(column)
        column[~known] = np.interp(rows[~known], rows[known], column[known]) if known.any() else 0.0
    return u


def _angle(u: np.ndarray, times: np.ndarray) -> np.ndarray:
    knots = np.concatenate([np.zeros((1, u.shape[1])), np.cumsum(u, axis=0)])
    rows = np.arange(len(knots))
    before = np.minimum(times, 0.0)[:, None] * u[0]
    return np.asarray(np.stack([np.interp(times, rows, column) for column in knots.T], axis=1) + before)


def _rate(u: np.ndarray, times: np.ndarray) -> np.ndarray:
    return np.asarray(u[np.clip(np.floor(times).astype(int), 0, len(u) - 1)])
