"""Many solved states of the rods, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ....frozen import Frozen
from ...robot import Robot
from ...rods.method import TO_NODES, enough_nodes
from ..equilibrium import Equilibrium
from ..state import columns

_COMMON = (
    "p", "q", "force", "dforce_dp", "dforce_dq", "motor_torque", "dtorque_dq", "energy", "rod_forces", "residual_norm",
    "drift",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Equilibria(Frozen):
    """Static equilibria at R poses, as in `Equilibrium`; a pose that was not solved is a row of NaN with its reason.

    Attributes
    ----------
    robot : Robot
    p : ndarray, shape (R, 2)
        Tip positions [m].
    q : ndarray, shape (R, n)
        Motor angles [rad].
    method : str
    force : ndarray, shape (R, 2)
        F = dU/dp [N].
    dforce_dp : ndarray, shape (R, 2, 2)
        K [N/m].
    dforce_dq : ndarray, shape (R, 2, n)
        G [N/rad].
    motor_torque : ndarray, shape (R, n)
        tau = dU/dq [N m].
    dtorque_dq : ndarray, shape (R, n)
        Diagonal of d2U/dq2 [N m/rad].
    energy : ndarray, shape (R,)
        U [J].
    rod_forces : ndarray, shape (R, n, 2)
        Applied to the tip of each rod [N].
    residual_norm : ndarray, shape (R,)
        Of the rods (dimensionless).
    drift : ndarray, shape (R,)
        Change of the invariant along the rods, over its size.
    unstable : ndarray of bool, shape (R, n)
        Rods with a conjugate point.
    reason : tuple of str, length R
        Why a pose was not solved; empty where it was.
    unknowns : ndarray, shape (R, n, u)
        Of the method, from which `nodes` are made.
    records : ndarray, shape (R, r)
        What a solver needs to go on from each (see `RobotState`); NaN where it has none.
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
    energy: np.ndarray
    rod_forces: np.ndarray
    residual_norm: np.ndarray
    drift: np.ndarray
    unstable: np.ndarray
    reason: tuple[str, ...]
    unknowns: np.ndarray
    records: np.ndarray

    @property
    def solved(self) -> np.ndarray:
        """Which poses were solved, shape (R,)."""
        return np.array([not words for words in self.reason], dtype=bool)

    @property
    def stable(self) -> np.ndarray:
        """Which poses are stable with their motors held, shape (R,): every rod with its tip held, and K > 0."""
        (a, b), (c, d) = np.moveaxis(self.dforce_dp, 0, -1)
        # The lesser eigenvalue of a symmetric matrix; NaN is not stable.
        least = (a + d) / 2 - np.hypot((a - d) / 2, (b + c) / 2)
        return np.asarray(~self.unstable.any(axis=1) & (least > 0))

    def rows(self, which: np.ndarray) -> Equilibria:
        """Return some of the poses, by their indices; one may come more than once."""
        arrays = {name: value[which] for name, value in self.__dict__.items() if isinstance(value, np.ndarray)}
        return replace(self, reason=tuple(self.reason[row] for row in which), **arrays)

    def nodes(self, row: int) -> np.ndarray:
        """Nodes of the rods at one pose, shape (n, 4, N), as `Equilibrium.nodes`: also a guess for `solve_statics`.

        Raises
        ------
        ValueError
            The pose was not solved.
        """
        if self.reason[row]:
            raise ValueError(f"row {row} was not solved and has no nodes: {self.reason[row]}")
        loads = self.rod_forces[row].T / (self.robot.stiffnesses / self.robot.lengths**2)
        count, to_nodes = enough_nodes(loads, 8), TO_NODES[self.method]
        return np.stack([to_nodes(u, q, count) for u, q in zip(self.unknowns[row], self.q[row], strict=True)])


def together(poses: Sequence[Equilibrium]) -> Equilibria:
    """Poses of one robot that were solved one by one by the same method; each has its record."""
    robot = poses[0].robot
    arrays = {name: np.stack([getattr(eq, name) for eq in poses]) for name in _COMMON}
    records = np.stack([eq.record for eq in poses if eq.record is not None])
    return Equilibria(
        robot,
        method=poses[0].method,
        unstable=np.array([[rod in eq.unstable_rods for rod in range(robot.n_rods)] for eq in poses]),
        reason=("",) * len(poses),
        unknowns=np.stack([columns(record, robot.n_rods).unknowns.T for record in records]),
        records=records,
        **arrays,
    )
