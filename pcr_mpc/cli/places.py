"""Where results go that are given no place, and a word before those of another scene go."""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

_ROOT = Path("results")
_LIST = ".scenes.json"  # of which scene the results in a place are
_CLOCK = 20_000_000  # ns by which a file system's clock may be behind


def own_place(options: argparse.Namespace, place: str, other: str = "--out takes another place") -> Path:
    """Return a place for a scene's results, and say before the run if they replace those of another scene.

    Parameters
    ----------
    options : argparse.Namespace
        With the file of the scene.
    place : str
        Of a file or a folder, in the folder of all results.
    other : str
        How to get another one.
    """
    earlier = _scenes().get(place)
    where = _ROOT / place
    if isinstance(earlier, str) and where.exists() and Path(earlier).resolve() != Path(options.scene).resolve():
        print(
            f"pcr-mpc: warning: the results of {earlier} that are in {where} will be replaced, as the scenes have the "
            f"same name; {other}",
            file=sys.stderr,
        )
    options.own_place = (place, time.time_ns())
    return where


def remember(options: argparse.Namespace) -> None:
    """Note of which scene the results are, if there are new ones in a place that `own_place` gave.

    It is for a warning alone: where it cannot be written, the command is what it was.
    """
    with suppress(OSError):
        _remember(options)


def _remember(options: argparse.Namespace) -> None:
    place, begin = getattr(options, "own_place", ("", 0))
    where = _ROOT / place
    if not (place and where.exists()):
        return
    files = [where, *where.iterdir()] if where.is_dir() else [where]
    # Of a run that failed before it wrote anything there is nothing new.
    if max(file.stat().st_mtime_ns for file in files) < begin - _CLOCK:
        return
    known = _scenes() | {place: str(options.scene)}
    (_ROOT / _LIST).write_text(json.dumps(known, indent=2) + "\n", encoding="utf-8")


def _scenes() -> dict[str, Any]:
    try:
        found = json.loads((_ROOT / _LIST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
