"""From a property that is lost somewhere to where it is lost."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable


def first_loss(holds: Callable[[float], bool], values: Iterable[float], tolerance: float) -> float:
    """Value up to which a property holds, along rising values; infinite if it holds for all, NaN if for none.

    ``tolerance`` is of the value, absolute.
    """
    last = math.nan
    for value in values:
        if holds(value):
            last = value
            continue
        if math.isnan(last):
            return math.nan
        while value - last > tolerance:
            middle = (last + value) / 2
            last, value = (middle, value) if holds(middle) else (last, middle)
        return last
    return math.inf
