"""Many held poses in one call: `solve_statics` without Python between the poses."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...robot import Robot
from ..equilibrium import Equilibrium
from ..held_tip import Way, chosen_way, solver_of
from ..solver import RodSolver
from .equilibria import Equilibria
from .rows import Rows


def solve_statics_batch(
    robot: Robot,
    p: Any,
    q: Any,
    *,
    guess: Equilibrium | Equilibria | None = None,
    along: bool = False,
    method: str | None = None,
    segments: int = 8,
    steps: int | None = None,
    scheme: str = "rk8",
    compiled: bool = False,
) -> Equilibria:
    """Static equilibria at many held poses: `solve_statics` of each, at hardly more than the cost of its graph.

    Parameters
    ----------
    robot : Robot
    p : array_like, shape (R, 2)
        Tip positions [m].
    q : array_like, shape (R, n)
        Motor angles [rad].
    guess : Equilibrium or Equilibria, optional
        Whose branch is followed to each pose; many of the same robot: each from its own. None: on the branch of least
        energy.
    along : bool
        Whether the poses are a path: the branch is followed from each that is solved to the next, from the guess, or
        from the first pose, solved cold. Otherwise each is followed to from the guess, or solved cold, which is slow.
    method, segments, steps, scheme
        See `solve_statics`.
    compiled : bool
        As machine code (see `Plant`).

    Returns
    -------
    Equilibria
        A pose that is out of reach or not finite, or to which the rods cannot be followed, is a row of NaN with its
        reason; a path goes on from the last pose before it.

    Raises
    ------
    ValueError
        Names an argument of the wrong shape or kind.
    """
    p, q = _rows("p", p, 2), _rows("q", q, robot.n_rods)
    if len(p) != len(q):
        raise ValueError(f"p has {len(p)} rows, q {len(q)}")
    if isinstance(guess, Equilibria):
        return _each_from_its_own(robot, p, q, guess, chosen_way(robot, method, segments, steps, scheme), compiled)
    if guess is not None and not isinstance(guess, Equilibrium):
        raise TypeError(f"guess is a {type(guess).__name__}, expected an Equilibrium")
    if guess is not None and guess.robot.n_rods != robot.n_rods:
        raise ValueError(f"guess has {guess.robot.n_rods} rods, the robot {robot.n_rods}")
    way = chosen_way(robot, method, segments, steps, scheme)
    solver = solver_of(robot, way.method, way.shooting)
    rows = Rows(robot, p, q, way, compiled)
    if isinstance(solver, RodSolver) and (along or guess is not None):
        rows.by_graphs(solver, guess, along=along)
    else:
        rows.one_by_one(range(len(p)), guess, along=along)
    return rows.result()


def solve_from_records(robot: Robot, p: np.ndarray, q: np.ndarray, records: np.ndarray) -> Equilibria:
    """`solve_statics_batch` by the default method, each from the record of a pose nearby (`Equilibria.records`)."""
    way = chosen_way(robot, None, 8, None, "rk8")
    solver = solver_of(robot, way.method, way.shooting)
    assert isinstance(solver, RodSolver)
    rows = Rows(robot, p, q, way, compiled=False)
    rows.from_records(solver, records)
    return rows.result()


def _each_from_its_own(
    robot: Robot, p: np.ndarray, q: np.ndarray, guess: Equilibria, way: Way, compiled: bool
) -> Equilibria:
    solver = solver_of(robot, way.method, way.shooting)
    same = guess.robot == robot and guess.method == way.method and len(guess.p) == len(p)
    if not same or not isinstance(solver, RodSolver):
        raise ValueError(
            f"guess holds {len(guess.p)} poses of {guess.robot.name} by {guess.method}, expected {len(p)} of "
            f"{robot.name} by {way.method}, and another method than single_shooting"
        )
    rows = Rows(robot, p, q, way, compiled)
    rows.from_records(solver, guess.records)
    return rows.result()


def _rows(name: str, value: Any, width: int) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "fiu" or array.ndim != 2 or array.shape[1] != width:
        raise ValueError(f"{name} has shape {array.shape} of {array.dtype}, expected numbers of shape (R, {width})")
    return np.array(array, dtype=float)
