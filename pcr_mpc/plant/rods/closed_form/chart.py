"""A chart of the stable shapes of one rod: where a cold start begins.

With clamp tangent along +x and a moment-free tip, a normalised rod is the pendulum
delta'' = sin(delta) in u = lambda * (distance from the tip), where delta is the angle from the rod's
tangent to its internal force and lambda^2 the size of that force. It starts at rest at the tip with
delta = tip_angle in (0, pi), and its mirror image covers the other handedness. A taut rod has
tip_angle of the order of exp(-lambda), so its logarithm is carried.

The rod is stable with its tip held for lambda below the first zero of det d(xi, eta)/d(log tip_angle, lambda):
the sheet of stable shapes is tabulated once, and a tip position is looked up by the triangles that cover it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ....buffered import BufferedFunction, per_thread
from . import elastica
from .nearly_straight import nearly_straight
from .pendulum import beyond_numbers

LEAST_CRITICAL_LOAD = 5.7659  # of all rods, at k = 0.9427
_MAX_LOAD = 600.0  # largest lambda on the sheet, about
_LAMBDA_STEPS = 480  # RK4 steps along each trajectory
_COLUMNS = 96  # columns of the tabulated sheet
_LAUNCH = 1e-4  # delta up to which the pendulum is linear to rounding
_LOOPED = -13.0  # log(tip_angle) below which the chart stops short of the full loop where stability ends
_ROUGHLY_TAUT = -9.0  # log(tip_angle) below which lambda_c is so much before the full loop that no table is needed
_TAUT = -21.0  # log(tip_angle) below which that stretch is skipped
_EDGE = 1e-9  # slack with which a triangle contains a point
_POLISHED = 1e-12  # distance from the target, in units of L


@dataclass(frozen=True)
class HeldShape:
    """One stable shape of a rod whose tip is held.

    Attributes
    ----------
    hand : int
        +1 if the rod turns left towards its tip (m > 0 there), -1 for the mirror image.
    log_tip_angle : float
        Logarithm of the angle between the tip's tangent and the tip force, which lies in (0, pi) rad.
    load : float
        lambda, the square root of the normalised tip force.
    energy : float
        Elastic energy, normalised by EI/L.
    """

    hand: int
    log_tip_angle: float
    load: float
    energy: float

    def stable(self) -> bool:
        """Whether the load is below lambda_c."""
        # Far below the tabulated limit there is no need to find it exactly.
        near = 0.7 * rough_critical_load(self.log_tip_angle)
        return self.load < near or self.load < critical_load(self.log_tip_angle)

    def polished(self, xi: float, eta: float) -> HeldShape | None:
        """The exact shape near this one whose tip is at (xi, eta), or None if Newton's method finds none."""
        unknowns = np.array([self.log_tip_angle, self.load])
        target = np.array([xi, self.hand * eta])
        value = _evaluate_tip(unknowns, target)
        for _ in range(20):
            step = -np.linalg.lstsq(value[1], value[0], rcond=1e-14)[0]
            # Half a unit is a large change of either unknown.
            step *= min(1.0, 0.5 / max(np.abs(step).max(), 1e-300))
            while True:
                trial = _evaluate_tip(unknowns + step, target)
                if np.linalg.norm(trial[0]) < np.linalg.norm(value[0]):
                    break
                step = step / 2
                if np.abs(step).max() < 1e-9:
                    return None
            unknowns, value = unknowns + step, trial
            if np.linalg.norm(value[0]) < _POLISHED:
                return HeldShape(self.hand, float(unknowns[0]), float(unknowns[1]), value[2])
        return None

    def nodes(self, n_nodes: int, clamp_angle: float) -> np.ndarray:
        """Nodal states [theta, n_x, n_y, m] for multiple shooting, shape (4, n_nodes), normalised."""
        return elastica.nodes(np.array([self.log_tip_angle, self.load, self.hand]), clamp_angle, n_nodes)


def stable_shapes(xi: float, eta: float) -> list[HeldShape]:
    """Every stable shape of a rod clamped at the origin along +x with its tip at (xi, eta), exact, by energy.

    Complete to the resolution of the chart: pairs of shapes that merge at a fold closer than about 1e-3 in
    (xi, eta), and shapes that carry more than 1e6 EI/L^2, may be missed.
    """
    found: list[HeldShape] = []
    for coarse in held_shapes(xi, eta):
        shape = coarse.polished(xi, eta)
        if shape is None or not shape.stable():
            continue
        if all(shape.hand != other.hand or abs(shape.load - other.load) > 1e-5 * shape.load for other in found):
            found.append(shape)
    return sorted(found, key=lambda shape: shape.energy)


def critical_load(log_tip_angle: float) -> float:
    """lambda_c, the load at which a rod with its tip held loses stability."""

    from scipy.optimize import brentq  # which takes a good part of a second to import, and few need it

    def determinant(load: float) -> float:
        return _determinant(log_tip_angle, load)

    if log_tip_angle < _LOOPED:
        # A full loop is about to leave a taut rod, a little short of 2 K(k).
        full_loop = 2.0 * (np.log(8.0) - log_tip_angle)
        if beyond_numbers(log_tip_angle - np.log(2.0)):
            return float(full_loop - 0.55)
        return float(brentq(determinant, full_loop - 0.8, full_loop - 0.3, xtol=1e-10))
    guess = float(rough_critical_load(log_tip_angle))
    # The table is good to a few per cent at most (where lambda_c jumps, between two of its rows).
    for width in (0.02, 0.1, 0.4):
        low, high = guess * (1 - width), guess * (1 + width)
        if determinant(low) * determinant(high) < 0:
            return float(brentq(determinant, low, high, xtol=1e-10))
    return guess


def critical_load_slope(log_tip_angle: float, critical: float) -> float:
    """D lambda_c / d log tip_angle: the zero of the determinant moves so that it stays one."""
    h = 1e-4
    by_angle = _determinant(log_tip_angle + h, critical) - _determinant(log_tip_angle - h, critical)
    return -by_angle / (_determinant(log_tip_angle, critical + h) - _determinant(log_tip_angle, critical - h))


def rough_critical_load(log_tip_angle: Any) -> Any:
    """lambda_c for a number or an array, at once; good to 1 %, and to 5 % where it is steep."""
    chart = _chart()
    taut = 2.0 * (np.log(8.0) - log_tip_angle) - 0.5
    return np.where(log_tip_angle < _ROUGHLY_TAUT, taut, np.interp(log_tip_angle, chart.rows, chart.limits))


def critical_load_table() -> tuple[np.ndarray, np.ndarray]:
    """Log tip_angle of each trajectory of the chart, increasing, and lambda_c there (see `rough_critical_load`)."""
    chart = _chart()
    return chart.rows, chart.limits


def held_shapes(xi: float, eta: float) -> list[HeldShape]:
    """Stable shapes of a rod clamped at the origin along +x with its tip at (xi, eta), in units of L.

    Returns
    -------
    list of HeldShape
        By increasing energy, to the resolution of the chart (a start for Newton's method, not a
        solution), nearly straight ones in closed form. If the tip lies in a gap of the chart, the nearest entry.
    """
    chart = _chart()
    found = []
    for hand, log_tip_angle, load in nearly_straight(xi, eta):
        energy = _evaluate_tip(np.array([log_tip_angle, load]), np.zeros(2))[2]
        found.append(HeldShape(hand, log_tip_angle, load, energy))
    for hand in (1, -1):
        target = np.array([xi, hand * eta])
        rows, weights = _containing(chart, target)
        for row, w in zip(rows, weights, strict=True):
            corners = chart.corners[row]
            values = (w @ field[corners] for field in (chart.log_tip_angle, chart.load, chart.energy))
            found.append(HeldShape(hand, *(float(value) for value in values)))
    if not found:
        distance = [np.hypot(chart.points[:, 0] - xi, chart.points[:, 1] - hand * eta) for hand in (1, -1)]
        hand = 1 if distance[0].min() <= distance[1].min() else -1
        at = int(np.argmin(distance[0 if hand == 1 else 1]))
        found = [HeldShape(hand, *(float(field[at]) for field in (chart.log_tip_angle, chart.load, chart.energy)))]
    return sorted(found, key=lambda shape: shape.energy)


def _evaluate_tip(unknowns: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Tip minus target, its Jacobian in (log tip_angle, load), and the energy."""
    function = _tip_map()
    function.inputs[0][:] = unknowns
    function()
    tip, jacobian, energy = function.outputs
    return tip - target, jacobian.copy(), float(energy[0])


def _determinant(log_tip_angle: float, load: float) -> float:
    return float(np.linalg.det(_evaluate_tip(np.array([log_tip_angle, load]), np.zeros(2))[1]))


@per_thread()
def _tip_map() -> BufferedFunction:
    return BufferedFunction(elastica.tip_map())


@dataclass(frozen=True, eq=False)
class _Chart:
    points: np.ndarray  # (M, 2) tip positions
    log_tip_angle: np.ndarray  # (M,)
    load: np.ndarray  # (M,)
    energy: np.ndarray  # (M,)
    corners: np.ndarray  # (T, 3) indices of each triangle's corners
    triangles: np.ndarray  # (T, 3, 2) their positions
    boxes: np.ndarray  # (4, T) least and greatest x, least and greatest y of each triangle
    rows: np.ndarray  # log tip_angle of each trajectory
    limits: np.ndarray  # its last stable load


@lru_cache
def _chart() -> _Chart:
    log_tip_angle = np.concatenate([-np.geomspace(_MAX_LOAD, 2.5, 150), np.log(np.linspace(0.1, np.pi - 1e-3, 110))])
    load, delta, sheet, determinant = _trajectories(log_tip_angle)
    # The determinant has no zero before the quarter period, where it may be all rounding.
    middle = np.argmax(load > _quarter_period(log_tip_angle)[:, None], axis=1)
    # Columns follow the turning of the base, so that taut rods (all turning within the last few u) are resolved.
    turning = np.abs(np.diff(delta, axis=1, prepend=delta[:, :1])) + 3.0 / _LAMBDA_STEPS
    columns = np.empty((4, len(log_tip_angle), _COLUMNS))
    for i, values in enumerate(determinant):
        unstable = np.flatnonzero(values[middle[i] :] * np.sign(values[middle[i]]) <= 0)
        last = middle[i] + unstable[0] if unstable.size else len(values) - 1  # the zero lies just before
        measure = np.cumsum(turning[i, : last + 1])
        at = np.linspace(measure[0], measure[-1], _COLUMNS)
        columns[:, i] = [np.interp(at, measure, f[i, : last + 1]) for f in (load, *sheet)]
    loads = columns[0]
    points = columns[1:3].reshape(2, -1).T
    index = np.arange(points.shape[0]).reshape(loads.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    corners = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    triangles = points[corners]
    low, high = triangles.min(axis=1) - _EDGE, triangles.max(axis=1) + _EDGE
    return _Chart(
        points=points,
        log_tip_angle=np.broadcast_to(log_tip_angle[:, None], loads.shape).ravel(),
        load=loads.ravel(),
        energy=columns[3].ravel(),
        corners=corners,
        triangles=triangles,
        boxes=np.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]]),
        rows=log_tip_angle,
        limits=loads[:, -1],
    )


def _quarter_period(log_tip_angle: np.ndarray) -> np.ndarray:
    """Load at which the pendulum hangs (delta = pi), K(k), to 5 %."""
    return np.asarray(np.log(8.0) - log_tip_angle + 0.25)


def _trajectories(log_tip_angle: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], np.ndarray]:
    """Load, delta, (tip position and energy) and stability determinant along each trajectory."""
    # The determinant's first zero lies before 2 K(k), half a swing of the pendulum. For very taut rods the far
    # half would carry a full loop, and 2 pi - delta underflows there: 16 past the middle is as far as it is exact.
    quarter_period = _quarter_period(log_tip_angle)
    launch, state = _launch(log_tip_angle)
    end = np.maximum(8.2, np.minimum(2.0 * quarter_period, quarter_period + 16.0)) - launch
    h = end / _LAMBDA_STEPS
    # Tangents with respect to log(tip_angle), by which the linear part of the motion is scaled.
    state = np.concatenate([state, state[:2], 0 * state[:1], state[3:]])
    states = []
    for _ in range(_LAMBDA_STEPS):
        state = _rk4(_pendulum_with_tangent, state, h)
        states.append(state)
    path = np.stack(states, axis=-1)  # (8, angles, loads)
    delta, rate, c, s, d_delta, _, d_c, d_s = path
    load = launch[:, None] + h[:, None] * np.arange(1, _LAMBDA_STEPS + 1)
    cos, sin = np.cos(delta), np.sin(delta)
    xi, eta = (cos * c + sin * s) / load, (sin * c - cos * s) / load
    # Differentiate the tip with respect to (log tip_angle, load): d(cos) = -sin d(delta), and so on.
    xi_a = (cos * d_c + sin * d_s + (cos * s - sin * c) * d_delta) / load
    eta_a = (sin * d_c - cos * d_s + (cos * c + sin * s) * d_delta) / load
    xi_l = (1.0 - eta * load * rate - xi) / load  # cos^2 + sin^2 = 1 from dc/du = cos, ds/du = sin
    eta_l = (xi * load * rate - eta) / load
    energy = load**2 * np.cos(np.exp(log_tip_angle))[:, None] - load * c
    return load, delta, [xi, eta, energy], xi_a * eta_l - eta_a * xi_l


def _launch(log_tip_angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where to start integrating, and the state (delta, rate, C, S) there.

    Near the tip of a taut rod delta = tip_angle cosh(u) to rounding: that stretch, up to `_LAUNCH`, is skipped.
    """
    taut = log_tip_angle < _TAUT
    u = np.where(taut, np.log(2.0 * _LAUNCH) - log_tip_angle, 0.0)
    tip_angle = np.exp(log_tip_angle)
    return u, np.array(
        [np.where(taut, _LAUNCH, tip_angle), np.where(taut, _LAUNCH, 0.0), u, np.where(taut, _LAUNCH, 0.0)]
    )


def _pendulum_with_tangent(state: np.ndarray) -> np.ndarray:
    delta, rate, _, _, d_delta, d_rate, _, _ = state
    sin, cos = np.sin(delta), np.cos(delta)
    return np.array([rate, sin, cos, sin, d_rate, cos * d_delta, -sin * d_delta, cos * d_delta])


def _rk4(f: Callable[[Any], Any], state: Any, h: Any) -> Any:
    k1 = f(state)
    k2 = f(state + h / 2 * k1)
    k3 = f(state + h / 2 * k2)
    k4 = f(state + h * k3)
    return state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _containing(chart: _Chart, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the triangles that contain ``target`` and its barycentric coordinates there."""
    x, y = target
    low_x, high_x, low_y, high_y = chart.boxes
    rows = np.flatnonzero((low_x <= x) & (x <= high_x) & (low_y <= y) & (y <= high_y))
    triangles = chart.triangles[rows]
    origin = triangles[:, 0]
    e1, e2, r = triangles[:, 1] - origin, triangles[:, 2] - origin, target - origin
    area = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        w1 = (r[:, 0] * e2[:, 1] - r[:, 1] * e2[:, 0]) / area
        w2 = (e1[:, 0] * r[:, 1] - e1[:, 1] * r[:, 0]) / area
        inside = (w1 >= -_EDGE) & (w2 >= -_EDGE) & (w1 + w2 <= 1 + _EDGE)
    w1, w2 = w1[inside], w2[inside]
    return rows[inside], np.stack([1 - w1 - w2, w1, w2], axis=1)
