"""The search for numbers that explain logs: on whole runs, or in pieces; noise, outliers and steps of the model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ...errors import IdentificationError, PCRError
from .first_guess import LONG, SHORT, first_guess, floor_of, jumps, noise_of, pieces_of
from .parameters import Parameters
from .prediction import Predictor
from .problem import Guess, Noise, Problem, Readings
from .solver import Solution, solve

Tell = Callable[[float], None]
# A run in which a start counts for more than this at the end is not predicted in one.
_GROWTH = 1e3
# Distance of the tip, in rod lengths, from which a run is better begun in pieces.
_LOST = 0.1
_LONGEST_RUN = 20.0  # s
# Gaps between pieces, in standard deviations of the readings: closed bit by bit.
_JOINTS = (10.0, 0.3, 1e-3)
_ROUNDS = 8
# Noise that is believed at first at least, in rod lengths and radians: with outliers, and of a clean log.
_MISFIT, _FIRST = 1e-3, 1e-5
# Share of the tip's motion that loose pieces may leave.
_UNLIKE = 0.05
_SETTLED = 0.02
# Readings this far off are outliers, in standard deviations; and how many are worth another loss.
_OUTLIER, _WORTH, _GROSS = 6.0, 1e-3, 20.0


@dataclass(frozen=True, eq=False)
class Found:
    """Where a search ended: problem, unknowns, and the (weighted) Jacobian there."""

    problem: Problem
    z: np.ndarray
    jacobian: np.ndarray
    readings: Readings
    method: str
    iterations: int
    refused: int


def search(predictor: Predictor, parameters: Parameters, loss: str, tell: Tell, *, try_delays: bool) -> Found:
    """Search on whole runs where that can be, else by multiple shooting.

    Raises
    ------
    PCRError
        The rods cannot follow even in short pieces from where the tip was seen.
    IdentificationError
        No convergence.
    """
    longest = max(log.step * len(log.t) for log in predictor.logs)
    length, why = (None, "") if longest <= _LONGEST_RUN else (LONG, f"runs of {longest:.3g} s are long")
    try:
        found = _Search(predictor, parameters, loss, tell, length, try_delays).run(_JOINTS[-1:])
        if not found.lost:
            return found.told(_method(length, why))
        why = f"in one piece {1e3 * found.distance:.3g} mm are left"
    except _Unsuited as reason:
        why = str(reason)
    except PCRError as error:
        why = f"in one piece the rods do not follow ({type(error).__name__})"
    found = _Search(predictor, parameters, loss, tell, SHORT, try_delays).run(_JOINTS)
    return found.told(_method(SHORT, why))


def _method(length: float | None, why: str) -> str:
    return "whole runs" if length is None else f"multiple shooting, pieces of {length:g} s ({why})"


class _Unsuited(Exception):
    """A run cannot be predicted in one piece; says why."""


@dataclass(frozen=True, eq=False)
class _Ended:
    found: Found
    distance: float
    lost: bool

    def told(self, method: str) -> Found:
        return replace(self.found, method=method)


class _Search:
    """One search with pieces of one length.

    Its rounds solve the same problem again with what the last has taught: noise of the readings, loss, and the
    difference that the scene's own steps make.
    """

    def __init__(
        self,
        predictor: Predictor,
        parameters: Parameters,
        loss: str,
        tell: Tell,
        length: float | None,
        try_delays: bool,
    ) -> None:
        self.predictor, self.parameters, self.loss, self.tell = predictor, parameters, loss, tell
        delay = parameters.values(np.zeros(len(parameters.free)))["delay"]
        place = parameters.index("delay")
        bound = delay if place is None else parameters.free[place].bounds[1]
        self.pieces = pieces_of(predictor.logs, skipped(predictor, bound), length)
        self.robust = loss == "huber" or (loss == "auto" and any(jumps(log) for log in predictor.logs))
        self.around = first_guess(
            predictor, parameters.robot, self.pieces, predictor.delay(0, {"delay": delay}), len(parameters.free)
        )
        self.noise = [noise_of(log, parameters.robot) for log in predictor.logs]
        # What believed numbers leave is no outlier, nor is what the model's steps leave in a log without noise: noise
        # comes down round by round.
        share = _MISFIT if self.robust else _FIRST
        least = Noise(share * float(parameters.robot.lengths.mean()), share)
        self.noise = [
            replace(one, tip=max(one.tip, least.tip), angle=max(one.angle, least.angle)) for one in self.noise
        ]
        self.corrections: list[np.ndarray] | None = None
        self.whole = length is None or length == LONG
        self.iterations, self.refused = 0, 0
        self.guess = self._best_delay(place) if try_delays and place is not None else self.around

    def run(self, joints: Sequence[float]) -> _Ended:
        guess = self.guess
        with suppress(PCRError):  # heavy rods: what their changing mass makes different is more than noise
            self._stepped(self._problem(joints[0]), guess)
        for joint in joints[:-1]:
            problem = self._problem(joint)
            vector = self._solved(problem, guess).vector
            guess = problem.unpacked(vector)
            self._require_likely(problem.readings(vector))
        if self.whole:
            self._require_suited(self._problem(joints[-1]), guess)
        for _ in range(_ROUNDS):
            problem = self._problem(joints[-1])
            solution = self._solved(problem, guess)
            guess = problem.unpacked(solution.vector)
            readings = problem.readings(solution.vector)
            settled = self._learnt(problem, readings, guess)
            if settled:
                break
        distance = self._distance(readings)
        lost = self.whole and distance > 0.02 * float(self.parameters.robot.lengths.mean())
        found = Found(problem, guess.z, solution.jacobian, readings, "", self.iterations, self.refused)
        return _Ended(found, distance, lost)

    def _problem(self, joint: float) -> Problem:
        return Problem(
            self.predictor, self.parameters, self.pieces, self.noise, self.around, joint=joint, robust=self.robust,
            corrections=self.corrections,
        )  # fmt: skip

    def _solved(self, problem: Problem, guess: Guess) -> Solution:
        solution = solve(problem, problem.packed(guess), self.tell)
        self.iterations += solution.iterations
        self.refused += solution.refused
        return solution

    def _require_suited(self, problem: Problem, guess: Guess) -> None:
        vector = problem.packed(guess)
        length = float(self.parameters.robot.lengths.mean())
        problem.linearised(vector)
        if problem.growth > _GROWTH:
            raise _Unsuited(f"a start counts for {problem.growth:.0f} times as much at the end")
        tips = problem.readings(vector).tip
        off = max(float(np.nanmedian(np.abs(tip))) * noise.tip for tip, noise in zip(tips, self.noise, strict=True))
        if off > _LOST * length:
            raise _Unsuited(f"the believed robot is {1e3 * off:.3g} mm off in one piece")

    def _require_likely(self, readings: Readings) -> None:
        """Raise where not even loose pieces are like the motion that was seen."""
        off = self._distance(readings)
        moved = max(float(np.sqrt(np.nansum(np.nanvar(log.p, axis=0)))) for log in self.predictor.logs)
        if off > _UNLIKE * moved:
            raise IdentificationError(
                f"even in pieces of {SHORT:g} s the best numbers leave {1e3 * off:.3g} mm between prediction and log, "
                f"where the tip moves by {1e3 * moved:.3g} mm RMS: it is hardly a log of {self.parameters.robot.name}; "
                "check geometry, units, signs and the start pose of the scene",
                residual=off,
            )

    def _distance(self, readings: Readings) -> float:
        """Of predicted tips from measured ones, outliers aside [m]."""
        off = [(tip * noise.tip).ravel() for tip, noise in zip(readings.tip, self.noise, strict=True)]
        return 1.4826 * math.sqrt(2.0) * float(np.nanmedian(np.abs(np.concatenate(off))))

    def _best_delay(self, place: int) -> Guess:
        """Try whole delays: the one from which a single step promises the least."""
        best = (np.inf, self.around)
        one, problem = self.parameters.free[place], self._problem(10.0)
        for delay in np.arange(math.floor(one.bounds[1]) + 1.0):
            z = np.zeros(len(self.parameters.free))
            z[place] = (delay - one.value) / one.sd
            guess = replace(self.around, z=z)
            try:
                residuals, jacobian = problem.linearised(problem.packed(guess))
            except PCRError:
                continue
            step = np.linalg.lstsq(jacobian, -residuals, rcond=1e-12)[0]
            left = float(np.sum((residuals + jacobian @ step) ** 2))
            if left < best[0]:
                best = (left, guess)
        return best[1]

    def _learnt(self, problem: Problem, readings: Readings, guess: Guess) -> bool:
        """Learn from a round; return whether there was nothing new."""
        least = floor_of(self.parameters.robot)
        settled, unknowns = True, problem.size - len(self.parameters.free)
        for i, (noise, log) in enumerate(zip(self.noise, self.predictor.logs, strict=True)):
            tip, angle = readings.tip[i] * noise.tip, readings.angle[i] * noise.angle
            if self.loss == "auto" and not self.robust and (_outlying(tip, least.tip) or _outlying(angle, least.angle)):
                self.robust, settled = True, False
            count = int((~np.isnan(tip)).sum() + (~np.isnan(angle)).sum())
            spare = max(0.1, 1.0 - (unknowns / len(self.predictor.logs) + len(self.parameters.free)) / max(count, 1))
            new = Noise(
                max(_spread(tip, self.robust) / math.sqrt(spare), least.tip),
                max(_spread(angle, self.robust), least.angle) if not np.isnan(log.q).all() else noise.angle,
                max(_spread(readings.torque[i], self.robust), least.torque) if log.torque is not None else noise.torque,
            )
            if log.torque is not None:
                settled &= abs(new.torque / noise.torque - 1.0) < _SETTLED
            settled &= abs(new.tip / noise.tip - 1.0) < _SETTLED and abs(new.angle / noise.angle - 1.0) < _SETTLED
            self.noise[i] = new
        return self._stepped(problem, guess) and settled

    def _stepped(self, problem: Problem, guess: Guess) -> bool:
        """Learn what the scene's own steps make different; return whether that is known already."""
        if self.corrections is not None and self._largest(self.corrections) < _SETTLED:
            return True  # so is any change of it
        arguments = self.parameters, guess.z, guess.missing, self.pieces, guess.starts
        fine = self.predictor.states(*arguments, fine=True)
        coarse = self.predictor.states(*arguments)
        old = self.corrections or [np.zeros_like(x) for x in coarse]
        self.corrections = [a - b for a, b in zip(fine, coarse, strict=True)]
        changes = [new - before for new, before in zip(self.corrections, old, strict=True)]
        return self._largest(changes) < _SETTLED

    def _largest(self, changes: Sequence[np.ndarray]) -> float:
        """Of changes of the pieces' states, that of the tip, in standard deviations of its readings."""
        return max(
            float(np.abs(change[:, :2]).max()) / self.noise[piece.log].tip
            for change, piece in zip(changes, self.pieces, strict=True)
        )


def held_fit(
    predictor: Predictor,
    parameters: Parameters,
    values: Mapping[str, float],
    noise: Sequence[Noise] | None,
    *,
    fine: bool = True,
) -> Readings | None:
    """Predict logs with given numbers, from the starts that suit best; None where the rods do not follow.

    With ``fine`` in the scene's own steps. Without noise residuals are in metres and radians.
    """
    held = replace(parameters, free=(), held=dict(values), root=np.zeros((0, 0)))
    pieces = pieces_of(predictor.logs, skipped(predictor, values["delay"]), None)
    guess = first_guess(predictor, parameters.robot, pieces, predictor.delay(0, dict(values)), 0)
    # What believed numbers leave is no noise.
    size = Noise(_MISFIT * float(parameters.robot.lengths.mean()), _MISFIT)
    try:
        problem = Problem(predictor, held, pieces, [size] * len(predictor.logs), guess, robust=True)
        vector = solve(problem, problem.packed(guess), enough=1e-2).vector
        states = predictor.states(held, np.zeros(0), guess.missing, pieces, problem.unpacked(vector).starts, fine=fine)
    except (PCRError, IdentificationError):
        return None
    problem.noise = tuple(noise or [Noise(1.0, 1.0)] * len(predictor.logs))
    return problem.compared(np.zeros(0), states)


def skipped(predictor: Predictor, delay: float) -> list[int]:
    """Rows at the beginning of each log in which commands may still act that came before it."""
    return [math.ceil(predictor.delay(i, {"delay": delay}) - 1e-9) for i in range(len(predictor.logs))]


def _spread(values: np.ndarray, robust: bool) -> float:
    known = values[~np.isnan(values)]
    if not len(known):
        return 0.0
    return 1.4826 * float(np.median(np.abs(known))) if robust else float(np.sqrt(np.mean(known**2)))


def _outlying(values: np.ndarray, least: float) -> bool:
    known = np.abs(values[~np.isnan(values)])
    if len(known) < 20:
        return False
    off = known / max(1.4826 * float(np.median(known)), least)
    return bool((off > _OUTLIER).mean() > _WORTH or off.max() > _GROSS)
