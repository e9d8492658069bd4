"""Poses at which the tip is in balance: forward (motors -> tip) and inverse (tip -> motors) statics."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...buffered import per_thread
from ...errors import ConvergenceError, PCRError, UnreachableError, UnstableError, checked_vector
from ..robot import Robot
from ..rods.method import Shooting, closed_form_method, shooting_method
from ..rods.physics import robot_layout
from .balance import follow, named, reach, settle, turn
from .balance_starts import angle_starts, tip_starts, unwound
from .equilibrium import Equilibrium
from .solver import RodSolver

_SHOOTING = Shooting(steps=2)  # where the closed form does not hold: 1e-8 of F but on taut rods


def forward_statics(robot: Robot, q: Any, force: Any = (0.0, 0.0), guess: Equilibrium | None = None) -> Equilibrium:
    """Tip position at which the rods carry a given force: the free pose for given motors.

    Parameters
    ----------
    q : array_like, shape (n,)
        Motor angles [rad].
    force : array_like, shape (2,)
        External force on the tip besides its own weight m g [N]: wanted is F = dU/dp = force + m g.
    guess : Equilibrium, optional
        Its branch is followed to (q, force) by continuation. None: the stable pose of least potential
        energy among those found by descent from several tip positions.

    Returns
    -------
    Equilibrium
        Stable, with ``eq.force == force + robot.tip_weight``; ``eq.mode`` says which working mode it is.

    Raises
    ------
    UnstableError
        The branch ends at a fold before q is reached.
    ConvergenceError
        No stable pose was found.
    """
    q, force = robot.checked_angles("q", q), checked_vector("force", force, 2) + robot.tip_weight
    solver = _solver(robot)
    if guess is not None:
        _require_equilibrium(guess)
        return follow(solver, guess, q, force)
    found: list[Equilibrium] = []
    last: PCRError | None = None
    for start in tip_starts(robot, q):
        try:
            solver.start(start, q)
            found.append(solver.equilibrium(settle(solver, start, q, force), q))
        except PCRError as error:
            last = error
    if not found:
        raise ConvergenceError(
            f"no stable pose found for q = {q} rad under {force} N; last failure: {last}; "
            "check that the rods can meet, or pass a guess",
            residual=np.nan,
            iterations=0,
            last=None,
        )
    return min(found, key=lambda eq: eq.energy - force @ eq.p)


def inverse_statics(
    robot: Robot, p: Any, force: Any = (0.0, 0.0), guess: Equilibrium | None = None, mode: str | None = None
) -> Equilibrium:
    """Motor angles that hold the tip at p while the rods carry a given force.

    With more than two rods the angles are not unique: those nearest to the guess are taken. Nor are whole turns, which
    no rod feels: a guess keeps its own; a search takes, of the turns between the stops, the one that leaves the motor
    nearest to the direction of the rod's chord, from -pi to pi.

    Parameters
    ----------
    p : array_like, shape (2,)
        Tip position [m].
    force : array_like, shape (2,)
        External force on the tip minus what the motion needs, f_ext - m a - c v [N]; the tip's own weight m g is
        added to it.
    guess : Equilibrium, optional
        Its branch is followed to (p, force). None: a search within the motors' limits.
    mode : str, optional
        Working mode to look for in a cold search, such as "LR" (see `Equilibrium.mode`).
        None: the stable pose of least energy.

    Raises
    ------
    UnreachableError
        If ``|p - base_i| >= L_i`` for some rod i, or the branch of the guess needs a motor beyond its stop.
    UnstableError
        The branch of the guess is not stable at p.
    ConvergenceError
        No stable pose of that mode was found within the motors' limits.
    """
    p, force = checked_vector("p", p, 2), checked_vector("force", force, 2) + robot.tip_weight
    robot.require_reachable(p)
    solver = _solver(robot)
    if guess is not None:
        if mode is not None:
            raise ValueError("give either guess, whose branch is followed, or mode, for a search")
        _require_equilibrium(guess)
        solver.begin(guess)
        eq = solver.equilibrium(p, reach(solver, guess, p, force))
        _require_usable(eq)
        return eq
    if mode is not None and (not isinstance(mode, str) or len(mode) != robot.n_rods or set(mode) - set("LR")):
        raise ValueError(f"mode is {mode!r}, expected {robot.n_rods} letters L or R")
    found: list[Equilibrium] = []
    for q in angle_starts(robot, p, force, mode):
        try:
            solver.start(p, q)
            eq = solver.equilibrium(p, turn(solver, p, q, force))
            near = unwound(robot, p, eq.q)
            if (near != eq.q).any():
                solver.start(p, near)
                eq = solver.equilibrium(p, near)
        except PCRError:
            continue
        lower, upper = robot.angle_limits.T
        if eq.stable and (mode in (None, eq.mode)) and (eq.q >= lower).all() and (eq.q <= upper).all():
            found.append(eq)
    if not found:
        raise ConvergenceError(
            f"no stable pose{f' of mode {mode}' if mode else ''} found that holds p = {p} m with force {force} N "
            f"within the motor limits {robot.angle_limits.tolist()} rad; try another mode or a nearer tip",
            residual=np.nan,
            iterations=0,
            last=None,
        )
    return min(found, key=lambda eq: eq.energy)


def _require_equilibrium(guess: Any) -> None:
    if not isinstance(guess, Equilibrium):
        raise TypeError(f"guess is a {type(guess).__name__}, expected an Equilibrium")


def _require_usable(eq: Equilibrium) -> None:
    """Raise if a pose that the motors should hold is unstable or beyond their stops."""
    if not eq.stable:
        raise UnstableError(
            f"the branch leads to a pose at p = {eq.p} m, q = {eq.q} rad that is in balance but not stable: smallest "
            f"stiffness {eq.stiffness_eigenvalues[0]:.4g} N/m{named(eq.unstable_rods)}; choose a nearer tip "
            "or another working mode",
            eigenvalue=float(eq.stiffness_eigenvalues[0]),
            rod=eq.unstable_rods,
            p=eq.p,
            q=eq.q,
        )
    lower, upper = eq.robot.angle_limits.T
    outside = np.flatnonzero((eq.q < lower) | (eq.q > upper))
    if outside.size:
        i = int(outside[0])
        raise UnreachableError(
            f"p = {eq.p} m needs motor {i} at {eq.q[i]:.4f} rad, outside [{lower[i]:.4f}, {upper[i]:.4f}] rad; "
            "choose a nearer tip or another working mode",
            rod=i,
            angle=float(eq.q[i]),
            limits=(float(lower[i]), float(upper[i])),
        )


def free_solver(robot: Robot) -> RodSolver:
    """Build a solver by the method that is exact for the robot's rods."""
    if robot.needs_shooting is None:
        return RodSolver(robot, closed_form_method())
    return RodSolver(robot, shooting_method(_SHOOTING, robot_layout(robot)))


@per_thread(maxsize=32)
def _solver(robot: Robot) -> RodSolver:
    return free_solver(robot)
