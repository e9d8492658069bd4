"""A QP solved without a solver."""

from itertools import product

import numpy as np


def packed(hessian):
    """Upper triangle, column by column."""
    return np.concatenate([hessian[: j + 1, j] for j in range(len(hessian))])


def by_enumeration(hessian, q, a, lower, upper):
    """Solve the conditions of Karush, Kuhn and Tucker for every set of active rows; the one that fits."""
    for sides in product((-1, 0, 1), repeat=len(a)):
        sides = np.array(sides)
        rows = np.flatnonzero(sides)
        if len(rows) > len(q):
            continue
        active, n = a[rows], len(q)
        kkt = np.block([[hessian, active.T], [active, np.zeros((len(rows), len(rows)))]])
        try:
            z = np.linalg.solve(kkt, np.concatenate([-q, np.where(sides > 0, upper, lower)[rows]]))
        except np.linalg.LinAlgError:
            continue
        value = a @ z[:n]
        signed = (z[n:] * sides[rows] >= 0) | (lower == upper)[rows]
        if signed.all() and (value <= upper + 1e-9).all() and (value >= lower - 1e-9).all():
            y = np.zeros(len(a))
            y[rows] = z[n:]
            return z[:n], y
    raise AssertionError("no active set fits")
