"""Search for a better tuning of a scene with Optuna: shared by processes and machines, resumable."""

from __future__ import annotations

import math
import platform
import warnings
import zlib
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ..control.tuning import LINEARISE, Tuning
from ..errors import PCRError, StudyError
from .episodes import Spread
from .parallel import finished
from .provenance import described, differences
from .scene import Scene
from .tuning_score import Costs, measure, score

if TYPE_CHECKING:
    from optuna import Study
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
_WAIT_FOR_SQLITE = 60.0  # s, while another process writes
# The best few in the search are run once more on other episodes: the best of many is partly lucky.
_CONFIRMED = 3


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
        Of the first episode.
    storage : str
        URL of Optuna's storage.
    """

    scene: Scene
    spread: Spread
    episodes: int
    seed: int
    storage: str

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


@dataclass(frozen=True)
class Chosen:
    """A tuning that beats the start on episodes which the search has not seen.

    Attributes
    ----------
    tuning : Tuning
    trial : int
    score, confirmed : float
        On the episodes of the search, and on the others.
    costs, start : Costs
        Of this tuning and of the start, on the others.
    """

    tuning: Tuning
    trial: int
    score: float
    confirmed: float
    costs: Costs
    start: Costs


def tune(search: Search, trials: int, executor: Executor, *, progress: bool = True) -> Chosen | None:
    """Add trials to the study of a search; return the best tuning so far, None if none beats the start.

    Parameters
    ----------
    search : Search
    trials : int
    executor : Executor
        Runs them; its processes need to reach the storage.
    progress : bool
        Show a progress bar on stderr.

    Raises
    ------
    PCRError
        Optuna is not installed.
    StudyError
        The study in the storage is of other settings, or a worker died; finished trials are kept.
    KeyboardInterrupt
        Says how to go on.
    """
    study = _prepare(search, executor, progress)
    begun = len(study.trials)
    try:
        for _ in finished(executor, partial(_run_trial, search), range(begun, begun + trials),
                          desc=f"tune {search.scene.name}", unit="trial", progress=progress):  # fmt: skip
            pass  # the storage has it
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted; {len(finished_trials(search))} trials are kept in {search.storage}, "
            "and the same command adds to them"
        ) from None
    return _confirm(search, executor, progress)


def finished_trials(search: Search) -> list[dict[str, Any]]:
    """All finished trials of a study, as rows: ``trial``, ``score``, the costs, and the parameters."""
    optuna = _optuna()
    trials = _study(search.storage, search.scene.name).get_trials(states=(optuna.trial.TrialState.COMPLETE,))
    return [{"trial": t.number, "score": t.value, **t.user_attrs["costs"], **t.params} for t in trials]


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


def _start_params(search: Search) -> dict[str, Any]:
    start = search.start
    params: dict[str, Any] = {
        "horizon": start.horizon,
        "input_weight": start.input_weight,
        "weigh_velocity": start.velocity_weight > 0,
        "velocity_weight": start.velocity_weight or RANGES["velocity_weight"][0],
        "linearise": start.model.linearise,
    }
    if start.observer is not None:
        params |= {"force_noise": start.observer.force_noise, "force_walk": start.observer.force_walk}
    if len(_periods(search.scene)) > 1:
        params["period"] = search.scene.period
    return params


def _periods(scene: Scene) -> list[float]:
    """Control periods that the plant's step divides; a known delay and a deadline are those of one period only."""
    if scene.delay or math.isfinite(scene.deadline):
        return [scene.period]
    ratios = {period: period / scene.plant.dt for period in {*PERIODS, scene.period}}
    fitting = [period for period, r in ratios.items() if r > 0.5 and abs(r - round(r)) <= 1e-9 * r]
    return sorted(period for period in fitting if scene.duration >= period)


def _space(search: Search) -> dict[str, BaseDistribution]:
    """Distribution of each parameter, wide enough for the start."""
    distributions = _optuna().distributions
    space: dict[str, BaseDistribution] = {}
    for name, value in _start_params(search).items():
        if name in RANGES:
            low, high = RANGES[name]
            space[name] = distributions.FloatDistribution(min(low, value), max(high, value), log=True)
        elif name == "horizon":
            low, high = HORIZONS
            space[name] = distributions.IntDistribution(min(low, value), max(high, value))
        else:
            choices = {"weigh_velocity": (False, True), "linearise": LINEARISE, "period": _periods(search.scene)}
            space[name] = distributions.CategoricalDistribution(choices[name])
    return space


def _prepare(search: Search, executor: Executor, progress: bool) -> Study:
    """Open or begin the study; its first trial is the start, which scores 1 by definition."""
    optuna = _optuna()
    start, name = search.start, search.scene.name
    settings = {**described(search.scene, start, search.spread), "episodes": search.episodes, "seed": search.seed}
    study: Study = optuna.create_study(storage=_storage(search.storage), study_name=name, load_if_exists=True)
    theirs = study.user_attrs.get("settings")
    if theirs is None:
        study.set_user_attr("settings", settings)
    elif changed := differences(theirs, settings):
        more = f" (and {len(changed) - 1} more)" if len(changed) > 1 else ""
        raise StudyError(
            f"{search.storage} holds a study {name} with other settings: {changed[0]}{more}; move it away or give "
            "another --storage",
            differences=changed,
        )
    if not study.trials:
        task = partial(measure, search.scene, start, seeds=search.seeds, spread=search.spread)
        ((_, costs),) = finished(executor, task, [start], desc=start.name, unit="tuning", progress=progress)
        trial = optuna.trial.create_trial(
            params=_start_params(search),
            distributions=_space(search),
            value=score(costs, costs),
            user_attrs={"costs": costs.row()},
        )
        study.add_trial(trial)
    return study


def _run_trial(search: Search, number: int) -> None:
    """Run one more trial; ``number`` decides which one, as far as the trials before it do not."""
    optuna = _optuna()
    study = _study(search.storage, search.scene.name)
    # Machines that share a study are not to begin with the same guesses.
    seed = np.random.SeedSequence([search.seed, number, zlib.crc32(platform.node().encode())]).generate_state(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        # Its trials that still run count as bad ones: workers do not crowd where one is already.
        study.sampler = optuna.samplers.TPESampler(seed=int(seed[0]), constant_liar=True)
    trial = study.ask(_space(search))
    try:
        tuning = candidate(search, trial.params)
        costs = measure(search.scene, search.start, tuning, search.seeds, search.spread)
        trial.set_user_attr("costs", costs.row())
        study.tell(trial, score(costs, Costs(**study.get_trials()[0].user_attrs["costs"])))
    except BaseException:
        study.tell(trial, state=optuna.trial.TrialState.FAIL)
        raise


def _confirm(search: Search, executor: Executor, progress: bool) -> Chosen | None:
    """Run the best of the search on other episodes; the first that still beats the start there is chosen."""
    best = sorted((row for row in finished_trials(search) if row["score"] < 1.0), key=lambda row: float(row["score"]))
    best = best[:_CONFIRMED]
    if not best:
        return None
    tunings = [candidate(search, row) for row in best]
    again = partial(measure, search.scene, search.start, seeds=search.other_seeds, spread=search.spread)
    pairs = finished(
        executor, again, [search.start, *tunings], desc="on other episodes", unit="tuning", progress=progress
    )
    costs = dict(pairs)
    start = costs[search.start]
    for row, tuning in zip(best, tunings, strict=True):
        confirmed = score(costs[tuning], start)
        if confirmed < 1.0:
            return Chosen(tuning, row["trial"], row["score"], confirmed, costs[tuning], start)
    return None


@lru_cache(maxsize=1)
def _study(url: str, name: str) -> Study:
    study: Study = _optuna().load_study(study_name=name, storage=_storage(url))
    return study


def _storage(url: str) -> Any:
    storages = _optuna().storages
    if url.startswith("sqlite"):
        return storages.RDBStorage(url, engine_kwargs={"connect_args": {"timeout": _WAIT_FOR_SQLITE}})
    return storages.get_storage(url)


def _optuna() -> Any:
    try:
        import optuna
    except ImportError:
        raise PCRError("tuning needs Optuna: pip install pcr_mpc[tune]") from None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna
