"""What the controller knows: tip velocity and an unknown force, from the measured tip and motor angles."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import solve_discrete_are

from ..buffered import BufferedFunction, graph_cache
from ..errors import ModelError, checked_number
from ..linearisation.linear_model import LinearModel

# What may be estimated while the robot moves.
ADAPTS = ("tip_mass", "stiffness")


@dataclass(frozen=True)
class ObserverTuning:
    """What the observer believes about noise.

    Attributes
    ----------
    tip_noise : float
        Least standard deviation of the measured tip position [m].
    force_noise : float
        Of a force that acts for one period and is gone [N].
    force_walk : float
        Of the change of the unknown force from one period to the next [N].
    adapts : tuple of {"tip_mass", "stiffness"}
        Numbers of the robot that change slowly, or at once and seldom, and are estimated while it moves: the tip's mass
        with what it carries; one factor for the stiffness of all rods. Motion shows their ratio only, so that of both
        together each gets its share by how far it is believed to walk.
    adapt_walk : float
        Of their change from one period to the next, over what they are believed to be.
    latency : float
        Age of a measured tip when it arrives, as far as it is known [s]: it corrects the estimate of that time, and the
        present follows from there. Angles are taken to be of the present.
    """

    tip_noise: float = 1e-5
    force_noise: float = 0.01
    force_walk: float = 0.005
    adapts: tuple[str, ...] = ()
    adapt_walk: float = 0.005
    latency: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "adapts", tuple(self.adapts))
        if unknown := [name for name in self.adapts if name not in ADAPTS]:
            raise ModelError(f"adapts: {unknown[0]!r} is none of {', '.join(ADAPTS)}", key="observer.adapts")
        if len(set(self.adapts)) < len(self.adapts):
            raise ModelError(f"adapts names one twice: {', '.join(self.adapts)}", key="observer.adapts")
        object.__setattr__(self, "latency", checked_number("latency", self.latency, minimum=0.0))
        if self.adapts and self.latency:
            raise ModelError(
                f"adapts {', '.join(self.adapts)} with a latency of {self.latency} s: what adapts looks at tips of the "
                "present; leave one of the two out",
                key="observer.adapts",
            )
        for field in fields(self):
            if field.name in ("adapts", "latency"):
                continue
            object.__setattr__(self, field.name, checked_number(field.name, getattr(self, field.name), above=0.0))


class DisturbanceObserver:
    """Steady-state Kalman filter for [p, v, d], d a force that walks at random; offset-free because d is one.

    Parameters
    ----------
    tuning : ObserverTuning
    tip_noise : float
        Standard deviation that the sensor's maker gives for the tip position [m].
    angle_step : float
        Resolution of the encoders [rad].
    model : LinearModel
        About the pose for which the gain is computed. It depends little on the pose: what matters is
        sqrt(K/m) dt, which is small.
    every : int
        Periods from one measured tip to the next.

    Attributes
    ----------
    gain : ndarray, shape (6, 2)
        What a surprise in the tip position says about [p, v, d].
    half_step : float
        Half the resolution of the encoders [rad].
    """

    def __init__(
        self, tuning: ObserverTuning, tip_noise: float, angle_step: float, model: LinearModel, every: int = 1
    ) -> None:
        n = model.B.shape[1]
        self.gain = _gain(tuning, max(tip_noise, tuning.tip_noise), model, every)
        self.half_step = angle_step / 2
        self._correct = BufferedFunction(correction(n))
        self._memory = np.zeros(6 + n)

    @property
    def x(self) -> np.ndarray:
        """Estimate of the state, shape (4 + n,)."""
        return self._memory[:-2]

    @x.setter
    def x(self, value: np.ndarray) -> None:
        self._memory[:-2] = value

    @property
    def force(self) -> np.ndarray:
        """Estimate of the unknown force, shape (2,) [N]."""
        return self._memory[-2:]

    @force.setter
    def force(self, value: np.ndarray) -> None:
        self._memory[-2:] = value

    def live_in(self, memory: np.ndarray) -> None:
        """Keep the estimate, [x, force], in memory that a graph reads, shape (6 + n,)."""
        memory[:] = self._memory
        self._memory = memory

    def start(self, x: np.ndarray) -> None:
        """Begin at a known state, without a force."""
        self.x, self.force = x, np.zeros(2)

    def correct(self, p: np.ndarray | None, q: np.ndarray | None) -> None:
        """Take in a measurement of the tip [m] and the motor angles [rad]; None: there is none.

        An encoder says in which interval the angle is; within it the prediction, which knows the commands, is better.
        """
        estimate, measured, gain, half_step = self._correct.inputs
        estimate[:] = self._memory
        measured[:2], measured[2:] = self.x[:2] if p is None else p, self.x[4:] if q is None else q
        gain[:], half_step[:] = self.gain, self.half_step
        self._correct()
        self._memory[:] = self._correct.outputs[0]

    def move(self, p: Any, v: Any) -> None:
        """Begin anew with the tip elsewhere, at position p [m] and velocity v [m/s], and no force suspected."""
        self._memory[:2], self._memory[2:4], self._memory[-2:] = p, v, 0.0

    def predict(self, model: LinearModel, u: np.ndarray) -> None:
        """Move on by one period in which the rates u are applied; ``model`` must know the force."""
        self.x = model(self.x, u)


@graph_cache()
def correction(n: int) -> Any:
    """Graph ([x, force] (6 + n), measured [p, q] (2 + n), gain (6, 2), half step of the encoders) -> [x, force]."""
    estimate, measured = ca.MX.sym("estimate", 6 + n), ca.MX.sym("measured", 2 + n)
    gain, half_step = ca.MX.sym("gain", 6, 2), ca.MX.sym("half_step")
    change = gain @ (measured[:2] - estimate[:2])
    angles = ca.fmin(ca.fmax(estimate[4:-2], measured[2:] - half_step), measured[2:] + half_step)
    corrected = ca.vertcat(estimate[:4] + change[:4], angles, estimate[-2:] + change[4:])
    return ca.Function("correct", [estimate, measured, gain, half_step], [corrected])


def _gain(tuning: ObserverTuning, tip_noise: float, model: LinearModel, every: int = 1) -> np.ndarray:
    """Gain of the filter, shape (6, 2): what a surprise in the tip position says about [p, v, d]."""
    a = np.block([[model.A[:4, :4], model.E[:4]], [np.zeros((2, 4)), np.eye(2)]])
    noise = np.block([[model.E[:4], np.zeros((4, 2))], [np.zeros((2, 2)), np.eye(2)]])
    covariance = np.diag([tuning.force_noise**2] * 2 + [tuning.force_walk**2] * 2)
    output = np.eye(2, 6)
    # In units of the tip's noise, the period and the force that moves the tip by as much in it: the Riccati equation
    # of 1e-10 m^2 is badly scaled, and similar robots then have the same numbers.
    push = tip_noise / float(np.linalg.norm(model.E[:2], 2))
    units = np.array([tip_noise] * 2 + [tip_noise / model.dt] * 2 + [push] * 2)
    a = a * units / units[:, None]
    noise = noise / units[:, None]
    driven = noise @ covariance @ noise.T
    if every > 1:
        powers = [np.linalg.matrix_power(a, j) for j in range(every)]
        a, driven = a @ powers[-1], np.asarray(sum(power @ driven @ power.T for power in powers))
    error = solve_discrete_are(a.T, output.T, (driven + driven.T) / 2, np.eye(2))
    # Not the gain that predicts, but the one that corrects.
    gain = error @ output.T @ np.linalg.inv(output @ error @ output.T + np.eye(2))
    return np.asarray(units[:, None] / tip_noise * gain)
