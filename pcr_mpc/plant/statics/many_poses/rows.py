"""Rows of many poses, which fill up as they are solved."""

from __future__ import annotations

from typing import Any

import numpy as np

from .... import interrupt
from ....errors import PCRError, checked_vector
from ...robot import Robot
from ...rods.follower import BRANCH_CHANGE
from ...rods.method import RodMethod
from ..equilibrium import Equilibrium, moment_units
from ..first_rung import Climbed
from ..held_tip import Way
from ..solver import RodSolver
from ..state import columns, record_size
from .equilibria import Equilibria
from .graphs import many, packed

# Poses in one call of a graph: each size is built once, and any number of poses takes few calls.
_SIZES, _GROWTH = tuple(2**k for k in range(9, -1, -1)), 8
_LEAST_BLOCK = 32
# Angle and slack beyond which the checks for one pose are asked, with their rounding and their words.
_LARGE, _DOUBTFUL = 1e5, 1e-6


class Rows:
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
        self._kind, self._numbers = packed(robot)

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
        graph = many(self._kind, method, count, along, self.compiled)
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


def _record(eq: Equilibrium) -> np.ndarray:
    assert eq.record is not None
    return eq.record
