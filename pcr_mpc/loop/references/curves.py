"""Curves by arc length: where a path leads, without its timing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from ...errors import ModelError

Points = tuple[tuple[float, float], ...]
# Gauss-Legendre nodes and weights on [0, 1]: exact to rounding on a blend of less than half a turn.
_NODES, _WEIGHTS = (np.polynomial.legendre.leggauss(24)[0] + 1) / 2, np.polynomial.legendre.leggauss(24)[1] / 2
_STRAIGHT = 1e-9  # rad, turn that is none
_SHARPEST = np.pi - 1e-3  # rad; where a path turns back it must come to rest
_ROUNDING = 1e-12
_PARTS = 16  # of each piece of a spline, for its length
_NEWTON = 8


class Curve(Protocol):
    """A curve by arc length."""

    @property
    def length(self) -> float:
        """Of the whole curve [m]."""

    def __call__(self, s: np.ndarray) -> np.ndarray:
        """Position [m], tangent and curvature vector [1/m] at arc lengths s [m], shape (len(s), 3, 2)."""


@dataclass(frozen=True)
class Circular:
    """A turn about a centre, from an angle on."""

    centre: tuple[float, float]
    radius: float
    angle: float
    clockwise: bool

    @property
    def length(self) -> float:
        """See `Curve`."""
        return 2 * np.pi * self.radius

    def __call__(self, s: np.ndarray) -> np.ndarray:
        """See `Curve`."""
        sense = -1.0 if self.clockwise else 1.0
        phi = self.angle + sense * s / self.radius
        out = np.stack([np.cos(phi), np.sin(phi)], axis=1)
        along = sense * np.stack([-np.sin(phi), np.cos(phi)], axis=1)
        return np.stack([self.centre + self.radius * out, along, -out / self.radius], axis=1)


@dataclass(frozen=True)
class Rounded:
    """Straight legs between points, and corners whose curvature rises and falls continuously.

    A corner of turn phi is a piece of length 2 r |phi| with the curvature (1 - cos(2 pi s / length)) / (2 r): r is its
    smallest radius of curvature. A radius of zero leaves corners sharp, where whoever goes along must come to rest.

    Attributes
    ----------
    points : tuple of (float, float)
        [m].
    radius : float
        [m].
    closed : bool
        Back to the first point, where the curve begins and ends: in the middle of its corner.
    """

    points: Points
    radius: float
    closed: bool

    def __post_init__(self) -> None:
        _ = self._pieces  # says whether the corners fit

    @property
    def length(self) -> float:
        """See `Curve`."""
        starts, _, _, _, lengths = self._pieces
        whole = float(starts[-1] + lengths[-1])
        return whole - (float(lengths[0]) if self.closed else 0.0)

    @cached_property
    def marks(self) -> np.ndarray:
        """Arc lengths at which the curve is nearest to its points, the first once more if it is closed [m]."""
        starts, _, _, _, lengths = self._pieces
        middles = (starts + lengths / 2)[::2]
        if self.closed:
            return np.asarray(middles - middles[0])
        return np.concatenate([[0.0], middles[1:-1], [self.length]])

    def __call__(self, s: np.ndarray) -> np.ndarray:
        """See `Curve`."""
        starts, places, headings, turns, lengths = self._pieces
        s = np.asarray(s, dtype=float) + (lengths[0] / 2 if self.closed else 0.0)
        i = np.clip(np.searchsorted(starts, s, side="right") - 1, 0, len(starts) - 1)
        size = np.where(lengths[i] > 0, lengths[i], 1.0)
        u = (s - starts[i]) / size
        out = np.empty((len(s), 3, 2))
        out[:, 0] = places[i] + _along(headings[i], turns[i], u) * size[:, None]
        theta = headings[i] + turns[i] * _turned(u)
        out[:, 1] = np.stack([np.cos(theta), np.sin(theta)], axis=1)
        bend = turns[i] / size * (1 - np.cos(2 * np.pi * u))
        out[:, 2] = bend[:, None] * np.stack([-np.sin(theta), np.cos(theta)], axis=1)
        return out

    @cached_property
    def _pieces(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Corners and legs in turn: start [m], place (2) [m], heading and turn [rad], length [m] of each.

        An open curve begins and ends with a corner without length, a closed one with its first corner, whole.
        """
        points = np.array(self.points + (self.points[:1] if self.closed else ()))
        legs = np.diff(points, axis=0)
        sizes, headings = np.hypot(*legs.T), np.arctan2(legs[:, 1], legs[:, 0])
        turns = np.diff(headings, prepend=headings[-1])
        turns = np.remainder(turns + np.pi, 2 * np.pi) - np.pi
        turns[np.abs(turns) < _STRAIGHT] = 0.0
        turns = np.append(turns, turns[0])
        if not self.closed:
            turns[[0, -1]] = 0.0
        if self.radius > 0:
            self._require_turns(turns, points)
        lengths = 2 * self.radius * np.abs(turns)
        # Chord of a corner over its length; both ends are as far from the point.
        chords = np.hypot(*_along(np.zeros(len(turns)), turns, np.ones(len(turns))).T) * lengths
        cuts = chords / (2 * np.cos(turns / 2))
        self._require_room(cuts, sizes, points)
        places = np.empty((2 * len(sizes) + 1, 2))
        ways = legs / sizes[:, None]
        places[1::2] = points[:-1] + cuts[:-1, None] * ways
        places[0] = points[0] - cuts[0] * ways[-1]
        places[2::2] = points[1:] - cuts[1:, None] * ways
        before = headings[-1] if self.closed else headings[0]
        straights = sizes - cuts[:-1] - cuts[1:]
        all_lengths = np.empty(len(places))
        all_lengths[::2], all_lengths[1::2] = lengths, np.maximum(straights, 0.0)
        all_headings = np.empty(len(places))
        all_headings[::2], all_headings[1::2] = np.concatenate([[before], headings]), headings
        all_turns = np.zeros(len(places))
        all_turns[::2] = turns
        starts = np.concatenate([[0.0], np.cumsum(all_lengths)[:-1]])
        return starts, places, all_headings, all_turns, all_lengths

    def _require_turns(self, turns: np.ndarray, points: np.ndarray) -> None:
        for i in np.flatnonzero(np.abs(turns) > _SHARPEST):
            raise ModelError(
                f"radius is {self.radius:g} m, and the path turns back at point {i % len(self.points)}, "
                f"({points[i][0]:g}, {points[i][1]:g}) m, which no radius can round; let it come to rest there, or "
                "move the point",
                key="radius",
            )

    def _require_room(self, cuts: np.ndarray, sizes: np.ndarray, points: np.ndarray) -> None:
        taken = cuts[:-1] + cuts[1:]
        short = taken - sizes
        i = int((taken / sizes).argmax())
        if short[i] > _ROUNDING * sizes[i]:
            (x, y), (xx, yy) = points[i], points[i + 1]
            units = " (millimetres? give metres)" if self.radius > sizes.sum() else ""
            raise ModelError(
                f"radius is {self.radius:g} m{units}: the leg from ({x:g}, {y:g}) to ({xx:g}, {yy:g}) m is "
                f"{1e3 * sizes[i]:.4g} mm long, and corners of radius {1e3 * self.radius:g} mm take "
                f"{1e3 * taken[i]:.4g} mm of it; the largest radius that fits is "
                f"{np.floor(1e6 * self.radius * sizes[i] / taken[i]) / 1e3:g} mm",
                key="radius",
            )


def _turned(u: np.ndarray) -> np.ndarray:
    """Share of a corner's turn after the share u of its length."""
    return u - np.sin(2 * np.pi * u) / (2 * np.pi)


def _along(heading: np.ndarray, turn: np.ndarray, u: np.ndarray) -> np.ndarray:
    """From where a corner of length 1 begins to the share u of it, shape (len(u), 2)."""
    theta = heading[:, None] + turn[:, None] * _turned(u[:, None] * _NODES)
    return np.asarray(np.stack([np.cos(theta) @ _WEIGHTS, np.sin(theta) @ _WEIGHTS], axis=1) * u[:, None])


@dataclass(frozen=True)
class Smooth:
    """Cubic spline through points, over the square roots of their distances; straight at its ends unless closed.

    Attributes
    ----------
    points : tuple of (float, float)
        [m].
    closed : bool
        Back to the first point.

    References
    ----------
    .. [1] E. Lee, "Choosing nodes in parametric curve interpolation", Computer-Aided Design 21 (1989): why the roots.
    """

    points: Points
    closed: bool

    def __post_init__(self) -> None:
        u, _ = self._table
        speed = np.hypot(*self._spline(u, 1).T)
        if speed.min() < 1e-6 * speed.max():
            x, y = self._spline(u[speed.argmin()])
            raise ModelError(f"the spline comes to a cusp at ({x:g}, {y:g}) m; add or move points there", key="points")

    @property
    def length(self) -> float:
        """See `Curve`."""
        return float(self._table[1][-1])

    @cached_property
    def marks(self) -> np.ndarray:
        """Arc lengths of the points, the first once more if it is closed [m]."""
        return np.asarray(self._table[1][::_PARTS])

    def __call__(self, s: np.ndarray) -> np.ndarray:
        """See `Curve`."""
        s = np.asarray(s, dtype=float)
        knots, lengths = self._table
        u = np.interp(s, lengths, knots)
        i = np.clip(np.searchsorted(lengths, s, side="right") - 1, 0, len(knots) - 2)
        for _ in range(_NEWTON):
            ahead = lengths[i] + self._between(knots[i], u)
            u = np.clip(u - (ahead - s) / np.hypot(*self._spline(u, 1).T), knots[i], knots[i + 1])
        first, second = self._spline(u, 1), self._spline(u, 2)
        square = (first * first).sum(axis=1, keepdims=True)
        along = (first * second).sum(axis=1, keepdims=True)
        bend = (second - first * along / square) / square
        return np.stack([self._spline(u), first / np.sqrt(square), bend], axis=1)

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import CubicSpline  # with half of SciPy, slow to import

        points = np.array(self.points + (self.points[:1] if self.closed else ()))
        roots = np.sqrt(np.hypot(*np.diff(points, axis=0).T))
        u = np.concatenate([[0.0], np.cumsum(roots)])
        return CubicSpline(u, points, bc_type="periodic" if self.closed else "natural")

    @cached_property
    def _table(self) -> tuple[np.ndarray, np.ndarray]:
        """Parameters, _PARTS to each piece of the spline, and arc lengths there."""
        ends = self._spline.x
        parts = np.arange(_PARTS) / _PARTS
        u = np.append((ends[:-1, None] + np.diff(ends)[:, None] * parts).ravel(), ends[-1])
        return u, np.concatenate([[0.0], np.cumsum(self._between(u[:-1], u[1:]))])

    def _between(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Arc length between parameters, which share a piece."""
        u = low[:, None] + (high - low)[:, None] * _NODES
        speed = np.linalg.norm(self._spline(u.ravel(), 1), axis=1).reshape(u.shape)
        return np.asarray(speed @ _WEIGHTS * (high - low))
