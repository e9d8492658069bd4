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

ORDERS_OF_PACE, ORDERS_OF_PATH = 4, 5  # b to b''', P to P''''
BY_PACE, BY_PATH_TOO = ORDERS_OF_PACE, ORDERS_OF_PACE + 2 * ORDERS_OF_PATH


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
    path : tuple of Linear
        P, P', P''.
    """

    theta: Linear
    pace: Linear
    pace_slope: Linear
    velocity: Linear
    acceleration: Linear
    jerk: Linear
    force: tuple[Linear, Linear, Linear]
    path: tuple[Linear, Linear, Linear]


def motion(pace: np.ndarray, path: np.ndarray, carrier: Carrier, width: int) -> Motion:
    """Compute motion and forces.

    Parameters
    ----------
    pace : ndarray, shape (4, M)
        b and its derivatives.
    path : ndarray, shape (5, M, 2)
        P and its derivatives.
    carrier : Carrier
    width : int
        Of the slopes: 0 for none, BY_PACE by b to b''', BY_PATH_TOO then by x of P to P'''', then by y.
    """
    b, b1, b2, b3 = (_unknown(values[:, None], (order,), width) for order, values in enumerate(pace))
    first = ORDERS_OF_PACE
    p, p1, p2, p3, p4 = (
        _unknown(values, (first + order, first + ORDERS_OF_PATH + order), width) for order, values in enumerate(path)
    )
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
    return Motion(theta, b, b1, speed[0], acceleration[0], acceleration[1] * theta, force, (p, p1, p2))


def _unknown(values: np.ndarray, places: tuple[int, ...], width: int) -> Linear:
    slope = np.zeros((*values.shape, width))
    for component, place in enumerate(places):
        if place < width:
            slope[:, component, place] = 1.0
    return Linear(values, slope)
