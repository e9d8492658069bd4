"""A signal that comes round with each lap, as its harmonics: smooth, with exact derivatives, and few numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Lowest frequencies pass whole; from this share of the bandwidth on less and less does, and nothing beyond it.
_WHOLE = 0.6


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Harmonics of a lap, up to a bandwidth.

    Parameters
    ----------
    duration : float
        Of a lap [s].
    bandwidth : float
        [Hz].

    Attributes
    ----------
    passed : ndarray, shape (H + 1,)
        Share of each harmonic, from the mean on, that is learnt.
    """

    duration: float
    bandwidth: float

    @property
    def passed(self) -> np.ndarray:
        """See the class."""
        count = int(self.duration * self.bandwidth + 1e-9)
        place = np.arange(count + 1) / max(self.duration * self.bandwidth, 1e-12)
        fall = np.clip((place - _WHOLE) / (1.0 - _WHOLE), 0.0, 1.0)
        return np.asarray(np.cos(np.pi / 2.0 * fall) ** 2)

    def found(self, laps: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
        """Fit harmonics to samples.

        Parameters
        ----------
        laps : ndarray, shape (K,)
            Where they were taken [laps].
        values : ndarray, shape (K, 2)

        Returns
        -------
        coefficients : ndarray, shape (H + 1, 2), complex
        rest : float
            Mean square of what they leave, of both columns together.
        """
        basis = self._basis(laps)
        real = np.hstack([basis.real, -basis.imag[:, 1:]])
        fitted = np.linalg.lstsq(real, values, rcond=None)[0]
        count = basis.shape[1]
        coefficients = fitted[:count].astype(complex)
        coefficients[1:] += 1j * fitted[count:]
        left = values - real @ fitted
        return coefficients, float(np.sum(left**2)) / max(len(laps) - real.shape[1], 1)

    def at(self, coefficients: np.ndarray, laps: np.ndarray, rate: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Value, derivative and second derivative in time, shape (K, 3, 2).

        Parameters
        ----------
        coefficients : ndarray, shape (H + 1, 2), complex
        laps, rate, change : ndarray, shape (K,)
            Where, in laps, how fast [1/s], and how that changes [1/s^2].
        """
        turn = 2j * np.pi * np.arange(len(coefficients))
        first, second = turn * rate[:, None], (turn * rate[:, None]) ** 2 + turn * change[:, None]
        basis = self._basis(laps)
        return np.stack([(basis * each).dot(coefficients).real for each in (1.0, first, second)], axis=1)

    def _basis(self, laps: np.ndarray) -> np.ndarray:
        return np.asarray(np.exp(2j * np.pi * np.multiply.outer(laps, np.arange(len(self.passed)))))
