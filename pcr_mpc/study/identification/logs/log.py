"""Recorded motion: what was told to the motors, and what the sensors saw."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ....errors import LogError, ModelError
from ....frozen import Frozen
from ....loop.run.run import load_run

# Of a row's time, in steps of the log, by which it may be beside the grid.
_OFF_GRID = 0.05
# Steps longer than this are a pause [steps]: then another log begins.
_PAUSE = 20
# Faster logs are thinned to this rate [1/s]: tips move slowly, and a thousand rows a second cost without telling more.
_FASTEST = 200.0
# Columns besides time in which there must be numbers, or nothing.
_NUMBERS = re.compile(r"(measured_)?(p_[xy]_m|q\d+_rad)|u\d+_rad_s|torque\d+_Nm")


@dataclass(frozen=True, eq=False)
class Log(Frozen):
    """One recorded motion at a uniform rate; what is missing is NaN.

    Attributes
    ----------
    name : str
        For reports.
    step : float
        From row to row [s].
    t : ndarray, shape (M,)
        [s].
    p : ndarray, shape (M, 2)
        Tip position as it was measured [m].
    q : ndarray, shape (M, n)
        Motor angles as they were measured [rad].
    u : ndarray, shape (M, n)
        Motor rates as they were commanded, each held from its row on [rad/s].
    driven_by : {"commands", "angles"}
        Whether ``u`` was recorded, or stands for the angles' differences, which come without a delay.
    torque : ndarray, shape (M, n), or None
        Torques of the motors as they were measured, positive counter-clockwise [N m].
    """

    name: str
    step: float
    t: np.ndarray
    p: np.ndarray
    q: np.ndarray
    u: np.ndarray
    driven_by: str = "commands"
    torque: np.ndarray | None = None

    @property
    def missing(self) -> np.ndarray:
        """Rows in which a command is missing."""
        return np.flatnonzero(np.isnan(self.u).any(axis=1))

    def part(self, first: int, last: int, name: str | None = None) -> Log:
        """Return the rows from ``first`` to before ``last``."""
        rows = slice(first, last)
        torque = None if self.torque is None else self.torque[rows]
        return replace(
            self, name=name or self.name, t=self.t[rows], p=self.p[rows], q=self.q[rows], u=self.u[rows], torque=torque
        )


def read_log(path: str | Path, n: int) -> list[Log]:
    """Read a log of a robot with n motors; a long pause in it makes two of it.

    Parameters
    ----------
    path : str or Path
        A CSV file with the columns ``t_s``, ``p_x_m``, ``p_y_m``, ``q0_rad``, ... and ``u0_rad_s``, ..., and perhaps
        ``torque0_Nm``, ..., in any order and among others; the record of `track`, run.csv or run.npz, or its folder.
    n : int
        Motors of the robot.

    Returns
    -------
    list of Log
        In their order in time.

    Raises
    ------
    LogError
        It is no such file, its times are not uniform, or it says nothing of the tip.
    FileNotFoundError
        There is none.
    """
    path = Path(path)
    return _thinned(_from_record(path, n) if path.is_dir() or path.suffix == ".npz" else _from_csv(path, n))


def _failure(path: Path, problem: str) -> LogError:
    return LogError(f"{path}: {problem}", file=str(path))


def _from_record(path: Path, n: int) -> list[Log]:
    folder = path if path.is_dir() else path.parent
    if not path.is_dir() and path.name != "run.npz":
        raise _failure(path, "is no record of `track`, which is called run.npz; give that, or a CSV file")
    try:
        run = load_run(folder)
    except ModelError as error:
        raise LogError(str(error), file=str(path)) from None
    if run.scene.robot.n_rods != n:
        raise _failure(path, f"is of a robot with {run.scene.robot.n_rods} motors, the scene's has {n}")
    count = len(run.u)
    if not count:
        raise _failure(path, "the run ended before its first command")
    if run.scene.payload is not None and run.scene.carried(run.t).any():
        raise _failure(path, "the tip picks up a payload in it; record a motion with nothing to pick up")
    t = run.scene.period * np.arange(count)
    return [Log(str(path), run.scene.period, t, run.measured[:, :2], run.measured[:, 4:], run.u)]


def _from_csv(path: Path, n: int) -> list[Log]:
    columns = _columns(path)
    for name in columns:
        found = re.fullmatch(r"(?:[qu]|torque)(\d+)_(?:rad(?:_s)?|Nm)", name)
        if found and int(found[1]) >= n:
            raise _failure(path, f"has a column {name!r}, but the scene's robot has {n} motors; is it another robot's?")
    if "t_s" not in columns:
        raise _failure(path, f"has no column 't_s', the time in seconds; its columns are {', '.join(columns)}")
    t = columns["t_s"]
    recorded = any(name.startswith("measured_") for name in columns)
    before = "measured_" if recorded else ""
    nothing = np.full(len(t), np.nan)
    p, q, u, torque = (
        np.stack([columns.get(name, nothing) for name in names], axis=1)
        for names in (
            [f"{before}p_{axis}_m" for axis in "xy"],
            [f"{before}q{i}_rad" for i in range(n)],
            [f"u{i}_rad_s" for i in range(n)],
            # Those in a record of `track` are true ones, which nobody has measured.
            ["" if recorded else f"torque{i}_Nm" for i in range(n)],
        )
    )
    if recorded:  # of `track`: a row for each step of the plant, with what was measured and told in the period
        rows = _first_rows(t, np.hstack([p, q, u]))
        t, p, q, u, torque = t[rows], p[rows], q[rows], u[rows], torque[rows]
    if np.isnan(p).all():
        raise _failure(
            path,
            "says nothing of the tip: no numbers in columns 'p_x_m' and 'p_y_m'; angles alone tell nothing about rods",
        )
    if np.isnan(q).all() and np.isnan(u).all():
        raise _failure(path, "says nothing of the motors: give columns 'u0_rad_s', ..., or at least 'q0_rad', ...")
    return _on_a_grid(path, t, p, q, u, torque)


def _columns(path: Path) -> dict[str, np.ndarray]:
    """Numbers of a CSV file by the names of its columns; empty cells are NaN."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as handle:
            text = handle.read()
    except UnicodeDecodeError as error:
        raise _failure(path, f"is no text ({error})") from None
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise _failure(path, "is empty")
    separator = max(",;\t", key=lines[0].count)
    header, *rows = list(csv.reader(lines, delimiter=separator))
    names = [name.strip() for name in header]
    if len(set(names)) < len(names):
        raise _failure(path, "has two columns of one name")
    values = np.full((len(rows), len(names)), np.nan)
    for k, row in enumerate(rows):
        if len(row) != len(names):
            raise _failure(path, f"row {k + 2} has {len(row)} cells, its header has {len(names)}")
        for j, cell in enumerate(row):
            try:
                values[k, j] = float(cell) if cell.strip() else np.nan
            except ValueError:
                if names[j] == "t_s" or _NUMBERS.fullmatch(names[j]):
                    raise _failure(path, f"row {k + 2}, column {names[j]!r}: {cell!r} is no number") from None
    values[~np.isfinite(values)] = np.nan
    return dict(zip(names, values.T, strict=True))


def _first_rows(t: np.ndarray, held: np.ndarray) -> np.ndarray:
    """First rows of control periods: what is held in a period changes there and nowhere else."""
    filled = np.where(np.isnan(held), 0.0, held)
    changes = np.flatnonzero((np.diff(filled, axis=0) != 0.0).any(axis=1)) + 1
    period = int(np.gcd.reduce(changes)) if len(changes) else 1
    return np.arange(0, len(t) - (len(t) % period == 1), max(period, 1))


def _on_a_grid(path: Path, t: np.ndarray, p: np.ndarray, q: np.ndarray, u: np.ndarray, torque: np.ndarray) -> list[Log]:
    """Rows at whole multiples of one step; those that are missing are of NaN, and a long pause divides the log."""
    if np.isnan(t).any():
        raise _failure(path, f"row {int(np.flatnonzero(np.isnan(t))[0]) + 2} has no time")
    steps = np.diff(t)
    if len(t) < 2 or not (steps > 0.0).all():
        back = np.flatnonzero(steps <= 0.0)
        raise _failure(path, f"time goes back at t = {t[back[0]]:g} s" if len(back) else "has one row only")
    step = float(np.median(steps))
    for _ in range(2):  # the mean over the whole log is better than a median of rounded differences
        whole = np.maximum(np.rint(steps / step), 1.0)
        step = float(steps[whole < _PAUSE].sum() / whole[whole < _PAUSE].sum())
    off = np.abs(steps / step - whole)
    if off.max() > _OFF_GRID and (off > _OFF_GRID).mean() > 0.01:
        worst = int(off.argmax())
        raise _failure(
            path,
            f"is not at a uniform rate: its rows are {1e3 * step:.4g} ms apart, but {1e3 * steps[worst]:.4g} ms at "
            f"t = {t[worst]:g} s; resample it",
        )
    logs, ends = [], [*(np.flatnonzero(whole >= _PAUSE) + 1), len(t)]
    for number, (first, last) in enumerate(zip([0, *ends[:-1]], ends, strict=True)):
        places = np.concatenate([[0], np.cumsum(whole[first : last - 1])]).astype(int)
        arrays = []
        for values in (p, q, u, torque):
            grid = np.full((places[-1] + 1, values.shape[1]), np.nan)
            grid[places] = values[first:last]
            arrays.append(grid)
        name = f"{path}" if len(ends) == 1 else f"{path} (part {number + 1})"
        times = t[first] + step * np.arange(places[-1] + 1)
        known = None if np.isnan(arrays[3]).all() else arrays[3]
        logs.append(_with_commands(Log(name, step, times, arrays[0], arrays[1], arrays[2], torque=known)))
    return logs


def _with_commands(log: Log) -> Log:
    """Let the angles drive a log without commands."""
    if not np.isnan(log.u).all():
        return log
    rows = np.arange(len(log.t))
    filled = np.stack([np.interp(rows, rows[~np.isnan(angle)], angle[~np.isnan(angle)]) for angle in log.q.T], axis=1)
    rates = np.diff(filled, axis=0, append=filled[-1:]) / log.step
    return replace(log, u=rates, driven_by="angles")


def _thinned(logs: list[Log]) -> list[Log]:
    """Every so manieth row of a fast log; commands are averaged in between."""
    thin = []
    for log in logs:
        every = max(1, int(1.0 / (_FASTEST * log.step) + 1e-6))
        count = len(log.t) // every
        if every > 1 and count > 1:
            u = log.u[: count * every].reshape(count, every, -1).mean(axis=1)
            first = slice(0, count * every, every)
            torque = None if log.torque is None else log.torque[first]
            log = replace(
                log, step=every * log.step, t=log.t[first], p=log.p[first], q=log.q[first], u=u, torque=torque
            )
        thin.append(log)
    return thin
