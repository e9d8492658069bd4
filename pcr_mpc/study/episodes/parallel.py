"""Many independent tasks on any `concurrent.futures.Executor`; what is finished is kept."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, TypeVar

from tqdm import tqdm

from ... import interrupt
from ...errors import StudyError
from ...files import write_text
from .provenance import differences

Row = dict[str, Any]
Argument = TypeVar("Argument")
Result = TypeVar("Result")
_PATIENCE = 2.0  # s
_LISTEN = 0.1  # s, between looks at whether to stop while others work
# Libraries that spread over all cores would fight for those of the other workers.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@contextmanager
def local_workers(jobs: int | None = None) -> Iterator[ProcessPoolExecutor]:
    """Open ``jobs`` processes on this machine (None: one for each core that is ours), one thread each."""
    jobs = available_cores() if jobs is None else jobs
    if jobs < 1:
        raise ValueError(f"jobs is {jobs}, expected at least 1")
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(_ONE_THREAD)  # new interpreters read it before they load anything
    try:
        # Not forked: a fork of a process with threads may hang.
        context = multiprocessing.get_context("spawn")
        resource_tracker.ensure_running()  # which, when it is started, lets signals through
        others = set(multiprocessing.active_children())
        executor = _Workers(jobs, mp_context=context, initializer=follow_the_parent)
        try:
            yield executor
        except BaseException:
            # What the workers are at is of no more use; finished rows are with the caller.
            executor.shutdown(wait=False, cancel_futures=True)
            # Until its thread has put away what was cancelled, it would fail on that loudly.
            patience = time.monotonic() + _PATIENCE
            while getattr(executor, "_cancel_pending_futures", False) and time.monotonic() < patience:
                time.sleep(0.01)
            for worker in set(multiprocessing.active_children()) - others:
                worker.terminate()
            raise
        finally:
            executor.shutdown()
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Workers(ProcessPoolExecutor):
    """Workers that Ctrl-C in a terminal, which reaches all processes, does not stop: the parent does."""

    def submit(self, *arguments: Any, **keywords: Any) -> Any:
        """See `Executor`; this is where processes are started.

        Raises
        ------
        StudyError
            What is to be worked on cannot be sent to another process; names what of it. None is started then.
        """
        require_portable(arguments)
        with interrupt.held_back():
            return super().submit(*arguments, **keywords)


def require_portable(task: Sequence[Any]) -> None:
    """Raise if a function with its arguments cannot be sent to a new process.

    Raises
    ------
    StudyError
        Names the part that cannot, such as the reference of a scene, and what to do.
    """
    try:
        pickled = pickle.dumps(task)
    except Exception as error:  # whatever a foreign object does when it is pickled
        name, part = _unportable("task", task)
        raise StudyError(
            f"{name} is {part!r}, which cannot be sent to worker processes: {error}; take a function or a class that "
            "stands at the top of a module, not a lambda or one within a function",
            part=name,
        ) from error
    main = sys.modules.get("__main__")
    if b"__main__" in pickled and getattr(main, "__file__", None) is None:
        raise StudyError(
            "what is to be worked on was made in an interactive session, whose functions and classes worker processes "
            "do not find; put them into a module, and import it",
            part="__main__",
        )


def _unportable(name: str, thing: Any) -> tuple[str, Any]:
    """The innermost part that cannot be pickled, and where it is."""
    if isinstance(thing, partial):
        parts = [(f"argument {i}", each) for i, each in enumerate(thing.args)] + list(thing.keywords.items())
        parts.append((getattr(thing.func, "__name__", "function"), thing.func))
    elif is_dataclass(thing) and not isinstance(thing, type):
        kind = type(thing).__name__.lower()
        parts = [(f"{kind}.{field.name}", getattr(thing, field.name)) for field in fields(thing)]
    elif isinstance(thing, tuple | list):
        parts = [(f"{name}[{i}]", each) for i, each in enumerate(thing)]
    else:
        parts = []
    for inner, part in parts:
        try:
            pickle.dumps(part)
        except Exception:
            return _unportable(inner, part)
    return name, thing


def follow_the_parent() -> None:
    """In another process: leave Ctrl-C to the one that started it, and end with that."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A parent that is killed leaves its workers waiting for ever.
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    interrupt.end_programs()
    os._exit(1)


def as_finished(futures: Iterable[Future[Result]]) -> Iterator[Future[Result]]:
    """Futures as they are finished, and an ear for Ctrl-C while there is none."""
    left = set(futures)
    while left:
        interrupt.check()
        done, left = wait(left, timeout=_LISTEN, return_when=FIRST_COMPLETED)
        yield from done


def finished(
    executor: Executor,
    task: Callable[[Argument], Result],
    arguments: Sequence[Argument],
    *,
    desc: str,
    unit: str,
    before: int = 0,
    progress: bool = True,
) -> Iterator[tuple[Argument, Result]]:
    """Run a task for each argument; yield argument and result as they come.

    Parameters
    ----------
    executor : Executor
    task : callable
        Importable where it runs.
    arguments : sequence
    desc, unit : str
        Of the progress bar on stderr.
    before : int
        Tasks that were finished before, for the progress bar.
    progress : bool
        Show it.

    Raises
    ------
    StudyError
        At the end, if tasks were left without a result: a worker died, or the task raised. ``lost`` are their
        arguments.
    """
    futures: dict[Future[Result], Argument] = {}
    lost: list[tuple[Argument, Exception]] = []
    try:
        for argument in arguments:
            try:
                futures[executor.submit(task, argument)] = argument
            except BrokenExecutor as error:
                lost.append((argument, error))
        bar = tqdm(as_finished(futures), desc=desc, unit=unit, initial=before, total=before + len(futures),
                   disable=not progress)  # fmt: skip
        for future in bar:
            try:
                result = future.result()
            except Exception as error:
                lost.append((futures[future], error))
            else:
                yield futures[future], result
    finally:  # interrupted, or the caller has had enough
        for future in futures:
            future.cancel()
    if lost:
        first, cause = lost[0]
        raise StudyError(
            f"{len(lost)} of {len(arguments)} tasks ended without a result; the first, {first}: "
            f"{type(cause).__name__}: {cause}",
            lost=[argument for argument, _ in lost],
        ) from cause


def collect(
    executor: Executor,
    task: Callable[[int], Row],
    seeds: Sequence[int],
    path: Path,
    settings: Mapping[str, Any],
    *,
    desc: str,
    unit: str = "episode",
    progress: bool = True,
) -> list[Row]:
    """Rows of a task for each seed, in the order of the seeds; resumes what an earlier call has left in a file.

    Each row is appended to the file as soon as it is there, as one line of JSON. A first line holds the settings.

    Parameters
    ----------
    executor, task, desc, unit, progress
        As for `finished`; the row of a seed has it as its ``seed``.
    seeds : sequence of int
    path : Path
    settings : mapping
        Ready for JSON; rows in the file are taken only if theirs were the same.

    Raises
    ------
    StudyError
        The file is of other settings, or some rows are still missing; those that there are are in the file.
    KeyboardInterrupt
        Says how to go on.
    """
    rows = _rows_so_far(path, dict(settings))
    missing = [seed for seed in dict.fromkeys(seeds) if seed not in rows]
    before = len(set(seeds)) - len(missing)
    kept = f"those that there are are kept in {path}, and the same command goes on from there"
    try:
        with open(path, "a", encoding="utf-8") as file:
            for seed, row in finished(executor, task, missing, desc=desc, unit=unit, before=before, progress=progress):
                line = json.dumps(row)
                file.write(line + "\n")
                file.flush()
                rows[seed] = json.loads(line)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted with {len(rows)} rows finished; {kept}") from None
    except StudyError as error:
        raise StudyError(f"{error}; {kept}", **error.details) from error.__cause__
    return [rows[seed] for seed in sorted(set(seeds))]


def _rows_so_far(path: Path, settings: dict[str, Any]) -> dict[int, Row]:
    """Rows in the file, by seed; begins it if there is none. A last line that was cut off is cut away."""
    text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
    whole = text[: text.rfind("\n") + 1]
    lines = whole.splitlines()
    if not lines:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps({"settings": settings}) + "\n")
        return {}
    try:
        header, *rows = map(json.loads, lines)
        theirs = header["settings"]
        found = {int(row["seed"]): row for row in rows}
    except (ValueError, KeyError, TypeError) as error:
        raise StudyError(f"{path}: not a file of a study ({error}); move it away", path=str(path)) from error
    changed = differences(theirs, settings)
    if changed:
        more = f" (and {len(changed) - 1} more)" if len(changed) > 1 else ""
        raise StudyError(
            f"{path} holds {len(found)} rows of other settings: {changed[0]}{more}; move it away to begin anew",
            path=str(path),
            differences=changed,
        )
    if len(whole) < len(text):
        write_text(path, whole)
    return found
