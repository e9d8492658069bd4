"""The pendulum that a rod in closed form is: elliptic functions, and how they change with the tip angle."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ....buffered import graph_cache

# Ascending Landen steps: k' falls below 1e-16 from any k >= 1e-6.
_LANDEN_STEPS = 8
# Logarithm of the smallest k' of which powers are taken, and of the unit that then takes its place, over k'.
_SMALLEST, _SHIFT = -100.0, 60.0


def elliptic(
    u: Any, k: Any, k_prime: Any, steps: int = _LANDEN_STEPS, log_k_prime: Any = None
) -> tuple[Any, Any, Any, Any]:
    """Sn, cn, dn and D = k'^2 int nd^2 du by ascending Landen transformations, with a fixed number of operations.

    The modulus is driven to 1, where the functions are hyperbolic and D = 0, so that k' may be as small as it
    likes (DLMF 22.7.6-8; k and k' are both arguments, for neither may come from the other). With
    D = E(am u) - k^2 sn cd, DLMF 19.8.13 becomes a sum of positive terms: nothing cancels.

    With the logarithm of k' too, cn and dn are given in units of k' exp(_SHIFT) where k' is `beyond_numbers`, for there
    neither it nor they are floating-point numbers, and what is wanted are their ratios.
    """
    if log_k_prime is None:
        found: tuple[Any, Any, Any, Any] = _elliptic(steps, shifted=False)(u, k, k_prime)
    else:
        found = _elliptic(steps, shifted=True)(u, k, k_prime, log_k_prime)
    return found


@graph_cache()
def _elliptic(steps: int, *, shifted: bool) -> Any:
    """Graph of `elliptic`, which CasADi copies into others faster than Python writes it down again."""
    arguments = [ca.SX.sym(name) for name in ("u", "k", "k_prime", "log_k_prime")[: 4 if shifted else 3]]
    u, k, k_prime = arguments[:3]
    moduli, factor = [], ca.SX(1)
    for _ in range(steps):
        twice = 2 / (1 + k)  # divisions take long, and CasADi makes them of reciprocals
        moduli.append((k, k_prime, k_prime, twice))
        factor *= (1 + k) / 2
        k, k_prime = ca.sqrt(k) * twice, (k_prime / 2 * twice) ** 2
    u = u_shifted = u * factor
    if shifted:
        # As cosh(x) is exp(x)/2, cosh(u) k' exp(_SHIFT) is cosh of the sum, but near the tip, where all is straight.
        tiny = beyond_numbers(arguments[3])
        u_shifted = ca.if_else(tiny, ca.fmax(u + arguments[3] + _SHIFT, 0), u)
        moduli[0] = *moduli[0][:2], ca.if_else(tiny, math.exp(-_SHIFT), moduli[0][2]), moduli[0][3]
    sn, dn = ca.tanh(u), 1 / ca.cosh(u_shifted)
    cn, d = dn, ca.SX(0)
    for k, k_prime, in_its_unit, twice in reversed(moduli):
        up = (in_its_unit / 2 * twice) ** 2  # complementary modulus one step up
        ratio = up / dn
        sn, cn, dn = twice * sn * cn / dn, (1 + k) / (2 * k) * (dn - ratio), (1 + k) / 2 * (dn + ratio)
        d = (1 + k) * d + k_prime**2 / 2 * twice * u + k * sn * (1 - k * cn / dn)
        u = u * twice
    return ca.Function("elliptic", arguments, [sn, cn, dn, d])


def beyond_numbers(log_k_prime: Any) -> Any:
    """Whether k' is too small for its powers to be floating-point numbers, by its logarithm."""
    return log_k_prime < _SMALLEST


class Swing(NamedTuple):
    """The pendulum at u.

    Attributes
    ----------
    cos, sin : casadi.SX
        Of its angle delta.
    rate : casadi.SX
        delta' = d delta/du, which is also int sin(delta) du.
    c : casadi.SX
        int cos(delta) du.
    """

    cos: Any
    sin: Any
    rate: Any
    c: Any


def pendulum(log_tip_angle: Any, u: Any, *, any_pull: bool = False) -> tuple[Any, Any, Any]:
    """Angle delta, its rate d delta/du and int cos(delta) du at u.

    Right up to log(tip_angle) = -300, and beyond with ``any_pull``, which costs more.
    """
    found, (half_sin, half_cos) = swing(log_tip_angle, u, any_pull=any_pull)
    return 2 * ca.atan2(half_sin, half_cos), found.rate, found.c


def swing(log_tip_angle: Any, u: Any, *, any_pull: bool) -> tuple[Swing, tuple[Any, Any]]:
    """The pendulum, and sine and cosine of delta/2."""
    half, log_half = ca.exp(log_tip_angle) / 2, log_tip_angle - np.log(2.0)
    k, k_prime = ca.cos(half), ca.sin(half)
    sn, cn, dn, d = elliptic(u, k, k_prime, log_k_prime=log_half if any_pull else None)
    if any_pull:
        k_prime = ca.if_else(beyond_numbers(log_half), math.exp(-_SHIFT), k_prime)
    return _swing_of(u, k, k_prime, sn, cn, dn, d)


def _swing_of(u: Any, k: Any, k_prime: Any, sn: Any, cn: Any, dn: Any, d: Any) -> tuple[Swing, tuple[Any, Any]]:
    sin, cos = k_prime / dn, k * cn / dn
    # Half the angle has its sine and cosine already, and their squares no cancellation.
    return Swing((cos - sin) * (cos + sin), 2 * sin * cos, 2 * k * sn * sin, u - 2 * d), (sin, cos)


def swing_with_slopes(log_tip_angle: Any, u: Any) -> tuple[Swing, Any]:
    """The pendulum, and the derivatives (3, 2) of delta, delta' and int cos(delta) by log(tip_angle) and u.

    By u they are [delta', sin(delta), cos(delta)]. By the tip angle, d/dk of sn, cn and dn at a fixed u is
    (u - int nd^2)/k times d/du, and of dn there is also -k sn^2/dn (DLMF 22.13, 19.4); that of int cos(delta) follows
    by integrating by parts, with the derivative of the pendulum's energy, which is
    delta' (d delta'/d tip_angle) = sin(delta) (d delta/d tip_angle) - sin(tip_angle).
    """
    tip_angle = ca.exp(log_tip_angle)
    k, k_prime = ca.cos(tip_angle / 2), ca.sin(tip_angle / 2)
    sn, cn, dn, d = elliptic(u, k, k_prime)
    found, _ = _swing_of(u, k, k_prime, sn, cn, dn, d)
    sd, cd, rest = sn / dn, cn / dn, d - k_prime**2 * u  # rest = k'^2 int (nd^2 - 1)
    delta_by = cn + k**2 * (sn * sd) * cd + rest * sd
    # The order of the products keeps them within floating-point numbers on taut rods.
    rate_by = (k**2 - k_prime**2) * sd - (k * k_prime * sd) ** 2 * sd + rest * cd / dn
    c_by = -(found.rate * delta_by + u * (2 * k * k_prime)) / 2
    by_angle = tip_angle * ca.vertcat(delta_by, rate_by, c_by)
    return found, ca.horzcat(by_angle, ca.vertcat(found.rate, found.sin, found.cos))
