"""Limits that are kept between the points too: a look at what lies there, and more points where it is too much."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ....errors import ConvergenceError
from .fastest import faster
from .meshing import FINE, points
from .pace import cells_of, times
from .timing import EXACT, NEAR, Timing

ALLOWED = 1.0 - 5e-4  # share of the limits that is used, so that they are kept between the points too
_EXCESS = 1e-4  # over 1, on the fine grid, at which no more points are added
_LARGEST_EXCESS = 1e-3
_ROUNDS, _ITERATIONS, _GAIN = 14, 6, 1e-3  # of the duration
_APART = 1e-6  # nearer points are the same


class Checked(NamedTuple):
    """Shares of limits, shape (limits, K), at the points x."""

    x: np.ndarray
    shares: np.ndarray

    @property
    def worst(self) -> float:
        """Largest share of any limit."""
        return float(self.shares.max())


def refined(timing: Timing, told: Callable[[float], None] | None = None) -> tuple[Timing, Timing]:
    """Add points where limits are exceeded between the points, until they are kept on a grid ten times as fine.

    Returns
    -------
    timing, fine : Timing
        At the points where limits were kept, and on the fine grid.

    Raises
    ------
    ConvergenceError
        They are not kept to a thousandth.
    """
    per_cell, tolerance = FINE // 3, NEAR  # a coarser grid finds most
    for _ in range(_ROUNDS):
        between = points(cells_of(timing.pace), per_cell)
        fine, checked = checked_at(timing, between, tolerance, suspect=1.0 + _EXCESS)
        if checked.worst <= 1.0 + _EXCESS:
            if tolerance == EXACT:
                return timing, fine
            per_cell, tolerance = FINE, EXACT if per_cell == FINE else NEAR
            continue
        x = with_points(timing.x, checked, ALLOWED)
        more = faster(timing.at(x), most=_ITERATIONS, trust=0.1, allowed=ALLOWED, tolerance=_GAIN, told=told)
        if more.pace is timing.pace and len(x) == len(timing.x):
            break
        timing, tolerance = more, NEAR
    # What is said of the last pace is what it is found to ask for.
    between = points(cells_of(timing.pace), FINE)
    fine, checked = checked_at(timing, between, EXACT, suspect=1.0 + _EXCESS)
    if checked.worst <= 1.0 + _LARGEST_EXCESS:
        return timing, fine
    limit, at = np.unravel_index(int(checked.shares.argmax()), checked.shares.shape)
    raise ConvergenceError(
        f"the plan still exceeds the limit on {fine.uses[limit].limit} by {100 * (checked.worst - 1):.3g} % at "
        f"{times(fine.pace, checked.x)[at]:.4f} s after {_ROUNDS} refinements at most; allow more of "
        f"it, or take other cells than {cells_of(fine.pace)}",
        residual=checked.worst - 1.0,
        iterations=_ROUNDS,
        last=fine.pace.c,
    )


def checked_at(timing: Timing, x: np.ndarray, tolerance: float, *, suspect: float) -> tuple[Timing, Checked]:
    """Look at the points x, and at places between them where a share may be larger than what is suspect.

    Returns
    -------
    fine : Timing
        At the points x.
    checked : Checked
        At the places too.
    """
    fine = timing.at(x, tolerance)
    places = _tops(x, fine.shares, suspect)
    if not places.size:
        return fine, Checked(x, fine.shares)
    between = fine.at(places, tolerance)
    order = np.argsort(both := np.concatenate([x, places]), kind="stable")
    return fine, Checked(both[order], np.concatenate([fine.shares, between.shares], axis=1)[:, order])


def _tops(x: np.ndarray, shares: np.ndarray, suspect: float) -> np.ndarray:
    """Where shares, shape (limits, K), may be largest between the points x: tops of parabolas through three.

    Where a share rises fast and then stays, a parabola is wrong: it says where to look, not what is there.
    """
    limit, at = np.nonzero((shares[:, 1:-1] >= shares[:, :-2]) & (shares[:, 1:-1] >= shares[:, 2:]))
    at += 1
    before, after, top = x[at] - x[at - 1], x[at + 1] - x[at], shares[limit, at]
    rise, fall = (top - shares[limit, at - 1]) / before, (top - shares[limit, at + 1]) / after
    bend, slope = (rise + fall) / (before + after), (rise * after - fall * before) / (before + after)
    offset = np.divide(slope, 2.0 * bend, out=np.zeros_like(bend), where=bend > 0.0)
    return np.unique((x[at] + offset)[(top + slope * offset / 2.0 > suspect) & (np.abs(offset) > _APART)])


def with_points(x: np.ndarray, checked: Checked, allowed: float) -> np.ndarray:
    """Add the points at which a limit's share is largest and more than allowed.

    Their neighbours too, to which a peak would move.
    """
    fine, shares = checked.x, checked.shares
    beside = np.pad(shares, ((0, 0), (1, 1)), constant_values=-np.inf)
    tops = (shares > allowed) & (shares >= beside[:, :-2]) & (shares >= beside[:, 2:])
    new = fine[np.convolve(tops.any(axis=0), [1, 1, 1], mode="same") > 0]
    new = new[(np.abs(new[:, None] - x) > _APART).all(axis=1)]
    return np.sort(np.concatenate([x, new]))
