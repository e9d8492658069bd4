"""Motion along a path whose speed is unknown.

The path is P(x), x from 0 to 1, with three derivatives that vanish at both ends: P runs through the path at the pace of
a nominal motion from rest to rest. The motion that is looked for is faster than it by theta(x) = dx/dt, and
b = theta^2 is the unknown. It is finite and positive everywhere, at the ends too, where the tip rests whatever it is.

    v = P' theta,    a = P'' b + P' b'/2,    F = (m + payload) (g - a) - c v

F is the force that the rods are to carry. With q(x) the angles by which they do, q' and q'' follow from F', F'' and
F(P, q) = F by implicit differentiation, and

    dq/dt = theta q',    d2q/dt2 = b q'' + b' q'/2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .linear import Linear

ORDERS_OF_PACE = 4  # b to b'''


@dataclass(frozen=True, eq=False)
class Carrier:
    """What the tip is: mass with what it carries [kg], drag [N s/m], weight [N], shape (2,)."""

    mass: float
    drag: float
    weight: np.ndarray


@dataclass(frozen=True, eq=False)
class Motion:
    """Tip motion and forces at M points; derivatives of F are by x.

    Attributes
    ----------
    theta, pace, pace_slope : Linear, one component
        theta, b and b'.
    velocity, acceleration, jerk : Linear, two components
    force : tuple of Linear
        F, F', F''.
    path : tuple of ndarray, shape (M, 2)
        P, P', P''.
    """

    theta: Linear
    pace: Linear
    pace_slope: Linear
    velocity: Linear
    acceleration: Linear
    jerk: Linear
    force: tuple[Linear, Linear, Linear]
    path: tuple[np.ndarray, np.ndarray, np.ndarray]


def motion(pace: np.ndarray, path: np.ndarray, carrier: Carrier, *, slopes: bool) -> Motion:
    """Compute motion and forces.

    Parameters
    ----------
    pace : ndarray, shape (4, M)
        b and its derivatives.
    path : ndarray, shape (5, M, 2)
        P and its derivatives.
    carrier : Carrier
    slopes : bool
        Whether to know them, by b to b'''.
    """
    width = ORDERS_OF_PACE if slopes else 0
    b, b1, b2, b3 = (_unknown(values, order, width) for order, values in enumerate(pace))
    p1, p2, p3, p4 = (Linear(values, np.zeros((*values.shape, width))) for values in path[1:])
    theta = b.sqrt()
    theta1 = b1 / (2.0 * theta)
    theta2 = (b2 - 2.0 * (theta1 * theta1)) / (2.0 * theta)
    speed = (p1 * theta, p2 * theta + p1 * theta1, p3 * theta + 2.0 * (p2 * theta1) + p1 * theta2)
    acceleration = (
        p2 * b + 0.5 * (p1 * b1),
        p3 * b + 1.5 * (p2 * b1) + 0.5 * (p1 * b2),
        p4 * b + 2.5 * (p3 * b1) + 2.0 * (p2 * b2) + 0.5 * (p1 * b3),
    )
    f, f1, f2 = (-carrier.mass * a - carrier.drag * v for a, v in zip(acceleration, speed, strict=True))
    force = Linear(f.value + carrier.weight, f.slope), f1, f2
    return Motion(theta, b, b1, speed[0], acceleration[0], acceleration[1] * theta, force, (path[0], path[1], path[2]))


def _unknown(values: np.ndarray, place: int, width: int) -> Linear:
    slope = np.zeros((len(values), 1, width))
    if width:
        slope[:, 0, place] = 1.0
    return Linear(values[:, None], slope)
