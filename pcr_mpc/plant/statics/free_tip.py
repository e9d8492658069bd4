"""Poses at which the tip is in balance: forward (motors -> tip) and inverse (tip -> motors) statics."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...buffered import per_thread
from ...errors import ConvergenceError, PCRError, UnreachableError, UnstableError, checked_vector
from ..robot import Robot
from ..rods.chart import held_shapes
from ..rods.method import Shooting, closed_form_method, shooting_method
from ..rods.physics import robot_layout
from .equilibrium import Equilibrium
from .solver import RodSolver

_MAX_ITERATIONS = 100
_MAX_TRIALS = 30  # motor angles tried for one balance; of 1600 that were found, the slowest took 21
_FORCE_TOLERANCE = 1e-9  # of the robot's force scale, sum EI/L^2
_RESOLUTION = 1e-12  # of the tip position, in rod lengths
_ANGLE_STEP = 0.25  # largest motor step of a continuation [rad]
_AHEAD = 0.1  # turn of the motors up to which the linear prediction of it is tried [rad]
_SMALLEST_STEP = 1e-5  # of a continuation, as a fraction of the way
_FOLD_STIFFNESS = 0.05  # smallest over largest eigenvalue of K: one that ends there has come to a fold
_TIP_STEP = 0.05  # largest tip step of a continuation, in rod lengths
_OFFSETS = np.linspace(-2.6, 2.6, 40)  # clamp angle minus chord angle, of a cold inverse start [rad]
_CANDIDATES = 24
_COMBINATIONS = 100_000
_SHOOTING = Shooting(steps=2)  # where the closed form does not hold: 1e-8 of F but on taut rods
_NARROW = 3  # angles between the stops that a cold inverse start needs at least


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
        return _follow(solver, guess, q, force)
    found: list[Equilibrium] = []
    last: PCRError | None = None
    for start in _tip_starts(robot, q):
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
        eq = solver.equilibrium(p, _reach(solver, guess, p, force))
        _require_usable(eq)
        return eq
    if mode is not None and (not isinstance(mode, str) or len(mode) != robot.n_rods or set(mode) - set("LR")):
        raise ValueError(f"mode is {mode!r}, expected {robot.n_rods} letters L or R")
    found: list[Equilibrium] = []
    for q in _angle_starts(robot, p, force, mode):
        try:
            solver.start(p, q)
            eq = solver.equilibrium(p, _turn(solver, p, q, force))
            unwound = _unwound(robot, p, eq.q)
            if (unwound != eq.q).any():
                solver.start(p, unwound)
                eq = solver.equilibrium(p, unwound)
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


def settle(solver: RodSolver, p: np.ndarray, q: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Descend the potential energy U(p, q) - force . p to a stable pose, by Newton's method with a bounded step."""
    robot = solver.robot
    solver.move(p, q)
    energy = solver.energy() - force @ p
    radius = 0.1 * robot.lengths.min()
    for iteration in range(_MAX_ITERATIONS):
        residual = solver.force() - force
        stiffness, _ = solver.jacobians()
        values, vectors = np.linalg.eigh((stiffness + stiffness.T) / 2)
        # No better than the tip position is resolved, which counts where rods are nearly straight.
        tolerance = _FORCE_TOLERANCE * robot.force_scale + _RESOLUTION * float(robot.lengths.max() * values[-1])
        if math.hypot(*residual) <= tolerance:
            if values[0] <= 0 or solver.unstable_rods():
                raise UnstableError(
                    f"the pose p = {p} m, q = {q} rad is in balance but not stable: smallest stiffness "
                    f"{values[0]:.4g} N/m{_named(solver.unstable_rods())}; the branch ended, choose other motor angles",
                    eigenvalue=float(values[0]),
                    rod=solver.unstable_rods(),
                    p=p,
                    q=q,
                )
            return p
        # Newton where the energy is convex, downhill where it is not.
        step = -vectors @ ((vectors.T @ residual) / np.maximum(np.abs(values), 1e-3 * np.abs(values).max()))
        step *= radius / max(math.hypot(*step), radius)
        while True:
            try:
                robot.require_reachable(p + step)
                solver.move(p + step, q, continuation=False)
                trial = solver.energy() - force @ (p + step)
                # Near the minimum the energy is flat to rounding: there the force must shrink instead.
                if trial < energy or math.hypot(*(solver.force() - force)) < 0.5 * math.hypot(*residual):
                    break
            except PCRError:
                pass
            step = step / 2
            if not math.hypot(*step) >= 1e-7 * robot.lengths.min():
                raise ConvergenceError(
                    f"the tip cannot settle near p = {p} m for q = {q} rad: force residual "
                    f"{math.hypot(*residual):.3g} N after {iteration} iterations; pass a guess",
                    residual=math.hypot(*residual),
                    iterations=iteration,
                    last=p,
                )
        p, energy = p + step, trial
    raise ConvergenceError(
        f"the tip did not settle in {_MAX_ITERATIONS} iterations, last at p = {p} m, force residual "
        f"{math.hypot(*residual):.3g} N; pass a guess",
        residual=math.hypot(*residual),
        iterations=_MAX_ITERATIONS,
        last=p,
    )


def _follow(solver: RodSolver, guess: Equilibrium, q: np.ndarray, force: np.ndarray) -> Equilibrium:
    """Follow the balanced tip from ``guess`` to (q, force), in sub-steps where one step fails."""
    robot, eq, done = solver.robot, guess, 0.0
    largest = substep = min(1.0, _ANGLE_STEP / max(float(np.abs(q - guess.q).max()), _ANGLE_STEP))
    near = _TIP_STEP * float(robot.lengths.min())
    while done < 1.0:
        target = 1.0 if done + substep >= 1.0 else done + substep
        at_q, at_force = guess.q + target * (q - guess.q), guess.force + target * (force - guess.force)
        solver.begin(eq)
        try:
            predicted = eq.p + np.linalg.solve(eq.dforce_dp, at_force - eq.force - eq.dforce_dq @ (at_q - eq.q))
            robot.require_reachable(predicted)
            p = settle(solver, predicted, at_q, at_force)
            if np.linalg.norm(p - predicted) > near:
                raise UnstableError(
                    f"the tip leaves its branch near p = {eq.p} m, q = {eq.q} rad: from there it falls to p = {p} m; "
                    "choose other motor angles, or a guess on another branch",
                    eigenvalue=float(eq.stiffness_eigenvalues[0]),
                    p=eq.p,
                    q=eq.q,
                )
        except PCRError as error:
            substep /= 2
            if substep < _SMALLEST_STEP:
                if eq.stiffness_eigenvalues[0] < _FOLD_STIFFNESS * eq.stiffness_eigenvalues[1]:
                    raise UnstableError(
                        f"the branch of the guess ends at a fold: at {100 * done:.1f} % of the way, p = {eq.p} m, "
                        f"q = {eq.q} rad, the smallest stiffness is down to {eq.stiffness_eigenvalues[0]:.3g} N/m, and "
                        "the tip would snap to another pose; choose other motor angles, or a guess on another branch",
                        eigenvalue=float(eq.stiffness_eigenvalues[0]),
                        p=eq.p,
                        q=eq.q,
                    ) from error
                raise
        else:
            eq, done, substep = solver.equilibrium(p, at_q), target, min(2 * substep, largest)
    return eq


def _require_equilibrium(guess: Any) -> None:
    if not isinstance(guess, Equilibrium):
        raise TypeError(f"guess is a {type(guess).__name__}, expected an Equilibrium")


def _named(rods: tuple[int, ...]) -> str:
    return f", unstable rods {', '.join(map(str, rods))}" if rods else ""


def _require_usable(eq: Equilibrium) -> None:
    """Raise if a pose that the motors should hold is unstable or beyond their stops."""
    if not eq.stable:
        raise UnstableError(
            f"the branch leads to a pose at p = {eq.p} m, q = {eq.q} rad that is in balance but not stable: smallest "
            f"stiffness {eq.stiffness_eigenvalues[0]:.4g} N/m{_named(eq.unstable_rods)}; choose a nearer tip "
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


def _reach(solver: RodSolver, guess: Equilibrium, p: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Follow the branch of ``guess`` to (p, force), in sub-steps where one step fails."""
    longest = _TIP_STEP * float(solver.robot.lengths.min())
    q, done = guess.q, 0.0
    k, g = guess.dforce_dp, guess.dforce_dq
    largest = substep = min(1.0, longest / max(float(np.linalg.norm(p - guess.p)), longest))
    while done < 1.0:
        target = min(1.0, done + substep)
        at_p, at_force = guess.p + target * (p - guess.p), guess.force + target * (force - guess.force)
        moved = (target - done) * (p - guess.p)
        ahead = _least_motion(g, (target - done) * (force - guess.force) - k @ moved)
        try:
            q = _turn(solver, at_p, q, at_force, ahead)
        except ConvergenceError as error:
            substep /= 2
            if substep < 1e-2:
                raise ConvergenceError(
                    f"no motor angles hold p = {p} m with force {force} N on the branch of the guess; got "
                    f"{100 * done:.0f} % of the way from p = {guess.p} m; {error}",
                    residual=error.residual,
                    iterations=error.iterations,
                    last=q,
                ) from None
        else:
            done, substep = target, min(2 * substep, largest)
            k, g = solver.jacobians()
    return q


def _least_motion(g: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Turn of the motors by which the rods carry so much more force: the least, if they are redundant."""
    return np.asarray(np.linalg.lstsq(g, force, rcond=1e-10)[0])


def _turn(
    solver: RodSolver, p: np.ndarray, q: np.ndarray, force: np.ndarray, ahead: np.ndarray | None = None
) -> np.ndarray:
    """Turn the motors by Newton's method (least motion if redundant) until the rods carry ``force`` at p.

    ``ahead`` is by how much they are expected to turn, which saves an iteration if it is little.
    """
    tolerance = _FORCE_TOLERANCE * solver.robot.force_scale
    if ahead is not None and np.abs(ahead).max() < _AHEAD:
        try:
            solver.move(p, q + ahead)
            q = q + ahead
        except PCRError:
            solver.move(p, q)
    else:
        solver.move(p, q)
    residual, trials = force - solver.force(), 0
    while math.hypot(*residual) > tolerance:
        step = _least_motion(solver.jacobians()[1], residual)
        step *= _ANGLE_STEP / max(float(np.abs(step).max()), _ANGLE_STEP)
        while True:
            if trials == _MAX_TRIALS:
                raise ConvergenceError(
                    f"motors cannot balance p = {p} m: force residual {math.hypot(*residual):.3g} N at q = {q} rad "
                    f"after {trials} trials",
                    residual=math.hypot(*residual),
                    iterations=trials,
                    last=q,
                )
            solver.move(p, q + step)
            trials += 1
            trial = force - solver.force()
            if math.hypot(*trial) < math.hypot(*residual):
                break
            step = step / 2
        q, residual = q + step, trial
    return q


def _tip_starts(robot: Robot, q: np.ndarray) -> list[np.ndarray]:
    """Tip positions to descend from: where the straight rods would end, drawn into reach, and points around it."""
    straight = robot.bases + robot.lengths[:, None] * np.stack([np.cos(q), np.sin(q)], axis=1)
    centre = robot.bases.mean(axis=0)
    radius = 0.5 * robot.lengths.min()
    starts = [straight.mean(axis=0)]
    starts += [centre + radius * np.array([np.cos(a), np.sin(a)]) for a in np.pi * np.arange(8) / 4 + np.pi / 2]
    # Of rods that only just meet, half of what is left between there and straight.
    closest = float((np.linalg.norm(centre - robot.bases, axis=1) / robot.lengths).max())
    reach = max(0.9, (1.0 + closest) / 2)
    inside = []
    for start in starts:
        for _ in range(60):
            if (np.linalg.norm(start - robot.bases, axis=1) < reach * robot.lengths).all():
                inside.append(start)
                break
            start = start + 0.1 * (centre - start)
    return inside


def _angle_starts(robot: Robot, p: np.ndarray, force: np.ndarray, mode: str | None) -> list[np.ndarray]:
    """Motor angles within limits whose coarse shapes nearly carry ``force``, best first."""
    scale = robot.force_scale
    # The coarser, the more rods there are to combine.
    stride = math.ceil(len(_OFFSETS) / max(1, int(_COMBINATIONS ** (1 / robot.n_rods))))
    offsets = _OFFSETS[stride // 2 :: stride]
    per_rod: list[np.ndarray] = []
    scores = np.zeros((1, 3))  # mismatch of the force (2) and energy of every combination so far
    scores[0, :2] = -force / scale
    for i, rod in enumerate(robot.rods):
        dx, dy = (p - rod.base) / rod.length
        lower, upper = rod.angle_limits
        chord = np.arctan2(dy, dx)
        angles = lower + (chord + offsets - lower) % (2 * np.pi)
        angles = _nearest_turn(angles[angles <= upper], chord, lower, upper)
        if len(angles) < _NARROW:
            angles = np.linspace(lower, upper, _NARROW)
        unit = rod.bending_stiffness / rod.length**2 / scale
        rows = []
        for angle in angles:
            cos, sin = np.cos(angle), np.sin(angle)
            shape = held_shapes(cos * dx + sin * dy, cos * dy - sin * dx)[0]
            if mode is None or ("L" if shape.hand < 0 else "R") == mode[i]:
                n_x, n_y = shape.nodes(1, angle)[1:3, 0] * unit
                rows.append((angle, n_x, n_y, shape.energy))
        table = np.array(rows).reshape(-1, 4)
        per_rod.append(table[:, 0])
        scores = (scores[:, None] + table[:, 1:]).reshape(-1, 3)
    best = np.argsort(np.hypot(*scores.T[:2]) + 0.02 * scores[:, 2], kind="stable")[:_CANDIDATES]
    chosen = np.unravel_index(best, [len(angles) for angles in per_rod])
    return list(np.stack([angles[at] for angles, at in zip(per_rod, chosen, strict=True)], axis=1))


def _unwound(robot: Robot, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Motor angles of the same shapes, each on the turn that is nearest to its rod's chord and between the stops."""
    chords = np.arctan2(*(p - robot.bases).T[::-1])
    return _nearest_turn(q, chords, *robot.angle_limits.T)


def _nearest_turn(angles: np.ndarray, wanted: Any, lower: Any, upper: Any) -> np.ndarray:
    """Add the whole turns by which angles come nearest to what is wanted and stay within limits, if they can."""
    turn = 2 * np.pi
    least, most = np.ceil((lower - angles) / turn), np.floor((upper - angles) / turn)
    turns = np.minimum(np.maximum(np.round((wanted - angles) / turn), least), most)
    return np.asarray(np.where(least <= most, angles + turn * turns, angles))


def free_solver(robot: Robot) -> RodSolver:
    """Build a solver by the method that is exact for the robot's rods."""
    if robot.needs_shooting is None:
        return RodSolver(robot, closed_form_method())
    return RodSolver(robot, shooting_method(_SHOOTING, robot_layout(robot)))


@per_thread(maxsize=32)
def _solver(robot: Robot) -> RodSolver:
    return free_solver(robot)
