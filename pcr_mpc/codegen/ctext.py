"""Numbers as C writes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

_WIDTH = 110


def number(value: float) -> str:
    """A double that is read back bit for bit."""
    if np.isnan(value):
        return "NAN"
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(value))


def block(values: Any) -> str:
    """Initialiser of an array of any shape, doubles or whole numbers."""
    array = np.asarray(values)
    if array.ndim > 1:
        return "{\n" + ",\n".join(block(row) for row in array) + "\n}"
    words = [number(v) if array.dtype.kind == "f" else str(int(v)) for v in array]
    return "{" + "\n".join(_lines(words)) + "}"


def array(kind: str, name: str, values: Any) -> str:
    """Definition of a constant array."""
    shape = "".join(f"[{length}]" for length in np.asarray(values).shape)
    return f"const {kind} {name}{shape} = {block(values)};\n"


def structure(kind: str, name: str, values: Sequence[str]) -> str:
    """Definition of a constant structure from the initialisers of its members."""
    return f"const {kind} {name} = {{\n" + ",\n".join(values) + "\n};\n"


def defines(values: dict[str, Any]) -> str:
    """Macros, one a line."""
    return "".join(f"#define {name} {number(v) if isinstance(v, float) else v}\n" for name, v in values.items())


def _lines(words: list[str]) -> list[str]:
    lines, line = [], ""
    for word in words:
        if len(line) + len(word) > _WIDTH:
            lines.append(line)
            line = ""
        line += f"{word}, "
    return [*lines, line.removesuffix(", ")]
