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

    def sampled(self, period: float, delay: float, lag: float = 0.0) -> Sampled:
        """What lies between the commands of a period and the state at its start.

        Parameters
        ----------
        period : float
            For which a command is held [s].
        delay : float
            Time after which it reaches the motors, any [s]: a fraction of a period splits the next one in two.
        lag : float
            Time constant with which the motors' rates follow their commands [s].

        Returns
        -------
        Sampled
            Its state is [x, rates of lagging motors, commands on the way, the last one first]; its output x.
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
        whole = size + on_the_way * n
        a_all, b_all = np.zeros((whole, whole)), np.zeros((whole, n))
        a_all[:size, :size] = rest @ begin
        effects = {periods: late} | ({periods + 1: rest @ early} if fraction else {})
        for age, effect in effects.items():
            if age == 0:
                b_all[:size] += effect
            else:
                a_all[:size, size + (age - 1) * n : size + age * n] += effect
        if on_the_way:
            b_all[size : size + n] = np.eye(n)
            a_all[size + n :, size:-n] = np.eye((on_the_way - 1) * n)
        return Sampled(a_all, b_all, np.eye(n_states, whole), np.zeros((n_states, n)))


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
