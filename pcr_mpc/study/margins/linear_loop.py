"""The linear closed loop about a pose: its eigenvalues, its response, and what each motor sees of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .linear_plant import LinearPlant, Sampled


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """A controller about a pose of the robot, without active limits.

    Attributes
    ----------
    t : float
        When the reference is there [s].
    p : ndarray, shape (2,)
        Tip [m].
    plant : LinearPlant
    controllers : tuple of Sampled
        From measured states to rates, in the periods from one picture to the next: in the first the tip is measured.
    period : float
        [s].
    delay : float
        By which commands reach the motors later, all in all [s].
    lag : float
        Time constant of the motors [s].
    latency : float
        Age of a measured tip [s].
    """

    t: float
    p: np.ndarray
    plant: LinearPlant
    controllers: tuple[Sampled, ...]
    period: float
    delay: float
    lag: float
    latency: float = 0.0

    def later(self, time: float) -> LinearLoop:
        """The same with commands that come later by a time [s]."""
        return replace(self, delay=self.delay + time)

    def closed(self, phase: int = 0) -> Sampled:
        """From what is added to the commanded rates to these rates, that included: the sensitivity at the motors.

        Its state is [that of the sampled plant, that of the controller]; ``phase`` is the period since a picture.
        """
        return self._closed(self._sampled(), phase)

    def _sampled(self) -> Sampled:
        return self.plant.sampled(self.period, self.delay, self.lag, self.latency)

    def _closed(self, plant: Sampled, phase: int) -> Sampled:
        own = self.controllers[phase]
        n = plant.B.shape[1]
        a = np.block([[plant.A + plant.B @ own.D @ plant.C, plant.B @ own.C], [own.B @ plant.C, own.A]])
        b = np.vstack([plant.B, np.zeros((len(own.A), n))])
        return Sampled(a, b, np.hstack([own.D @ plant.C, own.C]), np.eye(n))

    @property
    def cycle(self) -> int:
        """Periods from one picture to the next, after which the loop repeats."""
        return len(self.controllers)

    def transition(self) -> np.ndarray:
        """Over a cycle: the product of its periods'."""
        plant = self._sampled()
        product = self._closed(plant, 0).A
        for phase in range(1, self.cycle):
            product = self._closed(plant, phase).A @ product
        return product

    def eigenvalues(self) -> np.ndarray:
        """Of a cycle."""
        return np.asarray(np.linalg.eigvals(self.transition()))

    def spectral_radius(self) -> float:
        """Factor by which a small deviation grows in a period, in the long run and on the mean over a cycle."""
        return float(np.abs(self.eigenvalues()).max() ** (1.0 / self.cycle))

    def opened(self, motor: int) -> Sampled:
        """Loop transfer of a motor, the others closed: cut where its commands leave the controller, sign for negative
        feedback; of a loop whose cycle is one period."""
        closed = self.closed()
        out = closed.C[motor]
        a = closed.A - np.outer(closed.B[:, motor], out)
        return Sampled(a, closed.B[:, [motor]], -out[None], np.zeros((1, 1)))


def frequency_response(system: Sampled, frequencies: np.ndarray, period: float) -> np.ndarray:
    """Response at frequencies [Hz], shape (len(frequencies), outputs, inputs)."""
    z = np.exp(2j * np.pi * frequencies * period)[:, None, None]
    inner = np.linalg.solve(z * np.eye(len(system.A)) - system.A, np.broadcast_to(
        system.B.astype(complex), (len(frequencies), *system.B.shape)))  # fmt: skip
    return np.asarray(system.C @ inner + system.D)
