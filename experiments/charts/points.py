"""One row a point of a chart: kept in a CSV file as soon as it is measured, and not measured twice."""

from __future__ import annotations

import csv
import os
import platform
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from pcr_mpc.study.episodes.provenance import commit
from pcr_mpc.study.timing.machine import machine

Row = dict[str, Any]
Key = tuple[str, str, str]

# Errors are relative on the level of statics, in mm on the others. Times are wall time [s]: of one solve, of one
# simulated second (percentiles over its steps, times their number), of one control step. Iterations are of the solver,
# evaluations of the rods' equations (statics) or steps (the others), both medians.
FIELDS = (
    "level", "case", "method", "settings", "ours", "success", "attempts", "error", "error_max", "iterations",
    "evaluations", "time_p50", "time_p5", "time_p95", "time_p99", "remark", "machine", "versions", "commit",
)  # fmt: skip
_NUMBERS = ("error", "error_max", "iterations", "evaluations", "time_p50", "time_p5", "time_p95", "time_p99")
_PACKAGES = ("casadi", "numpy", "scipy", "osqp", "daqp", "mujoco", "pyelastica", "do_mpc", "crocoddyl")


def times(seconds: Sequence[float] | np.ndarray) -> Row:
    """Percentiles of the times of the successes, empty without any."""
    if not len(seconds):
        return {}
    found = np.percentile(np.asarray(seconds), [50, 5, 95, 99])
    return dict(zip(("time_p50", "time_p5", "time_p95", "time_p99"), map(float, found), strict=True))


def collect(
    level: str, keys: Sequence[Key], measure: Callable[[Key], Row], folder: Path, *, fresh: bool = False
) -> list[Row]:
    """Measure all points of a level that its CSV file does not have yet, and return all.

    Parameters
    ----------
    level : str
    keys : sequence of (case, method, settings)
    measure : callable
        Key -> the rest of the row.
    folder : Path
        Of the file, ``accuracy_vs_speed_LEVEL.csv``. Rows of the same commit in it are kept, unless the package has
        been changed since the commit; others are dropped.
    fresh : bool
        Keep none.

    Returns
    -------
    list of dict
        In the order of ``keys``.
    """
    path = folder / f"accuracy_vs_speed_{level}.csv"
    common = {"level": level} | about()
    known: dict[Key, Row] = {}
    if path.exists() and not fresh and not common["commit"].endswith("-dirty"):
        known = {_key(row): row for row in read(path) if row["commit"] == common["commit"] and _key(row) in keys}
    folder.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=FIELDS, restval="")
        writer.writeheader()
        writer.writerows(_text(row) for row in known.values())
        file.flush()
        bar = tqdm([key for key in keys if key not in known], desc=level, unit="point")
        for key in bar:
            bar.set_postfix_str(" ".join(key)[:60])
            known[key] = common | dict(zip(("case", "method", "settings"), key, strict=True)) | measure(key)
            writer.writerow(_text(known[key]))
            file.flush()
    return [known[key] for key in keys]


def about() -> dict[str, str]:
    """On what, with what and of which code something is measured."""
    return {"machine": _machine(), "versions": _versions(), "commit": commit()}


def read(path: Path) -> list[Row]:
    """Rows of a file of `collect`: numbers as numbers, NaN where there is none."""
    with open(path, newline="", encoding="utf-8") as file:
        return [_parsed(row) for row in csv.DictReader(file)]


def complete(rows: list[Row]) -> list[Row]:
    """Rows as they come back from the file."""
    return [_parsed({name: str(value) for name, value in _text(row).items()}) for row in rows]


def failures(row: Row) -> int:
    """How many attempts did not succeed."""
    return int(row["attempts"]) - int(row["success"])


def front(rows: list[Row]) -> Iterator[Row]:
    """Rows without failures that no other such row beats in both time and error, by increasing time."""
    least = np.inf
    sound = [row for row in rows if not failures(row) and np.isfinite([row["time_p50"], row["error"]]).all()]
    for row in sorted(sound, key=lambda row: (row["time_p50"], row["error"])):
        if row["error"] < least:
            least = row["error"]
            yield row


def _key(row: Row) -> Key:
    return row["case"], row["method"], row["settings"]


def _text(row: Row) -> Row:
    return {
        name: f"{value:.6g}" if isinstance(value := row.get(name, ""), float | np.floating) else value
        for name in FIELDS
    }


def _parsed(row: Row) -> Row:
    found = dict(row)
    for name in _NUMBERS:
        found[name] = float(row[name]) if row.get(name) else np.nan
    found["success"], found["attempts"] = int(row["success"]), int(row["attempts"])
    found["ours"] = row["ours"] == "True"
    return found


def _machine() -> str:
    found, threads = machine(), os.environ.get("OPENBLAS_NUM_THREADS", "all")
    busy = f"load {found['load']:.1f} at the start"
    return f"{found['processor']}, {found['cores']} cores, {threads} thread(s) in BLAS, {busy}"


def _versions() -> str:
    found = [f"python {platform.python_version()}"]
    for name in _PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)
