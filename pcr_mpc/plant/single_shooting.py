"""Single shooting, paper sec. 2: the baseline, solved by SciPy with exact derivatives."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import least_squares

from ..buffered import BufferedFunction
from ..errors import ConvergenceError
from .equilibrium import Equilibrium
from .multiple_shooting import rod_newton, robot_residual
from .robot import Robot
from .rod import sample_rod

_ACCEPTED_RESIDUAL = 1e-8


@lru_cache(maxsize=16)
def _residual_and_jacobians(robot: Robot, steps: int, scheme: str) -> Any:
    residual = robot_residual(robot, 1, steps, scheme)
    y, p, q = (ca.SX.sym(name, residual.size1_in(i)) for i, name in enumerate("Ypq"))
    r = residual(y, p, q)
    return ca.Function("single_shooting", [y, p, q], [r, ca.jacobian(r, y), ca.jacobian(r, ca.vertcat(p, q))])


def solve_single_shooting(
    robot: Robot, p: np.ndarray, q: np.ndarray, nodes: np.ndarray, *, steps: int = 32, scheme: str = "rk4"
) -> Equilibrium:
    """Solve eq. (5)-(6): the base loads of every rod and the joint force, 3n + 2 unknowns (8 for two rods).

    Parameters
    ----------
    nodes : ndarray, shape (n, 4, N)
        Guess; only the states at the base are used (see `Equilibrium.nodes`).
    steps : int
        Runge-Kutta steps along the whole rod.

    Raises
    ------
    ConvergenceError
        Levenberg-Marquardt stopped with a weighted residual above 1e-8.
    """
    n = robot.n_rods
    evaluate = BufferedFunction(_residual_and_jacobians(robot, steps, scheme))
    evaluate.inputs[1][:], evaluate.inputs[2][:] = p, q
    units = np.stack([robot.stiffnesses / robot.lengths**e for e in (2, 2, 1)], axis=1)
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

    # An overflow on the way is a bad trial point, which the solver rejects; the verdict is below.
    with np.errstate(all="ignore"):
        try:
            fit = least_squares(
                residual, guess, jacobian, method="lm", x_scale=scale, xtol=1e-15, ftol=1e-15, gtol=1e-15
            )
            y, evaluations = fit.x, int(fit.nfev)
        except ValueError:  # SciPy's word for a non-finite residual
            y, evaluations = guess, 1
    norm = float(np.linalg.norm(residual(y)))
    if not norm <= _ACCEPTED_RESIDUAL:
        raise ConvergenceError(
            f"single shooting at p = {p} m, q = {q} rad stopped with residual {norm:.2e} after {evaluations} "
            "evaluations; pass a closer guess or use method='multiple_shooting'",
            residual=norm,
            iterations=evaluations,
            last=y,
        )
    # Implicit function theorem: dY/d(p, q) = -(dR/dY)^-1 dR/d(p, q), one factorisation for all columns.
    sensitivity = -np.linalg.solve(evaluate.outputs[1], evaluate.outputs[2])
    base_loads = y[:-2].reshape(n, 3)
    solved = np.concatenate([q[:, None], base_loads / units], axis=1)[:, :, None]
    return _equilibrium(robot, p, q, solved, y[-2:], sensitivity, norm, evaluations)


def _equilibrium(
    robot: Robot,
    p: np.ndarray,
    q: np.ndarray,
    nodes: np.ndarray,
    force: np.ndarray,
    sensitivity: np.ndarray,
    norm: float,
    evaluations: int,
) -> Equilibrium:
    # Energy and conjugate points need states along the rod: judge them on eight nodes.
    newton, _ = rod_newton(8, 4, "rk8")
    moment_units = robot.stiffnesses / robot.lengths
    scalars = np.empty((robot.n_rods, 4))
    for i, rod in enumerate(robot.rods):
        sampled = sample_rod(nodes[i], 9)[2:, :8]
        scalars[i] = newton(sampled.ravel(order="F"), (p - rod.base) / rod.length)[3].full().ravel()
    size = 1.0 + np.hypot(nodes[:, 1, 0], nodes[:, 2, 0]) + nodes[:, 3, 0] ** 2 / 2
    return Equilibrium(
        robot=robot,
        p=p.copy(),
        q=q.copy(),
        method="single_shooting",
        force=force.copy(),
        dforce_dp=sensitivity[-2:, :2].copy(),
        dforce_dq=sensitivity[-2:, 2:].copy(),
        motor_torque=-moment_units * nodes[:, 3, 0],
        dtorque_dq=-np.diagonal(sensitivity[2:-2:3, 2:]).copy(),
        energy=float(moment_units @ scalars[:, 1]),
        rod_forces=nodes[:, 1:3, 0] * (robot.stiffnesses / robot.lengths**2)[:, None],
        nodes=nodes,
        residual_norm=norm,
        iterations=evaluations,
        drift=float(np.max(np.abs(scalars[:, 3]) / size)),
        unstable_rods=tuple(int(i) for i in np.flatnonzero(scalars[:, 2] > 0)),
    )
