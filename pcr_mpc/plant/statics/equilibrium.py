"""The solved state of the rods, and everything that follows from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ...frozen import Frozen, read_only
from ..robot import Robot
from ..rods.equations import RodPhysics, sample_rod
from ..rods.method import TO_NODES, enough_nodes
from ..rods.physics import robot_physics
from ..rods.strain import largest_moment, largest_strain, strain_along
from .state import Columns, columns


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

    Notes
    -----
    One that a `RodSolver` made keeps the record of its rods, from which torques, energy and nodes are computed when
    somebody asks for them, and from which a solver goes on when it is given as a guess.
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

    @classmethod
    def of_record(cls, pose: np.ndarray, record: np.ndarray, result: np.ndarray, others: dict[str, Any]) -> Equilibrium:
        """Make one of what a solver has, at a tenth of the constructor's cost.

        Parameters
        ----------
        pose : ndarray, shape (2 + n,)
            p and q.
        record, result : ndarray
            See `warm_calls`. They and the pose are kept, and made read-only.
        others : dict
            robot, method, residual_norm, iterations, rung, drift and unstable_rods; it is kept.
        """
        for array in (pose, record, result):
            array.setflags(write=False)
        others["p"], others["q"], others["force"] = pose[:2], pose[2:], result[:2]
        others["_record"], others["_result"] = record, result
        eq = object.__new__(cls)
        object.__setattr__(eq, "__dict__", others)
        return eq

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Compute from the record what nobody asked for before."""
            record = self.record
            if record is None:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            if name in _FROM_RESULT:
                value = _FROM_RESULT[name](self.__dict__["_result"])
            elif name in _FROM_RECORD:
                value = _FROM_RECORD[name](self, columns(record, self.robot.n_rods))
            else:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            self.__dict__[name] = read_only(value) if isinstance(value, np.ndarray) else value
            return value

    @property
    def record(self) -> np.ndarray | None:
        """What its solver remembered of the rods (see `warm_calls`); None where it came about in another way."""
        return self.__dict__.get("_record")

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
        if self.record is not None and self.method == "closed_form":
            hands = columns(self.record, self.robot.n_rods).unknowns[2]
            return "".join("R" if hand > 0 else "L" for hand in hands.tolist())
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
        _require_points(n_points)
        return np.stack(
            [
                rod.base + rod.length * sample_rod(nodes, n_points, physics)[:2].T
                for rod, nodes, physics in zip(self.robot.rods, self.nodes, self.physics, strict=True)
            ]
        )

    def strain(self, n_points: int = 50) -> np.ndarray:
        """Strain of the outermost fibres from base to tip, shape (n, n_points) [-]; NaN where no thickness is known.

        It is ``|kappa - kappa0|`` times half the thickness, and the stretch of a rod that does.
        """
        _require_points(n_points)
        rods = zip(self.robot.rods, self.nodes, self.physics, strict=True)
        return np.stack([strain_along(*rod, n_points) for rod in rods])

    @cached_property
    def max_strain(self) -> np.ndarray:
        """Largest strain of each rod, shape (n,) [-], exact for plain rods; NaN where no thickness is known."""
        found = np.full(self.robot.n_rods, np.nan)
        for i, (rod, physics) in enumerate(zip(self.robot.rods, self.physics, strict=True)):
            if rod.thickness_ratio is None:
                continue
            if physics is None:
                unit = rod.bending_stiffness / rod.length**2
                n_x, n_y = (self.rod_forces[i] / unit).tolist()
                m = float(self.motor_torque[i]) / (unit * rod.length)
                found[i] = rod.thickness_ratio * float(largest_moment(float(self.q[i]), n_x, n_y, -m))
            else:
                found[i] = largest_strain(rod, self.nodes[i], physics)[1]
        return read_only(found)

    @property
    def overstrained(self) -> tuple[int, ...]:
        """Rods strained beyond what their material bears."""
        return tuple(np.flatnonzero(self.max_strain > self.robot.strain_limits).tolist())


def _require_points(n_points: int) -> None:
    if n_points < 2:
        raise ValueError(f"n_points is {n_points}, expected at least 2")


def moment_units(robot: Robot) -> np.ndarray:
    """EI/L of each rod [N m]."""
    return np.asarray(robot.stiffnesses / robot.lengths)


def _nodes(eq: Equilibrium, rods: Columns) -> np.ndarray:
    count = enough_nodes(rods.loads, 8)
    return np.stack([TO_NODES[eq.method](u, q, count) for u, q in zip(rods.unknowns.T, eq.q, strict=True)])


_FROM_RESULT: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "dforce_dp": lambda result: result[2:6].reshape(2, 2, order="F"),
    "dforce_dq": lambda result: result[6:].reshape(2, -1, order="F"),
}
_FROM_RECORD: dict[str, Callable[[Equilibrium, Columns], Any]] = {
    # The motor turns the rod's base against its internal moment.
    "motor_torque": lambda eq, rods: -moment_units(eq.robot) * rods.loads[2],
    "dtorque_dq": lambda eq, rods: -moment_units(eq.robot) * rods.load_tangents[2, 2::3],
    "energy": lambda eq, rods: float(rods.scalars[2] @ moment_units(eq.robot)),
    "rod_forces": lambda eq, rods: (rods.loads[:2] * (eq.robot.stiffnesses / eq.robot.lengths**2)).T,
    "nodes": _nodes,
}
