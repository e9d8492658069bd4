"""The rod equations and their propagation along the arc, as CasADi graphs.

A rod is written in normalised units throughout the solvers: lengths in L, forces in EI/L^2,
moments in EI/L, energies in EI/L. One graph then serves every rod, and residuals of different
kinds can be compared. Positions keep the orientation of the world frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ...buffered import graph_cache
from ...frozen import Frozen

SCHEMES = ("rk4", "rk8")  # explicit Runge-Kutta: the paper's, and that of Dormand and Prince of order 8 in 12 stages


@dataclass(frozen=True)
class Layout:
    """What the graphs of rods that are not plain know of them; the numbers are given to the graphs.

    Attributes
    ----------
    intervals : int
        Equal pieces of the rod on each of which its properties are linear in s; 0 if they do not change.
    varying : bool
        Whether EI changes along the rod.
    stretching : bool
        Whether it stretches.
    """

    intervals: int
    varying: bool
    stretching: bool

    @property
    def size(self) -> int:
        """Entries of the vector [w_x, w_y, c, kappa0 at the knots, EI(s)/EI at the knots if it varies]."""
        return 3 + (self.intervals + 1) * (1 + self.varying)


@dataclass(frozen=True, eq=False)
class RodPhysics(Frozen):
    """What one rod has beyond the plain rod (uniform, straight, inextensible, weightless), normalised.

    Attributes
    ----------
    layout : Layout
    values : ndarray, shape (layout.size,)
        Weight of the rod w = mu g L / (EI/L^2), compliance c = EI / (L^2 EA), curvature kappa0 L and stiffness
        EI(s)/EI, as `Layout` orders them.
    """

    layout: Layout
    values: np.ndarray


@dataclass(frozen=True)
class _Here:
    """Properties of a rod at one point: weight, compliance, curvature and stiffness with their slopes in s."""

    weight: Any
    compliance: Any
    curvature: Any
    curvature_slope: Any
    stiffness: Any
    stiffness_slope: Any


def rod_ode(state: Any, here: _Here | None = None) -> Any:
    """Right-hand side of the planar Kirchhoff rod, paper eq. (1)-(4), in normalised units.

    With n the force that the far side of a cross-section applies to the near side, which at the tip is the force
    applied to the rod, a piece ds that weighs w ds is in balance if n' = -w. Stretch and curvature at rest enter as

        r' = (1 + c n.t) t,    theta' = m / f + kappa0,    m' = (1 + c n.t) (n_x sin(theta) - n_y cos(theta)).

    Parameters
    ----------
    state : casadi column, 7 entries
        x, y, theta, n_x, n_y, m, U: position, tangent angle, internal force (the force applied to
        the rod's tip), bending moment, elastic and potential energy stored so far.
    here : _Here, optional
        None: the plain rod of the paper. Otherwise the slopes have an eighth entry: what the changes of f and kappa0
        along the rod add to the invariant (see `multiple_shooting.invariant`).
    """
    theta, n_x, n_y, m = ca.vertsplit(state[2:6])
    cos, sin = ca.cos(theta), ca.sin(theta)
    if here is None:
        return ca.vertcat(cos, sin, m, 0, 0, n_x * sin - n_y * cos, m * m / 2)
    pull, bend = n_x * cos + n_y * sin, m / here.stiffness
    stretch = 1 + here.compliance * pull
    energy = m * bend / 2 + here.compliance * pull**2 / 2 - ca.dot(here.weight, state[:2])
    return ca.vertcat(
        stretch * cos,
        stretch * sin,
        bend + here.curvature,
        -here.weight,
        stretch * (n_x * sin - n_y * cos),
        energy,
        here.curvature_slope * m - here.stiffness_slope * bend**2 / 2,
    )


def unpacked(layout: Layout, physics: Any) -> tuple[Any, Any, Any, Any]:
    """Weight (2), compliance, curvature and stiffness at the knots (None where it does not vary), from one vector."""
    knots, compliance = layout.intervals + 1, physics[2] if layout.stretching else 0.0
    return physics[:2], compliance, physics[3 : 3 + knots], physics[3 + knots :] if layout.varying else None


def interpolated(values: Any, s: Any) -> Any:
    """Piecewise linear function of s in [0, 1] from its values at equally spaced knots."""
    last = values.numel() - 1
    if last == 0:
        return values[0]
    return sum(values[k] * ca.fmax(0, 1 - ca.fabs(s * last - k)) for k in range(last + 1))


@graph_cache()
def propagation(steps: int, scheme: str = "rk4", layout: Layout | None = None) -> Any:
    """Propagate a rod over an arc length.

    Parameters
    ----------
    steps : int
        Equal Runge-Kutta steps.
    scheme : {"rk4", "rk8"}
        Entry of `SCHEMES`.
    layout : Layout, optional
        None: the plain rod.

    Returns
    -------
    casadi.Function
        (z, h) -> end: z = [theta, n_x, n_y, m] (4) at the start, arc length h (1), and
        end = [dx, dy, theta, n_x, n_y, m, U] (7) with displacement and energy of this piece.
        With a layout (z, h, s, physics) -> end (8): the piece begins at s, and its weight's energy is counted from
        there. Within each step the properties are linear: exact if the knots are ends of steps.
    """
    z, h, s = ca.SX.sym("z", 4), ca.SX.sym("h"), ca.SX.sym("s")
    physics = ca.SX.sym("physics", layout.size if layout else 0)
    start = ca.vertcat(0, 0, z, 0) if layout is None else ca.vertcat(0, 0, z, 0, 0)
    state = runge_kutta(rod_ode, start, h, steps, scheme, layout, s, physics)
    return ca.Function("propagate", [z, h, s, physics] if layout else [z, h], [state])


def runge_kutta(
    slope: Callable[[Any, _Here | None], Any],
    state: Any,
    h: Any,
    steps: int,
    scheme: str,
    layout: Layout | None,
    s: Any,
    physics: Any,
) -> Any:
    """Integrate ``slope(state, here)`` over h in equal steps from s, with the properties of `propagation`'s rod."""
    a, b = _coefficients(scheme)
    step = h / steps
    for j in range(steps):
        along = _along(layout, physics, s + j * step, step, a.sum(axis=1)) if layout else [None] * len(b)
        slopes: list[Any] = []
        for row, here in zip(a, along, strict=True):
            increment = sum((w * k for w, k in zip(row, slopes, strict=False) if w), ca.SX(state.numel(), 1))
            slopes.append(slope(state + step * increment, here))
        state = state + step * sum(w * k for w, k in zip(b, slopes, strict=True) if w)
    return state


def _coefficients(scheme: str) -> tuple[np.ndarray, np.ndarray]:
    """A and b; where a rod's properties change along s, c is the row sums of A."""
    if scheme == "rk4":
        return np.diag([0.5, 0.5, 1.0], -1), np.array([1.0, 2.0, 2.0, 1.0]) / 6.0
    from scipy.integrate import DOP853  # with half of SciPy, which takes a good part of a second to import

    return np.asarray(DOP853.A), np.asarray(DOP853.B)


def _along(layout: Layout, physics: Any, s: Any, step: Any, nodes: np.ndarray) -> list[_Here]:
    """Properties at the stages of a Runge-Kutta step that begins at s."""
    weight, compliance, curvature, stiffness = unpacked(layout, physics)
    pairs = []
    for values in (curvature, stiffness):
        if values is None:
            pairs.append((ca.SX(1), ca.SX(0)))
        else:
            start = interpolated(values, s)
            pairs.append((start, interpolated(values, s + step) - start))
    (kappa, d_kappa), (f, d_f) = pairs
    return [_Here(weight, compliance, kappa + c * d_kappa, d_kappa / step, f + c * d_f, d_f / step) for c in nodes]


@graph_cache()
def _sampler(n_points: int, steps: int, layout: Layout | None) -> Any:
    return propagation(steps, "rk8", layout).map(n_points)


def sample_rod(nodes: np.ndarray, n_points: int, physics: RodPhysics | None = None) -> np.ndarray:
    """States of one rod at evenly spaced arc lengths from base to tip.

    Parameters
    ----------
    nodes : ndarray, shape (4, N)
        [theta, n_x, n_y, m] at s = 0, 1/N, ..., (N-1)/N, normalised.
    n_points : int
        Number of samples, both ends included.
    physics : RodPhysics, optional
        None: a plain rod.

    Returns
    -------
    ndarray, shape (6, n_points)
        x, y (relative to the base), theta, n_x, n_y, m; normalised.
    """
    n_nodes = nodes.shape[1]
    steps = max(4, 32 // n_nodes)
    s = np.linspace(0.0, 1.0, n_points)
    piece = np.minimum((s * n_nodes).astype(int), n_nodes - 1)
    layout: Layout | None = None
    whole_extra: tuple[np.ndarray, ...] = ()
    end_extra: tuple[np.ndarray, ...] = ()
    if physics is not None:
        layout = physics.layout
        steps = aligned_steps(layout, n_nodes, steps)
        at, column = np.arange(n_nodes)[None, :] / n_nodes, physics.values[:, None]
        whole_extra = at, np.repeat(column, n_nodes, axis=1)
        end_extra = at[:, piece], np.repeat(column, n_points, axis=1)
    whole = _sampler(n_nodes, steps, layout)(nodes, np.full((1, n_nodes), 1.0 / n_nodes), *whole_extra).full()
    starts = np.concatenate([np.zeros((2, 1)), np.cumsum(whole[:2], axis=1)], axis=1)
    lengths = (s - piece / n_nodes)[None, :]
    ends = _sampler(n_points, steps, layout)(nodes[:, piece], lengths, *end_extra).full()
    ends[:2] += starts[:, piece]
    return np.asarray(ends[:6])


def aligned_steps(layout: Layout | None, segments: int, steps: int) -> int:
    """Least number of steps per segment, at least ``steps``, whose ends include all knots of the rods' properties."""
    if layout is None:
        return steps
    intervals = max(1, layout.intervals)
    multiple = intervals // math.gcd(intervals, segments)
    return multiple * math.ceil(steps / multiple)
