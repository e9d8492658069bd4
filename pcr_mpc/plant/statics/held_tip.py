"""Statics of the robot with its tip held: (p, q) -> Equilibrium."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ...buffered import per_thread
from ...errors import ConvergenceError, checked_integer, checked_vector
from ...methods import METHODS
from ..robot import Robot
from ..rods.equations import SCHEMES
from ..rods.method import Shooting, closed_form_method, shooting_method
from ..rods.physics import require_plain, robot_layout
from .equilibrium import Equilibrium
from .single_shooting import SingleShooting
from .solver import RodSolver

# Steps of order 8 per segment, tried in turn until the drift is small enough.
_REFINEMENT = (1, 4, 12)
# Single shooting carries the errors of a rod from its base to its tip, where they have grown like exp(lambda).
_WANTED_DRIFT = {"multiple_shooting": 1e-6, "single_shooting": 1e-9}
# Below this slack, as a fraction of the length, less drift is wanted: a taut rod's force goes with 1/slack.
_TAUT = 0.05
_STRETCH = 5e-4  # least slack that counts for a rod that stretches
# Integration steps along a rod for which a graph may be built: half a minute and 1 GB.
_MOST_STEPS = 1024


def solve_statics(
    robot: Robot,
    p: Any,
    q: Any,
    *,
    method: str | None = None,
    segments: int = 8,
    steps: int | None = None,
    scheme: str = "rk8",
    guess: Equilibrium | np.ndarray | None = None,
) -> Equilibrium:
    """Static equilibrium of the rods for a held tip and given motor angles.

    Parameters
    ----------
    robot : Robot
    p : array_like, shape (2,)
        Tip position in the world frame [m].
    q : array_like, shape (n,)
        Motor angles, counter-clockwise from world x [rad].
    method : {"closed_form", "multiple_shooting", "single_shooting"}, optional
        Exact for plain rods; paper sec. 4, for all rods; or the baseline of sec. 2 for plain ones, which uses
        segments * steps integration steps. None: the closed form where it holds (see `Robot.needs_shooting`), else
        multiple shooting.
    segments : int
        Shooting segments per rod (N).
    steps : int, optional
        Runge-Kutta steps per segment. None: as many steps of order 8 as bring the drift of the invariant below
        1e-6 (mostly one, with 1e-7 relative error of F), up to 12 for taut rods.
    scheme : {"rk4", "rk8"}
        Runge-Kutta scheme where steps are given (else order 8): the paper's, or order 8, whose single step per
        segment is as fast as four of RK4 and a hundred times more accurate.
    guess : Equilibrium or ndarray, optional
        An equilibrium of this robot, whose branch is followed to (p, q); or nodes of shape (n, 4, N) from
        which to iterate (see `Equilibrium.nodes`). None: each rod takes its stable shape of least energy.
        One of the same method that is near costs little more than its graph.

    Returns
    -------
    Equilibrium
        Converged, and possibly unstable if a guess led there: see its ``stable``.

    Raises
    ------
    UnreachableError
        If ``|p - base_i| >= L_i`` for some rod i.
    ConvergenceError
        If the iteration did not reach the tolerance; carries the residual and the last iterate.
    ValueError
        Names an argument that is not finite or of the wrong shape.

    References
    ----------
    .. [1] M. Rekkal, G. Ganesh, J. Cavalcanti Santos, "Towards Computationally Efficient Dynamic
       Model of a Planar Parallel Continuum Robot".
    """
    p, q = checked_vector("p", p, 2), robot.checked_angles("q", q)
    robot.require_reachable(p)
    return chosen_way(robot, method, segments, steps, scheme).solve(robot, p, q, guess)


class Way(NamedTuple):
    """How the statics are solved; ``refined``: with as many steps as the drift wants."""

    method: str
    shooting: Shooting
    refined: bool

    def solve(self, robot: Robot, p: np.ndarray, q: np.ndarray, guess: Equilibrium | np.ndarray | None) -> Equilibrium:
        """Solve at a pose that is known to be in reach; see `solve_statics`."""
        if self.refined:
            return self._refined(robot, p, q, guess)
        return self._solved(robot, p, q, self.shooting, guess)

    def wanted_drift(self, robot: Robot, p: np.ndarray) -> float:
        """Drift with which a solution counts as resolved."""
        if not self.refined:
            return math.inf
        # A rod that stretches is no stiffer than its EA: there is no end to the slack that counts.
        slack = min(
            max(slack, _STRETCH if rod.stretches else 0.0)
            for slack, rod in zip(robot.slacks(p), robot.rods, strict=True)
        )
        return _WANTED_DRIFT[self.method] * min(1.0, slack / _TAUT)

    def _solved(
        self,
        robot: Robot,
        p: np.ndarray,
        q: np.ndarray,
        shooting: Shooting,
        guess: Equilibrium | np.ndarray | None,
    ) -> Equilibrium:
        solver = solver_of(robot, self.method, shooting)
        if not isinstance(guess, Equilibrium):
            solver.start(p, q, None if guess is None else _checked_nodes(guess, robot))
            return solver.equilibrium(p, q)
        if guess.robot.n_rods != robot.n_rods:
            raise ValueError(f"guess has {guess.robot.n_rods} rods, the robot {robot.n_rods}")
        if isinstance(solver, SingleShooting):
            solver.start(guess.p, guess.q, guess.nodes)
        else:
            found = solver.first.near(guess, p, q) if solver.first.knows(guess) else None
            if found is not None:
                return found
            solver.begin(guess)
        solver.move(p, q)
        return solver.equilibrium(p, q)

    def _refined(
        self, robot: Robot, p: np.ndarray, q: np.ndarray, guess: Equilibrium | np.ndarray | None
    ) -> Equilibrium:
        """Solve with finer and finer integration until the drift says that the rods are resolved."""
        failure: ConvergenceError | None = None
        wanted, segments = self.wanted_drift(robot, p), self.shooting.segments
        for steps in _REFINEMENT:
            if segments * steps > _MOST_STEPS:
                break
            try:
                eq = self._solved(robot, p, q, Shooting(segments, steps, "rk8"), guess)
            except ConvergenceError as error:
                failure = error
                continue
            if eq.drift <= wanted:
                return eq
            failure = ConvergenceError(
                f"rods at p = {p} m, q = {q} rad are not resolved by {segments} segments of {steps} steps: the "
                f"invariant m^2/2 + n.t drifts by {eq.drift:.1e} along a rod (wanted {wanted:.0e}); "
                "they are taut, use more segments",
                residual=eq.residual_norm,
                iterations=eq.iterations,
                last=eq.nodes,
            )
        assert failure is not None
        raise failure


def chosen_way(robot: Robot, method: str | None, segments: int, steps: int | None, scheme: str) -> Way:
    """Return the way that the arguments of `solve_statics` choose, or raise ValueError."""
    method = method or default_method(robot)
    try:
        return _way(method, segments, steps, scheme)
    except TypeError:  # what cannot be hashed is refused in words of its own
        return _way.__wrapped__(method, segments, steps, scheme)


@lru_cache(maxsize=32, typed=True)
def _way(method: str, segments: int, steps: int | None, scheme: str) -> Way:
    refined = steps is None and method in _WANTED_DRIFT
    shooting = checked_shooting(segments, 1 if steps is None else steps, scheme)
    return Way(method, replace(shooting, scheme="rk8") if refined and scheme != "rk8" else shooting, refined)


def default_method(robot: Robot) -> str:
    """Return the name of the method that is exact for the robot's rods."""
    return "closed_form" if robot.needs_shooting is None else "multiple_shooting"


def checked_shooting(segments: int, steps: int, scheme: str) -> Shooting:
    """Return the discretisation if it makes sense, or raise ValueError."""
    segments, steps = checked_integer("segments", segments), checked_integer("steps", steps)
    if segments * steps > _MOST_STEPS:
        raise ValueError(f"segments = {segments} times steps = {steps} is more than {_MOST_STEPS}")
    if scheme not in SCHEMES:
        raise ValueError(f"scheme is {scheme!r}, expected one of {', '.join(SCHEMES)}")
    return Shooting(segments, steps, scheme)


@per_thread(maxsize=32)
def solver_of(robot: Robot, method: str, shooting: Shooting) -> RodSolver | SingleShooting:
    """Return this thread's solver, for one call."""
    return make_solver(robot, method, shooting)


def make_solver(
    robot: Robot, method: str, shooting: Shooting, *, snapping: bool = False, compiled: bool = False
) -> RodSolver | SingleShooting:
    """Build the solver that goes by the name ``method``; ``compiled``: rods that are shot follow by machine code."""
    if method == "closed_form":
        return RodSolver(robot, closed_form_method(), snapping=snapping)
    if method == "multiple_shooting":
        return RodSolver(robot, shooting_method(shooting, robot_layout(robot)), snapping=snapping, compiled=compiled)
    if method == "single_shooting":
        if snapping:
            raise ValueError("single shooting does not notice where a branch ends: on_snap='jump' needs another method")
        require_plain(robot, "method 'single_shooting'")
        return SingleShooting(robot, shooting.segments * shooting.steps, shooting.scheme)
    raise ValueError(f"method is {method!r}, expected one of {', '.join(METHODS)}")


def _checked_nodes(guess: np.ndarray, robot: Robot) -> np.ndarray:
    nodes = np.asarray(guess, dtype=float)
    if nodes.ndim != 3 or nodes.shape[:2] != (robot.n_rods, 4) or not nodes.size or not np.isfinite(nodes).all():
        raise ValueError(
            f"guess has shape {nodes.shape} (finite: {np.isfinite(nodes).all()}), expected ({robot.n_rods}, 4, N)"
        )
    return nodes
