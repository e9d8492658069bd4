"""What a search for a better tuning varies: parameters, their ranges, and the guesses that it begins with."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from ...control.tuning import LINEARISE, Tuning
from ...errors import PCRError
from ...loop.scene.checks import is_multiple
from ...loop.scene.scene import Scene
from ..episodes.spread import Spread

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

HORIZONS = (4, 30)
PERIODS = (0.005, 0.01, 0.02)  # s
# Ranges of what is searched on a logarithmic scale; units as in `Tuning` and `ObserverTuning`.
RANGES = {
    "input_weight": (1e-5, 1e1),
    "velocity_weight": (1e-1, 1e3),
    "force_noise": (1e-4, 1.0),
    "force_walk": (1e-5, 1e-1),
}
# What somebody who knows the loop would try; the rest of each is as in the start. Twenty trials at random in seven
# dimensions find nothing, and a sampler that learns needs something to learn from.
GUESSES: tuple[dict[str, Any], ...] = (
    # Calmer inputs bear unknown delays. Three times the default's weight costs hardly any accuracy along the plan.
    {"linearise": "along_plan", "input_weight": 0.03},
    # Or a force that is believed to change slowly.
    {"linearise": "along_plan", "input_weight": 0.01, "force_walk": 1e-3},
    {"linearise": "along_plan", "input_weight": 0.03, "force_walk": 2e-3},
    # controllers/robust.toml: a short horizon that damps.
    {"horizon": 4, "linearise": "along_plan", "input_weight": 0.0114, "weigh_velocity": True, "velocity_weight": 4.5,
     "force_noise": 0.0214, "force_walk": 8.9e-4},
    # Limits that are reached want to be seen coming.
    {"horizon": 20, "linearise": "along_plan", "input_weight": 0.03},
    # With delays that are known, light inputs and one model a step: controllers/frozen.toml.
    {"horizon": 10, "linearise": "here", "input_weight": 1e-3},
    # The same look ahead, twice as often: half the dead time, twice the computing.
    {"horizon": 20, "period": 0.005, "linearise": "along_plan", "input_weight": 0.03, "force_walk": 2e-3},
    {"horizon": 6, "linearise": "along_plan", "input_weight": 0.1, "weigh_velocity": True, "velocity_weight": 1.0},
)  # fmt: skip


@dataclass(frozen=True)
class Search:
    """What is searched: all trials of a study share it.

    Attributes
    ----------
    scene : Scene
        Its tuning is the start.
    spread : Spread
    episodes : int
        With mismatch, for each trial; the same for all.
    seed : int
        Of the first episode, and of the sampler.
    storage : str
        URL of Optuna's storage.
    known : Tuning or None
        That an earlier search has found for the scene: the first guess.
    keep_period : bool
        The control period is given, by a bus or a camera.
    """

    scene: Scene
    spread: Spread
    episodes: int
    seed: int
    storage: str
    known: Tuning | None = None
    keep_period: bool = False

    @property
    def start(self) -> Tuning:
        """Tuning to improve."""
        tuning = self.scene.tuning
        if tuning is None or tuning.law != "linear_mpc":
            law = "nothing to track" if tuning is None else f"law {tuning.law!r}"
            raise ValueError(f"scene {self.scene.name} has {law}; what is tuned is the law 'linear_mpc'")
        return tuning

    @property
    def seeds(self) -> range:
        """Of the episodes of a trial."""
        return range(self.seed, self.seed + self.episodes)

    @property
    def other_seeds(self) -> range:
        """Of twice as many episodes that no trial has seen."""
        return range(self.seed + self.episodes, self.seed + 3 * self.episodes)


def parameters(search: Search, tuning: Tuning) -> dict[str, Any]:
    """Of a tuning: those that the search varies."""
    params: dict[str, Any] = {
        "horizon": tuning.horizon,
        "input_weight": tuning.input_weight,
        "weigh_velocity": tuning.velocity_weight > 0,
        "velocity_weight": tuning.velocity_weight or RANGES["velocity_weight"][0],
        "linearise": tuning.model.linearise,
    }
    if search.start.observer is not None:
        observer = tuning.observer or search.start.observer
        params |= {"force_noise": observer.force_noise, "force_walk": observer.force_walk}
    if len(_periods(search)) > 1:
        params["period"] = tuning.period or search.scene.period
    return params


def space(search: Search) -> dict[str, BaseDistribution]:
    """Distribution of each parameter, wide enough for the start."""
    try:
        from optuna import distributions
    except ImportError:
        raise PCRError("tuning needs Optuna: pip install pcr_mpc[tune]") from None
    found: dict[str, BaseDistribution] = {}
    for name, value in parameters(search, search.start).items():
        if name in RANGES:
            low, high = RANGES[name]
            found[name] = distributions.FloatDistribution(min(low, value), max(high, value), log=True)
        elif name == "horizon":
            low, high = HORIZONS
            found[name] = distributions.IntDistribution(min(low, value), max(high, value))
        else:
            choices: dict[str, Any] = {
                "weigh_velocity": (False, True),
                "linearise": LINEARISE,
                "period": _periods(search),
            }
            found[name] = distributions.CategoricalDistribution(choices[name])
    return found


def guesses(search: Search) -> list[dict[str, Any]]:
    """Parameters of the first trials: of the known tuning, then of those `GUESSES` that the scene has room for."""
    begin, allowed = parameters(search, search.start), space(search)
    found = [] if search.known is None else [parameters(search, search.known)]
    # Without an observer to tune, or with one period only, nothing is left of some guesses but others.
    found += [begin | guess for guess in GUESSES if guess.keys() <= begin.keys()]
    inside = [guess for guess in found if all(_within(allowed[name], value) for name, value in guess.items())]
    return [guess for i, guess in enumerate(inside) if guess != begin and guess not in inside[:i]]


def _within(distribution: Any, value: Any) -> bool:
    if hasattr(distribution, "choices"):
        return value in distribution.choices
    return bool(distribution.low <= value <= distribution.high)


def candidate(search: Search, params: dict[str, Any]) -> Tuning:
    """Tuning of a trial: the start with its parameters, numbers to three digits, as they are written to a file."""
    start, own = search.start, search.scene.period
    short = {name: float(f"{value:.3g}") for name, value in params.items() if name in RANGES}
    period = params.get("period", own)
    observer = start.observer
    if observer is not None:
        observer = replace(observer, force_noise=short["force_noise"], force_walk=short["force_walk"])
    return replace(
        start,
        horizon=params["horizon"],
        input_weight=short["input_weight"],
        velocity_weight=short["velocity_weight"] if params["weigh_velocity"] else 0.0,
        period=start.period if period == own else period,
        model=replace(start.model, linearise=params["linearise"]),
        observer=observer,
    )


def _periods(search: Search) -> list[float]:
    """Control periods that fit step and duration; a known delay and a deadline are those of one period only."""
    scene = search.scene
    if search.keep_period or scene.delay or math.isfinite(scene.deadline):
        return [scene.period]
    return sorted(
        period
        for period in {*PERIODS, scene.period}
        if is_multiple(period, scene.plant.dt) and is_multiple(scene.duration, period)
    )
