"""The hot path: rods that follow the tip and the motors from one pose to the next."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from ...errors import ConvergenceError, PCRError, UnstableError
from ..robot import Robot
from ..rods.follower import BranchEnds, NotConverged, RodFollower
from ..rods.method import RodMethod
from ..rods.physics import in_layout, require_plain
from ..rods.state import RodState
from .equilibrium import Equilibrium, moment_units
from .first_rung import FirstRung
from .state import RobotState

_MOST_SNAPS = 4  # of one rod in one move


@dataclass(frozen=True)
class Snap:
    """A rod whose shape was gone and that fell to another.

    Attributes
    ----------
    rod : int
    p : tuple of float
        Tip position at which it happened [m].
    q : float
        Angle of the rod's motor then [rad].
    energy_lost : float
        Elastic energy before minus after [J]; the model lets it vanish at once.
    """

    rod: int
    p: tuple[float, float]
    q: float
    energy_lost: float


class RodSolver:
    """Solves all rods of a robot and remembers the last pose as the next warm start.

    Parameters
    ----------
    robot : Robot
    method : RodMethod
        Of this robot.
    snapping : bool
        What `move` does where a rod's branch ends: raise, or let the rod fall to the stable shape that the
        descent of its energy reaches, recorded in ``snaps``.
    compiled : bool
        Whether the first rung runs as machine code where there is a compiler.

    Attributes
    ----------
    first : FirstRung
    rungs : Counter
        How many poses each rung of the ladder has solved.
    snaps : list of Snap
        Since the start, in order.

    Notes
    -----
    `move` climbs a ladder: "warm", tangent predictor and one or two Newton iterations, all rods in one graph;
    "newton", damped and rod by rod; "continuation" from the last pose in halved sub-steps; "snap", if allowed;
    then an error. It never falls back to a "cold" start, the ladder's other end, which could land on another
    branch: that is for `start`. A failed call leaves the last pose as it was.
    """

    def __init__(self, robot: Robot, method: RodMethod, *, snapping: bool = False, compiled: bool = False) -> None:
        if method.layout is None:
            require_plain(robot, f"method {method.name!r}")
        elif snapping:
            require_plain(robot, "on_snap='jump'")
        self.robot = robot
        self.method = method
        self.snapping = snapping
        self.rungs: Counter[str] = Counter()
        self.snaps: list[Snap] = []
        self._snaps_before = 0  # the last move
        # Plain rods share one follower.
        physics = (None,) if method.layout is None else in_layout(robot, method.layout)
        self._followers = [RodFollower(method, of_rod) for of_rod in physics] * (robot.n_rods // len(physics))
        self.first = FirstRung(robot, method, compiled=compiled)
        self._state: RobotState | None = None
        self._spare: RobotState | None = None
        self._moment_units = moment_units(robot)

    def start(self, p: np.ndarray, q: np.ndarray, nodes: np.ndarray | None = None) -> None:
        """Solve at (p, q) from a guess of the nodes, shape (n, 4, any N), or cold (None).

        A cold start takes, for each rod, the stable shape of least energy.
        """
        if nodes is not None and (nodes.ndim != 3 or nodes.shape[:2] != (self.robot.n_rods, 4) or not nodes.shape[2]):
            raise ValueError(f"guess has nodes of shape {nodes.shape}, expected ({self.robot.n_rods}, 4, N)")
        rods = []
        for i, pose in enumerate(self._poses(p, q)):
            try:
                rod = self._followers[i]
                rods.append(rod.cold(pose) if nodes is None else rod.from_nodes(pose, nodes[i]))
            except NotConverged as failure:
                raise self._error(i, failure, p, q) from None
        self._state, self._spare = RobotState.of_rods(self.robot, rods), RobotState.of_rods(self.robot, rods)
        self.rungs[self._state.rung] += 1
        self.snaps.clear()

    def begin(self, guess: Equilibrium) -> None:
        """Start where an equilibrium is: from its record if that is of this robot and method, else from its nodes."""
        if guess.robot != self.robot or not self.first.knows(guess):
            self.start(guess.p, guess.q, guess.nodes)
            return
        assert guess.record is not None
        if self._state is None:
            self._state, self._spare = (RobotState(self.robot, guess.record) for _ in range(2))
        else:
            self.recall(guess.record)
        self.snaps.clear()

    def move(
        self, p: np.ndarray, q: np.ndarray, *, derivatives: float | None = None, continuation: bool = True
    ) -> None:
        """Follow the branch from the last pose to (p, q).

        Parameters
        ----------
        derivatives : float, optional
            Greatest residual of the iterate at which the derivatives may have been taken; then the pose itself
            is solved to ``method.following``, enough for a simulation, which saves an evaluation. None: to
            rounding, and the derivatives belong to the solution itself.
        continuation : bool
            False: give up where Newton's method fails, for a caller that shortens its own steps.

        Raises
        ------
        UnstableError
            The branch ends on the way: the rod would snap to another shape.
        ConvergenceError
            Neither Newton's method nor continuation got there.
        """
        state = self.state
        self._snaps_before = len(self.snaps)
        found = self.first.climb(state.start, p, q, derivatives)
        if found is not None:
            _, record, result, residual, drift, iterations = found
            self.adopt(record, result, drift=drift, residual=residual, iterations=iterations)
            self.rungs["warm"] += 1
            return
        rods = state.rods()
        snaps: list[Snap] = []
        for i, pose in enumerate(self._poses(p, q)):
            try:
                rods[i] = self._follow(i, rods[i], pose, derivatives, continuation, snaps)
            except NotConverged as failure:
                raise self._error(i, failure, p, q) from None
        self._state, self._spare = RobotState.of_rods(self.robot, rods), state
        self.rungs[self._state.rung] += 1
        self.snaps += snaps

    def _follow(
        self,
        i: int,
        start: RodState,
        pose: np.ndarray,
        derivatives: float | None,
        continuation: bool,
        snaps: list[Snap],
    ) -> RodState:
        for count in range(_MOST_SNAPS):
            try:
                state = self._followers[i].follow(start, pose, derivatives, continuation=continuation)
                return replace(state, rung="snap") if count else state
            except BranchEnds as fold:
                if not self.snapping:
                    raise
                fallen = self._followers[i].snap(fold)
                rod = self.robot.rods[i]
                x, y = (np.array(rod.base) + rod.length * fallen.pose[:2]).tolist()
                lost = (fold.last.energy - fallen.energy) * float(self._moment_units[i])
                snaps.append(Snap(i, (x, y), float(fallen.pose[2]), lost))
                start = fallen
        raise NotConverged(start.residual, start.iterations, start.unknowns, f"snapped {_MOST_SNAPS} times in a row")

    def adopt(
        self, record: np.ndarray, result: np.ndarray, *, drift: float, residual: float, iterations: int = 1
    ) -> None:
        """Take over a pose that a graph has solved, as `warm_step` describes it."""
        # Into the spare one: the last state stays whole for a caller who goes back to it.
        assert self._spare is not None
        self._spare.take(record, result, drift, residual, iterations)
        self._state, self._spare = self._spare, self._state

    def recall(self, record: np.ndarray) -> None:
        """Go on from a pose whose ``state.record`` was copied."""
        assert self._spare is not None
        self._spare.recall(record)
        self._state, self._spare = self._spare, self._state

    def go_back(self) -> None:
        """Undo the last `move`."""
        del self.snaps[self._snaps_before :]
        self._state, self._spare = self._spare, self._state

    def force(self) -> np.ndarray:
        """F = sum n_i = dU/dp at the last pose, shape (2,) [N]."""
        return self.state.force

    def energy(self) -> float:
        """U at the last pose [J]."""
        return float(self.state.scalars[2] @ self._moment_units)

    def unstable_rods(self) -> tuple[int, ...]:
        """Rods with a conjugate point at the last pose."""
        return self.state.unstable_rods

    def drift(self) -> float:
        """Change of the invariant m^2/2 + n . t along the rods, over its size, added up."""
        return self.state.drift

    def jacobians(self) -> tuple[np.ndarray, np.ndarray]:
        """K (2, 2) [N/m] and G (2, n) [N/rad] at the last pose, by implicit differentiation."""
        state = self.state
        return state.k, state.g

    def equilibrium(self, p: np.ndarray, q: np.ndarray) -> Equilibrium:
        """Everything about the last pose, which was solved at (p, q)."""
        state = self.state
        return Equilibrium.of_record(
            np.concatenate([p, q]),
            state.record.copy(),
            state.result.copy(),
            {
                "robot": self.robot,
                "method": self.method.name,
                "residual_norm": float(state.residual),
                "iterations": state.iterations,
                "rung": state.rung,
                "drift": state.drift,
                "unstable_rods": state.unstable_rods,
            },
        )

    @property
    def state(self) -> RobotState:
        """Last pose."""
        if self._state is None:
            raise RuntimeError("no pose to start from: call start (or Plant.reset) first")
        return self._state

    def _poses(self, p: np.ndarray, q: np.ndarray) -> list[np.ndarray]:
        x, y = p
        return [
            np.array([(x - rod.base[0]) / rod.length, (y - rod.base[1]) / rod.length, angle])
            for rod, angle in zip(self.robot.rods, q, strict=True)
        ]

    def _error(self, rod: int, failure: NotConverged, p: np.ndarray, q: np.ndarray) -> PCRError:
        if isinstance(failure, BranchEnds):
            left = "" if math.isnan(failure.margin) else f", with {100 * failure.margin:.1f} % left to its limit"
            return UnstableError(
                f"rod {rod} cannot follow to p = {np.array(p)} m, q = {np.array(q)} rad: its branch ends "
                f"on the way{left}{' of stability' if left else ''}; it would snap to "
                "another shape; keep away from this pose, or let the plant snap",
                rod=rod,
                margin=failure.margin,
            )
        base = np.array(self.robot.rods[rod].base)
        more = ", use more segments" if self.method.name == "multiple_shooting" else ""
        reach = float(np.hypot(*(np.array(p) - base))) / self.robot.rods[rod].length
        return ConvergenceError(
            f"rod {rod} at p = {np.array(p)} m, q = {np.array(q)} rad (stretched to {reach:.4f} of its "
            f"length): {failure}; residual {failure.residual:.2e} after {failure.iterations} iterations; "
            f"move in smaller steps{more}, or pass a closer guess",
            rod=rod,
            residual=failure.residual,
            iterations=failure.iterations,
            last=failure.unknowns,
        )
