"""Arrays that cannot be changed behind the back of those who share them."""

from __future__ import annotations

from typing import Any

import numpy as np


def freeze(instance: Any) -> None:
    """Make the arrays of a frozen dataclass read-only; call from ``__post_init__``."""
    for value in instance.__dict__.values():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False


def read_only(array: np.ndarray) -> np.ndarray:
    """Return the array, made read-only."""
    array.flags.writeable = False
    return array
