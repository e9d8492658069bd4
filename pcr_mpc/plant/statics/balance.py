"""A tip in balance: by descent for given motors, by turning the motors for a given tip, and followed from there."""

from __future__ import annotations

import math

import numpy as np

from ...errors import ConvergenceError, PCRError, UnstableError
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
                    f"{values[0]:.4g} N/m{named(solver.unstable_rods())}; the branch ended, choose other motor angles",
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


def follow(solver: RodSolver, guess: Equilibrium, q: np.ndarray, force: np.ndarray) -> Equilibrium:
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


def reach(solver: RodSolver, guess: Equilibrium, p: np.ndarray, force: np.ndarray) -> np.ndarray:
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
            q = turn(solver, at_p, q, at_force, ahead)
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


def turn(
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


def named(rods: tuple[int, ...]) -> str:
    """Name unstable rods at the end of a sentence, if there are some."""
    return f", unstable rods {', '.join(map(str, rods))}" if rods else ""
