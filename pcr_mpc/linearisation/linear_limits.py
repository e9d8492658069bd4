"""What a controller must keep besides its motors' limits, linear in the state: lower <= C x <= upper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..frozen import Frozen

KINDS = ("torque", "tip region", "rod margin", "stiffness", "strain")

Rows = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # C, lower, upper, scale of one kind


@dataclass(frozen=True, eq=False)
class LinearLimits(Frozen):
    """Limits on what a pose means, about one state, as far as they are near; each row is normalised.

    Attributes
    ----------
    kinds : tuple of str
        Of each row, one of `KINDS`.
    C : ndarray, shape (m, 4 + n)
    lower, upper : ndarray, shape (m,)
        Kept where lower <= C x <= upper; infinite for none.
    scale : ndarray, shape (m,)
        What one unit of a row is: [N m], [m], 1, [N/m] and 1 by kind.
    """

    kinds: tuple[str, ...]
    C: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    scale: np.ndarray
