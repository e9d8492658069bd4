"""Inverse dynamics of a scene's reference."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...control.qp.program import Reference
from ...errors import ConvergenceError, PCRError, cause
from ...frozen import Frozen
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.many_poses.along import inverse_statics_along
from ...plant.statics.many_poses.equilibria import Equilibria
from ...plant.statics.margins import largest_strains, least_rod_margins, least_stiffnesses
from ..references.trajectory import sampled, smooth_step
from ..scene.scene import Scene
from .moving_rods import MovingRods

# The motor angles' change by the rods' inertia is found again from the angles that it leads to, until it settles [rad]:
# each time the error falls as the rods' share of the mass, 1/200 of the change on the default robot.
_SETTLED = 1e-5
_MOST_SWEEPS = 20
_STRIDE = 25  # periods from which to which the rods are followed along a reference that was solved before
_SHARE_RESOLUTION = 0.01


@dataclass(frozen=True, eq=False, kw_only=True)
class InverseDynamics(Frozen, Reference):
    """What the reference asks of the motors at K times from the start on.

    Attributes
    ----------
    states : ndarray, shape (K, 4 + n)
    inputs : ndarray, shape (K - 1, n)
        Rates that lead from each state to the next [rad/s].
    forces : ndarray, shape (K, 2)
        That the rods carry [N].
    angles_per_force : ndarray, shape (K, n, 2)
        Least change of the motor angles by which they carry one more newton [rad/N].
    torques : ndarray, shape (K, n)
        Of the motors [N m].
    torques_per_force : ndarray, shape (K, n, 2)
        Their change by that of the angles [N m/N].
    stiffness : ndarray, shape (K,)
        Least eigenvalue of K [N/m].
    rod_margin : ndarray, shape (K,)
        Least of the rods (see `least_rod_margin`).
    strains : ndarray, shape (K, n)
        Largest of each rod; NaN where no thickness is known.
    inertia : str
        Of the rods, that was reckoned with.
    """

    angles_per_force: np.ndarray
    torques: np.ndarray
    torques_per_force: np.ndarray
    stiffness: np.ndarray
    rod_margin: np.ndarray
    strains: np.ndarray
    inertia: str = "none"


def feed_forward(scene: Scene, robot: Robot, pose: Equilibrium, horizon: int, inertia: str = "none") -> InverseDynamics:
    """Inverse dynamics of the reference at every period, and one horizon beyond the end.

    The motor angles are those at which the rods carry F = -m a - c v on the reference, m with what the scene says that
    the tip carries, whose weight is a part of F too; the rates lead from each to the next.

    Where the rods have inertia, F = -pi' + dT/dp - c v with the momentum pi = M_pp v + M_pq q' and the kinetic energy
    T = w' M w / 2, w = [v, q'] (see `integrators`), derivatives as in `MovingRods`. M and q' are those of the angles
    looked for: a fixed point, begun without inertia. The reference's v is then M_pp^-1 pi, as the state's is.
    On the lemniscate, with such rods in the plant, this lowers the error from 47 to 6.2 um in open loop; with rods that
    the linear model knows, too, that of lemniscate.toml from 20 to 1.5 um, and from 6.1 to 0.3 um with an input weight
    of 0.001.

    Parameters
    ----------
    scene : Scene
    robot : Robot
        As it is believed to be.
    pose : Equilibrium
        At the start; its branch is followed.
    horizon : int
        Periods beyond the end of the scene.
    inertia : {"none", "constant", "condensed"}
        Of the rods (see `Plant`).

    Raises
    ------
    PCRError
        The reference leaves the workspace, or asks for more force than the rods can give; the message says when, and
        of what acceleration to take how much less.
    ConvergenceError
        The inertia of the rods changes the angles too much for the fixed point.
    """
    assert scene.trajectory is not None
    t = scene.period * np.arange(scene.n_periods + horizon + 1)
    p, v, a = np.moveaxis(sampled(scene.trajectory, t), 1, 0)
    carried = scene.carried(t)
    # Mass and weight of what is carried, which has nothing to do with the rods.
    loads = carried[:, None] * (np.array(robot.gravity) - a)
    forces = loads - robot.tip_mass * a - robot.drag * v
    resting = carried[:, None] * np.array(robot.gravity)
    poses = poses_along(robot, pose, t, p, forces, resting, a)
    q = poses.q
    if inertia != "none":
        massless, rods = forces, MovingRods(poses, pose, inertia, scene.period)
        # From rest the rods' inertia comes into play within the width of its derivatives.
        risen = smooth_step(t / rods.width)[0][:, None] if not v[0].any() else 1.0
        for _ in range(_MOST_SWEEPS):
            forces, own = rods.forces(poses, v, forces, loads - robot.drag * v, carried)
            # What would have had to begin before the start is left out.
            forces = massless + risen * (forces - massless)
            poses = poses_along(robot, pose, t, p, forces, resting, a)
            before, q = q, poses.q
            change = float(np.abs(q - before).max())
            if change < _SETTLED:
                break
        else:
            raise ConvergenceError(
                f"the inverse dynamics of {scene.name} with rods of inertia {inertia!r} did not settle: the motor "
                f"angles still change by {change:.1e} rad in sweep {_MOST_SWEEPS}; take a slower reference or "
                "inertia 'none'",
                residual=change,
                iterations=_MOST_SWEEPS,
                last=q,
            )
        v = own
    rates = np.diff(q, axis=0) / scene.period
    return _inverse_dynamics(np.hstack([p, v, q]), rates, forces, poses, inertia)


def _inverse_dynamics(
    states: np.ndarray, rates: np.ndarray, forces: np.ndarray, poses: Equilibria, inertia: str
) -> InverseDynamics:
    levers = np.linalg.pinv(poses.dforce_dq)
    return InverseDynamics(
        states,
        rates,
        forces,
        angles_per_force=levers,
        torques=poses.motor_torque,
        torques_per_force=poses.dtorque_dq[:, :, None] * levers,
        stiffness=least_stiffnesses(poses),
        rod_margin=least_rod_margins(poses),
        strains=largest_strains(poses),
        inertia=inertia,
    )


def held(
    reference: InverseDynamics, k: int, robot: Robot, pose: Equilibrium, payload: float, count: int
) -> InverseDynamics:
    """The point of the reference in period k, held at rest for ``count`` periods.

    Parameters
    ----------
    reference : InverseDynamics
    k : int
    robot : Robot
        As it is believed to be.
    pose : Equilibrium
        At the start of the reference; its branch is followed.
    payload : float
        That the tip carries [kg].
    count : int
    """
    on_the_way = np.unique([*range(0, k, _STRIDE), k])
    p = reference.states[[*on_the_way, k], :2]
    forces = np.vstack([reference.forces[on_the_way], payload * np.array(robot.gravity)])
    poses = poses_along(robot, pose, np.full(len(p), np.nan), p, forces, forces, np.zeros_like(p))
    end = poses.rows(np.full(count + 1, len(p) - 1))
    state = np.concatenate([end.p[0], np.zeros(2), end.q[0]])
    states, forces = np.tile(state, (count + 1, 1)), np.tile(forces[-1], (count + 1, 1))
    return _inverse_dynamics(states, np.zeros((count, robot.n_rods)), forces, end, "none")


def poses_along(
    robot: Robot,
    pose: Equilibrium,
    t: np.ndarray,
    p: np.ndarray,
    forces: np.ndarray,
    resting: np.ndarray,
    accelerations: np.ndarray,
) -> Equilibria:
    """Poses at which the rods carry the forces at the tips p; ``resting`` is what they would carry at rest [N]."""
    try:
        return inverse_statics_along(robot, p, forces, pose)
    except PCRError as error:
        raise _explained(robot, pose, t, p, forces, resting, accelerations, *_lost(error)) from None


def _lost(error: PCRError) -> tuple[int, PCRError]:
    """Place at which the rods could not carry the force, and why."""
    row = error.details.pop("row")
    return int(row), error


def _explained(
    robot: Robot,
    pose: Equilibrium,
    t: np.ndarray,
    p: np.ndarray,
    forces: np.ndarray,
    resting: np.ndarray,
    accelerations: np.ndarray,
    k: int,
    error: PCRError,
) -> PCRError:
    """The error of place k, blamed on the motion if all places could be held at rest, and by how much then."""
    stop = (k, error) if np.array_equal(forces, resting) else _first_lost(robot, pose, p, resting)
    if stop is not None:
        k, error = stop
        return type(error)(f"reference at t = {t[k]:.3f} s: {error}", **error.details)
    low, high = 0.0, 1.0
    while high - low > _SHARE_RESOLUTION:
        middle = (low + high) / 2
        kept = _first_lost(robot, pose, p, resting + middle * (forces - resting)) is None
        low, high = (middle, high) if kept else (low, middle)
    share = low or high
    slower = math.ceil(10.0 / math.sqrt(share)) / 10.0
    return type(error)(
        f"reference at t = {t[k]:.3f} s: it asks for an acceleration of {math.hypot(*accelerations[k]):.3g} m/s^2, for "
        f"which {cause(error)}. The rods could rest there and everywhere on it, and can give {100 * share:.0f} % of "
        f"the force that its motion takes; smooth it, or make it slower by a factor of at least {slower:g} "
        "(time_scale)",
        **error.details,
    )


def _first_lost(robot: Robot, pose: Equilibrium, p: np.ndarray, forces: np.ndarray) -> tuple[int, PCRError] | None:
    """First place at which the rods cannot carry the force there, and why; None if they can all the way."""
    try:
        inverse_statics_along(robot, p, forces, pose)
    except PCRError as error:
        return _lost(error)
    return None
