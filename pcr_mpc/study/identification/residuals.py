"""Whether residuals are noise and nothing else."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

_LAGS = 20


@dataclass(frozen=True, eq=False)
class Whiteness:
    """Of residuals, by Ljung and Box.

    Attributes
    ----------
    autocorrelation : ndarray, shape (L,)
        At lags from 1 on, the mean of all channels.
    band : float
        95 % of those of white noise are within.
    p_value : float
        Probability that white noise looks at least as coloured.
    widening : float
        By which factor the variance of a mean is larger than that of as many independent readings.
    """

    autocorrelation: np.ndarray
    band: float
    p_value: float
    widening: float

    @property
    def white(self) -> bool:
        """Whether there is no strong reason to think otherwise."""
        return self.p_value >= 1e-3


def whiteness(channels: Sequence[np.ndarray]) -> Whiteness:
    """Test channels of residuals for whiteness; NaN is where there is none."""
    found, counts, statistic, degrees = [], [], 0.0, 0
    for values in channels:
        known = ~np.isnan(values)
        count = int(known.sum())
        if count < 2 * _LAGS:
            continue
        filled = np.where(known, values - np.nanmean(values), 0.0)
        power = float(filled @ filled)
        if not power:
            continue
        lags = np.array([filled[k:] @ filled[:-k] for k in range(1, _LAGS + 1)]) / power
        statistic += count * (count + 2) * float((lags**2 / (count - np.arange(1, _LAGS + 1))).sum())
        degrees += _LAGS
        found.append(lags)
        counts.append(count)
    if not found:
        return Whiteness(np.zeros(_LAGS), 1.0, 1.0, 1.0)
    mean = np.mean(found, axis=0)
    ends = np.flatnonzero(mean <= 0.0)
    positive = mean[: ends[0]] if len(ends) else mean
    return Whiteness(
        mean, 1.96 / math.sqrt(sum(counts)), float(chi2.sf(statistic, degrees)), 1.0 + 2.0 * float(positive.sum())
    )


def change_noise(channels: Sequence[np.ndarray]) -> float:
    """Standard deviation of readings by what changes from each to the next: what is slow does not count."""
    changes = np.concatenate([np.diff(values) for values in channels])
    changes = changes[~np.isnan(changes)]
    if not len(changes):
        return 0.0
    return float(np.sqrt(np.mean(changes**2) / 2.0))
