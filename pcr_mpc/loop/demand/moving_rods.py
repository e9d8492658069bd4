"""What rods with inertia take of the forces that move the tip, along a reference."""

from __future__ import annotations

import math

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from ... import interrupt
from ...plant.motion.mass_matrix import CondensedMass
from ...plant.motion.plant import Plant
from ...plant.rods.method import closed_form_method
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.many_poses.equilibria import Equilibria

_SHARE = 0.7  # of the force by which motors turn the tip, that the rods' mass may take at the fastest turns
_LOOKED_AT = 200  # poses at most
_POWERS = 5  # of the polynomials whose slopes are derivatives


class MovingRods:
    """Momentum of tip and rods at the times of a reference, and its derivatives.

    Turns dq of the motors change what the rods carry by G dq, and their mass gives the tip M_pq dq''. Where
    1 - l w^2 = 0 for a positive eigenvalue l of M_pq G^+, the motors turn at w without any force on the tip: no
    reference says how much. On the default robot that is from 430 rad/s on, with the softest wires that `draft` offers
    from 100 rad/s on, a few times the frequency of a rod alone, where a rod does not keep its static shape anyway. So
    derivatives are slopes of polynomials of the fourth degree, fitted to as many periods as leave at most 0.7 of l w^2
    at any w; with light rods or long periods that is one before and one after, differences of second order.

    Parameters
    ----------
    poses : Equilibria
        Along the reference, of K periods, for rods without inertia.
    pose : Equilibrium
        At the start.
    inertia : {"constant", "condensed"}
        Of the rods (see `Plant`).
    period : float
        [s].

    Attributes
    ----------
    width : float
        From a time to the farthest one that its derivative is made from [s].
    """

    def __init__(self, poses: Equilibria, pose: Equilibrium, inertia: str, period: float) -> None:
        self._pose, self._inertia = pose, inertia
        some = poses.rows(np.unique(np.linspace(0, len(poses.q) - 1, _LOOKED_AT).astype(int)))
        mass, _ = _masses(some, pose, inertia)
        alone = float(np.linalg.eigvals(mass[:, :2, 2:] @ np.linalg.pinv(some.dforce_dq)).real.max())
        fastest = math.sqrt(_SHARE / alone) if alone > 0.0 else math.inf
        self._slopes, periods = _derivative(len(poses.q), period, fastest)
        self.width = periods * period

    def forces(
        self, poses: Equilibria, v: np.ndarray, before: np.ndarray, others: np.ndarray, carried: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Forces that the rods are to carry next, and M_pp^-1 pi with what is carried, both (K, 2) [N], [m/s].

        Parameters
        ----------
        poses : Equilibria
            That carry the forces ``before``.
        v : ndarray, shape (K, 2)
            Of the tip [m/s].
        before, others : ndarray, shape (K, 2)
            The latter have nothing to do with the rods [N].
        carried : ndarray, shape (K,)
            By the tip [kg].
        """
        mass, momentum, push = _momentum(poses, self._pose, self._inertia, v, self._slopes @ poses.q)
        loaded = mass[:, :2, :2] + carried[:, None, None] * np.eye(2)
        own = np.linalg.solve(loaded, (momentum + carried[:, None] * v)[:, :, None])[:, :, 0]
        wanted = others + push - self._slopes @ momentum
        # The turn that makes up for what is missing moves the rods' mass, too.
        return wanted - self._moved_by(wanted - before, poses, mass[:, :2, 2:]), own

    def _moved_by(self, missing: np.ndarray, poses: Equilibria, coupling: np.ndarray) -> np.ndarray:
        """What the rods' mass takes, (K, 2) [N], where the motors turn to make up for forces that are missing.

        With turns dq = G^+ f by forces f that the rods carry, f + d/dt(M_pq d/dt dq) is missing.
        """
        levers = np.linalg.pinv(poses.dforce_dq)
        twice = sparse.csr_array(sparse.kron(self._slopes, np.eye(2)))
        turned = sparse.block_diag(list(coupling)) @ sparse.kron(self._slopes, np.eye(coupling.shape[2]))
        taken = twice @ turned @ sparse.block_diag(list(levers))
        carried = splu(sparse.csc_array(sparse.eye_array(missing.size) + taken)).solve(missing.ravel())
        return np.asarray(missing.ravel() - carried).reshape(missing.shape)


def _derivative(count: int, period: float, fastest: float) -> tuple[sparse.csr_array, int]:
    """Derivatives by time of what is known in ``count`` periods, as a matrix, and from how many on each side.

    It multiplies no vibration by more than ``fastest`` [rad/s], if there are periods enough.
    """
    waves = np.linspace(0.0, math.pi, 200)[:, None]  # rad in a period
    for width in range(1, max(2, (count + 1) // 2)):
        steps = np.arange(min(2 * width + 1, count)) - width
        powers = np.arange(min(_POWERS, len(steps)))
        fit = np.linalg.pinv((1.0 * steps[:, None]) ** powers)
        if np.abs(np.sin(waves * steps) @ fit[1]).max() <= fastest * period:
            break
    weights = (powers[1:] * steps[:, None] ** (powers[1:] - 1)) @ fit[1:] / period  # for the slope at each of the steps
    first = np.clip(np.arange(count) - width, 0, count - len(steps))
    columns = first[:, None] + np.arange(len(steps))
    rows = np.broadcast_to(np.arange(count)[:, None], columns.shape)
    matrix = sparse.csr_array(
        (weights[np.arange(count) - first].ravel(), (rows.ravel(), columns.ravel())), shape=(count, count)
    )
    return matrix, width


def _momentum(
    poses: Equilibria, pose: Equilibrium, inertia: str, v: np.ndarray, rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass matrices, and momentum of tip and rods [N s] and dT/dp [N] at K poses, (K, 2) each."""
    mass, slopes = _masses(poses, pose, inertia)
    w, size = np.concatenate([v, rates], axis=1), mass.shape[1]
    by_tip = slopes[:, :, :2].reshape(-1, size, size, 2)  # M is symmetric: rows and columns are one
    return mass, np.einsum("kij,kj->ki", mass[:, :2], w), np.einsum("ki,kijp,kj->kp", w, by_tip, w) / 2


def _masses(poses: Equilibria, pose: Equilibrium, inertia: str) -> tuple[np.ndarray, np.ndarray]:
    """Mass matrices of tip and rods at each pose and their slopes, as `Plant.mass` has them."""
    found = []
    if inertia == "condensed" and poses.method == "closed_form":
        condensed = CondensedMass(poses.robot, closed_form_method())
        for unknowns, q in zip(poses.unknowns, poses.q, strict=True):
            interrupt.check()
            found.append(condensed(unknowns.T, q))
    else:
        plant = Plant(poses.robot, inertia=inertia)
        plant.reset(np.concatenate([poses.p[0], np.zeros(2), poses.q[0]]), pose)
        for p, q in zip(poses.p, poses.q, strict=True):
            interrupt.check()
            found.append(plant.mass(p, q))
    return np.stack([mass for mass, _ in found]), np.stack([slopes for _, slopes in found])
