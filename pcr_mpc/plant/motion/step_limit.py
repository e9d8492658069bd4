"""The longest step with which an integrator stays stable, for the errors of those that did not."""

from __future__ import annotations

import math

import numpy as np

# Of RK4: the boundary of its stability is nowhere in the left half plane nearer to the origin.
_RK4 = 2.785


def longest_step(integrator: str, stiffness: np.ndarray, mass: np.ndarray, drag: float) -> tuple[float, float]:
    """Greatest stable dt [s] of an integrator on M p'' + c p' + K p = 0, and the fastest swing omega [rad/s].

    Parameters
    ----------
    stiffness, mass : ndarray, shape (2, 2)
        K [N/m] and M [kg]; directions in which K is not positive do not count.
    drag : float
        c [N s/m].

    Notes
    -----
    Of one direction, with g = c/m. Symplectic Euler, drag explicit: (omega dt)^2 + 2 g dt < 4. Velocity Verlet, drag
    implicit in its first half: omega dt < 2. RK4: |s| dt < 2.785 for both roots s of s^2 + g s + omega^2 = 0. "gauss"
    is stable at any step.
    """
    inverse = np.linalg.inv(np.linalg.cholesky(mass))
    omega = math.sqrt(max(float(np.linalg.eigvalsh(inverse @ stiffness @ inverse.T)[-1]), 0.0))
    g = drag / float(np.linalg.eigvalsh(mass)[0])
    if integrator == "semi_implicit_euler":
        limit, rate = 4.0, g + math.hypot(g, 2.0 * omega)
    elif integrator == "velocity_verlet":
        limit, rate = 2.0, omega
    elif integrator == "rk4":
        limit, rate = _RK4, omega if g <= 2.0 * omega else g / 2 + math.sqrt(g**2 / 4 - omega**2)
    else:
        limit, rate = 1.0, 0.0
    return (limit / rate if rate else math.inf), omega
