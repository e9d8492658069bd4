"""What a controller must keep besides its motors' limits, linear in the state: C x + d <= 0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..frozen import freeze

KINDS = ("torque", "tip region", "rod margin", "stiffness")


@dataclass(frozen=True, eq=False)
class LinearLimits:
    """Limits on what a pose means, about one state; each row is normalised.

    Attributes
    ----------
    kinds : tuple of str
        Of each row, one of `KINDS`; the same for every pose.
    C : ndarray, shape (m, 4 + n)
    d : ndarray, shape (m,)
        Kept where C x + d <= 0; a row that is of no concern here has C = 0, d = -1.
    scale : ndarray, shape (m,)
        What one unit of a row is: [N m], [m], 1 and [N/m] by kind.
    """

    kinds: tuple[str, ...]
    C: np.ndarray
    d: np.ndarray
    scale: np.ndarray

    def __post_init__(self) -> None:
        freeze(self)
