"""Ctrl-C and its brothers, made safe for calls into C++ that lose Python's exceptions.

The command line's handler notes the signal and raises nothing; `check`, called at every step, pose, period, episode and
trial, raises `KeyboardInterrupt` from it. So no call can swallow it, and no file is left half written. A second signal
ends the process at once. Without `listening`, Python's own handler acts, and `check` does nothing.
"""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_ENDING = 0.5  # s
_LISTEN = 0.1  # s, between looks at whether to stop
_noted: int | None = None
_programs: list[subprocess.Popen[str]] = []
_nothing_to_lose = False


def check() -> None:
    """Raise `KeyboardInterrupt` if a signal to stop was noted."""
    if _noted is not None:
        raise KeyboardInterrupt


def completed(command: list[str]) -> subprocess.CompletedProcess[str]:
    """Run another program; it ends with this process, and where a signal to stop is noted meanwhile.

    Raises
    ------
    OSError
        There is no such program.
    """
    # In a session of its own: Ctrl-C in a terminal is ours alone, and what the program has started ends with it.
    with (
        _ending_programs(),
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace",
                         start_new_session=True) as process,
    ):  # fmt: skip
        _programs.append(process)
        try:
            while True:
                with suppress(subprocess.TimeoutExpired):
                    out, err = process.communicate(timeout=_LISTEN)
                    return subprocess.CompletedProcess(command, process.returncode, out, err)
                check()
        except BaseException:
            _end(process)
            raise
        finally:
            _programs.remove(process)


def end_programs() -> None:
    """End all programs that `completed` waits for, before a process that ends at once."""
    for process in list(_programs):
        _end(process)


def _end(process: subprocess.Popen[str]) -> None:
    """By force if need be; a compiler takes its files away before."""
    for kind in (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM)):
        with suppress(OSError):
            os.killpg(process.pid, kind) if hasattr(os, "killpg") else process.kill()
        with suppress(subprocess.TimeoutExpired):
            process.wait(_ENDING)


@contextmanager
def _ending_programs() -> Iterator[None]:
    """Where SIGTERM would end this process at once, as it does a worker, let it end its programs before."""
    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    ):
        yield
        return

    def end(kind: int, frame: FrameType | None) -> None:
        end_programs()
        os._exit(128 + kind)

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def exit_status() -> int:
    """Exit status of a command that was stopped: 128 and the signal's number, 130 for Ctrl-C."""
    return 128 + (signal.SIGINT if _noted is None else _noted)


def noted() -> bool:
    """Whether a signal to stop was noted."""
    return _noted is not None


def pass_on(error: BaseException) -> None:
    """Raise `KeyboardInterrupt` if that is what ended a run: it is no failure of what was tried."""
    check()
    if isinstance(error.__cause__, KeyboardInterrupt):
        raise KeyboardInterrupt from error


@contextmanager
def listening(*, to_the_end: bool = False) -> Iterator[None]:
    """Note SIGINT, SIGTERM and SIGHUP instead of acting on them; in the main thread only.

    Parameters
    ----------
    to_the_end : bool
        The process ends after this: the handlers stay, and a signal that comes then ends it at once.
    """
    global _noted, _nothing_to_lose
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    kinds = [signal.SIGINT, signal.SIGTERM]
    # nohup has it ignored, and that is to stay so.
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        kinds.append(signal.SIGHUP)
    _noted, _nothing_to_lose = None, False
    before = {kind: signal.signal(kind, _note) for kind in kinds}
    try:
        yield
    finally:
        _noted = None
        if to_the_end:
            _nothing_to_lose = True
        else:
            for kind, handler in before.items():
                signal.signal(kind, handler)


@contextmanager
def nothing_to_lose() -> Iterator[None]:
    """While this lasts, as while modules load, a signal ends the process at once."""
    global _nothing_to_lose
    _nothing_to_lose = True
    try:
        yield
    finally:
        _nothing_to_lose = False


@contextmanager
def held_back() -> Iterator[None]:
    """Keep SIGINT from processes that are started meanwhile, until they say what they make of it; it is not lost."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker  # not on all systems

    # Python starts it with the first process, and lets SIGINT through again then.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _note(kind: int, frame: FrameType | None) -> None:
    global _noted
    if _noted is None and not _nothing_to_lose:
        _noted = kind
        return
    # Not by sys.exit: that would wait for whatever does not end.
    end_programs()
    os.write(2, b"pcr-mpc: interrupted\n")
    os._exit(128 + kind)
