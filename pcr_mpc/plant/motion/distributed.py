"""The robot with rods of distributed mass: what the condensed inertia is measured against.

Unknowns are the strain modes of the rods and the tip, joined by an exact pin: the tips of all rods are p. Time steps
are Gauss collocation with two stages (order 4, symplectic but for the pin) on Lagrange's equations with the pin at
acceleration level, after which positions and velocities are moved onto it along the directions in which the pin's
forces act. The stiff modes that a step does not resolve stay bounded. Damping is the tip's drag alone: vibrations of
the rods live on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lu_factor, lu_solve

from ...errors import ConvergenceError
from ..robot import Robot
from ..rods.strain_modes import Blocks, StrainModes

_STAGES = np.array([[0.25, 0.25 - np.sqrt(3) / 6], [0.25 + np.sqrt(3) / 6, 0.25]])
_TWICE, _NODES = _STAGES @ _STAGES, _STAGES.sum(axis=1)
_MOST_ITERATIONS = 30
# Of angles [rad], and of tip forces relative to their size or EI/L^2.
_TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False)
class ModalState:
    """Modes a (n, N) [rad] with their rates, tip p, v (2), motors q, u (n) [m, m/s, rad, rad/s]."""

    a: np.ndarray
    a_dot: np.ndarray
    p: np.ndarray
    v: np.ndarray
    q: np.ndarray
    u: np.ndarray


class DistributedRods:
    """Lagrange's equations of tip and rods.

    Parameters
    ----------
    robot : Robot
    modes : int
        Strain modes per rod.
    """

    def __init__(self, robot: Robot, modes: int) -> None:
        self.robot = robot
        self.tip_mass = robot.tip_mass  # [kg]; more while the tip carries a payload
        self.modes = StrainModes(robot, modes)
        self._units = robot.stiffnesses / robot.lengths**2  # of forces
        n = robot.n_rods
        self._n_modes = n * modes
        # Rows and columns: modes, tip, forces on the rods' tips.
        self._size = self._n_modes + 2 + 2 * n

    def settled(self, p: np.ndarray, v: np.ndarray, q: np.ndarray, nodes: np.ndarray) -> ModalState:
        """Rods in equilibrium at (p, q), moving with the tip as their equilibrium does; motors at rest.

        Parameters
        ----------
        nodes : ndarray, shape (n, 4, any)
            Of an equilibrium at (p, q) (see `Equilibrium.nodes`).

        Raises
        ------
        ConvergenceError
            The modes cannot take that shape.
        """
        a, forces = self.modes.fitted(nodes), nodes[:, 1:3, 0] - self.modes.weight
        target = (p - self.robot.bases) / self.robot.lengths[:, None]
        for _ in range(_MOST_ITERATIONS):
            theta = self.modes.angles(a, q)
            at_rest = np.zeros_like(theta)
            blocks = self.modes.blocks(theta, at_rest, at_rest, forces)
            systems = np.zeros((len(a), a.shape[1] + 2, a.shape[1] + 2))
            systems[:, :-2, :-2] = blocks.stiffness
            systems[:, :-2, -2:] = -np.swapaxes(blocks.jacobian, 1, 2)
            systems[:, -2:, :-2] = blocks.jacobian
            residual = self.modes.forces(theta, at_rest, at_rest, forces)[0] + self.modes.elastic_moments(a)
            right = np.concatenate([-residual, target - self.modes.tips(a, q)], axis=1)
            step = np.linalg.solve(systems, right[:, :, None])[:, :, 0]
            a, forces = a + step[:, :-2], forces + step[:, -2:]
            if np.abs(step[:, :-2]).max() < _TOLERANCE:
                break
        else:
            raise _error("they did not settle; use more modes", float(np.abs(step).max()), _MOST_ITERATIONS, a)
        moves = np.zeros((len(a), a.shape[1] + 2, 1))
        moves[:, -2:, 0] = v / self.robot.lengths[:, None]
        a_dot = np.linalg.solve(systems, moves)[:, :-2, 0]
        return ModalState(a, a_dot, np.array(p), np.array(v), np.array(q), np.zeros(len(q)))

    @np.errstate(over="ignore", invalid="ignore")  # in iterations that diverge, which fail
    def step(self, state: ModalState, u: np.ndarray, f_ext: np.ndarray, dt: float) -> ModalState:
        """Advance by ``dt`` with the motors turning at ``u`` (n), from whose jump the rods take an impulse.

        Raises
        ------
        ConvergenceError
            The stages were not solved: the step is too long.
        """
        state = self._turned(state, u)
        n, width = self.robot.n_rods, self._n_modes + 2
        y, y_dot = np.append(state.a, state.p), np.append(state.a_dot, state.v)
        # The equations are linear in accelerations and pin forces.
        nothing = np.zeros(self._size)
        start = self._solve(state, -self._residual(y, y_dot, nothing, state.q, u, f_ext))
        theta, turning = self.modes.angles(state.a, state.q), self.modes.turned(state.a_dot, u)
        faster = self.modes.turned(start[: width - 2].reshape(n, -1), np.zeros(n))
        blocks = self.modes.blocks(theta, turning, faster, start[width:].reshape(n, 2))
        factors = lu_factor(self._stage_system(blocks, dt))
        q = state.q + dt * _NODES[:, None] * u
        unknowns, size, iteration = np.stack([start, start]), np.inf, 0
        # Written so that NaN goes on, and fails.
        while not size < _TOLERANCE:
            if iteration == _MOST_ITERATIONS:
                raise _error(f"a step of {dt} s was not solved; shorten it", size, iteration, unknowns)
            accelerations = unknowns[:, :width]
            at = y + dt * np.outer(_NODES, y_dot) + dt**2 * _TWICE @ accelerations
            at_dot = y_dot + dt * _STAGES @ accelerations
            residual = self._residual(at, at_dot, unknowns, q, u, f_ext)
            change = lu_solve(factors, -residual.ravel(), check_finite=False).reshape(2, -1)
            unknowns = unknowns + change
            forces = float(np.abs(change[:, width:]).max() / (1.0 + np.abs(unknowns[:, width:]).max()))
            size = max(dt**2 * float(np.abs(change[:, :width]).max()), forces)
            iteration += 1
        y = y + dt * y_dot + dt**2 * _STAGES.sum(axis=0) / 2 @ unknowns[:, :width]
        y_dot = y_dot + dt * unknowns[:, :width].sum(axis=0) / 2
        a, a_dot = y[:-2].reshape(n, -1), y_dot[:-2].reshape(n, -1)
        return self._pinned(ModalState(a, a_dot, y[-2:], y_dot[-2:], state.q + dt * u, u.copy()))

    def picked_up(self, state: ModalState, mass: float) -> ModalState:
        """State after ``mass`` [kg], at rest, has joined the tip, whose own mass holds it already."""
        width = self._n_modes + 2
        right = np.zeros(self._size)
        right[width - 2 : width] = -mass * state.v
        change = self._solve(state, right)
        a_dot = state.a_dot + change[: width - 2].reshape(self.robot.n_rods, -1)
        return replace(state, a_dot=a_dot, v=state.v + change[width - 2 : width])

    def energy(self, state: ModalState) -> float:
        """Kinetic energy, and that of the rods' bending and weight [J]."""
        kinetic, potential = self.modes.energies(state.a, state.a_dot, state.q, state.u)
        of_rods = (kinetic + potential) @ (self.robot.stiffnesses / self.robot.lengths)
        return float(of_rods + self.tip_mass * state.v @ state.v / 2)

    def _residual(
        self, y: np.ndarray, y_dot: np.ndarray, unknowns: np.ndarray, q: np.ndarray, u: np.ndarray, f_ext: np.ndarray
    ) -> np.ndarray:
        """Equations of motion of modes and tip, and the pins at acceleration level; stages along the first axis."""
        n, width, stages = self.robot.n_rods, self._n_modes + 2, unknowns.shape[:-1]
        a, a_dot, faster = (of[..., : width - 2].reshape(*stages, n, -1) for of in (y, y_dot, unknowns))
        forces, acceleration = unknowns[..., width:].reshape(*stages, n, 2), unknowns[..., width - 2 : width]
        still = np.zeros_like(q)
        on_modes, tips = self.modes.forces(
            self.modes.angles(a, q), self.modes.turned(a_dot, u), self.modes.turned(faster, still), forces
        )
        on_modes += self.modes.elastic_moments(a)
        on_tip = self.tip_mass * acceleration + self.robot.drag * y_dot[..., -2:] - f_ext
        on_tip += (self._units[:, None] * forces).sum(axis=-2)
        pins = self.robot.lengths[:, None] * tips - acceleration[..., None, :]
        return np.concatenate([on_modes.reshape(*stages, -1), on_tip, pins.reshape(*stages, -1)], axis=-1)

    def _system(self, blocks: Blocks) -> np.ndarray:
        """Derivative of the residual in accelerations and pin forces."""
        n, width = self.robot.n_rods, self._n_modes + 2
        system = self._rows(blocks.mass, blocks.jacobian, self.tip_mass)
        per_rod = self._n_modes // n
        for i in range(n):
            columns = slice(width + 2 * i, width + 2 * i + 2)
            system[i * per_rod : (i + 1) * per_rod, columns] = -blocks.jacobian[i].T
            system[width - 2 : width, columns] = self._units[i] * np.eye(2)
            system[columns, width - 2 : width] = -np.eye(2)
        return system

    def _rows(self, of_modes: np.ndarray, of_tips: np.ndarray, of_tip: float) -> np.ndarray:
        """Blocks (n, N, N) and (n, 2, N) of the rods, and a number for the tip, at their places."""
        width, per_rod = self._n_modes + 2, of_modes.shape[1]
        matrix = np.zeros((self._size, self._size))
        for i, length in enumerate(self.robot.lengths):
            own = slice(i * per_rod, (i + 1) * per_rod)
            matrix[own, own] = of_modes[i]
            matrix[width + 2 * i : width + 2 * i + 2, own] = length * of_tips[i]
        matrix[width - 2 : width, width - 2 : width] = of_tip * np.eye(2)
        return matrix

    def _stage_system(self, blocks: Blocks, dt: float) -> np.ndarray:
        """Derivative of both stages' residuals in both stages' unknowns."""
        damping = self._rows(blocks.damping, blocks.tip_damping, self.robot.drag)
        stiffness = self._rows(blocks.stiffness, blocks.tip_stiffness, 0.0)
        system = np.kron(np.eye(2), self._system(blocks))
        return np.asarray(system + np.kron(dt * _STAGES, damping) + np.kron(dt**2 * _TWICE, stiffness))

    def _solve(self, state: ModalState, right: np.ndarray) -> np.ndarray:
        """Accelerations and pin forces, or what else obeys the mass and the pins at this shape."""
        theta = self.modes.angles(state.a, state.q)
        at_rest = np.zeros_like(theta)
        blocks = self.modes.blocks(theta, at_rest, at_rest, np.zeros((self.robot.n_rods, 2)))
        return np.asarray(np.linalg.solve(self._system(blocks), right))

    def _turned(self, state: ModalState, u: np.ndarray) -> ModalState:
        """Motors brought to the rates ``u`` in no time."""
        jump = u - state.u
        if not jump.any():
            return state
        n, width = self.robot.n_rods, self._n_modes + 2
        theta = self.modes.angles(state.a, state.q)
        jumps = self.modes.turned(np.zeros_like(state.a), jump)
        still, nothing = np.zeros_like(theta), np.zeros((n, 2))
        impulses, tips = self.modes.forces(theta, still, jumps, nothing)
        impulses -= self.modes.forces(theta, still, still, nothing)[0]  # the weight takes its time
        right = np.concatenate([impulses.ravel(), np.zeros(2), (self.robot.lengths[:, None] * tips).ravel()])
        change = self._solve(state, -right)
        a_dot = state.a_dot + change[: width - 2].reshape(n, -1)
        return replace(state, a_dot=a_dot, v=state.v + change[width - 2 : width], u=u.copy())

    def _pinned(self, state: ModalState) -> ModalState:
        """Tips brought together again, then their velocities."""
        n, width, lengths = self.robot.n_rods, self._n_modes + 2, self.robot.lengths[:, None]

        def correction(gaps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            change = self._solve(state, np.concatenate([np.zeros(width), gaps.ravel()]))
            return change[: width - 2].reshape(n, -1), change[width - 2 : width]

        of_modes, of_tip = correction(state.p - self.robot.bases - lengths * self.modes.tips(state.a, state.q))
        state = replace(state, a=state.a + of_modes, p=state.p + of_tip)
        velocities = self.modes.tip_velocities(state.a, state.a_dot, state.q, state.u)
        of_modes, of_tip = correction(state.v - lengths * velocities)
        return replace(state, a_dot=state.a_dot + of_modes, v=state.v + of_tip)


def _error(what: str, size: float, iterations: int, last: np.ndarray) -> ConvergenceError:
    return ConvergenceError(
        f"rods in strain modes: {what}; last change {size:.1e} after {iterations} iterations",
        residual=size,
        iterations=iterations,
        last=last,
    )
