"""Shapes of nearly straight rods in closed form: where their cold start begins, for no table resolves them.

A rod is clamped phi away from its chord, the slack is s = 1 - chord / L, and all is in units of L and EI.

*Taut.* The pendulum of `chart` is on its separatrix. With a = 4 sin(delta/4)^2 and b = 2 sin(delta/2) at the clamp, the
tip lies 1 - a / lambda along the force and b / lambda across it, so that with rho = 1 - (1 - s)^2

    rho lambda^2 - 2 a lambda + 4 a = 0,    delta = phi + atan2(b, lambda - a),
    tan(tip_angle/4) cosh(lambda) = tan(delta/4),

and what is left out is of the order of exp(-lambda).

*Slender.* All angles are small: a beam under the axial force mu and the force v across it, for which

    phi = v D(mu),      D = (cosh(lambda) - sinh(lambda) / lambda) / mu,
    s = v^2 T(mu),      T = (1/4 + sinh(2 lambda) / (8 lambda) - (sinh(lambda) / lambda)^2 / 2) / mu^2

with lambda = sqrt(mu), power series in mu that hold for pulled and for pushed rods alike. What is left out is of the
order of phi^2 and s.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

_LEAST_TAUT = 8.0  # lambda from which a rod counts as taut: the first guess is good to exp(-8)
_LARGEST_TIP_ANGLE = -3.0  # its logarithm, up to which the pendulum is on its separatrix
_MOST_SLACK = 0.03  # of a rod that counts as slender
_SWEEPS = 60  # of the fixed point for delta; each gains a factor of lambda or so
# Axial forces of slender rods: that with which a clamp along the chord buckles, tan(lambda) = lambda, and the range of
# stable shapes that are not taut.
_BUCKLING, _PUSHED, _PULLED = -20.190729, -36.21, 70.0
_TERMS = 45  # of the power series


def nearly_straight(xi: float, eta: float) -> list[tuple[int, float, float]]:
    """Hand, log(tip_angle) and lambda of nearly straight shapes of a rod clamped along +x with its tip at (xi, eta)."""
    slack, phi = 1.0 - math.hypot(xi, eta), math.atan2(eta, xi)
    if slack <= 0:
        return []
    found = [_taut(hand, hand * phi % (2 * math.pi), slack) for hand in (1, -1)]
    if slack < _MOST_SLACK:
        near = 1 if phi >= 0 else -1
        found += [_slender(near, abs(phi), slack), _slender(-near, -abs(phi), slack)]
    return [shape for shape in found if shape is not None]


def _taut(hand: int, phi: float, slack: float) -> tuple[int, float, float] | None:
    rho, delta, load = slack * (2.0 - slack), phi, 0.0
    for _ in range(_SWEEPS):
        a = 4.0 * math.sin(delta / 4.0) ** 2
        if a < 4.0 * rho:
            return None
        load = a * (1.0 + math.sqrt(1.0 - 4.0 * rho / a)) / rho
        before, delta = delta, phi + math.atan2(2.0 * math.sin(delta / 2.0), load - a)
        if abs(delta - before) < 1e-15 * delta:
            break
    if load < _LEAST_TAUT or not delta < 2 * math.pi:
        return None
    log_tip_angle = math.log(8.0 * math.tan(delta / 4.0)) - load
    return (hand, log_tip_angle, load) if log_tip_angle < _LARGEST_TIP_ANGLE else None


def _slender(hand: int, phi: float, slack: float) -> tuple[int, float, float] | None:
    mu, slope, energy = _beams()
    wanted = phi / math.sqrt(slack)
    steepness = slope / np.sqrt(energy)
    # Both branches are monotone; they meet where the rod buckles.
    side = mu >= _BUCKLING if phi >= 0 else mu <= _BUCKLING
    if not steepness[side][0] <= wanted <= steepness[side][-1]:
        return None
    along = float(np.interp(wanted, steepness[side], mu[side]))
    across = math.sqrt(slack / float(np.interp(along, mu, energy)))
    return hand, math.log(math.atan2(across, along)), math.sqrt(math.hypot(along, across))


@lru_cache
def _beams() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axial forces mu, ascending, and D and T there."""
    mu = np.concatenate([np.linspace(_PUSHED, _BUCKLING, 200)[:-1], np.linspace(_BUCKLING, _PULLED, 1000)])
    slope, energy = np.zeros_like(mu), np.zeros_like(mu)
    for k in range(_TERMS - 1, -1, -1):
        slope = slope * mu + 1.0 / math.factorial(2 * k + 2) - 1.0 / math.factorial(2 * k + 3)
        energy = energy * mu + 4.0 ** (k + 1) * (1.0 / math.factorial(2 * k + 5) - 4.0 / math.factorial(2 * k + 6))
    return mu, slope, energy
