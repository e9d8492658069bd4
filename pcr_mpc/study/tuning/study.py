"""Search for a better tuning of a scene with Optuna: shared by processes and machines, resumable."""

from __future__ import annotations

import math
import warnings
from collections import deque
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from ...control.tuning import Tuning
from ...errors import PCRError, StudyError
from ..episodes.parallel import as_finished, finished
from ..episodes.provenance import described, differences
from .score import Costs, measure, score
from .space import Search, candidate, guesses, parameters, space

if TYPE_CHECKING:
    from optuna import Study, Trial

_WAIT_FOR_SQLITE = 60.0  # s, while another process writes
# Trials that may run at once. A trial is chosen knowing all but the last so many: more would teach it less.
_AHEAD = 8
# The best few in the search are run once more on other episodes: the best of many is partly lucky.
_CONFIRMED = 3
# Scores that differ by less are the same; then the shorter horizon is the better one: it takes less time.
_SAME = 0.01


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
        Measures them; this process alone speaks with the storage.
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
    try:
        _run(study, search, trials, executor, progress)
        return _confirm(search, executor, progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted; {len(finished_trials(search))} trials are kept in {search.storage}, "
            "and the same command adds to them"
        ) from None


def finished_trials(search: Search) -> list[dict[str, Any]]:
    """All finished trials of a study, as rows: ``trial``, ``score``, the costs, and the parameters."""
    optuna = _optuna()
    trials = _study(search.storage, search.scene.name).get_trials(states=(optuna.trial.TrialState.COMPLETE,))
    return [{"trial": t.number, "score": t.value, **t.user_attrs["costs"], **t.params} for t in trials]


def _prepare(search: Search, executor: Executor, progress: bool) -> Study:
    """Open or begin the study; its first trial is the start, which scores 1 by definition."""
    optuna = _optuna()
    start, name = search.start, search.scene.name
    settings = {**described(search.scene, start, search.spread), "episodes": search.episodes, "seed": search.seed,
                "keep_period": search.keep_period}  # fmt: skip
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
            params=parameters(search, start),
            distributions=space(search),
            value=score(costs, costs),
            user_attrs={"costs": costs.row()},
        )
        study.add_trial(trial)
        for guess in guesses(search):
            study.enqueue_trial(guess)
    return study


def _run(study: Study, search: Search, trials: int, executor: Executor, progress: bool) -> None:
    """Run more trials. Asked and told in turn, they do not depend on how many processes there are, nor on the clock."""
    task = partial(measure, search.scene, search.start, seeds=search.seeds, spread=search.spread)
    start = Costs(**study.get_trials(deepcopy=False)[0].user_attrs["costs"])
    pending: deque[tuple[Trial, Future[Costs]]] = deque()
    lost: list[tuple[int, Exception]] = []

    def ask() -> None:
        trial = _ask(study, search)
        try:
            pending.append((trial, executor.submit(task, candidate(search, trial.params))))
        except BaseException:
            study.tell(trial, state=_optuna().trial.TrialState.FAIL)
            raise

    def tell(trial: Trial, future: Future[Costs]) -> None:
        try:
            costs = future.result()
        except Exception as error:
            lost.append((trial.number, error))
            study.tell(trial, state=_optuna().trial.TrialState.FAIL)
            return
        trial.set_user_attr("costs", costs.row())
        study.tell(trial, score(costs, start))

    bar = tqdm(range(trials), desc=f"tune {search.scene.name}", unit="trial", disable=not progress)
    try:
        for number in bar:
            while len(pending) < min(_AHEAD, trials - number):
                ask()
            for _ in as_finished([pending[0][1]]):  # wait while it is still on the list
                pass
            tell(*pending.popleft())
    except BrokenExecutor as error:
        lost.append((len(study.trials) - 1, error))
    finally:
        for trial, future in pending:
            if future.done():
                tell(trial, future)
            else:
                future.cancel()
                study.tell(trial, state=_optuna().trial.TrialState.FAIL)
    if lost:
        first, cause = lost[0]
        raise StudyError(
            f"{len(lost)} of {trials} trials ended without a result, the others are kept in {search.storage}; the "
            f"first, trial {first}: {type(cause).__name__}: {cause}",
            lost=[number for number, _ in lost],
        ) from cause


def _ask(study: Study, search: Search) -> Trial:
    """Next trial: a guess that is left, or what the sampler makes of the trials that were told and are running."""
    optuna = _optuna()
    seed = np.random.SeedSequence([search.seed, len(study.trials)]).generate_state(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        # Its trials that still run count as bad ones: it does not crowd where one is already.
        study.sampler = optuna.samplers.TPESampler(seed=int(seed[0]), constant_liar=True)
    return study.ask(space(search))


def _confirm(search: Search, executor: Executor, progress: bool) -> Chosen | None:
    """Run the best of the search on other episodes; the first that still beats the start there is chosen."""
    rows = [row for row in finished_trials(search) if not row.get("margin_lack")]
    better = [row for row in rows if row["score"] < 1.0]
    if not better:
        return None
    least = min(row["score"] for row in better)
    best = sorted(better, key=lambda row: (int(math.log(row["score"] / least) / _SAME), row["horizon"], row["score"]))
    best = best[:_CONFIRMED]
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
