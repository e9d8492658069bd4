"""The hot path: rods that follow the tip and the motors from one pose to the next."""

from __future__ import annotations

import math

import numpy as np

from ..buffered import BufferedFunction
from ..errors import ConvergenceError, PCRError, UnstableError
from . import elastica
from .chart import critical_load, held_shapes
from .equilibrium import Equilibrium
from .robot import Robot
from .rod_method import RodMethod, warm_step
from .rod_state import RobotState, RodState

MAX_ITERATIONS = 60
# A warm start that needs more is better served by a smaller sub-step.
_WARM_ITERATIONS = 8
# Residual, relative to the load, at which a rod counts as solved.
TOLERANCE = 1e-10
# A warm start whose unknowns move further than this beyond the prediction may have left its branch.
_BRANCH_CHANGE = 0.3
_ROUGH = 1e-4
# A rod that can be followed no further with less than this left to lambda_c has come to a fold.
_FOLD_MARGIN = 0.15
_SMALLEST_SUBSTEP = 1.0 / 1024.0


class _NotConverged(Exception):
    def __init__(self, rod: int, residual: float, iterations: int, unknowns: np.ndarray, reason: str) -> None:
        super().__init__(reason)
        self.rod, self.residual, self.iterations, self.unknowns = rod, residual, iterations, unknowns
        self.last_state: RodState | None = None  # as far as continuation came


class RodSolver:
    """Solves all rods of a robot and remembers the last pose as the next warm start.

    Parameters
    ----------
    robot : Robot
    method : RodMethod

    Notes
    -----
    `move` climbs a ladder: tangent predictor and one or two Newton iterations, all rods in one graph; damped
    Newton, rod by rod; continuation from the last pose in halved sub-steps; then `ConvergenceError`. It never
    falls back to a cold start, which could land on another branch. A failed call leaves the last pose as it was.
    """

    def __init__(self, robot: Robot, method: RodMethod) -> None:
        self.robot = robot
        self.method = method
        self._newton = BufferedFunction(method.newton)
        self._check = BufferedFunction(method.residual)
        self._warm = [BufferedFunction(warm_step(robot, method, iterations)) for iterations in (1, 2)]
        self._state: RobotState | None = None
        self._spare: RobotState | None = None
        self._force_units = robot.stiffnesses / robot.lengths**2
        self._moment_units = robot.stiffnesses / robot.lengths

    def start(self, p: np.ndarray, q: np.ndarray, nodes: np.ndarray | None = None) -> None:
        """Solve at (p, q) from a guess of the nodes, shape (n, 4, any N), or cold (None).

        A cold start takes, for each rod, the stable shape of least energy.
        """
        if nodes is not None and (nodes.ndim != 3 or nodes.shape[:2] != (self.robot.n_rods, 4) or not nodes.shape[2]):
            raise ValueError(f"guess has nodes of shape {nodes.shape}, expected ({self.robot.n_rods}, 4, N)")
        poses = self._poses(p, q)
        try:
            if nodes is not None:
                rods = [
                    self._solve(i, pose, self.method.from_nodes(nodes[i]), TOLERANCE) for i, pose in enumerate(poses)
                ]
            else:
                rods = [self._cold(i, pose) for i, pose in enumerate(poses)]
            self._state, self._spare = RobotState(self.robot, rods), RobotState(self.robot, rods)
        except _NotConverged as failure:
            raise self._error(failure, p, q) from None

    def move(self, p: np.ndarray, q: np.ndarray, *, derivatives: float = TOLERANCE, continuation: bool = True) -> None:
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
        UnstableError
            The branch ends on the way: the rod would snap to another shape.
        ConvergenceError
            Neither Newton's method nor continuation got there.
        """
        state = self._started()
        # Where rough derivatives will do, one Newton iteration usually does; else the first would be wasted.
        for warm in self._warm if derivatives >= _ROUGH else self._warm[1:]:
            warm.inputs[0][:] = p
            warm.inputs[1][:] = q
            warm.inputs[2][:] = state.unknowns
            warm.inputs[3][:] = state.tangents
            warm.inputs[4][:] = state.poses
            warm()
            residual, rough, change, conjugate_points, _ = warm.outputs[6].tolist()
            if residual <= TOLERANCE and rough <= derivatives and change <= _BRANCH_CHANGE and not conjugate_points:
                # Into the spare one: the last state stays whole for a caller who goes back to it.
                assert self._spare is not None
                self._spare.take(warm.outputs, 1 if warm is self._warm[0] else 2)
                self._state, self._spare = self._spare, state
                return
        rods, poses = state.rods(), self._poses(p, q)
        try:
            rods = [self._follow(i, rods[i], pose, derivatives, continuation) for i, pose in enumerate(poses)]
        except _NotConverged as failure:
            raise self._error(failure, p, q) from None
        self._state, self._spare = RobotState(self.robot, rods), state

    def go_back(self) -> None:
        """Undo the last `move`."""
        self._state, self._spare = self._spare, self._state

    def force(self) -> np.ndarray:
        """F = sum n_i = dU/dp at the last pose, shape (2,) [N]."""
        return self._started().force

    def energy(self) -> float:
        """U at the last pose [J]."""
        return float(self._started().scalars[2] @ self._moment_units)

    def unstable_rods(self) -> tuple[int, ...]:
        """Rods with a conjugate point at the last pose."""
        return self._started().unstable_rods

    def drift(self) -> float:
        """Change of the invariant m^2/2 + n . t along the rods, over its size, added up."""
        return self._started().drift

    def jacobians(self) -> tuple[np.ndarray, np.ndarray]:
        """K (2, 2) [N/m] and G (2, n) [N/rad] at the last pose, by implicit differentiation."""
        state = self._started()
        return state.k, state.g

    def equilibrium(self, p: np.ndarray, q: np.ndarray) -> Equilibrium:
        """Everything about the last pose, which was solved at (p, q)."""
        state = self._started()
        k, g = self.jacobians()
        # Nodes at most 4 / lambda apart, so that integrating between them is stable on taut rods.
        load = math.sqrt(float(np.hypot(*state.loads[:2]).max()))
        n_nodes = max(8, 2 ** math.ceil(math.log2(max(load, 1.0) / 4.0)))
        nodes = [
            self.method.to_nodes(u, pose[2], n_nodes) for u, pose in zip(state.unknowns.T, state.poses.T, strict=True)
        ]
        return Equilibrium(
            robot=self.robot,
            p=np.array(p),
            q=np.array(q),
            method=self.method.name,
            force=self.force().copy(),
            dforce_dp=k.copy(),
            dforce_dq=g.copy(),
            # The motor turns the rod's base against its internal moment.
            motor_torque=-self._moment_units * state.loads[2],
            dtorque_dq=-self._moment_units * state.load_tangents[2, 2::3],
            energy=self.energy(),
            rod_forces=(state.loads[:2] * self._force_units).T,
            nodes=np.stack(nodes),
            residual_norm=float(state.residual),
            iterations=state.iterations,
            drift=self.drift(),
            unstable_rods=self.unstable_rods(),
        )

    def _started(self) -> RobotState:
        if self._state is None:
            raise RuntimeError("no pose to start from: call start (or Plant.reset) first")
        return self._state

    def _poses(self, p: np.ndarray, q: np.ndarray) -> list[np.ndarray]:
        x, y = p
        return [
            np.array([(x - rod.base[0]) / rod.length, (y - rod.base[1]) / rod.length, angle])
            for rod, angle in zip(self.robot.rods, q, strict=True)
        ]

    def _follow(self, i: int, start: RodState, pose: np.ndarray, derivatives: float, continuation: bool) -> RodState:
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
                    first.last_state = state
                    raise first from None
            else:
                done, substep = target, 2 * substep
        return state

    def _predict(self, i: int, start: RodState, pose: np.ndarray, derivatives: float) -> RodState:
        predicted = start.unknowns + start.tangent @ (pose - start.pose)
        state = self._solve(i, pose, predicted, derivatives, _WARM_ITERATIONS)
        branch = self.method.branch
        if np.abs(state.unknowns[branch] - predicted[branch]).max() > _BRANCH_CHANGE:
            raise _NotConverged(i, state.residual, state.iterations, state.unknowns, "left its branch")
        return state

    def _cold(self, i: int, pose: np.ndarray) -> RodState:
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        xi, eta = cos * pose[0] + sin * pose[1], cos * pose[1] - sin * pose[0]
        last = _NotConverged(i, math.nan, 0, pose, "no stable shape found")
        for coarse in held_shapes(xi, eta):
            shape = coarse.polished(xi, eta) or coarse
            try:
                state = self._solve(i, pose, self.method.from_shape(shape, pose[2]), TOLERANCE)
            except _NotConverged as failure:
                last = failure
                continue
            if state.scalars[3] == 0:
                return state
            last = _NotConverged(i, state.residual, state.iterations, state.unknowns, "found only unstable shapes")
        raise last

    @np.errstate(all="ignore")  # an overflow is a bad trial point, and rejected
    def _solve(
        self, i: int, pose: np.ndarray, unknowns: np.ndarray, derivatives: float, most: int = MAX_ITERATIONS
    ) -> RodState:
        """Damped Newton from ``unknowns``.

        A step is kept if the next Newton step is shorter or the residual smaller. The residual alone will not
        do: on a taut rod (condition 1e8) it rises by orders of magnitude on a step that lands next to the
        solution.
        """
        newton, check = self._newton, self._check
        newton.inputs[0][:] = unknowns
        newton.inputs[1][:] = check.inputs[1][:] = pose
        newton()
        step, scalars = newton.outputs[0], newton.outputs[4]
        for iteration in range(1, most + 1):
            residual, length = scalars[0], scalars[1]
            if residual <= TOLERANCE:
                return self._rod_state(pose, unknowns, newton.outputs[2], residual, iteration)
            if residual <= derivatives:
                trial = unknowns + step
                check.inputs[0][:] = trial
                check()
                if check.outputs[0][0] <= TOLERANCE:
                    return self._rod_state(pose, trial, check.outputs[1], check.outputs[0][0], iteration)
            direction, size = step.copy(), 1.0
            while True:
                newton.inputs[0][:] = trial = unknowns + size * direction
                newton()
                # Written so that NaN is a failure.
                if (
                    scalars[0] <= max((1.0 - 0.1 * size) * residual, TOLERANCE)
                    or scalars[1] <= (1.0 - 0.25 * size) * length
                ):
                    break
                size /= 2
                if size < 1e-3:
                    raise _NotConverged(i, residual, iteration, unknowns, "no descent")
            unknowns = trial
        raise _NotConverged(i, scalars[0], most, unknowns, "too many iterations")

    def _rod_state(
        self, pose: np.ndarray, unknowns: np.ndarray, loads: np.ndarray, residual: float, iterations: int
    ) -> RodState:
        _, tangent, _, load_tangent, scalars = self._newton.outputs
        return RodState(
            pose,
            unknowns,
            tangent.copy(),
            loads.copy(),
            load_tangent.copy(),
            scalars.copy(),
            float(residual),
            iterations,
        )

    def _error(self, failure: _NotConverged, p: np.ndarray, q: np.ndarray) -> PCRError:
        if failure.last_state is not None:
            last = failure.last_state
            nodes = self.method.to_nodes(last.unknowns, last.pose[2], 8)
            log_tip_angle, load, _ = elastica.from_nodes(nodes)
            margin = 1.0 - load / critical_load(log_tip_angle)
            if margin < _FOLD_MARGIN:
                return UnstableError(
                    f"rod {failure.rod} cannot follow to p = {np.array(p)} m, q = {np.array(q)} rad: its branch ends "
                    f"on the way, with {100 * margin:.1f} % left to its limit of stability; it would snap to another "
                    "shape; keep away from this pose",
                    rod=failure.rod,
                    margin=margin,
                )
        base = np.array(self.robot.rods[failure.rod].base)
        reach = float(np.hypot(*(np.array(p) - base))) / self.robot.rods[failure.rod].length
        return ConvergenceError(
            f"rod {failure.rod} at p = {np.array(p)} m, q = {np.array(q)} rad (stretched to {reach:.4f} of its "
            f"length): {failure}; residual {failure.residual:.2e} after {failure.iterations} iterations; "
            "move in smaller steps, pass a closer guess, or use more segments",
            rod=failure.rod,
            residual=failure.residual,
            iterations=failure.iterations,
            last=failure.unknowns,
        )
