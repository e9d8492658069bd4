"""A path at the pace of a nominal motion: P(x), x from 0 to 1, which rests at both ends."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline

from .path import TipPath, fitted


class PacedPath:
    """A given path: P(x) = p(s(x)).

    Parameters
    ----------
    path : TipPath
    nominal : BSpline
        Length from the start [m] by x; its first three derivatives vanish at both ends.
    """

    def __init__(self, path: TipPath, nominal: BSpline) -> None:
        self.path, self.nominal = path, nominal
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """P and its first four derivatives, shape (5, len(x), 2), which a plan asks for again and again at its x."""
        if self._last is None or self._last[0] is not x:
            self._last = x, self._derivatives(x)
        return self._last[1]

    def _derivatives(self, x: np.ndarray) -> np.ndarray:
        """By the chain rule (Faa di Bruno)."""
        s, s1, s2, s3, s4 = (self.nominal(x, nu=order)[:, None] for order in range(5))
        p, p1, p2, p3, p4 = self.path.derivatives(s[:, 0])
        return np.stack(
            [
                p,
                p1 * s1,
                p2 * s1**2 + p1 * s2,
                p3 * s1**3 + 3.0 * p2 * s1 * s2 + p1 * s3,
                p4 * s1**4 + 6.0 * p3 * s1**2 * s2 + p2 * (3.0 * s2**2 + 4.0 * s1 * s3) + p1 * s4,
            ]
        )

    def repaced(self, x: np.ndarray, share: np.ndarray, cells: int) -> PacedPath:
        """Return the same path at another pace.

        Parameters
        ----------
        x : ndarray, shape (K,)
            Of points on this one, from 0 to 1.
        share : ndarray, shape (K,)
            The x that they are to have; increasing from 0 to 1.
        cells : int
            Pieces of the new pace's spline.
        """
        nominal = fitted(share, self.nominal(x)[:, None], np.linspace(0.0, 1.0, cells + 1), 7, flat=4)
        return PacedPath(self.path, BSpline(nominal.t, nominal.c[:, 0], nominal.k))


def paced(path: TipPath) -> PacedPath:
    """Pace a path by the polynomial of degree 7 from rest to rest."""
    knots, coefficients = np.repeat([0.0, 1.0], 8), np.repeat([0.0, path.length], 4)
    return PacedPath(path, BSpline(knots, coefficients, 7))
