"""The fastest pace along a course: sequential linear programming with exact slopes.

A linear program takes limits and time as linear in the coefficients of b, within a trust region. What that misses is
seen when the result is evaluated, and handed to the program once more as a constant (a second-order correction): the
steps can then be ten times as long. The limits' shares are kept by an exact penalty, so that every program is feasible.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.optimize import linprog

from ... import interrupt
from ...errors import ConvergenceError, PCRError
from ...plant.statics.equilibria import Equilibria
from ...plant.statics.equilibrium import Equilibrium
from .angles import Angles, angles
from .course import Course
from .limits import PlanLimits, Use, uses
from .motion import ORDERS_OF_PACE, Carrier, Motion, motion
from .pace import duration, local_basis, quadrature, unit_splines

_PENALTY = 1.0  # of log duration for exceeding a limit by all of it; slower motion buys it back for less
_CORRECTIONS = 3
_ENOUGH, _GOOD, _POOR = 0.8, 0.6, 0.3  # of the predicted gain: no correction, a wider and a narrower trust region
_WIDER, _NARROWER = 1.6, 0.4
_LEAST_GAIN, _LEAST_TRUST = 0.1, 1e-5
_WIDEST_TRUST = 2.0
# Which limits a program begins with, of the way to those that a change can reach at all; how often others are added.
_NEAR_LIMIT, _ADDITIONS, _LP_TOLERANCE = 0.05, 4, 1e-7
# Force of the rods that may be missing, in units of sum EI/L^2: on the way, and in the end.
_NEAR, _EXACT = 1e-3, 1e-6


@dataclass(frozen=True, eq=False)
class Problem:
    """What is planned.

    Attributes
    ----------
    course : Course
    pose : Equilibrium
        Near the start.
    carrier : Carrier
    limits : PlanLimits
    """

    course: Course
    pose: Equilibrium
    carrier: Carrier
    limits: PlanLimits


@dataclass(frozen=True, eq=False)
class Timing:
    """A pace along a problem's course, and what follows from it at the points x.

    Attributes
    ----------
    problem : Problem
    pace : BSpline
        b.
    x : ndarray, shape (M,)
    moved : Motion
    turned : Angles
    uses : list of Use
    """

    problem: Problem
    pace: BSpline
    x: np.ndarray
    moved: Motion
    turned: Angles
    uses: list[Use]

    @property
    def duration(self) -> float:
        """[s]."""
        return duration(self.pace)

    @property
    def shares(self) -> np.ndarray:
        """Largest share of each limit at each point, shape (limits, M)."""
        return np.stack([use.largest for use in self.uses])

    @property
    def worst(self) -> float:
        """Largest share of any limit."""
        return float(self.shares.max())

    def at(self, x: np.ndarray) -> Timing:
        """Return the same at other points."""
        q = np.stack([np.interp(x, self.x, angle) for angle in self.turned.q.value.T], axis=1)
        return evaluated(self.problem, self.pace, x, q, self.near(x), _EXACT)

    def near(self, x: np.ndarray) -> Equilibria:
        """Poses at the points nearest to x."""
        return self.turned.poses.rows(np.rint(np.interp(x, self.x, np.arange(len(self.x)))).astype(int))


def evaluated(
    problem: Problem,
    pace: BSpline,
    x: np.ndarray,
    q: np.ndarray,
    near: Equilibria | None = None,
    tolerance: float = _NEAR,
) -> Timing:
    """Evaluate a pace at the points x; errors, ``near`` and ``tolerance`` as `balanced`.

    Parameters
    ----------
    q : ndarray, shape (len(x), n)
        Guess [rad].
    """
    values = np.stack([pace(x, nu=order) for order in range(ORDERS_OF_PACE)])
    moved = motion(values, problem.course(x), problem.carrier, free=problem.course.unknowns > 0)
    turned = angles(moved, problem.pose, q, x, near, tolerance)
    return Timing(problem, pace, x, moved, turned, uses(problem.limits, moved, turned))


def faster(
    timing: Timing,
    *,
    most: int,
    trust: float = 1.0,
    allowed: float = 1.0,
    tolerance: float = 1e-4,
    told: Callable[[float], None] | None = None,
) -> Timing:
    """Improve a pace until it gains no more.

    Parameters
    ----------
    timing : Timing
        To start from; the limits are kept at its points.
    most : int
        Iterations.
    trust : float
        By which share a coefficient may change at first.
    allowed : float
        Share of the limits that may be used.
    tolerance : float
        Gain, as a share of the duration, that is none.
    told : callable, optional
        Is told the duration [s] after each iteration.

    Raises
    ------
    ConvergenceError
        The linear program was not solved.
    """
    for _ in range(most):
        interrupt.check()
        program = _Program(timing, allowed)
        found = None
        while found is None:
            predicted, found = program.step(trust, tolerance)
            if predicted < tolerance:
                return timing
            if found is None:
                trust *= _NARROWER
                if trust < _LEAST_TRUST:
                    return timing
        gain, timing = found
        if told is not None:
            told(timing.duration)
        if gain > _GOOD * predicted:
            trust = min(_WIDER * trust, _WIDEST_TRUST)
        elif gain < _POOR * predicted:
            trust *= _NARROWER
    return timing


class _Program:
    """The linear program at one pace.

    Parameters
    ----------
    timing : Timing
    allowed : float
    """

    def __init__(self, timing: Timing, allowed: float) -> None:
        self._timing, self._allowed = timing, allowed
        pace, course = timing.pace, timing.problem.course
        x, weights = quadrature(pace)
        paces = len(pace.c)
        # Unknowns: relative changes of the coefficients of b, and what the course has of its own.
        gradient = -0.5 * (weights * pace(x) ** -1.5) @ unit_splines(pace)(x) / timing.duration * pace.c
        self._gradient = np.concatenate([gradient, np.zeros(course.unknowns)])
        self._paces = paces
        # Few of them count at each point: which, and how b, P and their derivatives change with them.
        columns, values = local_basis(pace, timing.x, ORDERS_OF_PACE)
        self._parts = [(columns, values * pace.c[columns])]
        if course.unknowns:
            columns, values = course.basis(timing.x)
            self._parts.append((paces + columns, values))
        self._columns = np.concatenate([columns for columns, _ in self._parts], axis=1)
        shares = [use.share.slope[:, i] for use in timing.uses for i in range(use.share.slope.shape[1])]
        self._slopes = np.concatenate([self._by_unknowns(slope) for slope in shares])
        self._where = np.tile(self._columns, (len(shares), 1))
        self._both = np.concatenate([np.full(use.share.value.size, use.both) for use in timing.uses])
        self._beyond = self._excess(timing)

    def _by_unknowns(self, slope: np.ndarray) -> np.ndarray:
        """From slopes by b, P and their derivatives, shape (M, D), to slopes by the unknowns that count."""
        blocks, first = [], 0
        for _, values in self._parts:
            blocks.append(np.einsum("mo,omj->mj", slope[:, first : first + len(values)], values))
            first += len(values)
        return np.concatenate(blocks, axis=1)

    def step(self, trust: float, tolerance: float) -> tuple[float, tuple[float, Timing] | None]:
        """Return the gain that is predicted, and what was gained and the timing that gains it; None: not enough."""
        rest = _stacked(self._timing)
        predicted, best = 0.0, None
        for correction in range(_CORRECTIONS):
            change, excess = self._solved(rest, trust)
            if correction == 0:
                predicted = -float(self._gradient @ change) + _PENALTY * (self._beyond - excess)
                if predicted < tolerance:
                    break
            trial = self._moved(change)
            if trial is None:
                break
            gain = float(np.log(self._timing.duration / trial.duration))
            gain += _PENALTY * (self._beyond - self._excess(trial))
            if best is not None and gain <= best[0]:
                break
            best = gain, trial
            if gain > _ENOUGH * predicted:
                break
            # What the slopes do not know is taken for the same in the next try.
            rest = _stacked(trial) - (self._slopes * change[self._where]).sum(axis=1)
        return predicted, best if best is not None and best[0] > _LEAST_GAIN * predicted else None

    def _excess(self, timing: Timing) -> float:
        return max(timing.worst - self._allowed, 0.0)

    def _solved(self, rest: np.ndarray, trust: float) -> tuple[np.ndarray, float]:
        """Changes of the unknowns, and by how much limits are exceeded then, if shares are rest + slopes @ change."""
        reach = trust * np.abs(self._slopes).sum(axis=1)
        # Limits that are near; those that the change turns out to meet as well are added.
        near = _NEAR_LIMIT * reach
        high, low = rest + near > self._allowed, self._both & (rest - near < -self._allowed)
        for _ in range(_ADDITIONS):
            change, excess = self._with(high, low, rest, trust)
            share = rest + (self._slopes * change[self._where]).sum(axis=1)
            most = self._allowed + excess + _LP_TOLERANCE
            missed_high, missed_low = ~high & (share > most), ~low & self._both & (share < -most)
            if not (missed_high.any() or missed_low.any()):
                return change, excess
            high |= missed_high
            low |= missed_low
        return self._with(rest + reach > self._allowed, self._both & (rest - reach < -self._allowed), rest, trust)

    def _with(self, high: np.ndarray, low: np.ndarray, rest: np.ndarray, trust: float) -> tuple[np.ndarray, float]:
        """Solve the program with these limits from above and from below."""
        count = len(self._gradient)
        slopes = np.concatenate([self._slopes[high], -self._slopes[low]])
        where = np.concatenate([self._where[high], self._where[low]])
        # The last column is the excess.
        entries = np.column_stack([slopes, np.full(len(slopes), -1.0)])
        places = np.column_stack([where, np.full(len(where), count)])
        ends = entries.shape[1] * np.arange(len(entries) + 1)
        rows = sparse.csr_array((entries.ravel(), places.ravel(), ends), shape=(len(entries), count + 1))
        bounds = np.concatenate([self._allowed - rest[high], self._allowed + rest[low]])
        box = [(-trust / (1.0 + trust), trust)] * self._paces + [(-trust, trust)] * (count - self._paces)
        held, equal = self._timing.problem.course.held(), None
        if held is not None:
            none = sparse.csr_array((held.shape[0], self._paces)), sparse.csr_array((held.shape[0], 1))
            equal = sparse.hstack([none[0], held, none[1]]).tocsr()
        found: Any = linprog(  # type: ignore[call-overload]  # its stubs know no sparse matrices
            np.append(self._gradient, _PENALTY),
            rows,
            bounds,
            equal,
            None if equal is None else np.zeros(equal.shape[0]),
            bounds=[*box, (0.0, None)],
            method="highs-ds",
            options={"presolve": False},  # there is nothing to find, and looking takes a quarter of the time
        )
        if found.status != 0:
            raise ConvergenceError(
                f"a linear program of the plan was not solved: {found.message}; take fewer or more cells",
                residual=float("nan"),
                iterations=int(found.nit),
                last=self._timing.pace.c,
            )
        return found.x[:-1], float(found.x[-1])

    def _moved(self, change: np.ndarray) -> Timing | None:
        """Evaluate a change; None if the rods cannot do it."""
        old = self._timing
        pace = BSpline(old.pace.t, old.pace.c * (1.0 + change[: self._paces]), old.pace.k)
        problem = replace(old.problem, course=old.problem.course.moved(change[self._paces :]))
        moves = np.concatenate([np.einsum("omj,mj->om", values, change[columns]) for columns, values in self._parts])
        q = old.turned.q.value + np.einsum("mkd,dm->mk", old.turned.q.slope, moves)
        try:
            return evaluated(problem, pace, old.x, q, old.turned.poses)
        except PCRError:
            return None


def _stacked(timing: Timing) -> np.ndarray:
    return np.concatenate([use.share.value.ravel(order="F") for use in timing.uses])
