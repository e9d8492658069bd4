"""A camera as hardware has it: its pictures are late, rare, and sometimes missing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import ModelError, check_numbers, checked_integer
from ...toml_table import Table

_NUMBERS: dict[str, Any] = {"latency": {"minimum": 0.0}, "lost": {"minimum": 0.0, "maximum": 0.99}}
_STREAM = 2  # of the random numbers; the measurement noise has another


@dataclass(frozen=True)
class Camera:
    """How a measured tip reaches the controller; the encoders are at hand in every period.

    Attributes
    ----------
    latency : float
        Age of a picture when its tip is known [s].
    every : int
        A tip arrives in every so many control periods, the first one of all included; in between there is none (NaN).
    lost : float
        Share of the pictures in which no tip is found; which ones depends on the seed of the run.
    """

    latency: float = 0.0
    every: int = 1
    lost: float = 0.0

    def __post_init__(self) -> None:
        check_numbers(self, _NUMBERS)
        try:
            object.__setattr__(self, "every", checked_integer("every", self.every))
        except ValueError as error:
            raise ModelError(str(error), key="every") from None


IDEAL = Camera()  # that is as fast as the encoders


class Pictures:
    """What the camera of a run says.

    Parameters
    ----------
    camera : Camera
    dt : float
        Step of the plant [s].
    seed : int
        Of the run.
    """

    def __init__(self, camera: Camera, dt: float, seed: int) -> None:
        self._camera, self._back = camera, camera.latency / dt
        self._chance = np.random.default_rng([seed, _STREAM])

    def tip(self, k: int, states: np.ndarray) -> np.ndarray:
        """Tip that arrives in period k, shape (2,) [m], after ``states`` at all steps of the plant so far; NaN: none.

        Before the start the robot was at rest.
        """
        lost = self._chance.random() < self._camera.lost
        if lost or k % self._camera.every:
            return np.full(2, np.nan)
        at = max(len(states) - 1 - self._back, 0.0)
        before = int(at)
        after = min(before + 1, len(states) - 1)
        return np.asarray(states[before, :2] + (at - before) * (states[after, :2] - states[before, :2]))


def read_camera(sensor: Table) -> Camera | None:
    """Take what a scene's [sensor] table says of the camera, if it does."""
    if not any(sensor.has(key) for key in ("latency", "every", "lost")):
        return None
    return Camera(
        sensor.number("latency", 0.0, **_NUMBERS["latency"]),
        sensor.integer("every", 1),
        sensor.number("lost", 0.0, **_NUMBERS["lost"]),
    )
