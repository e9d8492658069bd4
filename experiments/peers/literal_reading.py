"""The paper's method as its text reads: multiple shooting of sec. 4 handed to SciPy's least squares.

Two rods, N segments each. Unknowns: the state [theta, n_x, n_y, m] at the start of every segment, 8N in all. Residuals,
8N as well: continuity from each segment to the next, the tip's position, no moment at the pin, and the balance of
forces there, integrated by classical Runge-Kutta steps in SI units. Where the text leaves the count open, it is closed
as the README says: theta_{i,0} is the motor's angle and no unknown, and F is solved for in its stead.

`scipy.optimize.least_squares` is called as it comes: trust region, Jacobian by forward differences, tolerances 1e-8.
The integration is a loop over rods, segments and steps, as the equations are written. So that nobody calls that a straw
man, the same loop over steps alone, for all segments of all rods at once, is the other choice, ten times as fast.

Time is stepped as in the paper's sec. 3: the statics at the new pose, from the last solution, and semi-implicit Euler.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from pcr_mpc import ConvergenceError, Equilibrium, Robot
from pcr_mpc.plant.rods.equations import sample_rod

# A fit that leaves more than this, in SI units, has found no equilibrium.
ACCEPTED_RESIDUAL = 1e-4
# Trial points after which a fit that does not converge is given up.
MOST_TRIALS = 100


@dataclass
class Solution:
    """What least squares found.

    Attributes
    ----------
    unknowns : ndarray, shape (8N,)
    force : ndarray, shape (2,)
        F [N].
    iterations : int
        Jacobians that were evaluated.
    evaluations : int
        Residuals that were, those for the Jacobians among them.
    """

    unknowns: np.ndarray
    force: np.ndarray
    iterations: int
    evaluations: int


class LiteralReading:
    """Statics and time steps of a robot with two rods.

    Parameters
    ----------
    robot : Robot
    segments : int
        N, of each rod; 1 is single shooting.
    steps : int
        Runge-Kutta steps in a segment.
    at_once : bool
        Integrate all segments as one array.
    """

    def __init__(self, robot: Robot, segments: int = 8, steps: int = 4, *, at_once: bool = False) -> None:
        self.robot, self.segments, self.steps = robot, segments, steps
        self._integrate = self._at_once if at_once else self._one_by_one

    def guess(self, pose: Equilibrium) -> np.ndarray:
        """Unknowns of a known pose, shape (8N,)."""
        units = np.stack([np.ones(2), *[self.robot.stiffnesses / self.robot.lengths**e for e in (2, 2, 1)]])
        nodes = [sample_rod(rod, self.segments + 1)[2:, : self.segments] for rod in pose.nodes]
        return self._flat(np.stack(nodes, axis=1) * units[:, :, None], pose.force)

    def solve(self, p: np.ndarray, q: np.ndarray, guess: np.ndarray) -> Solution:
        """Find the equilibrium at (p, q) from a guess of the unknowns.

        Raises
        ------
        ConvergenceError
            Least squares stopped with a residual above `ACCEPTED_RESIDUAL`, or met one that is not finite.
        """
        evaluations = 0

        def residual(unknowns: np.ndarray) -> np.ndarray:
            nonlocal evaluations
            evaluations += 1
            return self.residual(unknowns, p, q)

        with np.errstate(all="ignore"):
            try:
                fit = least_squares(residual, guess, max_nfev=MOST_TRIALS)
            except ValueError as error:
                raise ConvergenceError(
                    f"literal reading at p = {p} m, q = {q} rad: {error}", residual=np.nan, iterations=0, last=guess
                ) from None
            norm = float(np.linalg.norm(fit.fun))
        if not norm <= ACCEPTED_RESIDUAL:
            raise ConvergenceError(
                f"literal reading at p = {p} m, q = {q} rad stopped with residual {norm:.1e}: {fit.message}",
                residual=norm,
                iterations=fit.njev,
                last=fit.x,
            )
        return Solution(fit.x, fit.x[-2:].copy(), int(fit.njev), evaluations)

    def residual(self, unknowns: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Paper eq. (15), shape (8N,): gaps [rad, N, N, N m], tip [m], moment at the tip [N m], forces [N]."""
        nodes, force = np.empty((4, 2, self.segments)), unknowns[-2:]
        nodes.reshape(4, -1)[1:] = unknowns[: 6 * self.segments].reshape(3, -1)
        nodes[0, :, 0] = q
        nodes[0, :, 1:] = unknowns[6 * self.segments : -2].reshape(2, -1)
        displacement, ends = self._integrate(nodes)
        gaps = ends[:, :, :-1] - nodes[:, :, 1:]
        tips = self.robot.bases.T + displacement.sum(axis=2) - p[:, None]
        balance = ends[1:3, :, -1].sum(axis=1) - force
        return np.concatenate([gaps.ravel(), tips.ravel(), ends[3, :, -1], balance])

    def step(self, x: np.ndarray, u: np.ndarray, last: Solution, dt: float) -> tuple[np.ndarray, Solution]:
        """One step of semi-implicit Euler from state x with ``last``, the rods there; the new state and its rods."""
        p, v, q = x[:2], x[2:4], x[4:]
        v = v - dt / self.robot.tip_mass * (last.force + self.robot.drag * v)
        p, q = p + dt * v, q + dt * u
        return np.concatenate([p, v, q]), self.solve(p, q, last.unknowns)

    def _flat(self, nodes: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Forces and moments of all nodes, angles of all but the first, F."""
        return np.concatenate([nodes[1:].ravel(), nodes[0, :, 1:].ravel(), force])

    def _one_by_one(self, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Displacement (2, 2, N) [m] and final state (4, 2, N) of every segment."""
        displacement, ends = np.empty((2, 2, self.segments)), np.empty((4, 2, self.segments))
        for i, rod in enumerate(self.robot.rods):
            h = rod.length / (self.segments * self.steps)
            for j in range(self.segments):
                theta, n_x, n_y, m = nodes[:, i, j]
                y = np.array([0.0, 0.0, theta, m])
                for _ in range(self.steps):
                    y = _runge_kutta(y, n_x, n_y, h, rod.bending_stiffness)
                displacement[:, i, j], ends[:, i, j] = y[:2], (y[2], n_x, n_y, y[3])
        return displacement, ends

    def _at_once(self, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Do as `_one_by_one`, for all segments together."""
        y = np.stack([np.zeros_like(nodes[0]), np.zeros_like(nodes[0]), nodes[0], nodes[3]])
        h = (self.robot.lengths / (self.segments * self.steps))[:, None]
        for _ in range(self.steps):
            y = _runge_kutta(y, nodes[1], nodes[2], h, self.robot.stiffnesses[:, None])
        return y[:2], np.stack([y[2], nodes[1], nodes[2], y[3]])


def _runge_kutta(y: np.ndarray, n_x: np.ndarray, n_y: np.ndarray, h: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
    """One classical step of [x, y, theta, m], paper eq. (1)-(4)."""

    def slope(state: np.ndarray) -> np.ndarray:
        cos, sin = np.cos(state[2]), np.sin(state[2])
        return np.array([cos, sin, state[3] / stiffness, n_x * sin - n_y * cos])

    k1 = slope(y)
    k2 = slope(y + h / 2 * k1)
    k3 = slope(y + h / 2 * k2)
    k4 = slope(y + h * k3)
    return np.asarray(y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
