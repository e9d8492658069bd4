"""Margins of a scene's loop as its linear models predict them, about poses along the reference."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np

from ...control.tuning import Tuning
from ...frozen import Frozen
from ...loop.demand.feed_forward import InverseDynamics
from ...loop.scene.scene import Scene
from .linear_loop import LinearLoop, frequency_response
from .poses import LinearLoops, PoseOfReference, scaled
from .search import first_loss

LONGEST, _PER_PERIOD = 30, 4  # periods of delay that are tried, and steps of each
_DELAY_TOLERANCE, _FACTOR_TOLERANCE = 1e-3, 2e-3  # of a period; of a factor
_FACTORS = np.geomspace(1.0, 32.0, 21)  # from one to the next 19 % more
_STAY = 8  # periods at each pose, or the next multiple of a cycle
_FREQUENCIES = 400  # from a thousandth of the Nyquist frequency on


@dataclass(frozen=True)
class Least:
    """The least of a margin over the poses, and where it is.

    Attributes
    ----------
    value : float
        Infinite if no limit was found in the range that is searched.
    t : float
        When the reference is there [s].
    p : (float, float)
        Tip [m].
    """

    value: float
    t: float
    p: tuple[float, float]

    def summary(self) -> dict[str, Any]:
        """Ready for JSON; None where there is no limit."""
        return {"value": self.value if math.isfinite(self.value) else None, "t_s": self.t,
                "p_m": list(self.p)}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Margins(Frozen):
    """Predicted margins along the reference; all shapes (M, ...) with M poses.

    Attributes
    ----------
    scene, controller : str
    period : float
        [s].
    t : ndarray, shape (M,)
        [s].
    p : ndarray, shape (M, 2)
        Tip [m].
    radius : ndarray, shape (M,)
        Spectral radius of a period.
    delay : ndarray, shape (M,)
        Further delay that the loop bears [s].
    path_delay : float
        The same on the way along all poses, where it may be unstable for a moment [s].
    cycle : int
        Periods from one picture of the tip to the next. Beyond 1 a frequency that goes in comes out as several: there
        is no ``gain``, ``phase``, ``sensitivity`` and ``response`` then (None).
    gain, phase : ndarray, shape (M, n), or None
        Gain margin [-] and phase margin [deg] at each motor, the others closed, by python-control.
    stiffness, mass : ndarray, shape (M,)
        Largest factor on EI of all rods and on the tip mass.
    lag : ndarray, shape (M,)
        Largest time constant of the motors, the scene's own included [s].
    sensitivity : ndarray, shape (M,), or None
        Peak over frequency of the largest singular value of the sensitivity at the motors.
    eigenvalues : ndarray, shape (M, size)
        Of a cycle.
    frequencies : ndarray, shape (F,)
        [Hz].
    response : ndarray, shape (M, F), or None
        Largest singular value of the sensitivity.
    """

    scene: str
    controller: str
    period: float
    t: np.ndarray
    p: np.ndarray
    radius: np.ndarray
    delay: np.ndarray
    path_delay: float
    cycle: int
    gain: np.ndarray | None
    phase: np.ndarray | None
    stiffness: np.ndarray
    mass: np.ndarray
    lag: np.ndarray
    sensitivity: np.ndarray | None
    eigenvalues: np.ndarray
    frequencies: np.ndarray
    response: np.ndarray | None

    def least(self, values: np.ndarray, *, largest: bool = False) -> Least:
        """Of the margins ``values``, shape (M,), the least, or the largest of what should be small."""
        values = np.where(np.isnan(values), 0.0, values)
        at = int(values.argmax() if largest else values.argmin())
        return Least(float(values[at]), float(self.t[at]), (float(self.p[at, 0]), float(self.p[at, 1])))

    def summary(self) -> dict[str, Any]:
        """Figures, ready for JSON; those that a loop does not have are left out."""
        found: dict[str, Any] = {
            "spectral_radius": self.least(self.radius, largest=True).summary(),
            "delay_margin_ms": self.least(1e3 * self.delay).summary(),
            "stiffness_factor": self.least(self.stiffness).summary(),
            "mass_factor": self.least(self.mass).summary(),
            "motor_lag_ms": self.least(1e3 * self.lag).summary(),
        }
        if self.sensitivity is not None and self.gain is not None and self.phase is not None:
            found["sensitivity_peak"] = self.least(self.sensitivity, largest=True).summary()
            found["gain_margin"] = [self.least(each).summary() for each in self.gain.T]
            found["phase_margin_deg"] = [self.least(each).summary() for each in self.phase.T]
        return found


def delay_margin(*loops: LinearLoop) -> float:
    """Further delay up to which a linear loop is stable, or a way along several [s]; NaN: it is not as it is."""
    period = loops[0].period
    steps = np.arange(LONGEST * _PER_PERIOD + 1) * period / _PER_PERIOD
    return first_loss(lambda time: path_radius([loop.later(time) for loop in loops]) < 1.0, steps.tolist(),
                      _DELAY_TOLERANCE * period)  # fmt: skip


def path_radius(loops: Sequence[LinearLoop]) -> float:
    """Factor by which a small deviation grows in a period on the way along all poses, on the mean, if the way is gone
    again and again: on a path a loop may be unstable for a moment, and recover."""
    if len(loops) == 1:
        return loops[0].spectral_radius()
    cycle = loops[0].cycle
    times = math.ceil(_STAY / cycle)
    powers = [np.linalg.matrix_power(loop.transition(), times) for loop in loops]
    product = reduce(lambda before, power: power @ before, powers)
    largest = float(np.abs(np.linalg.eigvals(product)).max())
    return float(largest ** (1.0 / (times * cycle * len(loops))))


def predict_delay_margin(
    scene: Scene, tuning: Tuning | None = None, *, poses: int = 9, reference: InverseDynamics | None = None
) -> Least:
    """Further delay that a loop bears, predicted by the linear closed loop where it is least along the reference.

    Parameters
    ----------
    scene : Scene
    tuning : Tuning, optional
        Instead of the scene's own.
    poses : int
        At equal times along the reference.
    reference : InverseDynamics, optional
        Of the scene's reference, if they are known already: most of what it costs.

    Returns
    -------
    Least
        [s]; 0 where the loop is not stable as it is.

    Raises
    ------
    MarginsError
        As `LinearLoops`.
    """
    loops = LinearLoops(scene, tuning, poses=poses, reference=reference)
    found = [(0.0 if math.isnan(margin := delay_margin(loop)) else margin, loop) for loop in loops.all()]
    least, loop = min(found, key=lambda pair: pair[0])
    return Least(least, loop.t, (float(loop.p[0]), float(loop.p[1])))


def predict_margins(scene: Scene, tuning: Tuning | None = None, *, poses: int = 24) -> Margins:
    """Margins of the loop as it runs, predicted from linear closed loops about poses along the reference.

    The loop is the robot, the law's gain without active limits, observer, motor target, prediction of the told delay,
    untold delay, the motors' lag, and a camera that is late or rare. What the scene says of these is in; margins are
    counted from there.

    Parameters
    ----------
    scene : Scene
    tuning : Tuning, optional
        Instead of the scene's own.
    poses : int
        At equal times along the reference.

    Returns
    -------
    Margins

    Raises
    ------
    MarginsError
        As `LinearLoops`.
    """
    loops = LinearLoops(scene, tuning, poses=poses)
    linear = loops.all()
    period = loops.scene.period
    frequencies = np.geomspace(1e-3, 0.999, _FREQUENCIES) * 0.5 / period
    cycle = linear[0].cycle
    alike = cycle == 1
    classical = [_classical(loop, frequencies) for loop in linear] if alike else []
    responses = np.stack([_sensitivity(loop, frequencies) for loop in linear]) if alike else None
    spectra = [loop.eigenvalues() for loop in linear]
    return Margins(
        scene=loops.scene.name,
        controller=loops.tuning.name,
        period=period,
        t=np.array([loop.t for loop in linear]),
        p=np.stack([loop.p for loop in linear]),
        radius=np.array([float(np.abs(each).max() ** (1.0 / cycle)) for each in spectra]),
        delay=np.array([delay_margin(loop) for loop in linear]),
        path_delay=delay_margin(*linear),
        cycle=cycle,
        gain=np.array([[gain for gain, _ in each] for each in classical]) if alike else None,
        phase=np.array([[phase for _, phase in each] for each in classical]) if alike else None,
        stiffness=np.array([_factor(loops, pose, "stiffness") for pose in loops.poses]),
        mass=np.array([_factor(loops, pose, "mass") for pose in loops.poses]),
        lag=np.array([_largest_lag(loop) for loop in linear]),
        sensitivity=None if responses is None else responses.max(axis=1),
        eigenvalues=np.stack(spectra),
        frequencies=frequencies,
        response=responses,
    )


def _sensitivity(loop: LinearLoop, frequencies: np.ndarray) -> np.ndarray:
    response = frequency_response(loop.closed(), frequencies, loop.period)
    return np.asarray(np.linalg.svd(response, compute_uv=False)[:, 0])


def _classical(loop: LinearLoop, frequencies: np.ndarray) -> list[tuple[float, float]]:
    """Gain and phase margin [deg] at each motor; the least ratio by which a gain may rise."""
    import control  # takes seconds

    found = []
    for motor in range(loop.plant.B.shape[1]):
        response = frequency_response(loop.opened(motor), frequencies, loop.period)[:, 0, 0]
        data = control.frd(response, 2 * np.pi * frequencies, smooth=True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            gains, phases, *_ = control.stability_margins(data, returnall=True)
        # Many a sampled loop crosses the negative axis at the Nyquist frequency, the end of any grid.
        last = float(frequency_response(loop.opened(motor), np.array([0.5 / loop.period]), loop.period)[0, 0, 0].real)
        crossed = [float(gain) for gain in gains] + ([-1.0 / last] if last < 0.0 else [])
        rising = [gain for gain in crossed if gain > 1.0]
        found.append((min(rising, default=math.inf), min((abs(float(each)) for each in phases), default=math.inf)))
    return found


def _factor(loops: LinearLoops, pose: PoseOfReference, name: str) -> float:
    robot = loops.scene.robot

    def holds(factor: float) -> bool:
        other = scaled(robot, **{name: factor})
        return loops.at(pose, other).spectral_radius() < 1.0

    return first_loss(holds, _FACTORS.tolist(), _FACTOR_TOLERANCE)


def _largest_lag(loop: LinearLoop) -> float:
    steps = loop.lag + np.concatenate([[0.0], loop.period * np.geomspace(0.05, 100.0, 40)])
    return first_loss(lambda lag: replace(loop, lag=lag).spectral_radius() < 1.0, steps.tolist(),
                      _DELAY_TOLERANCE * loop.period)  # fmt: skip
