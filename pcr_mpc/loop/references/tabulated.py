"""A path that was recorded, drawn or computed elsewhere: rows of times and positions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ...errors import ModelError, check_numbers, checked_array
from .curves import Points
from .rows import scatter
from .trajectory import check_flag

_DEGREE = 5  # of the spline that smooths: acceleration is a smooth cubic
_LEAST = {"rows": 4, "smoothed": 8, "hermite": 2}
_CLOSED = 1e-6  # of the path's extent: ends that are this near are the same point


@dataclass(frozen=True)
class Tabulated:
    """Through positions at given times, or near them; acceleration is continuous, and the tip stays at the end.

    Without smoothing a cubic spline goes through the positions; with velocities, quintics go through them and the
    positions, and through the accelerations, which if they are not given are the slopes of a cubic spline through the
    velocities. With smoothing it is the spline of degree 5 with as few knots as leave the sum of squared distances at
    what noise of that standard deviation makes of it [1]_.

    Attributes
    ----------
    times : tuple of float
        Increasing; the first counts as 0 [s].
    points : tuple of (float, float)
        Position [m].
    velocities, accelerations : tuple of (float, float) or None
        [m/s], [m/s^2].
    smoothing : float
        Standard deviation of each coordinate's noise [m].
    closed : bool
        The last position is the first again, and it passes there smoothly.

    References
    ----------
    .. [1] P. Dierckx, "Curve and Surface Fitting with Splines", Oxford, 1993 (FITPACK, by `scipy.interpolate.splprep`).
    """

    times: tuple[float, ...]
    points: Points
    velocities: Points | None = None
    accelerations: Points | None = None
    smoothing: float = 0.0
    closed: bool = False

    def __post_init__(self) -> None:
        times = self._table("times", 1)
        if (np.diff(times) <= 0.0).any():
            i = int(np.argmax(np.diff(times) <= 0.0)) + 1
            raise ModelError(f"times: row {i} is not after the row before; expected rows in order", key="times")
        for name in ("points", "velocities", "accelerations"):
            if getattr(self, name) is not None:
                rows = self._table(name, 2)
                if len(rows) != len(times):
                    raise ModelError(f"{name}: {len(rows)} rows for {len(times)} times", key=name)
                object.__setattr__(self, name, tuple((x, y) for x, y in rows.tolist()))
        check_numbers(self, {"smoothing": {"minimum": 0.0}})
        check_flag(self, "closed")
        if self.accelerations is not None and self.velocities is None:
            raise ModelError("accelerations without velocities: give both", key="accelerations")
        if self.smoothing and self.velocities is not None:
            raise ModelError(
                "smoothing is for positions: leave out the velocities, or take smoothing = 0", key="smoothing"
            )
        kind = "smoothed" if self.smoothing else "rows" if self.velocities is None else "hermite"
        if len(times) < _LEAST[kind]:
            raise ModelError(
                f"points: {len(times)} row{'s' * (len(times) != 1)}, expected at least {_LEAST[kind]}; way-points are "
                "kind 'waypoints'",
                key="points",
            )
        object.__setattr__(self, "times", tuple((times - times[0]).tolist()))
        if self.closed:
            self._require_closed()

    @property
    def duration(self) -> float:
        """Time of the last row, the first being 0 [s]."""
        return self.times[-1]

    @cached_property
    def residuals(self) -> np.ndarray:
        """Distances of the path from its rows, shape (K,) [m]."""
        return np.asarray(np.linalg.norm(self(np.array(self.times))[:, 0] - np.array(self.points), axis=1))

    @cached_property
    def scatter(self) -> float:
        """Standard deviation of each coordinate's noise, if the rows look noisy and are not smoothed, else zero [m]."""
        if self.smoothing or self.velocities is not None:
            return 0.0
        return scatter(np.array(self.times), np.array(self.points))

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """See `Trajectory`."""
        t = np.asarray(t, dtype=float)
        within = np.clip(t, 0.0, self.duration)
        samples = np.stack([spline(within) for spline in self._splines], axis=1)
        samples[within != t, 1:] = 0.0
        return samples

    @cached_property
    def _splines(self) -> tuple[Any, Any, Any]:
        """Position, velocity and acceleration."""
        from scipy.interpolate import BPoly, BSpline, CubicSpline, splprep  # with half of SciPy, slow to import

        t, points = np.array(self.times), np.array(self.points)
        if self.closed:
            points[-1] = points[0]
        if self.smoothing:
            # Twice a coordinate's variance for each row, in units of that variance.
            (found, _), _, code, message = splprep(
                points.T, u=t, w=np.full(len(t), 1 / self.smoothing), s=2 * len(t), k=_DEGREE, per=self.closed,
                quiet=1, full_output=1,
            )  # fmt: skip
            if code > 0:
                raise ModelError(
                    f"no spline comes within smoothing = {self.smoothing:g} m of the rows: {message}; take "
                    f"{2 * self.smoothing:g}",
                    key="smoothing",
                )
            knots, coefficients, _ = found
            spline: Any = BSpline(np.array(knots), np.array(coefficients).T, _DEGREE)
        elif self.velocities is None:
            spline = CubicSpline(t, points, bc_type="periodic" if self.closed else "not-a-knot")
        else:
            velocities = np.array(self.velocities)
            if self.accelerations is None:
                if self.closed:
                    velocities[-1] = velocities[0]
                accelerations = CubicSpline(t, velocities, bc_type="periodic" if self.closed else "not-a-knot")(t, 1)
            else:
                accelerations = np.array(self.accelerations)
            spline = BPoly.from_derivatives(t, np.stack([points, velocities, accelerations], axis=1))
        return spline, spline.derivative(1), spline.derivative(2)

    def _table(self, name: str, columns: int) -> np.ndarray:
        value = getattr(self, name)
        try:
            shape = (len(value),) if columns == 1 else (len(value), columns)
            return checked_array(name, value, shape)
        except (TypeError, ValueError) as error:
            message = str(error) if isinstance(error, ValueError) else f"{name} is {value!r}, expected rows"
            raise ModelError(message, key=name) from None

    def _require_closed(self) -> None:
        points = np.array(self.points)
        gap = float(np.hypot(*(points[-1] - points[0])))
        allowed = max(_CLOSED * float(np.ptp(points, axis=0).max()), 5.0 * self.smoothing)
        if gap > allowed:
            raise ModelError(
                f"the path is to be closed, but its last position is {1e3 * gap:.3g} mm from its first (allowed are "
                f"{1e3 * allowed:.2g} mm); add a last row at ({points[0][0]:g}, {points[0][1]:g}) m, or take "
                "closed = false",
                key="closed",
            )
        for name, unit in (("velocities", "m/s"), ("accelerations", "m/s^2")):
            if getattr(self, name) is not None:
                rows = np.array(getattr(self, name))
                jump = float(np.hypot(*(rows[-1] - rows[0])))
                if jump > _CLOSED * float(np.abs(rows).max()):
                    raise ModelError(
                        f"the path is to be closed, but its last row's {name} are {jump:.3g} {unit} from its first's; "
                        "take closed = false",
                        key="closed",
                    )
