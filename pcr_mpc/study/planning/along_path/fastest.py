"""The fastest pace along a course: sequential linear programming with exact slopes.

A linear program takes limits and time as linear in the coefficients of b, within a trust region. What that misses is
seen when the result is evaluated, and handed to the program once more as a constant (a second-order correction): the
steps can then be ten times as long. The limits' shares are kept by an exact penalty, so that every program is feasible.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import BSpline

from .... import interrupt
from ....errors import PCRError
from ..motion import ORDERS_OF_PACE
from .pace import local_basis, quadrature, unit_splines
from .program import LinearProgram
from .timing import Timing, evaluated

# Of log duration for exceeding a limit by all of it. Slower motion buys rates and their changes back for less; what is
# taken at rest already, such as a torque, may cost more: as long as a program would rather exceed it, that is raised.
_PENALTY, _RAISED, _MOST_PENALTY = 1.0, 4.0, 1e3
_CORRECTIONS = 2
_ENOUGH, _GOOD, _POOR = 0.8, 0.6, 0.3  # of the predicted gain: no correction, a wider and a narrower trust region
_WIDER, _NARROWER = 1.6, 0.4
_LEAST_GAIN, _LEAST_TRUST = 0.1, 1e-5
_WIDEST_TRUST = 2.0
_KEPT, _REPAIRED = 2e-4, 0.1  # excess that is none; share of a greater one that is worth a step
# Which limits a program begins with, of the way to those that a change can reach at all; how often others are added.
_NEAR_LIMIT, _ADDITIONS, _LP_TOLERANCE = 0.05, 4, 1e-7


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
    basis, program, penalty = _Basis(timing), None, _PENALTY
    for _ in range(most):
        interrupt.check()
        program = _Program(timing.with_slopes(), allowed, penalty, basis, program)
        # Limits are to be kept, however little time that takes.
        enough = min(tolerance, _REPAIRED * program.beyond) if program.beyond > _KEPT else tolerance
        found = None
        while found is None:
            predicted, found = program.step(trust, enough)
            if program.left > _KEPT < program.beyond and penalty < _MOST_PENALTY:
                penalty *= _RAISED
                program.penalise(penalty)
                found = None
                continue
            if predicted < enough:
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


class _Basis:
    """The splines that b is made of, at the points where limits are kept and where time is counted.

    Few of them count at each point: which, and how b and its derivatives change with them.
    """

    def __init__(self, timing: Timing) -> None:
        pace = timing.pace
        self.nodes, self.weights = quadrature(pace)
        self.at_nodes = unit_splines(pace)(self.nodes)
        self.columns, self.values = local_basis(pace, timing.x, ORDERS_OF_PACE)


class _Program:
    """The linear program at one pace.

    Parameters
    ----------
    timing : Timing
    allowed, penalty : float
    basis : _Basis
        At its points.
    last : _Program, optional
        At the same points; its answer is where the search for this one's begins.

    Attributes
    ----------
    beyond : float
        By how much more than what is allowed of a limit is used.
    left : float
        The same, as it is foreseen after the last step.
    """

    def __init__(self, timing: Timing, allowed: float, penalty: float, basis: _Basis, last: _Program | None) -> None:
        self._timing, self._allowed, self._penalty, self.left = timing, allowed, penalty, 0.0
        pace = timing.pace
        # Unknowns: relative changes of the coefficients of b.
        by_own = -0.5 * (basis.weights * pace(basis.nodes) ** -1.5) @ basis.at_nodes
        self._gradient = by_own / timing.duration * pace.c
        self._columns, self._values = basis.columns, basis.values * pace.c[basis.columns]
        shares = [use.share.slope[:, i] for use in timing.uses for i in range(use.share.slope.shape[1])]
        self._slopes = np.concatenate([np.einsum("mo,omj->mj", slope, self._values) for slope in shares])
        self._where = np.tile(self._columns, (len(shares), 1))
        self._both = np.concatenate([np.full(use.share.value.size, use.both) for use in timing.uses])
        self.beyond = self._excess(timing)
        self._reach = np.abs(self._slopes).sum(axis=1)
        self._program = LinearProgram(np.append(self._gradient, penalty))
        self._known = np.zeros((2, len(self._both)), dtype=bool)
        self._rows = np.empty(0, dtype=int), np.empty(0)
        if last is not None:
            self._go_on_from(last)

    def step(self, trust: float, tolerance: float) -> tuple[float, tuple[float, Timing] | None]:
        """Return the gain that is predicted, and what was gained and the timing that gains it; None: not enough."""
        rest = _stacked(self._timing)
        predicted, best = 0.0, None
        for correction in range(_CORRECTIONS):
            change, excess = self._solved(rest, trust)
            if correction == 0:
                self.left = excess
                predicted = -float(self._gradient @ change) + self._penalty * (self.beyond - excess)
                if predicted < tolerance:
                    break
            trial = self._moved(change)
            if trial is None:
                break
            gain = float(np.log(self._timing.duration / trial.duration))
            gain += self._penalty * (self.beyond - self._excess(trial))
            if best is not None and gain <= best[0]:
                break
            best = gain, trial
            if gain > _ENOUGH * predicted:
                break
            # What the slopes do not know is taken for the same in the next try.
            rest = _stacked(trial) - (self._slopes * change[self._where]).sum(axis=1)
        return predicted, best if best is not None and best[0] > _LEAST_GAIN * predicted else None

    def penalise(self, penalty: float) -> None:
        """Charge so much for an excess from now on."""
        self._penalty = penalty
        self._program.charge(len(self._gradient), penalty)

    def _go_on_from(self, last: _Program) -> None:
        """Begin with the limits that held the last program's answer, and with that answer."""
        rows, signs = (of_rows[last._program.held()] for of_rows in last._rows)
        above, below = np.zeros_like(self._known)
        above[rows[signs > 0.0]] = below[rows[signs < 0.0]] = True
        self._add(above, below, _stacked(self._timing))
        self._program.begin_as(last._program)

    def _excess(self, timing: Timing) -> float:
        return max(timing.worst - self._allowed, 0.0)

    def _solved(self, rest: np.ndarray, trust: float) -> tuple[np.ndarray, float]:
        """Changes of the unknowns, and by how much limits are exceeded then, if shares are rest + slopes @ change."""
        self._bound(rest, trust)
        reach = trust * self._reach
        # Limits that are near; those that the change turns out to meet as well are added.
        near = _NEAR_LIMIT * reach
        self._add(rest + near > self._allowed, self._both & (rest - near < -self._allowed), rest)
        for _ in range(_ADDITIONS):
            found = self._program.solved()
            change, excess = found[:-1], float(found[-1])
            share = rest + (self._slopes * change[self._where]).sum(axis=1)
            most = self._allowed + excess + _LP_TOLERANCE
            if not self._add(share > most, self._both & (share < -most), rest):
                return change, excess
        self._add(rest + reach > self._allowed, self._both & (rest - reach < -self._allowed), rest)
        found = self._program.solved()
        return found[:-1], float(found[-1])

    def _bound(self, rest: np.ndarray, trust: float) -> None:
        """Tell the program what is known of shares and steps."""
        rows, signs = self._rows
        self._program.bound_rows(np.full(len(rows), -np.inf), self._allowed - signs * rest[rows])
        count = len(self._gradient)
        least, most = np.full(count, -trust / (1.0 + trust)), np.full(count, trust)
        self._program.bound(np.append(least, 0.0), np.append(most, np.inf))

    def _add(self, high: np.ndarray, low: np.ndarray, rest: np.ndarray) -> bool:
        """Add limits to the program from above and from below, but those that it has; whether there were any."""
        new = [np.flatnonzero(wanted & ~known) for wanted, known in zip((high, low), self._known, strict=True)]
        for rows, known in zip(new, self._known, strict=True):
            known[rows] = True
        rows, signs = np.concatenate(new), np.repeat([1.0, -1.0], [len(new[0]), len(new[1])])
        # The last column is the excess.
        values = np.column_stack([signs[:, None] * self._slopes[rows], np.full(len(rows), -1.0)])
        columns = np.column_stack([self._where[rows], np.full(len(rows), len(self._gradient))])
        self._program.add_rows(np.full(len(rows), -np.inf), self._allowed - signs * rest[rows], columns, values)
        self._rows = np.append(self._rows[0], rows), np.append(self._rows[1], signs)
        return len(rows) > 0

    def _moved(self, change: np.ndarray) -> Timing | None:
        """Evaluate a change; None if the rods cannot do it."""
        old = self._timing
        pace = BSpline(old.pace.t, old.pace.c * (1.0 + change), old.pace.k)
        moves = np.einsum("omj,mj->om", self._values, change[self._columns])
        q = old.turned.q.value + np.einsum("mkd,dm->mk", old.turned.q.slope, moves)
        try:
            return evaluated(old.problem, pace, old.x, q, old.turned.poses)
        except PCRError:
            return None


def _stacked(timing: Timing) -> np.ndarray:
    return np.concatenate([use.share.value.ravel(order="F") for use in timing.uses])
