"""Many held poses in one call: `solve_statics` without Python between the poses."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ... import interrupt
from ...buffered import BufferedFunction, graph_cache, per_thread
from ...compiled import compiled as machine_code
from ...errors import PCRError, checked_vector
from ..robot import Robot
from ..rods.follower import BRANCH_CHANGE
from ..rods.method import RodMethod, for_compiler, warm_calls, warm_step
from ..rods.numbers import Kind
from ..rods.physics import robot_layout
from .equilibria import Equilibria
from .equilibrium import Equilibrium, moment_units
from .first_rung import Climbed
from .held_tip import Way, chosen_way, solver_of
from .solver import RodSolver
from .state import columns, record_size

# Poses in one call of a graph: each size is built once, and any number of poses takes few calls.
_SIZES, _GROWTH = tuple(2**k for k in range(9, -1, -1)), 8
_LEAST_BLOCK = 32
# Angle and slack beyond which the checks for one pose are asked, with their rounding and their words.
_LARGE, _DOUBTFUL = 1e5, 1e-6


def solve_statics_batch(
    robot: Robot,
    p: Any,
    q: Any,
    *,
    guess: Equilibrium | Equilibria | None = None,
    along: bool = False,
    method: str | None = None,
    segments: int = 8,
    steps: int | None = None,
    scheme: str = "rk8",
    compiled: bool = False,
) -> Equilibria:
    """Static equilibria at many held poses: `solve_statics` of each, at hardly more than the cost of its graph.

    Parameters
    ----------
    robot : Robot
    p : array_like, shape (R, 2)
        Tip positions [m].
    q : array_like, shape (R, n)
        Motor angles [rad].
    guess : Equilibrium or Equilibria, optional
        Whose branch is followed to each pose; many of the same robot: each from its own. None: on the branch of least
        energy.
    along : bool
        Whether the poses are a path: the branch is followed from each that is solved to the next, from the guess, or
        from the first pose, solved cold. Otherwise each is followed to from the guess, or solved cold, which is slow.
    method, segments, steps, scheme
        See `solve_statics`.
    compiled : bool
        As machine code (see `Plant`).

    Returns
    -------
    Equilibria
        A pose that is out of reach or not finite, or to which the rods cannot be followed, is a row of NaN with its
        reason; a path goes on from the last pose before it.

    Raises
    ------
    ValueError
        Names an argument of the wrong shape or kind.
    """
    p, q = _rows("p", p, 2), _rows("q", q, robot.n_rods)
    if len(p) != len(q):
        raise ValueError(f"p has {len(p)} rows, q {len(q)}")
    if isinstance(guess, Equilibria):
        return _each_from_its_own(robot, p, q, guess, chosen_way(robot, method, segments, steps, scheme), compiled)
    if guess is not None and not isinstance(guess, Equilibrium):
        raise TypeError(f"guess is a {type(guess).__name__}, expected an Equilibrium")
    if guess is not None and guess.robot.n_rods != robot.n_rods:
        raise ValueError(f"guess has {guess.robot.n_rods} rods, the robot {robot.n_rods}")
    way = chosen_way(robot, method, segments, steps, scheme)
    solver = solver_of(robot, way.method, way.shooting)
    work = _Work(robot, p, q, way, compiled)
    if isinstance(solver, RodSolver) and (along or guess is not None):
        work.by_graphs(solver, guess, along=along)
    else:
        work.one_by_one(range(len(p)), guess, along=along)
    return work.result()


def solve_from_records(robot: Robot, p: np.ndarray, q: np.ndarray, records: np.ndarray) -> Equilibria:
    """`solve_statics_batch` by the default method, each from the record of a pose nearby (`Equilibria.records`)."""
    way = chosen_way(robot, None, 8, None, "rk8")
    solver = solver_of(robot, way.method, way.shooting)
    assert isinstance(solver, RodSolver)
    work = _Work(robot, p, q, way, compiled=False)
    work.from_records(solver, records)
    return work.result()


def _each_from_its_own(
    robot: Robot, p: np.ndarray, q: np.ndarray, guess: Equilibria, way: Way, compiled: bool
) -> Equilibria:
    solver = solver_of(robot, way.method, way.shooting)
    same = guess.robot == robot and guess.method == way.method and len(guess.p) == len(p)
    if not same or not isinstance(solver, RodSolver):
        raise ValueError(
            f"guess holds {len(guess.p)} poses of {guess.robot.name} by {guess.method}, expected {len(p)} of "
            f"{robot.name} by {way.method}, and another method than single_shooting"
        )
    work = _Work(robot, p, q, way, compiled)
    work.from_records(solver, guess.records)
    return work.result()


def _rows(name: str, value: Any, width: int) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "fiu" or array.ndim != 2 or array.shape[1] != width:
        raise ValueError(f"{name} has shape {array.shape} of {array.dtype}, expected numbers of shape (R, {width})")
    return np.array(array, dtype=float)


class _Work:
    """Rows that fill up."""

    def __init__(self, robot: Robot, p: np.ndarray, q: np.ndarray, way: Way, compiled: bool) -> None:
        self.robot, self.p, self.q, self.way, self.compiled = robot, p, q, way, compiled
        count, n = q.shape
        widths = {"closed_form": 3, "multiple_shooting": 4 * way.shooting.segments, "single_shooting": 4}
        shapes = {
            "force": (2,),
            "dforce_dp": (2, 2),
            "dforce_dq": (2, n),
            "motor_torque": (n,),
            "dtorque_dq": (n,),
            "energy": (),
            "rod_forces": (n, 2),
            "residual_norm": (),
            "drift": (),
            "unknowns": (n, widths[way.method]),
        }
        self.arrays = {name: np.empty((count, *shape)) for name, shape in shapes.items()}
        self.arrays["residual_norm"][:] = np.nan  # a row that is still to be solved
        self.unstable = np.zeros((count, n), dtype=bool)
        self.records = np.empty((count, record_size(widths[way.method], n)))
        self._recorded = np.zeros(count, dtype=bool)
        self.reasons = [""] * count
        self._wanted = np.full(count, np.inf)  # drift
        self._kind, self._numbers = _numbers(robot)

    def result(self) -> Equilibria:
        """All rows."""
        unsolved = np.isnan(self.arrays["residual_norm"])
        if unsolved.any():
            for array in self.arrays.values():
                array[unsolved] = np.nan
        if not self._recorded.all():
            self.records[~self._recorded] = np.nan
        return Equilibria(
            self.robot,
            self.p,
            self.q,
            self.way.method,
            unstable=self.unstable,
            reason=tuple(self.reasons),
            records=self.records,
            **self.arrays,
        )

    def one_by_one(self, rows: Any, guess: Equilibrium | None, *, along: bool) -> None:
        """Solve rows without graphs of many."""
        for row in rows:
            eq = self.alone(row, guess)
            guess = eq if along and eq is not None else guess

    def alone(self, row: int, guess: Equilibrium | None) -> Equilibrium | None:
        """Solve one row as `solve_statics` does; None, with a reason, if that fails."""
        interrupt.check()
        try:
            p, q = checked_vector("p", self.p[row], 2), self.robot.checked_angles("q", self.q[row])
            self.robot.require_reachable(p)
            eq = self.way.solve(self.robot, p, q, guess)
        except (PCRError, ValueError) as error:
            self.reasons[row] = str(error)
            return None
        for name, array in self.arrays.items():
            if name != "unknowns":
                array[row] = getattr(eq, name)
        n = self.robot.n_rods
        unknowns = eq.nodes.transpose(0, 2, 1).reshape(n, -1) if eq.record is None else columns(eq.record, n).unknowns.T
        self.arrays["unknowns"][row] = unknowns
        self.unstable[row, list(eq.unstable_rods)] = True
        if eq.record is not None:
            self.records[row], self._recorded[row] = eq.record, True
        return eq

    def by_graphs(self, solver: RodSolver, guess: Equilibrium | None, *, along: bool) -> None:
        """Solve blocks of rows in one call each, and alone those that a few Newton iterations do not bring along."""
        fit = self._fit()
        last = self._known(solver, guess)
        if along:
            self._follow(solver, guess, last, fit)
            return
        if last is not None:
            rows = np.flatnonzero(fit)
            self._spread(solver.method, np.broadcast_to(_record(last), (len(rows), len(_record(last)))), rows)
        self.one_by_one(np.flatnonzero(np.isnan(self.arrays["residual_norm"])), guess, along=False)

    def from_records(self, solver: RodSolver, records: np.ndarray) -> None:
        """Solve each row from a record of its own; those that cannot be followed to are left with a reason."""
        known = self._fit() & np.isfinite(records).all(axis=1)
        self._spread(solver.method, records[known], np.flatnonzero(known))
        for row in np.flatnonzero(np.isnan(self.arrays["residual_norm"])):
            self.reasons[row] = (
                f"the rods could not be followed in one step to p = {self.p[row]} m, q = {self.q[row]} rad; guess from "
                "a nearer pose, or along a path"
            )

    def _fit(self) -> np.ndarray:
        """Whether rows are for graphs, and need no checks of their own; sets how exact they are to be."""
        fit, (x, y) = np.ones(len(self.p), dtype=bool), self.p.T
        # Written so that NaN is not fit.
        for rod, angles in zip(self.robot.rods, self.q.T, strict=True):
            fit &= np.abs(angles) < _LARGE
            fit &= 1 - np.hypot(x - rod.base[0], y - rod.base[1]) / rod.length > _DOUBTFUL
        if self.way.refined:
            self._wanted[fit] = [self.way.wanted_drift(self.robot, p) for p in self.p[fit]]
        return np.asarray(fit)

    def _known(self, solver: RodSolver, guess: Equilibrium | None) -> Equilibrium | None:
        """Return a guess with a record of this robot and method, if it can be had."""
        if guess is None or (guess.robot == self.robot and solver.first.knows(guess)):
            return guess
        try:
            return self.way.solve(self.robot, guess.p, guess.q, guess)
        except PCRError:
            return None

    def _follow(self, solver: RodSolver, guess: Equilibrium | None, last: Equilibrium | None, fit: np.ndarray) -> None:
        """Solve a path, each pose from the one before."""
        method, row, size = solver.method, 0, _SIZES[0]
        while row < len(fit):
            if last is None or not fit[row]:
                last = self.alone(row, last or guess) or last
                row += 1
                continue
            # Up to the next that is not fit, in as large a block as there is.
            block = fit[row : row + size]
            size = next(size for size in _SIZES if size <= (len(block) if block.all() else int(block.argmin())))
            rows = slice(row, row + size)
            records, verdict, results = self._called(method, rows, _record(last), along=True)
            good = self._good(method, rows, verdict, verdict[:, 2])
            done = size if good.all() else int(good.argmin())
            if done:
                self._take(slice(row, row + done), records[:done], verdict[:done], results[:done])
                i, pose = done - 1, np.concatenate((self.p[row + done - 1], self.q[row + done - 1]))
                residual, drift = float(verdict[i, 0]), float(verdict[i, 4])
                found = Climbed(pose, records[i], results[i], residual, drift, method.settling)
                last = solver.first.equilibrium(found)
            row += done
            if done < size:
                last = self.alone(row, last) or last
                row += 1
            # Small blocks after a row that failed, where others may: what is behind it was for nothing.
            size = min(_GROWTH * size, _SIZES[0]) if done == size else _SIZES[-1]

    def _spread(self, method: RodMethod, starts: np.ndarray, rows: np.ndarray) -> None:
        """Solve rows from records; a second time from where the first led, if that was on their branch."""
        changed = np.zeros(len(rows))
        for _ in range(2):
            # Outputs of a graph are valid until the next call: they are put together, and judged once.
            found: list[tuple[np.ndarray, ...]] = []
            first = 0
            # The last few of many rows fill a block with others: a call costs as much as some of them.
            filled = len(rows) + (-len(rows) % _LEAST_BLOCK if len(rows) > _LEAST_BLOCK else 0)
            order = np.arange(filled) % len(rows) if len(rows) else np.arange(0)
            while first < filled:
                size = next(size for size in _SIZES if size <= filled - first)
                some = order[first : first + size]
                outputs = self._called(method, rows[some], starts[some], along=False)
                found.append(outputs if size == filled else tuple(array.copy() for array in outputs))
                first += size
            if not found:
                return
            records, verdict, results = (np.concatenate(arrays)[: len(rows)] for arrays in zip(*found, strict=True))
            changed += verdict[:, 2]
            good = self._good(method, rows, verdict, changed)
            near = (changed <= BRANCH_CHANGE) & (verdict[:, 3] <= 0) & np.isfinite(verdict[:, 0])
            again = near & ~good
            if good.all():
                self._take(rows, records, verdict, results)
                return
            self._take(rows[good], records[good], verdict[good], results[good])
            rows, starts, changed = rows[again], records[again], changed[again]

    def _good(self, method: RodMethod, rows: Any, verdict: np.ndarray, changed: np.ndarray) -> np.ndarray:
        """Whether rods have followed to rounding, as `FirstRung` has it; NaN is not good."""
        solved = (verdict[:, :2] <= method.tolerance).all(axis=1) & (verdict[:, 4] <= self._wanted[rows])
        return np.asarray(solved & (changed <= BRANCH_CHANGE) & (verdict[:, 3] <= 0))

    def _called(
        self, method: RodMethod, rows: Any, starts: np.ndarray, *, along: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Records, verdicts and results of rows (a slice or indices), valid until the next call; starts are records."""
        interrupt.check()
        count = len(self.p[rows])
        graph = _many(self._kind, method, count, along, self.compiled)
        start, target, numbers = (place.T.reshape(-1, place.shape[0]) for place in graph.inputs)
        start[:] = starts[..., : start.shape[1]]
        target[:, :2], target[:, 2:], numbers[:] = self.p[rows], self.q[rows], self._numbers
        graph()
        records, verdict, results = (place.T.reshape(count, -1) for place in graph.outputs)
        return records, verdict, results

    def _take(self, rows: Any, records: np.ndarray, verdict: np.ndarray, results: np.ndarray) -> None:
        """Copy what the graphs found."""
        n, to, count = self.robot.n_rods, self.arrays, len(records)
        if not count:
            return
        force_units, moments = self.robot.stiffnesses / self.robot.lengths**2, moment_units(self.robot)
        scalars = records[:, -5 * n :].reshape(count, n, 5)
        load_tangents = records[:, -14 * n : -5 * n].reshape(count, n, 3, 3)  # of a rod: by column, that is by pose
        loads = records[:, -17 * n : -14 * n].reshape(count, n, 3)
        self.records[rows], self._recorded[rows] = records, True
        to["unknowns"][rows] = records[:, : to["unknowns"][0].size].reshape(count, n, -1)
        to["force"][rows] = results[:, :2]
        to["dforce_dp"][rows] = results[:, 2:6].reshape(count, 2, 2).transpose(0, 2, 1)
        to["dforce_dq"][rows] = results[:, 6:].reshape(count, n, 2).transpose(0, 2, 1)
        to["motor_torque"][rows] = -moments * loads[:, :, 2]
        to["dtorque_dq"][rows] = -moments * load_tangents[:, :, 2, 2]
        to["energy"][rows] = scalars[:, :, 2] @ moments
        to["rod_forces"][rows] = loads[:, :, :2] * force_units[:, None]
        to["residual_norm"][rows], to["drift"][rows] = verdict[:, 0], verdict[:, 4]


@per_thread(maxsize=32)
def _numbers(robot: Robot) -> tuple[Kind, np.ndarray]:
    kind = Kind(robot.n_rods, robot_layout(robot))
    return kind, kind.pack(robot)


def _record(eq: Equilibrium) -> np.ndarray:
    assert eq.record is not None
    return eq.record


@per_thread(maxsize=32)
def _many(kind: Kind, method: RodMethod, count: int, along: bool, compiled: bool) -> BufferedFunction:
    return BufferedFunction(_many_graph(kind, method, count, along, compiled))


@graph_cache(maxsize=8)
def _one_graph(kind: Kind, method: RodMethod, compiled: bool) -> Any:
    # A compiler is given a rod once, not as often as it is solved: a third of the time to build, the same bits.
    if compiled:
        return machine_code(warm_calls(kind, for_compiler(method), method.settling))
    return warm_step(kind, method, method.settling)


@graph_cache(maxsize=32)
def _many_graph(kind: Kind, method: RodMethod, count: int, along: bool, compiled: bool) -> Any:
    """(record or starts, targets, numbers) -> records, verdicts, results of ``count`` poses."""
    warm = _one_graph(kind, method, compiled)
    target, start, numbers = (ca.MX.sym(warm.name_in(i), *warm.size_in(i)) for i in range(3))
    if not along:
        found = warm(target, start, numbers)
        return ca.Function("pose", [start, target, numbers], found).map("poses", "serial", count, [2], [])
    step = _one_step(kind, method, compiled)
    targets = ca.MX.sym("targets", target.numel(), count)
    record = ca.MX.sym("record", step.numel_in(0))
    moved: Any = step.mapaccum("poses", count, 1, {})(record, targets, ca.repmat(numbers, 1, count))
    return ca.Function("path", [record, targets, numbers], list(moved))


@graph_cache(maxsize=8)
def _one_step(kind: Kind, method: RodMethod, compiled: bool) -> Any:
    """From a record to the next, for a path of any length.

    The whole record goes on from pose to pose, though only its first part is started from: it is there once.
    """
    warm = _one_graph(kind, method, compiled)
    target, start, numbers = (ca.MX.sym(warm.name_in(i), *warm.size_in(i)) for i in range(3))
    record = ca.MX.sym("record", warm.numel_out(0))
    step = ca.Function("pose", [record, target, numbers], warm(target, record[: start.numel()], numbers))
    return step.expand() if warm.is_a("SXFunction") else step
