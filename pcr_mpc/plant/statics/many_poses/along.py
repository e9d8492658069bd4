"""Inverse statics along a path: the motors turned from one pose to the next in a graph."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from .... import interrupt
from ....buffered import BufferedFunction, graph_cache, per_thread
from ....errors import PCRError, checked_array
from ...robot import Robot
from ...rods.follower import BRANCH_CHANGE
from ...rods.method import RodMethod, warm_step
from ...rods.numbers import Kind
from ...rods.physics import robot_layout
from ..equilibrium import Equilibrium
from ..first_rung import ROUGH, Climbed, FirstRung
from ..free_tip import free_solver, inverse_statics
from .batch import solve_from_records
from .equilibria import Equilibria, together

_BLOCK = 64  # poses in one call of the graph
_TRIALS = 2  # of the motors at each pose: predicted, and corrected once; a last step is not looked at
_LARGEST_TURN = 0.25  # of the motors from one pose to the next [rad]
_ROUGHLY = 1e-2  # force that may be missing before the last step, in units of sum EI/L^2: about its square is left
_EXACTLY = 1e-9
_POLISHES = 3
_SINGULAR = 1e-9  # det(G G') relative to its diagonal, below which the motors have lost a direction


def inverse_statics_along(robot: Robot, p: Any, force: Any, guess: Equilibrium) -> Equilibria:
    """Inverse statics at every pose of a path, each on the branch of the one before.

    Finds what `inverse_statics` finds from pose to pose, to the same tolerance; where the graph does not lead on, that
    is asked. Of more than two motors the angles are those of least motion along the path, to which small steps of
    `inverse_statics` lead: their error falls with the square of the distance between poses.

    Parameters
    ----------
    robot : Robot
    p : array_like, shape (K, 2)
        Tip positions [m].
    force : array_like, shape (K, 2)
        As `inverse_statics` has it: besides the tip's own weight [N].
    guess : Equilibrium
        Whose branch is followed to the first.

    Returns
    -------
    Equilibria
        All solved, stable and between the motors' stops.

    Raises
    ------
    UnreachableError, UnstableError, ConvergenceError
        As `inverse_statics`, with the first pose at which it failed, ``row``.
    """
    p = checked_array("p", p, (len(p), 2))
    force = checked_array("force", force, p.shape)
    if robot.needs_shooting is not None:  # a graph of theirs saves nothing
        return _one_by_one(robot, p, force, guess)
    first = _alone(robot, p, force, 0, guess)
    q, records = _walked(robot, p, force, first)
    wanted = force + robot.tip_weight
    for _ in range(_POLISHES):
        poses = solve_from_records(robot, p, q, records)
        missed = wanted - poses.force
        held = poses.solved & poses.stable & _within_stops(robot, q)
        if not held.all():
            break
        if (np.linalg.norm(missed, axis=1) <= _EXACTLY * robot.force_scale).all():
            return poses
        q, records = q + np.einsum("kij,kj->ki", np.linalg.pinv(poses.dforce_dq), missed), poses.records
    return _one_by_one(robot, p, force, guess)


def _one_by_one(robot: Robot, p: np.ndarray, force: np.ndarray, guess: Equilibrium) -> Equilibria:
    found = []
    for row in range(len(p)):
        guess = _alone(robot, p, force, row, guess)
        found.append(guess)
    return together(found)


def _alone(robot: Robot, p: np.ndarray, force: np.ndarray, row: int, guess: Equilibrium) -> Equilibrium:
    interrupt.check()
    try:
        return inverse_statics(robot, p[row], force[row], guess=guess)
    except PCRError as error:
        raise type(error)(str(error), **error.details, row=row) from None


def _within_stops(robot: Robot, q: np.ndarray) -> np.ndarray:
    low, high = robot.angle_limits.T
    return np.asarray(((q >= low) & (q <= high)).all(axis=1))


def _walked(robot: Robot, p: np.ndarray, force: np.ndarray, first: Equilibrium) -> tuple[np.ndarray, np.ndarray]:
    """Motor angles at every pose, nearly, from the first on, shape (K, n) [rad], and records of poses close to them."""
    assert first.record is not None
    wanted, last = force + robot.tip_weight, first
    q, records = np.tile(first.q, (len(p), 1)), np.tile(first.record, (len(p), 1))
    row = 1
    while row < len(p):
        rows = slice(row, min(row + _BLOCK, len(p)))
        done, last = _block(last, p[rows], wanted[rows], q[rows], records[rows])
        row += done
        if row < rows.stop:
            last = _alone(robot, p, force, row, last)
            q[row], records[row] = last.q, last.record
            row += 1
    return q, records


def _block(
    last: Equilibrium, p: np.ndarray, force: np.ndarray, q: np.ndarray, records: np.ndarray
) -> tuple[int, Equilibrium]:
    """Turn the motors at a few poses more, and write angles and records; how many followed, and the last of these."""
    interrupt.check()
    robot, count = last.robot, len(p)
    first, graph, numbers = _graph(robot)
    assert last.record is not None
    start, targets, given = graph.inputs
    result = [last.force, last.dforce_dp.ravel("F"), last.dforce_dq.ravel("F")]
    start[:] = np.concatenate([last.p, last.q, last.record, *result])
    # What is left of the block stays where the path ends.
    targets[:2, :count], targets[2:, :count] = p.T, force.T
    targets[:2, count:], targets[2:, count:] = p[-1:].T, force[-1:].T
    given[:] = numbers
    graph()
    states, turned, verdict = (place.T[:count] for place in graph.outputs)
    missed, turn, residual, changed, conjugate_points, softest = verdict.T
    # Written so that NaN is not good.
    good = (missed <= _ROUGHLY * robot.force_scale) & (turn <= _LARGEST_TURN) & (residual <= ROUGH)
    good &= (changed <= BRANCH_CHANGE) & (conjugate_points == 0) & (softest > 0) & _within_stops(robot, turned)
    done = count if good.all() else int(np.argmin(good))
    if not done:
        return 0, last
    ends = [2 + robot.n_rods, 2 + robot.n_rods + records.shape[1]]
    q[:done], records[:done] = turned[:done], states[:done, ends[0] : ends[1]]
    pose, record, carried = np.split(states[done - 1], ends)
    return done, first.equilibrium(Climbed(pose, record, carried, float(residual[done - 1]), 0.0, 0))


@per_thread(maxsize=8)
def _graph(robot: Robot) -> tuple[FirstRung, BufferedFunction, np.ndarray]:
    first, kind = free_solver(robot).first, Kind(robot.n_rods, robot_layout(robot))
    return first, BufferedFunction(_path_graph(kind, first.method, _BLOCK)), kind.pack(robot)


@graph_cache(maxsize=8)
def _path_graph(kind: Kind, method: RodMethod, count: int) -> Any:
    """([p, q, record, result], targets [p, F] (4, count), numbers) -> the same, corrected q, and verdicts of all."""
    n, warm = kind.n_rods, warm_step(kind, method, 1)
    pose_size, start_size, record_size, result_size = 2 + n, warm.numel_in(1), warm.numel_out(0), warm.numel_out(2)
    state = ca.MX.sym("state", pose_size + record_size + result_size)
    target, numbers = ca.MX.sym("target", 4), ca.MX.sym("numbers", kind.size)
    pose, record, result = ca.vertsplit(state, [0, pose_size, pose_size + record_size, state.numel()])
    p, wanted = target[:2], target[2:]
    force, k, g = _parts(result, n)
    before = g
    turned = pose[2:] + least_motion(g, wanted - force - k @ (p - pose[:2]))
    changed = conjugate_points = residual = ca.MX(0)
    for _ in range(_TRIALS):
        reached = turned
        record, verdict, result = warm(ca.vertcat(p, reached), record[:start_size], numbers)
        residual, changed, conjugate_points = verdict[0], changed + verdict[2], conjugate_points + verdict[3]
        force, k, g = _parts(result, n)
        missed = wanted - force
        turned = reached + least_motion(g, missed)
        if n > 2:  # the least motion for the middle of the way, not for its start: an error of second order
            middle, way = (before + g) / 2, turned - pose[2:]
            turned = pose[2:] + least_motion(middle, middle @ way)
    moved = ca.vertcat(p, reached, record, result)
    half, skew = (k[0, 0] - k[1, 1]) / 2, (k[0, 1] + k[1, 0]) / 2
    softest = (k[0, 0] + k[1, 1]) / 2 - ca.norm_2(ca.vertcat(half, skew))
    turn = ca.norm_inf(turned - pose[2:])
    said = ca.vertcat(ca.norm_2(missed), turn, residual, changed, conjugate_points, softest)
    many = ca.Function("step", [state, target, numbers], [moved, turned, said]).mapaccum("steps", count, 1, {})
    targets = ca.MX.sym("targets", 4, count)
    found: Any = many(state, targets, ca.repmat(numbers, 1, count))
    return ca.Function("path", [state, targets, numbers], list(found))


def _parts(result: Any, n: int) -> tuple[Any, Any, Any]:
    """F, K and G."""
    return result[:2], ca.reshape(result[2:6], 2, 2), ca.reshape(result[6:], 2, n)


def least_motion(g: Any, force: Any) -> Any:
    """G^+ force, the least turn of the motors that gives so much more; none where they have lost a direction."""
    square = g @ g.T
    a, b, d = square[0, 0], square[0, 1], square[1, 1]
    determinant = a * d - b * b
    step = g.T @ ca.vertcat(d * force[0] - b * force[1], a * force[1] - b * force[0]) / determinant
    return ca.if_else(determinant >= _SINGULAR * a * d, step, ca.DM.zeros(g.size2()))
