"""One rod, from one pose to the next: every rung of the ladder but the cheapest."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ...buffered import BufferedFunction
from ...errors import ConvergenceError
from .closed_form import elastica
from .closed_form.chart import critical_load, held_shapes
from .equations import RodPhysics
from .method import RodMethod, enough_nodes
from .physics import plain_physics
from .snap import landing
from .state import RodState

MAX_ITERATIONS = 60
# A warm start that needs more is better served by a smaller sub-step.
_WARM_ITERATIONS = 8
# A warm start whose unknowns move further than this beyond the prediction may have left its branch.
BRANCH_CHANGE = 0.3
# A rod that can be followed no further with less than this left to lambda_c has come to a fold.
_FOLD_MARGIN = 0.15
_SMALLEST_SUBSTEP = 1.0 / 1024.0
# Slacks, in units of L, between which the smallest sub-step shrinks with it, as what changes a rod does.
_STRAIGHTEST, _STRAIGHT = 1e-9, 0.01
_SNAP_NODES = 64
# A cold start of a rod that is not plain begins at a tip no further from its base than this, in units of L.
_WELL_BENT = 0.9
_SMALLEST_GROWTH = 1.0 / 256.0
_FURTHEST = 0.1  # from a fold, in units of L and rad, at which its shape is sought to be gone


# Pull beyond which the shape of a rod takes more points than can be kept, in EI/L^2.
_HARDEST = 1e10


class NotConverged(Exception):
    """Newton's method failed: where it stood."""

    def __init__(self, residual: float, iterations: int, unknowns: np.ndarray, reason: str) -> None:
        super().__init__(reason)
        self.residual, self.iterations, self.unknowns = residual, iterations, unknowns


class _Crossed(NotConverged):
    """It landed on the other side of a fold."""


class BranchEnds(NotConverged):
    """It failed because the rod has come to a fold: how far it came, how short of the limit, and the next step.

    The margin is NaN for rods that are not plain, whose limit has no table.
    """

    def __init__(self, failure: NotConverged, last: RodState, margin: float, step: np.ndarray) -> None:
        super().__init__(failure.residual, failure.iterations, failure.unknowns, str(failure))
        self.last, self.margin, self.step = last, margin, step


class RodFollower:
    """Solves single rods, normalised, by one method.

    Parameters
    ----------
    method : RodMethod
    physics : RodPhysics or None
        Of the rod, if it is not plain.
    """

    def __init__(self, method: RodMethod, physics: RodPhysics | None = None) -> None:
        self.method = method
        self._physics = physics
        self._newton, self._check, self._retract, self._distance = map(BufferedFunction, method.any_pull)
        if physics is not None:
            self._become(physics.values)

    def cold(self, pose: np.ndarray) -> RodState:
        """Stable shape of least energy; of a rod that is not plain, the one into which that of a plain rod grows."""
        if self._physics is None:
            return self._from_chart(pose)
        # The chart is of plain rods, and shooting resolves no taut ones from scratch.
        near = pose.copy()
        near[:2] *= min(1.0, _WELL_BENT / max(math.hypot(*pose[:2]), _WELL_BENT))
        return replace(self.follow(self._grown(near, self._physics), pose), rung="cold")

    def _become(self, values: np.ndarray) -> None:
        self._newton.inputs[2][:] = self._check.inputs[2][:] = values

    def _grown(self, pose: np.ndarray, physics: RodPhysics) -> RodState:
        """Follow the stable shape from a plain rod to this one at a held pose, by growing what makes the difference."""
        plain = plain_physics(physics.layout)
        try:
            self._become(plain)
            state = last = self._from_chart(pose)
            done, before, step = 0.0, 0.0, 0.5
            while done < 1.0:
                target = min(1.0, done + step)
                # The shape goes on as it went since the last but one.
                ahead = (target - done) / (done - before) if done > before else 0.0
                predicted = state.unknowns + ahead * (state.unknowns - last.unknowns)
                self._become(plain + target * (physics.values - plain))
                try:
                    grown = self.solve(pose, predicted, most=_WARM_ITERATIONS)
                    if self._apart(grown.unknowns, predicted) > BRANCH_CHANGE or not grown.stable:
                        raise NotConverged(grown.residual, grown.iterations, grown.unknowns, "left its branch")
                except NotConverged as failure:
                    step /= 2
                    if step < _SMALLEST_GROWTH:
                        reason = f"the shape of the plain rod is lost {100 * done:.0f} % of the way to this rod"
                        raise NotConverged(failure.residual, failure.iterations, failure.unknowns, reason) from None
                else:
                    last, state, before, done, step = state, grown, done, target, 2 * step
            return state
        finally:
            self._become(physics.values)

    def _from_chart(self, pose: np.ndarray) -> RodState:
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        xi, eta = cos * pose[0] + sin * pose[1], cos * pose[1] - sin * pose[0]
        last = NotConverged(math.nan, 0, pose, "no stable shape found")
        for coarse in held_shapes(xi, eta):
            shape = coarse.polished(xi, eta) or coarse
            try:
                state = self.solve(pose, self.method.from_shape(shape, pose[2]))
            except NotConverged as failure:
                last = failure
                continue
            if state.stable:
                return replace(state, rung="cold")
            last = NotConverged(state.residual, state.iterations, state.unknowns, "found only unstable shapes")
        raise last

    def from_nodes(self, pose: np.ndarray, nodes: np.ndarray) -> RodState:
        """Shape near given nodes, shape (4, N)."""
        starts = self.method.from_nodes(nodes, self._physics)
        for unknowns in starts[:-1]:
            try:
                return self.solve(pose, unknowns)
            except NotConverged:
                continue
        return self.solve(pose, starts[-1])

    def follow(
        self, start: RodState, pose: np.ndarray, derivatives: float | None = None, *, continuation: bool = True
    ) -> RodState:
        """Keep to the branch of ``start`` up to ``pose``: damped Newton from the prediction, or continuation."""
        try:
            return self._predict(start, pose, derivatives)
        except NotConverged as failure:
            if not continuation:
                raise
            first = failure
        # Continuation along the straight line from the last pose, sub-steps halved and doubled as they go.
        slack = 1.0 - max(math.hypot(*start.pose[:2]), math.hypot(*pose[:2]))
        smallest = _SMALLEST_SUBSTEP * (slack / _STRAIGHT if _STRAIGHTEST <= slack < _STRAIGHT else 1.0)
        state, done, substep, crossed = start, 0.0, 0.5, False
        while done < 1.0:
            target = 1.0 if done + substep >= 1.0 else done + substep
            try:
                state = self._predict(state, start.pose + target * (pose - start.pose), None)
            except NotConverged as failure:
                substep /= 2
                crossed = crossed or isinstance(failure, _Crossed)
                if substep < smallest:
                    margin = self._margin(state)
                    if margin > _FOLD_MARGIN or (math.isnan(margin) and not crossed):
                        raise first from None
                    raise BranchEnds(first, state, margin, 2 * substep * (pose - start.pose)) from None
            else:
                done, substep, crossed = target, 2 * substep, False
        return replace(state, rung="continuation")

    def snap(self, fold: BranchEnds) -> RodState:
        """Stable shape to which the rod descends where its branch ends."""
        last = fold.last
        nodes = self.method.to_nodes(last.unknowns, last.pose[2], _SNAP_NODES)
        # Just beyond the fold the slope is hardly one, and a chain of links folds a little later than a rod: look
        # further and further until the shape is gone, and come back along the shape that is found.
        distance = 1.0
        while distance * np.abs(fold.step).max() < _FURTHEST:
            pose = last.pose + distance * fold.step
            distance *= 2.0
            try:
                state = self.from_nodes(pose, landing(nodes, pose))
                elsewhere = self._apart(state.unknowns, last.unknowns) > BRANCH_CHANGE
                if elsewhere and state.stable and state.energy < last.energy:
                    return replace(self.follow(state, last.pose + fold.step), rung="snap")
            except (NotConverged, ConvergenceError):
                continue
        raise NotConverged(fold.residual, fold.iterations, last.unknowns, "nowhere lower to snap to")

    @np.errstate(all="ignore")  # an overflow is a bad trial point, and rejected
    def solve(
        self, pose: np.ndarray, unknowns: np.ndarray, derivatives: float | None = None, most: int = MAX_ITERATIONS
    ) -> RodState:
        """Damped Newton from ``unknowns``; ``derivatives`` as in `RodSolver.move`.

        A step is kept if the next Newton step is shorter or the residual smaller. The residual alone will not
        do: on a taut rod (condition 1e8) it rises by orders of magnitude on a step that lands next to the
        solution.
        """
        newton, check, solved = self._newton, self._check, self.method.tolerance
        newton.inputs[0][:] = unknowns
        newton.inputs[1][:] = check.inputs[1][:] = pose
        newton()
        step, scalars = newton.outputs[0], newton.outputs[4]
        for iteration in range(1, most + 1):
            residual, length = scalars[0], scalars[1]
            if residual <= solved:
                if derivatives is None:
                    unknowns = self._polish(unknowns)
                return self._state(pose, unknowns, newton.outputs[2], scalars[0], iteration)
            if derivatives is not None and residual <= derivatives:
                trial = self._step(unknowns, step)
                check.inputs[0][:] = trial
                check()
                if check.outputs[0][0] <= self.method.following:
                    return self._state(pose, trial, check.outputs[1], check.outputs[0][0], iteration)
            direction, size = step.copy(), 1.0
            while True:
                newton.inputs[0][:] = trial = self._step(unknowns, size * direction)
                newton()
                # Written so that NaN is a failure.
                if (
                    scalars[0] <= max((1.0 - 0.1 * size) * residual, solved)
                    or scalars[1] <= (1.0 - 0.25 * size) * length
                ):
                    break
                size /= 2
                if size < 1e-3:
                    raise NotConverged(residual, iteration, unknowns, "no descent")
            unknowns = trial
        raise NotConverged(scalars[0], most, unknowns, "too many iterations")

    def _polish(self, unknowns: np.ndarray) -> np.ndarray:
        """One more Newton step, if it gains anything: near a fold each digit of the residual counts."""
        newton = self._newton
        residual = newton.outputs[4][0]
        newton.inputs[0][:] = better = self._step(unknowns, newton.outputs[0])
        newton()
        # Written so that NaN is a failure.
        if newton.outputs[4][0] <= residual:
            return better
        newton.inputs[0][:] = unknowns
        newton()
        return unknowns

    def _step(self, unknowns: np.ndarray, change: np.ndarray) -> np.ndarray:
        self._retract.inputs[0][:] = unknowns
        self._retract.inputs[1][:] = change
        self._retract()
        return self._retract.outputs[0].copy()

    def _apart(self, one: np.ndarray, other: np.ndarray) -> float:
        """How far two shapes of the rod are from each other, in numbers of order one."""
        self._distance.inputs[0][:], self._distance.inputs[1][:] = one, other
        self._distance()
        return float(self._distance.outputs[0][0])

    def _margin(self, state: RodState) -> float:
        """1 - lambda / lambda_c, known of plain rods only."""
        if self._physics is not None:
            return math.nan
        nodes = self.method.to_nodes(state.unknowns, state.pose[2], enough_nodes(state.loads, _SNAP_NODES))
        log_tip_angle, load, _ = elastica.from_nodes(nodes)
        return 1.0 - float(load) / critical_load(float(log_tip_angle))

    def _predict(self, start: RodState, pose: np.ndarray, derivatives: float | None) -> RodState:
        predicted = self._step(start.unknowns, start.tangent @ (pose - start.pose))
        state = self.solve(pose, predicted, derivatives, _WARM_ITERATIONS)
        if self._apart(state.unknowns, predicted) > BRANCH_CHANGE:
            raise NotConverged(state.residual, state.iterations, state.unknowns, "left its branch")
        # A stable branch does not turn unstable: it ends, and Newton's method landed on its other side.
        if start.stable and not state.stable:
            raise _Crossed(state.residual, state.iterations, state.unknowns, "walked through a fold")
        return state

    def _state(
        self, pose: np.ndarray, unknowns: np.ndarray, loads: np.ndarray, residual: float, iterations: int
    ) -> RodState:
        _, tangent, _, load_tangent, scalars = self._newton.outputs
        pull = math.hypot(*loads[:2].tolist())
        if pull > _HARDEST:
            raise NotConverged(
                residual, iterations, unknowns, f"it is pulled straight at {pull:.1e} EI/L^2, at most {_HARDEST:.0e}"
            )
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
