"""Single shooting, paper sec. 2: the baseline, solved by SciPy with exact derivatives."""

from __future__ import annotations

from collections import Counter
from typing import Any

import casadi as ca
import numpy as np

from ...buffered import BufferedFunction, graph_cache
from ...errors import ConvergenceError
from ..robot import Robot
from ..rods.closed_form.chart import held_shapes
from ..rods.equations import propagation
from ..rods.shooting.multiple_shooting import invariant, robot_residual, rod_newton
from .equilibrium import Equilibrium

_ACCEPTED_RESIDUAL = 1e-8
# Of the slack of the most stretched rod, which the residual must be far below: its force goes with 1/slack.
_ACCEPTED_FRACTION = 1e-4
_MAX_EVALUATIONS = 200  # of 320 poses solved, the slowest took 167


@graph_cache(maxsize=16)
def _residual_and_jacobians(robot: Robot, steps: int, scheme: str) -> Any:
    residual = robot_residual(robot, 1, steps, scheme)
    y, p, q = (ca.SX.sym(name, residual.size1_in(i)) for i, name in enumerate("Ypq"))
    r = residual(y, p, q)
    return ca.Function("single_shooting", [y, p, q], [r, ca.jacobian(r, y), ca.jacobian(r, ca.vertcat(p, q))])


@graph_cache(maxsize=16)
def _judge(steps: int, scheme: str) -> Any:
    """Energy and drift of the integration that was solved, and conjugate points on eight nodes along it."""
    base, pose = ca.MX.sym("base", 4), ca.MX.sym("pose", 3)
    nodes = [base]
    for _ in range(7):
        nodes.append(propagation(4, "rk8")(nodes[-1], 1.0 / 8.0)[2:6])
    newton, _ = rod_newton(8, 4, "rk8")
    conjugate_points = newton(ca.vertcat(*nodes), pose)[4][3]
    end = propagation(steps, scheme)(base, 1.0)
    drift = (invariant(end[2:6]) - invariant(base)) / (1 + ca.norm_2(base[1:3]) + base[3] ** 2 / 2)
    return ca.Function("judge", [base, pose], [ca.vertcat(end[6], conjugate_points, drift)])


class SingleShooting:
    """Eq. (5)-(6): the base loads of every rod and the joint force, 3n + 2 unknowns (8 for two rods).

    Same calls as `RodSolver`: it remembers the last pose as the next guess. It is the baseline: nothing keeps it
    from converging to another branch.

    Parameters
    ----------
    robot : Robot
    steps : int
        Runge-Kutta steps along the whole rod.
    scheme : {"rk4", "rk8"}
        Runge-Kutta scheme.
    """

    def __init__(self, robot: Robot, steps: int = 8, scheme: str = "rk8") -> None:
        self.robot = robot
        self._evaluate = BufferedFunction(_residual_and_jacobians(robot, steps, scheme))
        self._units = np.stack([robot.stiffnesses / robot.lengths**e for e in (2, 2, 1)], axis=1)
        self._judge = BufferedFunction(_judge(steps, scheme))
        self.snaps: list[Any] = []  # none is ever noticed
        self.rungs: Counter[str] = Counter()
        self._last: Equilibrium | None = None
        self._before: Equilibrium | None = None

    def start(self, p: np.ndarray, q: np.ndarray, nodes: np.ndarray | None = None) -> None:
        """Solve at (p, q) from the base states of ``nodes``, shape (n, 4, N), or cold (None)."""
        self._last = self._solve(p, q, np.stack(self._cold(p, q)) if nodes is None else nodes)

    def move(self, p: np.ndarray, q: np.ndarray, *, derivatives: float | None = None) -> None:
        """Solve at (p, q) from the last pose. The derivatives always belong to the solution."""
        last = self._solution()
        self._last, self._before = self._solve(p, q, last.nodes), last

    def go_back(self) -> None:
        """Undo the last `move`."""
        self._last, self._before = self._before, self._last

    def force(self) -> np.ndarray:
        """F at the last pose, shape (2,) [N]."""
        return self._solution().force

    def jacobians(self) -> tuple[np.ndarray, np.ndarray]:
        """K (2, 2) [N/m] and G (2, n) [N/rad] at the last pose."""
        eq = self._solution()
        return eq.dforce_dp, eq.dforce_dq

    def unstable_rods(self) -> tuple[int, ...]:
        """Rods with a conjugate point at the last pose."""
        return self._solution().unstable_rods

    def drift(self) -> float:
        """Largest change of the invariant m^2/2 + n . t along a rod, over its size."""
        return self._solution().drift

    def equilibrium(self, p: np.ndarray, q: np.ndarray) -> Equilibrium:
        """Everything about the last pose, which was solved at (p, q)."""
        return self._solution()

    def _solution(self) -> Equilibrium:
        if self._last is None:
            raise RuntimeError("no pose to start from: call start (or Plant.reset) first")
        return self._last

    def _cold(self, p: np.ndarray, q: np.ndarray) -> list[np.ndarray]:
        nodes = []
        for rod, angle in zip(self.robot.rods, q, strict=True):
            x, y = (p - rod.base) / rod.length
            cos, sin = np.cos(angle), np.sin(angle)
            xi, eta = cos * x + sin * y, cos * y - sin * x
            coarse = held_shapes(xi, eta)[0]
            nodes.append((coarse.polished(xi, eta) or coarse).nodes(1, angle))
        return nodes

    def _solve(self, p: np.ndarray, q: np.ndarray, nodes: np.ndarray) -> Equilibrium:
        n, evaluate, units = self.robot.n_rods, self._evaluate, self._units
        evaluate.inputs[1][:], evaluate.inputs[2][:] = p, q
        loads = nodes[:, 1:, 0] * units
        guess = np.concatenate([loads.ravel(), loads[:, :2].sum(axis=0)])
        scale = np.concatenate([units.ravel(), np.full(2, units[:, 0].mean())])

        def residual(y: np.ndarray) -> np.ndarray:
            evaluate.inputs[0][:] = y
            evaluate()
            return evaluate.outputs[0].copy()

        def jacobian(y: np.ndarray) -> np.ndarray:
            residual(y)
            return evaluate.outputs[1].copy()

        from scipy.optimize import least_squares  # slow to import, and of no use to the other methods

        # An overflow on the way is a bad trial point, which the solver rejects; the verdict is below.
        with np.errstate(all="ignore"):
            try:
                fit = least_squares(
                    residual, guess, jacobian, method="lm", x_scale=scale, xtol=1e-15, ftol=1e-15, gtol=1e-15,
                    max_nfev=_MAX_EVALUATIONS,
                )  # fmt: skip
                y, evaluations = fit.x, int(fit.nfev)
            except ValueError:  # SciPy's word for a non-finite residual
                y, evaluations = guess, 1
            norm = float(np.linalg.norm(residual(y)))
        if not norm <= min(_ACCEPTED_RESIDUAL, _ACCEPTED_FRACTION * min(self.robot.slacks(p))):
            raise ConvergenceError(
                f"single shooting at p = {p} m, q = {q} rad stopped with residual {norm:.2e} after {evaluations} "
                "evaluations; pass a closer guess or use method='multiple_shooting'",
                residual=norm,
                iterations=evaluations,
                last=y,
            )
        self.rungs["newton"] += 1
        # Implicit function theorem: dY/d(p, q) = -(dR/dY)^-1 dR/d(p, q), one factorisation for all columns.
        sensitivity = -np.linalg.solve(evaluate.outputs[1], evaluate.outputs[2])
        base_loads = y[:-2].reshape(n, 3)
        solved = np.concatenate([q[:, None], base_loads / units], axis=1)[:, :, None]
        scalars = np.empty((n, 3))
        for i, rod in enumerate(self.robot.rods):
            self._judge.inputs[0][:] = solved[i, :, 0]
            self._judge.inputs[1][:] = *((p - rod.base) / rod.length), q[i]
            self._judge()
            scalars[i] = self._judge.outputs[0]
        return Equilibrium(
            robot=self.robot,
            p=p.copy(),
            q=q.copy(),
            method="single_shooting",
            force=y[-2:].copy(),
            dforce_dp=sensitivity[-2:, :2].copy(),
            dforce_dq=sensitivity[-2:, 2:].copy(),
            motor_torque=-base_loads[:, 2],
            dtorque_dq=-np.diagonal(sensitivity[2:-2:3, 2:]).copy(),
            energy=float((self.robot.stiffnesses / self.robot.lengths) @ scalars[:, 0]),
            rod_forces=base_loads[:, :2].copy(),
            nodes=solved,
            residual_norm=norm,
            iterations=evaluations,
            rung="newton",
            drift=float(np.abs(scalars[:, 2]).max()),
            unstable_rods=tuple(int(i) for i in np.flatnonzero(scalars[:, 1] > 0)),
        )
