"""The hot path: rods that follow the tip and the motors from one pose to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..buffered import BufferedFunction
from ..errors import ConvergenceError
from .chart import held_shapes
from .equilibrium import Equilibrium
from .multiple_shooting import rod_newton
from .robot import Robot

MAX_ITERATIONS = 60
# A warm start that needs more is better served by a smaller sub-step.
_WARM_ITERATIONS = 8
# Residual at which a rod counts as solved, times 1 + its normalised force.
TOLERANCE = 1e-10
# A warm start that turns a node further than this beyond its prediction may have left its branch [rad].
_BRANCH_ANGLE = 0.3
_SMALLEST_SUBSTEP = 1.0 / 64.0


@dataclass(frozen=True)
class Shooting:
    """Discretisation of the rods by multiple shooting.

    Attributes
    ----------
    segments : int
        N, shooting segments per rod.
    steps : int
        Runge-Kutta steps per segment.
    scheme : {"rk4", "rk8"}
        Runge-Kutta scheme.
    """

    segments: int = 8
    steps: int = 4
    scheme: str = "rk4"


class _NotConverged(Exception):
    def __init__(self, rod: int, residual: float, iterations: int, nodes: np.ndarray, reason: str) -> None:
        super().__init__(reason)
        self.rod, self.residual, self.iterations, self.nodes = rod, residual, iterations, nodes


def _invariant_size(nodes: np.ndarray) -> float:
    return 1.0 + math.hypot(nodes[1], nodes[2]) + nodes[3] ** 2 / 2


def _length(step: np.ndarray, load: float) -> float:
    """Length of a step with forces in units of the load, moments of its root, angles in radians."""
    theta, n_x, n_y, m = (step[i::4] for i in range(4))
    scale = 1.0 / (1.0 + load)
    return math.sqrt(theta @ theta + scale * (m @ m + scale * (n_x @ n_x + n_y @ n_y)))


class _RodState:
    """One solved rod: normalised pose, nodes, and what the last linear solve gave."""

    __slots__ = ("iterations", "nodes", "pose", "residual", "scalars", "stiffness", "tangent")

    def __init__(self, pose, nodes, tangent, stiffness, scalars, residual, iterations):  # type: ignore[no-untyped-def]
        self.pose = pose  # (3,) tip relative to base / L, clamp angle
        self.nodes = nodes  # (4N,)
        self.tangent = tangent  # (4N, 3) d nodes / d pose
        self.stiffness = stiffness  # (3, 3) d [n_x, n_y, m]_0 / d pose
        self.scalars = scalars  # (4,) residual, energy, conjugate points, drift
        self.residual = residual
        self.iterations = iterations


class RodSolver:
    """Solves all rods of a robot and remembers the last pose as the next warm start.

    Parameters
    ----------
    robot : Robot
    shooting : Shooting
        Discretisation.

    Notes
    -----
    `move` climbs a ladder: tangent predictor and damped Newton; then continuation from the last pose
    in halved sub-steps; then `ConvergenceError`. It never falls back to a cold start, which could
    land on another branch. A failed call leaves the last pose as it was.
    """

    def __init__(self, robot: Robot, shooting: Shooting) -> None:
        self.robot = robot
        self.shooting = shooting
        newton, residual = rod_newton(shooting.segments, shooting.steps, shooting.scheme)
        self._newton = BufferedFunction(newton)
        self._check = BufferedFunction(residual)
        self._rods: list[_RodState] = []
        self._inverse_lengths = [1.0 / rod.length for rod in robot.rods]
        self._force_units = [rod.bending_stiffness / rod.length**2 for rod in robot.rods]

    @property
    def started(self) -> bool:
        """Whether there is a pose to move from."""
        return bool(self._rods)

    def start(self, p: np.ndarray, q: np.ndarray, nodes: np.ndarray | None = None) -> None:
        """Solve at (p, q) from a guess of the nodes, shape (n, 4, N), or cold (None).

        A cold start takes, for each rod, the stable shape of least energy.
        """
        poses = self._poses(p, q)
        try:
            if nodes is not None:
                self._rods = [
                    self._solve(i, pose, nodes[i].ravel(order="F").copy(), TOLERANCE)
                    for i, pose in enumerate(poses)
                ]
            else:
                self._rods = [self._cold(i, pose) for i, pose in enumerate(poses)]
        except _NotConverged as failure:
            raise self._error(failure, p, q) from None

    def move(
        self, p: np.ndarray, q: np.ndarray, *, derivatives: float = TOLERANCE, continuation: bool = True
    ) -> None:
        """Follow the branch from the last pose to (p, q).

        Parameters
        ----------
        derivatives : float
            Greatest residual of the iterate at which the derivatives may have been taken. By default they
            belong to the solution itself; a simulation that needs the force alone saves an evaluation.
        continuation : bool
            False: give up where Newton's method fails, for a caller that shortens its own steps.

        Raises
        ------
        ConvergenceError
            Neither Newton's method nor continuation got there.
        """
        poses = self._poses(p, q)
        try:
            self._rods = [self._follow(i, pose, derivatives, continuation) for i, pose in enumerate(poses)]
        except _NotConverged as failure:
            raise self._error(failure, p, q) from None

    def force(self) -> tuple[float, float]:
        """F = sum n_i = dU/dp at the last pose [N]."""
        f_x = f_y = 0.0
        for rod, unit in zip(self._rods, self._force_units, strict=True):
            f_x += unit * rod.nodes[1]
            f_y += unit * rod.nodes[2]
        return f_x, f_y

    def energy(self) -> float:
        """U at the last pose [J]."""
        return sum(
            unit * rod.length * state.scalars[1]
            for unit, rod, state in zip(self._force_units, self.robot.rods, self._rods, strict=True)
        )

    def unstable_rods(self) -> tuple[int, ...]:
        """Rods with a conjugate point at the last pose."""
        return tuple(i for i, rod in enumerate(self._rods) if rod.scalars[2] > 0)

    def drift(self) -> float:
        """Largest change of the invariant m^2/2 + n . t along a rod, over its size."""
        return max(abs(rod.scalars[3]) / _invariant_size(rod.nodes) for rod in self._rods)

    def jacobians(self) -> tuple[np.ndarray, np.ndarray]:
        """K (2, 2) [N/m] and G (2, n) [N/rad] at the last pose, by implicit differentiation."""
        k = np.zeros((2, 2))
        g = np.empty((2, self.robot.n_rods))
        for i, rod in enumerate(self._rods):
            k += (self._force_units[i] * self._inverse_lengths[i]) * rod.stiffness[:2, :2]
            g[:, i] = self._force_units[i] * rod.stiffness[:2, 2]
        return k, g

    def equilibrium(self, p: np.ndarray, q: np.ndarray) -> Equilibrium:
        """Everything about the last pose, which was solved at (p, q)."""
        k, g = self.jacobians()
        moment_units = self.robot.stiffnesses / self.robot.lengths
        nodes = np.stack([rod.nodes.reshape((4, -1), order="F") for rod in self._rods])
        stiffness = np.stack([rod.stiffness for rod in self._rods])
        rod_forces = np.array(self._force_units)[:, None] * nodes[:, 1:3, -1]
        return Equilibrium(
            robot=self.robot,
            p=np.array(p),
            q=np.array(q),
            method="multiple_shooting",
            force=np.array(self.force()),
            dforce_dp=k,
            dforce_dq=g,
            # The motor turns the rod's base against its internal moment.
            motor_torque=-moment_units * nodes[:, 3, 0],
            dtorque_dq=-moment_units * stiffness[:, 2, 2],
            energy=float(moment_units @ [rod.scalars[1] for rod in self._rods]),
            rod_forces=rod_forces,
            nodes=nodes,
            residual_norm=math.hypot(*(rod.residual for rod in self._rods)),
            iterations=max(rod.iterations for rod in self._rods),
            drift=self.drift(),
            unstable_rods=self.unstable_rods(),
        )

    def _poses(self, p: np.ndarray, q: np.ndarray) -> list[np.ndarray]:
        x, y = p
        return [
            np.array([(x - rod.base[0]) * scale, (y - rod.base[1]) * scale, angle])
            for rod, scale, angle in zip(self.robot.rods, self._inverse_lengths, q, strict=True)
        ]

    def _follow(self, i: int, pose: np.ndarray, derivatives: float, continuation: bool) -> _RodState:
        start = self._rods[i]
        try:
            return self._predict(i, start, pose, derivatives)
        except _NotConverged as failure:
            if not continuation:
                raise
            first = failure
        # Continuation along the straight line from the last pose, sub-steps halved and doubled as they go.
        state, done, substep = start, 0.0, 0.5
        while done < 1.0:
            target = 1.0 if done + substep >= 1.0 else done + substep
            try:
                state = self._predict(i, state, start.pose + target * (pose - start.pose), TOLERANCE)
            except _NotConverged:
                substep /= 2
                if substep < _SMALLEST_SUBSTEP:
                    raise first from None
            else:
                done, substep = target, 2 * substep
        return state

    def _predict(self, i: int, start: _RodState, pose: np.ndarray, derivatives: float) -> _RodState:
        predicted = start.nodes + start.tangent @ (pose - start.pose)
        state = self._solve(i, pose, predicted.copy(), derivatives, _WARM_ITERATIONS)
        if np.abs(state.nodes[0::4] - predicted[0::4]).max() > _BRANCH_ANGLE:
            raise _NotConverged(i, state.residual, state.iterations, state.nodes, "left its branch")
        return state

    def _cold(self, i: int, pose: np.ndarray) -> _RodState:
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        xi, eta = cos * pose[0] + sin * pose[1], cos * pose[1] - sin * pose[0]
        last = _NotConverged(i, math.nan, 0, pose, "no stable shape found")
        for coarse in held_shapes(xi, eta):
            shape = coarse.polished(xi, eta) or coarse
            try:
                state = self._solve(i, pose, shape.nodes(self.shooting.segments, pose[2]).ravel(order="F"), TOLERANCE)
            except _NotConverged as failure:
                last = failure
                continue
            if state.scalars[2] == 0:
                return state
            last = _NotConverged(i, state.residual, state.iterations, state.nodes, "found only unstable shapes")
        raise last

    @np.errstate(all="ignore")  # an overflow is a bad trial point, and rejected
    def _solve(
        self, i: int, pose: np.ndarray, nodes: np.ndarray, derivatives: float, most: int = MAX_ITERATIONS
    ) -> _RodState:
        """Damped Newton from ``nodes``.

        A step is kept if the next Newton step is shorter or the residual smaller. The residual alone will not
        do: on a taut rod (condition 1e8) it rises by orders of magnitude on a step that lands next to the
        solution.
        """
        newton, check = self._newton, self._check
        nodes[0] = pose[2]
        newton.inputs[1][:] = check.inputs[1][:] = pose[:2]
        load = math.hypot(nodes[1], nodes[2])
        tolerance = TOLERANCE * (1.0 + load)
        newton.inputs[0][:] = nodes
        newton()
        residual = newton.outputs[3][0]
        for iteration in range(1, most + 1):
            if residual <= tolerance:
                return self._state(pose, nodes, residual, iteration)
            if residual <= derivatives:
                trial = nodes + newton.outputs[0]
                check.inputs[0][:] = trial
                check()
                if check.outputs[0][0] <= tolerance:
                    return self._state(pose, trial, check.outputs[0][0], iteration)
            step = newton.outputs[0].copy()
            length = _length(step, load)
            size = 1.0
            while True:
                newton.inputs[0][:] = trial = nodes + size * step
                newton()
                trial_residual = newton.outputs[3][0]
                # Written so that NaN is a failure.
                if (
                    trial_residual <= max((1.0 - 0.1 * size) * residual, tolerance)
                    or _length(newton.outputs[0], load) <= (1.0 - 0.25 * size) * length
                ):
                    break
                size /= 2
                if size < 1e-3:
                    raise _NotConverged(i, residual, iteration, nodes, "no descent")
            nodes, residual = trial, trial_residual
        raise _NotConverged(i, residual, most, nodes, "too many iterations")

    def _state(self, pose: np.ndarray, nodes: np.ndarray, residual: float, iterations: int) -> _RodState:
        _, tangent, stiffness, scalars = self._newton.outputs
        return _RodState(
            pose, nodes, tangent.copy(), stiffness.copy(), scalars.copy(), float(residual), iterations
        )

    def _error(self, failure: _NotConverged, p: np.ndarray, q: np.ndarray) -> ConvergenceError:
        base = np.array(self.robot.rods[failure.rod].base)
        reach = float(np.hypot(*(np.array(p) - base))) / self.robot.rods[failure.rod].length
        return ConvergenceError(
            f"rod {failure.rod} at p = {np.array(p)} m, q = {np.array(q)} rad (stretched to {reach:.4f} of its "
            f"length): {failure}; residual {failure.residual:.2e} after {failure.iterations} iterations; "
            "move in smaller steps, pass a closer guess, or use more segments",
            rod=failure.rod,
            residual=failure.residual,
            iterations=failure.iterations,
            last=failure.nodes,
        )
