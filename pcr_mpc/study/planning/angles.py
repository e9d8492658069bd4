"""Motor angles along a motion: inverse statics at many points in one call, and how they change with the forces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from ...compiled import has_compiler
from ...errors import ConvergenceError
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.many_poses.batch import solve_statics_batch
from ...plant.statics.many_poses.equilibria import Equilibria
from .linear import Linear
from .motion import Motion

_MOST_STEPS = 12
_LARGEST_STEP = 0.15  # rad
_MOST_SWEEPS, _SETTLED = 8, 1e-4  # of the angles of more than two motors along the path, and by how little they change
_STEP = 1e-6  # of the motors, in radians, and of the tip, in rod lengths, for differences


@dataclass(frozen=True, eq=False)
class Stand:
    """The rods at M points of a motion, solved.

    Attributes
    ----------
    pose : Equilibrium
        From which their branch was followed.
    poses : Equilibria
        Within the tolerance.
    q : ndarray, shape (M, n)
        Motor angles [rad], to the square of that.
    levers : ndarray, shape (M, n, 2)
        G^+ [rad/N].
    along : (ndarray, ndarray)
        Derivatives of K, (M, 2, 2), and of G^+ along the path.
    """

    pose: Equilibrium
    poses: Equilibria
    q: np.ndarray
    levers: np.ndarray
    along: tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Angles:
    """Motor angles at M points, and the motors' motion.

    Attributes
    ----------
    q, rate, acceleration : Linear, n components
        [rad], [rad/s], [rad/s^2].
    torque : Linear, n components
        [N m].
    stand : Stand
    """

    q: Linear
    rate: Linear
    acceleration: Linear
    torque: Linear
    stand: Stand

    @property
    def poses(self) -> Equilibria:
        """Of the stand."""
        return self.stand.poses


def followed(pose: Equilibrium, p: np.ndarray, q: np.ndarray, near: Equilibria | None) -> Equilibria:
    """Held poses at many points, from poses near them, or where these do not lead there along the path from a pose."""
    compiled = has_compiler()
    if near is not None:
        poses = solve_statics_batch(pose.robot, p, q, guess=near, compiled=compiled)
        if poses.solved.all():
            return poses
    return solve_statics_batch(pose.robot, p, q, guess=pose, along=True, compiled=compiled)


def balanced(
    pose: Equilibrium, p: np.ndarray, force: np.ndarray, q: np.ndarray, near: Equilibria | None, tolerance: float
) -> tuple[Equilibria, np.ndarray]:
    """Turn the motors by Newton's method until the rods carry the forces, at all points at once.

    Parameters
    ----------
    pose : Equilibrium
        Near the first point; its branch is followed from point to point.
    p, force : ndarray, shape (M, 2)
        [m], [N].
    q : ndarray, shape (M, n)
        Guess [rad].
    near : Equilibria or None
        Poses near each of the points, which saves the way along the path.
    tolerance : float
        Force that may be missing, in units of sum EI/L^2. A last step, without a look at its result, takes it away.

    Returns
    -------
    poses : Equilibria
        Within the tolerance.
    q : ndarray, shape (M, n)
        Angles at which it is met, to the square of that [rad].

    Raises
    ------
    ConvergenceError
        With the first point at which it failed, ``row``.
    """
    robot = pose.robot
    allowed = tolerance * robot.force_scale
    steps = 0
    while steps < _MOST_STEPS:
        steps += 1
        poses = followed(pose, p, q, near)
        missed = force - poses.force
        size = np.linalg.norm(missed, axis=1)
        lost = np.flatnonzero(~np.isfinite(size))
        if lost.size:
            break
        turn = np.einsum("mij,mj->mi", _levers(poses.dforce_dq), missed)
        if (size <= allowed).all():
            return poses, poses.q + turn
        q = q + turn * np.minimum(1.0, _LARGEST_STEP / np.maximum(np.abs(turn).max(axis=1, keepdims=True), 1e-300))
        near = poses
    row = int(lost[0]) if lost.size else int(size.argmax())
    raise ConvergenceError(
        f"no motor angles were found at which the rods carry {force[row]} N at p = {p[row]} m: "
        f"{poses.reason[row] or f'{size[row]:.3g} N are missing after {_MOST_STEPS} steps'}",
        residual=float(size[row]),
        iterations=steps,
        last=q[row],
        row=row,
    )


def stood(
    moved: Motion,
    pose: Equilibrium,
    q: np.ndarray,
    near: Equilibria | None,
    tolerance: float,
    x: np.ndarray | None = None,
) -> Stand:
    """Solve the rods for the forces of a motion; see `balanced`.

    With more than two motors there are many angles that do. At the points ``x`` of all the way they are those of least
    motion from the first ones on, q' = G^+ (F' - K p'); at others, where none are given, those nearest to q.
    """
    p, p1, force, force1 = moved.path[0], moved.path[1], moved.force[0].value, moved.force[1].value
    for sweep in range(_MOST_SWEEPS):
        poses, q = balanced(pose, p, force, q, near, tolerance)
        levers = _levers(poses.dforce_dq)
        q1 = np.einsum("mij,mj->mi", levers, force1 - np.einsum("mij,mj->mi", poses.dforce_dp, p1))
        if x is None or q.shape[1] == 2 or sweep == _MOST_SWEEPS - 1:
            break
        away = q[0] + make_interp_spline(x, q1, k=3).antiderivative()(x) - q
        # Only what changes no force: the rest is the error of the integral.
        away -= np.einsum("mij,mj->mi", levers, np.einsum("mij,mj->mi", poses.dforce_dq, away))
        if np.abs(away).max() < _SETTLED:
            break
        q, near = q + away, poses
    return Stand(pose, poses, q, levers, _along(pose, poses, p1, q1, levers))


def angles(moved: Motion, stand: Stand, x: np.ndarray) -> Angles:
    """Motor angles, rates and accelerations of a motion at the points x."""
    f, f1, f2 = moved.force
    _, p1, p2 = moved.path
    poses, levers, (k1, h1) = stand.poses, stand.levers, stand.along
    stiffness = poses.dforce_dp
    # Along x: K P' + G q' = F', with H = G^+. The slopes: G dq = dF at every x.
    first = f1.less(stiffness, p1)
    turn = Linear(first.through(levers).value, f1.through(levers).slope + f.through(h1).slope)
    turn2 = f2.less(k1, p1).less(stiffness, p2).through(levers) + first.through(h1)
    if f.slope.size:
        h2 = _derivative(x, h1)
        slope = f2.through(levers).slope + 2.0 * f1.through(h1).slope + f.through(h2).slope
        turn2 = Linear(turn2.value, slope)
    q = Linear(stand.q, f.through(levers).slope)
    rate = turn * moved.theta
    acceleration = turn2 * moved.pace + 0.5 * (turn * moved.pace_slope)
    torque = Linear(poses.motor_torque, poses.dtorque_dq[:, :, None] * q.slope)
    return Angles(q, rate, acceleration, torque, stand)


def _levers(coupling: np.ndarray) -> np.ndarray:
    """H = G^+: the least turn of the motors by which the rods carry one more newton, shape (M, n, 2) [rad/N]."""
    return np.linalg.inv(coupling) if coupling.shape[2] == 2 else np.linalg.pinv(coupling)


def _along(
    pose: Equilibrium, poses: Equilibria, p1: np.ndarray, q1: np.ndarray, levers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of K and H at each pose where tip and motors move by p1 and q1: by differences, at the pose alone."""
    size = np.abs(np.concatenate([p1 / poses.robot.lengths.mean(), q1], axis=1)).max(axis=1)
    step = _STEP / np.maximum(size, _STEP)
    there = followed(pose, poses.p + step[:, None] * p1, poses.q + step[:, None] * q1, poses)
    if not there.solved.all():
        row = int(np.argmin(there.solved))
        raise ConvergenceError(
            f"the rods could not be followed from p = {poses.p[row]} m: {there.reason[row]}; keep away from this pose",
            residual=float("nan"),
            iterations=0,
            last=poses.q[row],
            row=row,
        )
    scale = 1.0 / step[:, None, None]
    return scale * (there.dforce_dp - poses.dforce_dp), scale * (_levers(there.dforce_dq) - levers)


def _derivative(x: np.ndarray, values: np.ndarray) -> np.ndarray:
    """By x, as far as the slopes of the limits need it."""
    return np.asarray(make_interp_spline(x, values.reshape(len(x), -1), k=3)(x, nu=1).reshape(values.shape))
