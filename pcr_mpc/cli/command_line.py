"""Command line: track a scene, solve a pose, time the loop, tune a controller."""

from __future__ import annotations

import argparse
import importlib
import math
import os
import sys
import traceback
import warnings

from .. import interrupt
from ..files import leaving_no_empty_folders
from .parser import ABOVE_ZERO, ENDINGS, LEAST, parser
from .places import remember

# Arguments that name a file: a path, or the name of one of these kinds that comes with the package.
_FILES = {
    "scene": ("scene",),
    "robot": ("robot",),
    "target": ("scene", "robot"),
    "controller": ("tuning",),
    "start": ("tuning",),
}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status: 1 for a failure, 130 for Ctrl-C."""
    given = sys.argv[1:] if arguments is None else arguments
    with interrupt.listening(to_the_end=arguments is None):
        try:
            status = _run(parser().parse_args(given), given)
            sys.stdout.flush()
            return status
        except BrokenPipeError:  # of `pcr-mpc ... | head`: nobody reads on, which is no failure to report
            for stream in (sys.__stdout__, sys.__stderr__):
                if stream is not None:
                    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
            return 128 + 13  # SIGPIPE


def _run(options: argparse.Namespace, given: list[str]) -> int:
    try:
        warnings.formatwarning = lambda message, *_, **__: f"pcr-mpc: warning: {message}\n"
        _check(options, given)
        with interrupt.nothing_to_lose():
            module, name = options.run
            command = getattr(importlib.import_module(f"{__package__}.{module}"), name)
        try:
            with leaving_no_empty_folders():
                status: int = command(options)
        finally:
            remember(options)
        sys.stdout.flush()
        if not status:  # else the command has said what there is to say
            interrupt.check()
        return status
    except BrokenPipeError:
        raise
    except (Exception, KeyboardInterrupt) as error:
        if isinstance(error.__cause__, BrokenPipeError):
            raise BrokenPipeError from error
        stopped = interrupt.noted() or KeyboardInterrupt in (type(error), type(error.__cause__))
        if options.traceback:
            traceback.print_exc()
        print(f"pcr-mpc: {_message(error, stopped, options)}", file=sys.stderr)
        return interrupt.exit_status() if stopped else 1


def _check(options: argparse.Namespace, given: list[str]) -> None:
    """Find the commonest errors before anything that takes time is loaded."""
    for before, one in zip(["", *given], given, strict=False):
        # As of a shell's variable that is not set: as a path it would be the folder one is in.
        if not one.strip() or (one.startswith("--") and one.endswith("=")):
            before = before if before.startswith("--") else f"an argument of {options.command}"
            what = one.strip().rstrip("=") or before
            raise ValueError(f"{what} is empty; give a name")
    for name, least in LEAST.items():
        if (value := getattr(options, name, None)) is not None and value < least:
            raise ValueError(f"--{name} is {value}, expected at least {least}")
    for name, unit in ABOVE_ZERO.items():
        if (value := getattr(options, name, None)) is not None and not 0.0 < value < math.inf:
            raise ValueError(f"--{name.replace('_', '-')} is {value:g} {unit}, expected a finite number > 0")
    ending = ENDINGS.get(options.run[1])
    if ending and options.out is not None and options.out.suffix.lower() != ending:
        raise ValueError(f"--out is {options.out}, expected a name that ends with {ending}")
    with interrupt.nothing_to_lose():
        from .finding import found

        options.named = []
        for name, kinds in _FILES.items():
            wanted = getattr(options, name, None)
            if wanted and not (name == "controller" and isinstance(wanted, str)):  # else the name of a class
                path, by_name = found(str(wanted), kinds, options.command)
                setattr(options, name, path)
                options.named += [name] if by_name else []


def _message(error: BaseException, stopped: bool, options: argparse.Namespace) -> str:
    from ..errors import ModelError, PCRError, SimulationError, described  # which load NumPy

    if stopped:
        return str(error) if isinstance(error, KeyboardInterrupt | SimulationError) and str(error) else "interrupted"
    if isinstance(error, MemoryError):
        return f"out of memory: {error}".rstrip(": ")
    if isinstance(error, ModelError) and not {"file", "said"} & set(error.details):
        from .behind import file_behind

        file = file_behind(str(error.details.get("key")), options)
        return f"{file}: {error}" if file else str(error)
    if isinstance(error, PCRError | ValueError | OSError):
        return described(error)
    return f"{type(error).__name__}: {error}; --traceback shows where"
