"""A path from a CSV file."""

from __future__ import annotations

import csv
import difflib
import math
from pathlib import Path

import numpy as np

from ...errors import ModelError, described
from .rows import rounding
from .tabulated import Tabulated

_REQUIRED = ("t_s", "x_m", "y_m")
_PAIRS = (("vx_m_s", "vy_m_s"), ("ax_m_s2", "ay_m_s2"))
_COLUMNS = (*_REQUIRED, *_PAIRS[0], *_PAIRS[1])
_NEAR = 0.6  # likeness of a column's name to a known one
# A path in thousandths: this far out, or so slow that whole seconds pass from row to row for longer than that.
_FAR, _STEP, _LONG = 20.0, 5.0, 600.0


def load_path(file: str | Path, *, smoothing: float | None = None, closed: bool = False) -> Tabulated:
    """Read a path from a CSV file: columns t_s, x_m, y_m, and if they are known vx_m_s, vy_m_s, ax_m_s2, ay_m_s2.

    Rows may be at any times, in order; they count from the first one. Columns may be in any order. Empty lines, and
    lines that begin with #, are passed over.

    Parameters
    ----------
    file : str or Path
    smoothing, closed
        See `Tabulated`. None: that of rounding to the digits in the file, where there are so many rows that it would
        shake the tip, else zero.

    Raises
    ------
    ModelError
        Names the file, the row and line, and what is wrong: a column that is missing or in other units, a separator, a
        number, times that repeat or go back.
    """
    path = Path(file)
    lines = _lines(path)
    if not lines:
        raise _wrong(path, f"is empty; its first line has the columns: {','.join(_COLUMNS)}")
    names = _header(path, lines[0][1])
    if len(lines) == 1:
        raise _wrong(path, "has no rows below its header")
    rows = np.array([_row(path, number, names, cells) for number, cells in lines[1:]]).reshape(-1, len(names))
    table = dict(zip(names, rows.T, strict=True))
    _require_order(path, table["t_s"], [number for number, _ in lines[1:]])
    _question_units(path, table)
    velocities, accelerations = (
        np.stack([table[x], table[y]], axis=1).tolist() if x in table else None for x, y in _PAIRS
    )
    points = np.stack([table["x_m"], table["y_m"]], axis=1).tolist()
    if smoothing is None:
        smoothing = 0.0 if velocities else rounding(table["t_s"], np.array(points), _resolution(names, lines[1:]))
    try:
        return Tabulated(
            tuple(table["t_s"].tolist()), points, velocities, accelerations, smoothing=smoothing, closed=closed
        )
    except ModelError as error:
        raise ModelError(f"{path}: {error}", file=str(path), **error.details) from None


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """Number and cells of each line that holds some."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise _wrong(path, f"is not UTF-8 text ({error}); save it as CSV in UTF-8") from None
    except OSError as error:
        raise ModelError(described(error), file=str(path), key="file") from None
    try:
        cells = list(csv.reader(text.splitlines()))
    except csv.Error as error:
        raise _wrong(path, f"is no CSV: {error}") from None
    return [
        (number, [cell.strip() for cell in line])
        for number, line in enumerate(cells, start=1)
        if any(cell.strip() for cell in line) and not line[0].lstrip().startswith("#")
    ]


def _header(path: Path, names: list[str]) -> list[str]:
    if len(names) == 1:
        for separator, what in ((";", "semicolons"), ("\t", "tabs"), (" ", "blanks")):
            if separator in names[0]:
                raise _wrong(
                    path, f"has {what} between its columns; save it with commas, and with points in its numbers"
                )
    if all(_number(name) is not None for name in names):
        raise _wrong(path, f"begins with numbers; its first line has the names of the columns: {','.join(_COLUMNS)}")
    for name in names:
        if name not in _COLUMNS:
            near = next(iter(difflib.get_close_matches(name.lower(), _COLUMNS, n=1, cutoff=_NEAR)), None)
            hint = f"; did you mean {near}? Units are those in the names" if near else ""
            raise _wrong(path, f"column {name!r} is not known{hint} (known: {', '.join(_COLUMNS)})", nearest=near)
    if double := [name for name in names if names.count(name) > 1]:
        raise _wrong(path, f"has column {double[0]} twice")
    if missing := [name for name in _REQUIRED if name not in names]:
        raise _wrong(path, f"has no column {missing[0]}; found {', '.join(names)}")
    if _PAIRS[1][0] in names and _PAIRS[0][0] not in names:
        raise _wrong(path, "has accelerations without velocities; give both, or leave the accelerations out")
    for x, y in _PAIRS:
        if (x in names) != (y in names):
            raise _wrong(path, f"has only one of {x} and {y}; give both, or neither")
    return names


def _row(path: Path, line: int, names: list[str], cells: list[str]) -> list[float]:
    if len(cells) != len(names):
        comma = "; are there commas in its numbers?" if len(cells) > len(names) else ""
        raise _wrong(path, f"line {line} has {len(cells)} values for {len(names)} columns{comma}")
    values = []
    for name, cell in zip(names, cells, strict=True):
        value = _number(cell)
        if value is None or not math.isfinite(value):
            raise _wrong(path, f"line {line}: {name} is {cell!r}, expected a finite number")
        values.append(value)
    return values


def _resolution(names: list[str], lines: list[tuple[int, list[str]]]) -> float:
    """Of the last digit in which a position is given [m]."""
    cells = (cells[names.index(name)].lower() for name in ("x_m", "y_m") for _, cells in lines)
    split = (cell.partition("e") for cell in cells)
    return 10.0 ** -max((len(digits.partition(".")[2]) - int(power or 0) for digits, _, power in split), default=0)


def _require_order(path: Path, t: np.ndarray, lines: list[int]) -> None:
    wrong = np.flatnonzero(np.diff(t) <= 0.0) + 1
    if len(wrong):
        i = int(wrong[0])
        what = "the same time as" if t[i] == t[i - 1] else "earlier than"
        more = f"; so are {len(wrong) - 1} more rows" if len(wrong) > 1 else ""
        raise _wrong(
            path,
            f"row {i + 1} (line {lines[i]}), t_s = {t[i]:g}, is {what} the row before, t_s = {t[i - 1]:g}{more}; sort "
            "the rows by time, and leave one of each time",
            row=i + 1,
        )


def _question_units(path: Path, table: dict[str, np.ndarray]) -> None:
    far = max(float(np.abs(table[name]).max(initial=0.0)) for name in ("x_m", "y_m"))
    if far > _FAR:
        raise _wrong(
            path,
            f"x_m and y_m reach {far:g} m, expected metres: if they are millimetres ({far / 1e3:.3g} m) divide them by "
            f"1000, if they are centimetres ({far / 1e2:.3g} m) by 100",
        )
    t = table["t_s"]
    if len(t) > 1 and t[-1] - t[0] > _LONG and np.median(np.diff(t)) > _STEP:
        raise _wrong(
            path, f"t_s goes from {t[0]:g} to {t[-1]:g} s in {len(t)} rows: are these milliseconds? Divide by 1000"
        )


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def _wrong(path: Path, problem: str, **details: object) -> ModelError:
    return ModelError(f"{path}: {problem}", file=str(path), key="file", **details)
