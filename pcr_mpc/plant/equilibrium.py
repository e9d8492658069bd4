"""The solved state of the rods, and everything that follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..frozen import Frozen, read_only
from .robot import Robot
from .rod import RodPhysics, sample_rod
from .rod_physics import robot_physics


@dataclass(frozen=True, eq=False)
class Equilibrium(Frozen):
    """Static equilibrium of the rods for a held tip: it exists only if the solve converged.

    With U(p, q) the elastic energy and, if the rods have weight, its potential, force = dU/dp is what holds the joint
    and motor_torque = dU/dq is what the motors supply. The tip's own weight is an external force, and no part of U.

    Attributes
    ----------
    robot : Robot
    p : ndarray, shape (2,)
        Tip position [m].
    q : ndarray, shape (n,)
        Motor angles [rad].
    method : str
        How it was solved.
    force : ndarray, shape (2,)
        F = dU/dp, held against the rods [N].
    dforce_dp : ndarray, shape (2, 2)
        K = d2U/dp2 [N/m].
    dforce_dq : ndarray, shape (2, n)
        G = d2U/dpdq [N/rad]; dtau/dp is its transpose.
    motor_torque : ndarray, shape (n,)
        tau = dU/dq [N m].
    dtorque_dq : ndarray, shape (n,)
        Diagonal of d2U/dq2 [N m/rad]; rods do not couple at a held tip.
    energy : float
        U [J]; each rod's weight has its potential zero at its motor.
    rod_forces : ndarray, shape (n, 2)
        n_i, force applied to the tip of each rod [N].
    nodes : ndarray, shape (n, 4, N)
        [theta, n_x, n_y, m] at s = j L/N of each rod, in units [rad, EI/L^2, EI/L^2, EI/L].
    residual_norm : float
        2-norm of the weighted residual (dimensionless).
    iterations : int
        Newton iterations of the slowest rod.
    rung : str
        Of the solver's ladder: "warm", "newton", "continuation", "snap" or "cold" (see `RodSolver`).
    drift : float
        Change of the `invariant` along the rods, over its size: the discretisation's own error estimate.
    unstable_rods : tuple of int
        Rods with a conjugate point: not stable even with the tip held.
    """

    robot: Robot
    p: np.ndarray
    q: np.ndarray
    method: str
    force: np.ndarray
    dforce_dp: np.ndarray
    dforce_dq: np.ndarray
    motor_torque: np.ndarray
    dtorque_dq: np.ndarray
    energy: float
    rod_forces: np.ndarray
    nodes: np.ndarray
    residual_norm: float
    iterations: int
    rung: str
    drift: float
    unstable_rods: tuple[int, ...]
    converged: bool = True

    @cached_property
    def stiffness_eigenvalues(self) -> np.ndarray:
        """Eigenvalues of K, ascending, shape (2,) [N/m]."""
        return read_only(np.linalg.eigvalsh((self.dforce_dp + self.dforce_dp.T) / 2))

    @property
    def stable(self) -> bool:
        """Whether the pose is stable with its motors held: every rod with its tip held, and K > 0."""
        return not self.unstable_rods and bool(self.stiffness_eigenvalues[0] > 0)

    @property
    def physics(self) -> tuple[RodPhysics | None, ...]:
        """What each rod has beyond the plain rod, if anything."""
        return robot_physics(self.robot) or (None,) * self.robot.n_rods

    @cached_property
    def mode(self) -> str:
        """Working mode: for each rod the side of its chord, seen from base to tip, to which it bows at its tip.

        One letter a rod, L(eft) or R(ight): the default robot with its rods bowed outward is "LR".
        """
        letters = []
        for nodes, physics in zip(self.nodes, self.physics, strict=True):
            _, _, theta, n_x, n_y, _ = sample_rod(nodes, 2, physics)[:, -1]
            # Near the moment-free tip the rod turns as -m'(L) = n_y cos(theta) - n_x sin(theta); a taut rod has
            # no turn left there, but keeps the sense of its last node.
            turn = (n_y * np.cos(theta) - n_x * np.sin(theta)) / np.hypot(n_x, n_y)
            letters.append("R" if (turn if abs(turn) > 1e-5 else nodes[3, -1]) > 0 else "L")
        return "".join(letters)

    def shape(self, n_points: int = 50) -> np.ndarray:
        """Centrelines from base to tip, shape (n, n_points, 2) [m]."""
        if n_points < 2:
            raise ValueError(f"n_points is {n_points}, expected at least 2")
        return np.stack(
            [
                rod.base + rod.length * sample_rod(nodes, n_points, physics)[:2].T
                for rod, nodes, physics in zip(self.robot.rods, self.nodes, self.physics, strict=True)
            ]
        )
