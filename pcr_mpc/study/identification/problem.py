"""Least squares: what was measured against what numbers predict, and against what was believed of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .parameters import Parameters
from .prediction import Piece, Predictor
from .torques import torques_along

# Beyond so many standard deviations Huber's loss grows linearly.
HUBER = 1.5
# What is believed of a start, in its scales: next to nothing.
_START = 100.0


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the readings of a log: of tip [m], angles [rad] and torques [N m].

    An infinite one is of readings that do not count.
    """

    tip: float
    angle: float
    torque: float = math.inf


@dataclass(frozen=True, eq=False)
class Guess:
    """A point of the search.

    Attributes
    ----------
    z : ndarray, shape (F,)
        Free parameters.
    missing : tuple of ndarray
        Of each log, by how much each missing command is off a straight line [rad/s].
    starts : ndarray, shape (S, 4 + n)
        States in which the pieces begin.
    """

    z: np.ndarray
    missing: tuple[np.ndarray, ...]
    starts: np.ndarray


@dataclass(frozen=True, eq=False)
class Readings:
    """Residuals of the readings, in standard deviations: NaN where there was none.

    Attributes
    ----------
    tip, angle : list of ndarray
        Of each log, shapes (M, 2) and (M, n); predicted less measured.
    x : list of ndarray
        Predicted states of each log at its rows, shape (M, 4 + n); NaN where it was not predicted.
    torque : list of ndarray
        Residuals of the torques [N m], shape (M, n); NaN also where they do not count.
    """

    tip: list[np.ndarray]
    angle: list[np.ndarray]
    x: list[np.ndarray]
    torque: list[np.ndarray]


class Problem:
    """Residuals and their Jacobian.

    Unknowns are, in this order, the starts of all pieces in their scales, the missing commands in standard deviations,
    and the free parameters' z. Residuals are of the readings, of the joints between pieces, and of what was believed.

    Parameters
    ----------
    predictor : Predictor
    parameters : Parameters
    pieces : sequence of Piece
    noise : sequence of Noise
        Of each log.
    joint : float
        Standard deviation of a gap between joined pieces, in those of the readings.
    robust : bool
        Huber's loss for the readings instead of squares.
    corrections : list of ndarray, optional
        Of each piece, what is added to its states at its rows.
    around : Guess
        First guess, in which starts are believed, next to nothing.
    """

    def __init__(
        self,
        predictor: Predictor,
        parameters: Parameters,
        pieces: Sequence[Piece],
        noise: Sequence[Noise],
        around: Guess,
        *,
        joint: float = 1e-3,
        robust: bool = False,
        corrections: Sequence[np.ndarray] | None = None,
    ) -> None:
        self.predictor, self.parameters, self.pieces = predictor, parameters, tuple(pieces)
        self.noise, self.joint, self.robust, self.around = tuple(noise), joint, robust, around
        self.corrections = corrections
        n, length = predictor.n, float(parameters.robot.lengths.mean())
        self.scales = np.array([1e-3 * length] * 2 + [1e-3 * length * predictor.omega] * 2 + [1e-3] * n)
        # A missing command is believed to be like its neighbours within the changes that there are.
        self._spread = [
            np.maximum(np.nanstd(log.u, axis=0), 1e-3) if log.missing.size else np.ones(n) for log in predictor.logs
        ]
        self._of_missing = [
            spread[np.argwhere(np.isnan(log.u))[:, 1]] for log, spread in zip(predictor.logs, self._spread, strict=True)
        ]
        counts = [len(of) for of in self._of_missing]
        self._at_missing = np.cumsum([0, *counts]) + len(self.pieces) * (4 + n)
        self.size = int(self._at_missing[-1]) + len(parameters.free)
        self.n_readings, self.growth = 0, 0.0
        self._sensors = [*(f"tip_offset_{axis}" for axis in "xy"), *(f"motor_zero[{i}]" for i in range(n))]
        self._of_sensors = [parameters.index(name) for name in self._sensors]

    def packed(self, guess: Guess) -> np.ndarray:
        """One vector of all unknowns, shape (size,)."""
        starts = (guess.starts - self.around.starts) / self.scales
        missing = [each / scale for each, scale in zip(guess.missing, self._of_missing, strict=True)]
        return np.concatenate([starts.ravel(), *missing, guess.z])

    def unpacked(self, vector: np.ndarray) -> Guess:
        """Inverse of `packed`."""
        states = 4 + self.predictor.n
        starts = vector[: len(self.pieces) * states].reshape(-1, states) * self.scales + self.around.starts
        at = self._at_missing
        missing = [vector[a:b] * scale for a, b, scale in zip(at[:-1], at[1:], self._of_missing, strict=True)]
        return Guess(vector[at[-1] :].copy(), tuple(missing), starts)

    def linearised(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals and their Jacobian, shape (rows, size); errors as `Predictor.states`."""
        guess = self.unpacked(vector)
        states, slopes, n_states = [], [], 4 + self.predictor.n
        for i, (piece, start) in enumerate(zip(self.pieces, guess.starts, strict=True)):
            found = self.predictor.derivatives(self.parameters, guess.z, guess.missing[piece.log], piece, start)
            relative = np.abs(found.by_start * self.scales / self.scales[:, None])
            self.growth = max(self.growth if i else 0.0, float(relative.max()))
            slope = np.zeros((*found.x.shape, self.size))
            slope[:, :, i * n_states : (i + 1) * n_states] = found.by_start * self.scales
            first, last = self._at_missing[piece.log : piece.log + 2]
            slope[:, :, first:last] = found.by_missing * self._of_missing[piece.log]
            slope[:, :, self._at_missing[-1] :] = found.by_free
            states.append(found.x)
            slopes.append(slope)
        return self._assembled(vector, self._corrected(states), slopes)

    def loss(self, residuals: np.ndarray) -> float:
        """Half the sum of squares, or of Huber's loss of the readings."""
        half = 0.5 * residuals**2
        if self.robust:
            size = np.abs(residuals[: self.n_readings])
            half[: self.n_readings] = np.where(size <= HUBER, half[: self.n_readings], HUBER * (size - HUBER / 2.0))
        return float(half.sum())

    def weights(self, residuals: np.ndarray) -> np.ndarray:
        """Square roots of the weights with which squares stand for the loss about these residuals."""
        weights = np.ones(len(residuals))
        if self.robust:
            size = np.maximum(np.abs(residuals[: self.n_readings]), HUBER)
            weights[: self.n_readings] = np.sqrt(HUBER / size)
        return weights

    def readings(self, vector: np.ndarray) -> Readings:
        """Residuals log by log; errors as `Predictor.states`."""
        guess = self.unpacked(vector)
        states = self._corrected(
            self.predictor.states(self.parameters, guess.z, guess.missing, self.pieces, guess.starts)
        )
        return self.compared(guess.z, states)

    def compared(self, z: np.ndarray, states: Sequence[np.ndarray]) -> Readings:
        """Residuals log by log of the states of all pieces."""
        offsets = self._offsets(z)
        tips, angles, all_states, torques = [], [], [], []
        for number, log in enumerate(self.predictor.logs):
            x = np.full((len(log.t), 4 + self.predictor.n), np.nan)
            for piece, state in zip(self.pieces, states, strict=True):
                if piece.log == number:
                    count = len(state) - piece.joined
                    x[piece.first : piece.first + count] = state[:count]
            tips.append((x[:, :2] + offsets[:2] - log.p) / self.noise[number].tip)
            angles.append((x[:, 4:] + offsets[2:] - log.q) / self.noise[number].angle)
            all_states.append(x)
            off = np.full((len(log.t), self.predictor.n), np.nan)
            known = ~np.isnan(x).any(axis=1)
            if log.torque is not None and math.isfinite(self.noise[number].torque):
                robot = self.parameters.robot_at(z)
                off[known] = torques_along(robot, x[known], self.predictor.pose).values - log.torque[known]
            torques.append(off)
        return Readings(tips, angles, all_states, torques)

    def _of_torques(
        self, z: np.ndarray, piece: Piece, x: np.ndarray, slope: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Residuals of the torques at states of a piece, and their derivatives."""
        log, noise = self.predictor.logs[piece.log], self.noise[piece.log]
        if log.torque is None or not math.isfinite(noise.torque):
            return np.empty(0), np.empty((0, self.size))
        found = torques_along(self.parameters.robot_at(z), x, self.predictor.pose)
        by_all = found.by_state @ slope
        by_value = np.zeros((*found.values.shape, len(self.parameters.free)))
        for j, one in enumerate(self.parameters.free):
            if one.name in found.by_number:
                by_value[:, :, j] = found.by_number[one.name]
        by_all[:, :, int(self._at_missing[-1]) :] += by_value @ self.parameters.gradient(z)
        rest = (found.values - log.torque[piece.first : piece.first + len(x)]) / noise.torque
        known = ~np.isnan(rest)
        return rest[known], by_all[known] / noise.torque

    def _corrected(self, states: Sequence[np.ndarray]) -> list[np.ndarray]:
        if self.corrections is None:
            return list(states)
        return [x + change for x, change in zip(states, self.corrections, strict=True)]

    def _assembled(
        self, vector: np.ndarray, states: Sequence[np.ndarray], slopes: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        guess, n, first_free = self.unpacked(vector), self.predictor.n, int(self._at_missing[-1])
        by_z, n_states = np.diag(self.parameters.gradient(guess.z)), 4 + n
        offsets, columns = self._offsets(guess.z), [0, 1, *range(4, n_states)]
        rows: list[np.ndarray] = []
        lines: list[np.ndarray] = []
        for piece, x, slope in zip(self.pieces, states, slopes, strict=True):
            log, noise = self.predictor.logs[piece.log], self.noise[piece.log]
            at = slice(piece.first, piece.last if piece.joined else piece.last + 1)
            seen = np.hstack([log.p[at], log.q[at]])
            scale = np.array([noise.tip] * 2 + [noise.angle] * n)
            rest = (x[: len(seen), columns] + offsets - seen) / scale
            by_all = slope[: len(seen), columns] / scale[:, None]
            for j, index in enumerate(self._of_sensors):
                if index is not None:
                    by_all[:, j, first_free + index] += by_z[index] / scale[j]
            known = ~np.isnan(rest)
            rows.append(rest[known])
            lines.append(by_all[known])
            more, by_all = self._of_torques(guess.z, piece, x[: len(seen)], slope[: len(seen)])
            rows.append(more)
            lines.append(by_all)
        self.n_readings = sum(map(len, rows))
        for i, (piece, x, slope) in enumerate(zip(self.pieces, states, slopes, strict=True)):
            if not piece.joined:
                continue
            noise = self.noise[piece.log]
            gap = self.joint * np.array([noise.tip] * 2 + [noise.tip * self.predictor.omega] * 2 + [noise.angle] * n)
            rows.append((x[-1] - guess.starts[i + 1]) / gap)
            by_all = slope[-1].copy()
            by_all[:, (i + 1) * n_states : (i + 2) * n_states] -= np.diag(self.scales)
            lines.append(by_all / gap[:, None])
        believed = np.diag(1.0 / np.where(np.arange(self.size) < len(self.pieces) * n_states, _START, 1.0))
        believed[first_free:, first_free:] = self.parameters.root
        return np.concatenate([*rows, believed @ vector]), np.concatenate([*lines, believed])

    def _offsets(self, z: np.ndarray) -> np.ndarray:
        """What the sensors add to position and angles."""
        values = self.parameters.values(z)
        return np.array([values[name] for name in self._sensors])
