"""The rod equations and their propagation along the arc, as CasADi graphs.

A rod is written in normalised units throughout the solvers: lengths in L, forces in EI/L^2,
moments in EI/L, energies in EI/L. One graph then serves every rod, and residuals of different
kinds can be compared. Positions keep the orientation of the world frame.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import DOP853

# Explicit Runge-Kutta schemes as (A, b); the rod equation does not depend on s, so c is not needed.
SCHEMES: dict[str, tuple[np.ndarray, np.ndarray]] = {
    "rk4": (np.diag([0.5, 0.5, 1.0], -1), np.array([1.0, 2.0, 2.0, 1.0]) / 6.0),
    "rk8": (np.asarray(DOP853.A), np.asarray(DOP853.B)),  # Dormand and Prince, order 8, 12 stages
}


def rod_ode(state: Any) -> Any:
    """Right-hand side of the planar Kirchhoff rod, paper eq. (1)-(4), in normalised units.

    Parameters
    ----------
    state : casadi column, 7 entries
        x, y, theta, n_x, n_y, m, U: position, tangent angle, internal force (the force applied to
        the rod's tip), bending moment, elastic energy stored so far.
    """
    _, _, theta, n_x, n_y, m, _ = ca.vertsplit(state)
    cos, sin = ca.cos(theta), ca.sin(theta)
    return ca.vertcat(cos, sin, m, 0, 0, n_x * sin - n_y * cos, m * m / 2)


@lru_cache
def propagation(steps: int, scheme: str = "rk4") -> Any:
    """Propagate a rod over an arc length.

    Parameters
    ----------
    steps : int
        Equal Runge-Kutta steps.
    scheme : {"rk4", "rk8"}
        Entry of `SCHEMES`.

    Returns
    -------
    casadi.Function
        (z, h) -> end: z = [theta, n_x, n_y, m] (4) at the start, arc length h (1), and
        end = [dx, dy, theta, n_x, n_y, m, U] (7) with displacement and energy of this piece.
    """
    a, b = SCHEMES[scheme]
    z, h = ca.SX.sym("z", 4), ca.SX.sym("h")
    state = ca.vertcat(0, 0, z, 0)
    step = h / steps
    for _ in range(steps):
        slopes: list[Any] = []
        for row in a:
            increment = sum((w * k for w, k in zip(row, slopes, strict=False) if w), ca.SX(7, 1))
            slopes.append(rod_ode(state + step * increment))
        state = state + step * sum(w * k for w, k in zip(b, slopes, strict=True) if w)
    return ca.Function("propagate", [z, h], [state])


@lru_cache
def _sampler(n_points: int, steps: int) -> Any:
    return propagation(steps, "rk8").map(n_points)


def sample_rod(nodes: np.ndarray, n_points: int) -> np.ndarray:
    """States of one rod at evenly spaced arc lengths from base to tip.

    Parameters
    ----------
    nodes : ndarray, shape (4, N)
        [theta, n_x, n_y, m] at s = 0, 1/N, ..., (N-1)/N, normalised.
    n_points : int
        Number of samples, both ends included.

    Returns
    -------
    ndarray, shape (6, n_points)
        x, y (relative to the base), theta, n_x, n_y, m; normalised.
    """
    n_nodes = nodes.shape[1]
    steps = max(4, 32 // n_nodes)
    whole = _sampler(n_nodes, steps)(nodes, np.full((1, n_nodes), 1.0 / n_nodes)).full()
    starts = np.concatenate([np.zeros((2, 1)), np.cumsum(whole[:2], axis=1)], axis=1)
    s = np.linspace(0.0, 1.0, n_points)
    piece = np.minimum((s * n_nodes).astype(int), n_nodes - 1)
    ends = _sampler(n_points, steps)(nodes[:, piece], (s - piece / n_nodes)[None, :]).full()
    ends[:2] += starts[:, piece]
    return np.asarray(ends[:6])
