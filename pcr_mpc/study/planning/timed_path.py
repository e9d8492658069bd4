"""A planned motion: where the tip is when, and what that asks of the robot."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import BSpline

from ...frozen import Frozen
from .along_path.course import PacedPath
from .along_path.pace import cells_of, duration, places, times
from .limits import UNITS, PlanLimits

ACTIVE = 0.95  # share of a limit from which on it acts
_HEADER = "t_s,x_m,y_m,vx_m_s,vy_m_s,ax_m_s2,ay_m_s2"
_ROW = 5e-4  # s


class Move(ABC):
    """A motion from rest to rest."""

    @property
    @abstractmethod
    def duration(self) -> float:
        """[s]."""

    @abstractmethod
    def at(self, t: np.ndarray) -> np.ndarray:
        """Position [m], velocity [m/s] and acceleration [m/s^2] at times within the duration, (len(t), 3, 2)."""

    @abstractmethod
    def breaks(self) -> np.ndarray:
        """Times at which its pieces meet [s]."""

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """The same at any times."""
        t = np.asarray(t, dtype=float)
        samples = self.at(np.clip(t, 0.0, self.duration))
        samples[(t < 0.0) | (t > self.duration), 1:] = 0.0
        return samples


@dataclass(frozen=True, eq=False)
class Paced(Move):
    """A course at a pace.

    Attributes
    ----------
    course : PacedPath
    pace : BSpline
    """

    course: PacedPath
    pace: BSpline

    @property
    def duration(self) -> float:
        """See `Move`."""
        return duration(self.pace)

    def at(self, t: np.ndarray) -> np.ndarray:
        """See `Move`."""
        x = places(self.pace, t)
        p, p1, p2 = self.course(x)[:3]
        b, b1 = self.pace(x)[:, None], self.pace(x, nu=1)[:, None]
        return np.stack([p, p1 * np.sqrt(b), p2 * b + p1 * b1 / 2.0], axis=1)

    def breaks(self) -> np.ndarray:
        """See `Move`."""
        return times(self.pace, np.linspace(0.0, 1.0, cells_of(self.pace) + 1))


@dataclass(frozen=True)
class RodsMass:
    """What a plan asks for with the rods' inertia, at the control periods.

    Attributes
    ----------
    inertia : str
        Of the rods, as the scene's controller knows it.
    limits : PlanLimits
        That are kept with it.
    rate, acceleration, torque : float
        Largest of any motor [rad/s], [rad/s^2], [N m].
    strains : tuple of float
        Largest of each rod; NaN where no thickness is known.
    rod_margin, stiffness : float
        Least of any rod, NaN where it is not known, and of the tip [N/m].
    rounds : int
        Plans that were made.
    """

    inertia: str
    limits: PlanLimits
    rate: float
    acceleration: float
    torque: float
    strains: tuple[float, ...]
    rod_margin: float
    stiffness: float
    rounds: int = 1

    @property
    def shares(self) -> dict[str, float]:
        """Of the limits, by their names in `PlanLimits`: 1 is all of it."""
        limits = self.limits
        found = {kind: getattr(self, kind) / getattr(limits, kind) for kind in ("rate", "acceleration", "torque")}
        found["stiffness"] = limits.stiffness / self.stiffness if self.stiffness > 0.0 else math.inf
        if limits.strains:
            found["strains"] = max(np.nan_to_num(np.array(self.strains) / limits.strains).tolist())
        if math.isfinite(self.rod_margin) and math.isfinite(limits.rod_margin):
            found["rod_margin"] = (1.0 - self.rod_margin) / (1.0 - limits.rod_margin)
        return found

    def summary(self) -> dict[str, Any]:
        """Ready for JSON: what is asked of the motors with inertia, what is allowed, and the shares of all limits."""
        return {
            "inertia": self.inertia,
            "plans": self.rounds,
            "shares": self.shares,
            "asked": {"rate_rad_s": self.rate, "rate_change_rad_s2": self.acceleration, "torque_Nm": self.torque},
            "limits": {
                "rate_rad_s": self.limits.rate,
                "rate_change_rad_s2": self.limits.acceleration,
                "torque_Nm": self.limits.torque,
            },
        }


@dataclass(frozen=True, eq=False)
class TimedPath(Frozen):
    """A path with its timing, at rest before and after; a `Trajectory`.

    Attributes
    ----------
    name : str
        Of the scene.
    move : Move
    limits : PlanLimits
    deviation : float
        Greatest distance of the path from the one that was given [m].
    grid : int
        Points at which limits were kept.
    t : ndarray, shape (K,)
        Times at which limits were checked: ten times as many [s].
    s : ndarray, shape (K,)
        Length from the start [m].
    motion : ndarray, shape (K, 3, 2)
        Position [m], velocity [m/s] and acceleration [m/s^2] there.
    q, rates : ndarray, shape (K, n)
        Motor angles [rad] and rates [rad/s] there.
    kinds : tuple of str
        The limits.
    shares : ndarray, shape (limits, K)
        Largest share of each that is used: 1 is all of it.
    iterations : int
    rods : RodsMass or None
        With the rods' inertia, if the plan reckons with it; ``limits`` are then lowered.
    """

    name: str
    move: Move
    limits: PlanLimits
    deviation: float
    grid: int
    t: np.ndarray
    s: np.ndarray
    motion: np.ndarray
    q: np.ndarray
    rates: np.ndarray
    kinds: tuple[str, ...]
    shares: np.ndarray
    iterations: int
    rods: RodsMass | None = None

    @property
    def duration(self) -> float:
        """[s]."""
        return self.move.duration

    @property
    def excess(self) -> float:
        """By what share of it the worst limit is exceeded on the fine grid; negative: what is left."""
        return float(self.shares.max()) - 1.0

    @property
    def acting(self) -> np.ndarray:
        """Index of the limit that acts at each time, shape (K,); -1 where none does."""
        return np.where(self.shares.max(axis=0) >= ACTIVE, self.shares.argmax(axis=0), -1)

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """Position [m], velocity [m/s] and acceleration [m/s^2] at times t, shape (len(t), 3, 2)."""
        return self.move(t)

    def csv(self, step: float = _ROW) -> str:
        """Table for ``[reference] kind = "file"``: time, position, velocity and acceleration, to all digits.

        Parameters
        ----------
        step : float
            Longest time from row to row [s].
        """
        # Rows where pieces of the timing meet: between them the motion is so smooth that their spline is the same.
        breaks = self.move.breaks()
        count = math.ceil(float(np.diff(breaks).max()) / step)
        t = np.interp(np.arange(count * (len(breaks) - 1) + 1) / count, np.arange(len(breaks)), breaks)
        rows = np.column_stack([t, self(t).reshape(len(t), 6)])
        return "\n".join([_HEADER, *(",".join(map(repr, row)) for row in rows.tolist())]) + "\n"

    def summary(self) -> dict[str, Any]:
        """Figures for a table and for machines."""
        weights = np.gradient(self.t) / self.duration
        rows = [
            {
                "limit": kind,
                "value": self.limits.value(kind),
                "unit": UNITS[kind],
                "largest_share": float(share.max()),
                "at_s": float(self.t[share.argmax()]),
                "acts_share": float(weights[self.acting == i].sum()),
            }
            for i, (kind, share) in enumerate(zip(self.kinds, self.shares, strict=True))
        ]
        return {
            "scene": self.name,
            "duration_s": self.duration,
            "length_mm": 1e3 * float(self.s[-1]),
            "deviation_mm": 1e3 * self.deviation,
            "top_speed_m_s": float(np.linalg.norm(self.motion[:, 1], axis=1).max()),
            "limits": rows,
            "grid": self.grid,
            "checked": len(self.t),
            "largest_excess": self.excess,
            "iterations": self.iterations,
            "rods": None if self.rods is None else self.rods.summary(),
        }
