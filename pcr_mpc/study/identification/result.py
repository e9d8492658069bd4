"""What an identification comes to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...frozen import Frozen
from ...loop.scene.scene import Scene
from ...plant.robot import Robot
from ...plant.uncertainty import Uncertainty
from .logs.log import Log
from .problem import Noise
from .residuals import Whiteness


@dataclass(frozen=True)
class Estimate:
    """One number.

    Attributes
    ----------
    name, unit : str
    value, sd : float
        Estimate and its standard deviation, in the unit.
    low, high : float
        95 % interval.
    prior, prior_sd : float
        What was believed.
    told : {"data", "prior"}
        Whether the data halved what was unknown of it.
    """

    name: str
    unit: str
    value: float
    sd: float
    low: float
    high: float
    prior: float
    prior_sd: float
    told: str


@dataclass(frozen=True, eq=False)
class Fit(Frozen):
    """A log and what is predicted for it; arrays have its rows.

    Attributes
    ----------
    log : Log
    before : ndarray or None, shape (M, 4 + n)
        States as predicted with what was believed, from the start that suits it best; None where its rods do not
        follow.
    after : ndarray, shape (M, 4 + n)
        States as predicted with the estimates.
    tip, angle : ndarray
        Residuals, predicted less measured, of shapes (M, 2) [m] and (M, n) [rad].
    noise : Noise
        As estimated.
    outliers : int
        Readings that are more than six standard deviations off.
    """

    log: Log
    before: np.ndarray | None
    after: np.ndarray
    tip: np.ndarray
    angle: np.ndarray
    noise: Noise
    outliers: int

    def rms(self, *, before: bool = False) -> float | None:
        """RMS distance of the measured tip from the predicted one [m]."""
        states = self.before if before else self.after
        if states is None:
            return None
        off = states[:, :2] - self.log.p if before else self.tip
        return float(np.sqrt(np.nanmean(np.nansum(off**2, axis=1)[~np.isnan(off).all(axis=1)])))


@dataclass(frozen=True, eq=False)
class Identification(Frozen):
    """A robot's numbers as recorded motion tells them.

    Attributes
    ----------
    scene : Scene
    robot : Robot
        With the estimates.
    estimates : tuple of Estimate
    correlation : ndarray, shape (F, F)
        Of the estimates.
    delay : float
        Of the commands [control periods of the scene].
    forces : tuple of (float, float)
        On the tip in each log [N].
    fits : tuple of Fit
    validation : tuple of Fit
        Of logs that were not used.
    chi2_per_dof : float
        Of the readings, in terms of the sensors' noise: what the scene says of it, or what changes from each residual
        to the next. About 1 where nothing but noise is left.
    whiteness : Whiteness
        Of the tip's residuals.
    unidentified : tuple of str
        What the data cannot tell.
    correlations : tuple of (str, str, float)
        Strong ones.
    warnings : tuple of str
    method, loss : str
        How it was done.
    iterations, refused : int
    seconds : float
    """

    scene: Scene
    robot: Robot
    estimates: tuple[Estimate, ...]
    correlation: np.ndarray
    delay: float
    forces: tuple[tuple[float, float], ...]
    fits: tuple[Fit, ...]
    validation: tuple[Fit, ...]
    chi2_per_dof: float
    whiteness: Whiteness
    unidentified: tuple[str, ...]
    correlations: tuple[tuple[str, str, float], ...]
    warnings: tuple[str, ...]
    method: str
    loss: str
    iterations: int
    refused: int
    seconds: float

    def estimate(self, name: str) -> Estimate:
        """Return the estimate of one number."""
        return next(one for one in self.estimates if one.name == name)

    @property
    def uncertainty(self) -> Uncertainty | None:
        """How well the robot's numbers are known now; None where none of them was free."""
        kept = [i for i, one in enumerate(self.estimates) if belongs_to_robot(one.name)]
        if not kept:
            return None
        sd = np.array([self.estimates[i].sd for i in kept])
        return Uncertainty(tuple(self.estimates[i].name for i in kept), sd, self.correlation[np.ix_(kept, kept)])


def belongs_to_robot(name: str) -> bool:
    """Whether a parameter is one of the robot's numbers, and not of its sensors, its bus or its load."""
    return name.startswith("rods[") or name in ("tip_mass", "drag")
