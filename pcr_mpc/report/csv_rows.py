"""Rows of a study as a CSV file."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..files import replacing


def write_rows(
    path: Path, rows: Sequence[Mapping[str, Any]], columns: Iterable[str] | None = None, digits: int | None = None
) -> None:
    """Write rows under a header; what a row lacks stays empty.

    Parameters
    ----------
    path : Path
        Its folder is made if need be.
    rows : sequence of mappings
    columns : iterable of str, optional
        Which, and in what order. None: all that occur, in order of appearance.
    digits : int, optional
        Significant digits of floats. None: all, so that they read back the same.
    """
    names = list(dict.fromkeys(name for row in rows for name in row) if columns is None else columns)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as draft, open(draft, "w", newline="", encoding="utf-8") as handle:
        writer = csv.DictWriter(handle, fieldnames=names, restval="", extrasaction="ignore")
        writer.writeheader()
        for row in rows:
            writer.writerow(row if digits is None else {name: _rounded(v, digits) for name, v in row.items()})


def _rounded(value: Any, digits: int) -> Any:
    return f"{value:.{digits}g}" if isinstance(value, float) else value
