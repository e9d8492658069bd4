"""Whether a pose is stable, by how much, and what else the robot could snap to."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import ConvergenceError, PCRError, checked_integer, checked_vector
from ...frozen import Frozen
from ..robot import Robot
from ..rods.closed_form import elastica
from ..rods.closed_form.chart import HeldShape, critical_load, stable_shapes
from ..rods.equations import aligned_steps, sample_rod
from ..rods.method import closed_form_method
from ..rods.physics import require_plain
from ..rods.shooting.multiple_shooting import rod_newton
from .balance import settle
from .equilibrium import Equilibrium
from .free_tip import free_solver
from .solver import RodSolver

_MAX_ITERATIONS = 40
_BALANCED = 1e-9  # residual force, of sum EI/L^2
_SAME = 1e-4  # of the rods' length, and of EI/L^2 and their forces, within which two poses are one
_RESOLVED = 1e-5  # residual and drift at which the sweep is trusted


@dataclass(frozen=True, eq=False)
class Stability(Frozen):
    """Verdict on one equilibrium.

    Attributes
    ----------
    unstable_directions : int
        Of the robot with its motors held: those of its rods with the tip held, and the negative eigenvalues of
        K. Zero if and only if the pose is stable.
    rod_margins : ndarray, shape (n,)
        1 - lambda / lambda_c of each rod: 1 unloaded, 0 at the limit, negative beyond. NaN where the rods are not
        plain (see `Robot.needs_shooting`): their limit is not a matter of one load.
    stiffness_eigenvalues : ndarray, shape (2,)
        Of K, ascending [N/m]. Where one passes zero the free tip snaps ("type 2" singularity).
    motor_authority : float
        Smallest singular value of G [N/rad]. Where it is zero the motors lose a direction of force ("type 1").
    """

    unstable_directions: int
    rod_margins: np.ndarray
    stiffness_eigenvalues: np.ndarray
    motor_authority: float

    @property
    def stable(self) -> bool:
        """Whether every direction is stable."""
        return self.unstable_directions == 0


def assess_stability(eq: Equilibrium) -> Stability:
    """Stability of the rods with the tip held, and the eigenvalues of K.

    Plain rods are judged by the closed form, lambda against lambda_c(k); others by `count_conjugate_points`, which
    gives no margin.
    """
    margins, count = np.full(eq.robot.n_rods, np.nan), 0
    if eq.robot.needs_shooting is not None:
        count = count_conjugate_points(eq)
    else:
        for i, nodes in enumerate(eq.nodes):
            log_tip_angle, load, _ = elastica.from_nodes(nodes)
            margins[i] = 1.0 - load / critical_load(log_tip_angle)
            count += elastica.conjugate_points(np.array([log_tip_angle, load, 1.0]))
    return Stability(
        unstable_directions=count + int((eq.stiffness_eigenvalues < 0).sum()),
        rod_margins=margins,
        stiffness_eigenvalues=eq.stiffness_eigenvalues,
        motor_authority=float(np.linalg.svd(eq.dforce_dq, compute_uv=False)[-1]),
    )


def least_rod_margin(eq: Equilibrium) -> float:
    """Least 1 - lambda / lambda_c of the rods; NaN if they are not plain. Cheaper than `assess_stability`."""
    return min(rod_margins(eq))


def rod_margins(eq: Equilibrium) -> list[float]:
    """1 - lambda / lambda_c of each rod; NaN if they are not plain."""
    if eq.robot.needs_shooting is not None:
        return [float("nan")] * eq.robot.n_rods
    shapes = (elastica.from_nodes(nodes) for nodes in eq.nodes)
    return [1.0 - load / critical_load(log_tip_angle) for log_tip_angle, load, _ in shapes]


def count_conjugate_points(eq: Equilibrium, segments: int = 16) -> int:
    """Unstable directions of the rods with the tip held, by a sweep over the rod equation from the tip.

    The independent route: Till and Rucker's transition matrices of the discretised rod, no elliptic functions.
    Two conjugate points within one of the segments would be missed.

    Raises
    ------
    ConvergenceError
        The segments do not resolve a taut rod.
    """
    layout = None if eq.physics[0] is None else eq.physics[0].layout
    newton, _ = rod_newton(segments, aligned_steps(layout, segments, 2), "rk8", layout)
    count = 0.0
    for rod, nodes, angle, physics in zip(eq.robot.rods, eq.nodes, eq.q, eq.physics, strict=True):
        sampled = sample_rod(nodes, segments + 1, physics)[2:, :segments]
        known = () if physics is None else (physics.values,)
        pose = np.append((eq.p - rod.base) / rod.length, angle)
        residual, _, _, conjugate_points, drift = newton(sampled.ravel(order="F"), pose, *known)[4].full().ravel()
        if not (residual < _RESOLVED and abs(drift) < _RESOLVED):
            raise ConvergenceError(
                f"a rod is too taut for {segments} segments: along the sweep its residual is {residual:.1e} and its "
                f"state drifts by {abs(drift):.1e} (at most {_RESOLVED:.0e} each); use more segments, or "
                "assess_stability",
                residual=residual,
                iterations=0,
                last=sampled,
            )
        count += conjugate_points
    return round(count)


def distance_to_fold(eq: Equilibrium, p_end: Any, q_end: Any, tolerance: float = 1e-6) -> float:
    """How far along a straight motion of tip and motors the pose stays stable.

    Parameters
    ----------
    eq : Equilibrium
        Stable start.
    p_end, q_end : array_like, shapes (2,), (n,)
        End of the motion [m, rad].
    tolerance : float
        Of the result.

    Returns
    -------
    float
        Fraction of the motion at which a rod reaches its limit or an eigenvalue of K passes zero; 1.0 if the
        whole motion is stable.
    """
    p_end, q_end = checked_vector("p_end", p_end, 2), checked_vector("q_end", q_end, eq.robot.n_rods)
    if not eq.stable:
        return 0.0
    solver = free_solver(eq.robot)
    solver.begin(eq)
    done, step = 0.0, 1.0 / 32.0
    while done < 1.0 and step > tolerance:
        target = min(1.0, done + step)
        p, q = eq.p + target * (p_end - eq.p), eq.q + target * (q_end - eq.q)
        try:
            eq.robot.require_reachable(p)
            solver.move(p, q, continuation=False)
            reached = solver.equilibrium(p, q)
        except PCRError:
            step /= 2
            continue
        if reached.stable:
            done = target
        else:
            step /= 2
            back = eq.p + done * (p_end - eq.p), eq.q + done * (q_end - eq.q)
            solver.start(*back, reached.nodes) if done == 0.0 else solver.move(*back)
    return done


def all_equilibria(
    robot: Robot, p: Any = None, q: Any = None, force: Any = (0.0, 0.0), *, starts: int = 8
) -> list[Equilibrium]:
    """Every equilibrium for given motor angles: "what else could it snap to?"

    Parameters
    ----------
    p : array_like, shape (2,), optional
        Held tip [m]: all combinations of the rods' stable shapes. None: the tip is free.
    q : array_like, shape (n,)
        Motor angles [rad].
    force : array_like, shape (2,)
        External force on a free tip besides its own weight m g [N], as `forward_statics` takes it.
    starts : int
        Positions of a free tip in a rod length from which poses are looked for.

    Returns
    -------
    list of Equilibrium
        By energy (free tip: potential energy, that of the weight included), each with its verdict ``stable``. A held
        tip's list is complete to the resolution of the chart (see `chart.stable_shapes`). A free tip's holds every
        pose to which Newton's method or the energy's descent lead from tip positions L / ``starts`` apart on every
        sheet of stable rods; nothing proves that there are no others.

    Raises
    ------
    UnreachableError
        The held tip is out of reach.
    ModelError
        The rods are not plain: the chart of stable shapes is of plain rods.
    """
    require_plain(robot, "all_equilibria")
    q, force = checked_vector("q", q, robot.n_rods), checked_vector("force", force, 2) + robot.tip_weight
    if p is not None:
        p = checked_vector("p", p, 2)
        robot.require_reachable(p)
        return held_equilibria(robot, p, q)
    spacing = robot.lengths.min() / checked_integer("starts", starts)
    low = (robot.bases - robot.lengths[:, None]).min(axis=0)
    high = (robot.bases + robot.lengths[:, None]).max(axis=0)
    free: list[Equilibrium] = []
    solver = RodSolver(robot, closed_form_method())
    for start in itertools.product(np.arange(low[0], high[0], spacing), np.arange(low[1], high[1], spacing)):
        at = np.array(start)
        if (np.linalg.norm(at - robot.bases, axis=1) > 0.98 * robot.lengths).any():
            continue
        for held in held_equilibria(robot, at, q):
            # Newton's method finds saddles too; the descent finds minima that it runs past.
            for search in (_balance, _descend):
                balanced = search(solver, held, force)
                if balanced is not None and not any(_same(balanced, other) for other in free):
                    free.append(balanced)
    return sorted(free, key=lambda eq: eq.energy - float(force @ eq.p))


def held_equilibria(robot: Robot, p: np.ndarray, q: np.ndarray) -> list[Equilibrium]:
    """Equilibria of the held tip: all combinations of the rods' shapes that are stable in themselves, by energy.

    Complete, to the resolution of the chart, for plain rods; those of others are looked for from the shapes that plain
    ones would have, and what leads nowhere, or to the same twice, is left out.

    Parameters
    ----------
    robot : Robot
    p : ndarray, shape (2,)
        Tip, within the rods' reach [m].
    q : ndarray, shape (n,)
        Motor angles [rad].
    """
    solver = free_solver(robot)
    choices: list[list[HeldShape]] = []
    for rod, angle in zip(robot.rods, q, strict=True):
        dx, dy = (p - rod.base) / rod.length
        cos, sin = np.cos(angle), np.sin(angle)
        choices.append(stable_shapes(cos * dx + sin * dy, cos * dy - sin * dx))
    found: list[Equilibrium] = []
    for shapes in itertools.product(*choices):
        nodes = np.stack([shape.nodes(8, angle) for shape, angle in zip(shapes, q, strict=True)])
        try:
            solver.start(p, q, nodes)
            eq = solver.equilibrium(p, q)
        except ConvergenceError:
            continue  # a shape at the very edge of the chart
        if robot.needs_shooting is None or not (eq.unstable_rods or any(_same(eq, other) for other in found)):
            found.append(eq)
    return sorted(found, key=lambda eq: eq.energy)


def _balance(solver: RodSolver, start: Equilibrium, force: np.ndarray) -> Equilibrium | None:
    """Newton's method on F(p, q) = force, to a stable or an unstable pose; None if it leads nowhere."""
    robot, p, q = start.robot, start.p, start.q
    longest = 0.1 * robot.lengths.min()
    try:
        solver.begin(start)
        for _ in range(_MAX_ITERATIONS):
            residual = solver.force() - force
            if np.linalg.norm(residual) < _BALANCED * robot.force_scale:
                eq = solver.equilibrium(p, q)
                return None if eq.unstable_rods else eq
            step = -np.linalg.solve(solver.jacobians()[0], residual)
            p = p + step * min(1.0, longest / float(np.linalg.norm(step)))
            robot.require_reachable(p)
            solver.move(p, q, continuation=False)
    except (PCRError, np.linalg.LinAlgError):
        return None
    return None


def _descend(solver: RodSolver, start: Equilibrium, force: np.ndarray) -> Equilibrium | None:
    """Energy descent to a stable pose; None if the rods cannot follow."""
    try:
        solver.begin(start)
        return solver.equilibrium(settle(solver, start.p, start.q, force), start.q)
    except PCRError:
        return None


def _same(a: Equilibrium, b: Equilibrium) -> bool:
    length = a.robot.lengths.min()
    unit = (a.robot.stiffnesses / a.robot.lengths**2)[:, None]
    near = np.abs(a.p - b.p).max() <= _SAME * length
    return bool(near and (np.abs(a.rod_forces - b.rod_forces) <= _SAME * (unit + np.abs(b.rod_forces))).all())
