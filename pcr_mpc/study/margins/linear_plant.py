"""The robot about a pose in continuous time, and as a controller samples it: behind a delay and motors that lag."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm, logm

from ...frozen import Frozen
from ...linearisation.linearise import linearise
from ...plant.motion.plant import Plant

_ROUNDING = 1e-9  # of a period


class Sampled(NamedTuple):
    """x+ = A x + B w, z = C x + D w."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray


@dataclass(frozen=True, eq=False)
class LinearPlant(Frozen):
    """x' = A x + B u about a pose: x = [p, v, q] in deviations from it, u the rates at which the clamps turn.

    Attributes
    ----------
    A : ndarray, shape (4 + n, 4 + n)
    B : ndarray, shape (4 + n, n)
    """

    A: np.ndarray
    B: np.ndarray

    def sampled(self, period: float, delay: float, lag: float = 0.0, latency: float = 0.0) -> Sampled:
        """What lies between the commands of a period and the state at its start.

        Parameters
        ----------
        period : float
            For which a command is held [s].
        delay : float
            Time after which it reaches the motors, any [s]: a fraction of a period splits the next one in two.
        lag : float
            Time constant with which the motors' rates follow their commands [s].
        latency : float
            Age of a measured tip, any [s].

        Returns
        -------
        Sampled
            Its state is [x, rates of lagging motors, commands on the way, the last one first, late tips likewise]; its
            output x, with the tip where it was.
        """
        n_states, n = self.B.shape
        a, b = self.A, self.B
        if lag > 0.0:
            a = np.block([[a, b], [np.zeros((n, n_states)), -np.eye(n) / lag]])
            b = np.vstack([np.zeros((n_states, n)), np.eye(n) / lag])
        size = len(a)
        periods = math.floor(delay / period + _ROUNDING)
        fraction = max(delay / period - periods, 0.0)
        fraction = fraction if fraction > _ROUNDING else 0.0
        begin, early = _held(a, b, fraction * period)
        rest, late = _held(a, b, (1.0 - fraction) * period)
        on_the_way = periods + (fraction > 0.0)
        pictures = math.ceil(latency / period - _ROUNDING)
        commands = size + on_the_way * n
        whole = commands + 2 * pictures
        a_all, b_all, c_all = np.zeros((whole, whole)), np.zeros((whole, n)), np.eye(n_states, whole)

        def moves(rows: slice, state: np.ndarray, effects: dict[int, np.ndarray]) -> None:
            """Write what the state at the start, and commands that are so many periods old, do to some rows."""
            a_all[rows, :size] = state
            for age, effect in effects.items():
                if age == 0:
                    b_all[rows] = effect
                else:
                    a_all[rows, size + (age - 1) * n : size + age * n] = effect

        moves(slice(0, size), rest @ begin, {periods: late} | ({periods + 1: rest @ early} if fraction else {}))
        if on_the_way:
            b_all[size : size + n] = np.eye(n)
            a_all[size + n : commands, size : commands - n] = np.eye((on_the_way - 1) * n)
        if pictures:
            # The picture that is taken in this period is at hand so many periods later.
            taken = pictures * period - latency
            if taken <= fraction * period:
                state, effect = _held(a, b, taken)
                moves(slice(commands, commands + 2), state[:2], {periods + 1: effect[:2]} if fraction else {})
            else:
                state, effect = _held(a, b, taken - fraction * period)
                moves(slice(commands, commands + 2), state[:2] @ begin,
                      {periods: effect[:2]} | ({periods + 1: state[:2] @ early} if fraction else {}))  # fmt: skip
            a_all[commands + 2 :, commands:-2] = np.eye(2 * (pictures - 1))
            c_all[:2], c_all[:2, -2:] = 0.0, np.eye(2)
        return Sampled(a_all, b_all, c_all, np.zeros((n_states, n)))


def linear_plant(plant: Plant, x: np.ndarray) -> LinearPlant:
    """Linear plant about the state x, from the exact discretisation over a step of `linearise`.

    Raises
    ------
    UnreachableError, ConvergenceError, UnstableError, ValueError
        As `linearise`.
    """
    model = linearise(plant, x, np.zeros(plant.robot.n_rods), plant.dt)
    n_states, n = model.B.shape
    step = np.block([[model.A, model.B], [np.zeros((n, n_states)), np.eye(n)]])
    rates = np.real(logm(step))[:n_states] / plant.dt
    return LinearPlant(rates[:, :n_states], rates[:, n_states:])


def _held(a: np.ndarray, b: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition over a time [s], and the effect of inputs that are held meanwhile."""
    size, n = b.shape
    both = expm(time * np.block([[a, b], [np.zeros((n, size + n))]]))
    return both[:size, :size], both[:size, size:]
