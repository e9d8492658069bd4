"""Double or single precision: tolerances that rounding allows, and C text that computes in the other type."""

from __future__ import annotations

import re
from typing import Any

# In single precision the closed form leaves residuals of 1e-6 to 1e-4 of a rod's length: 500 roundings at most.
ROUNDING = 2e-4

_DOUBLE = {
    "PCR_ROUGH": 1e-4,  # residual with which a step is as good as sure to be finished
    "PCR_CLOSE": 1e-6,  # of derivatives of rods that are followed to another pose
    "PCR_SAME_ANGLE": 1e-9,
    "PCR_MET": 1e-12,  # of a limit on rates, relative
    "PCR_NARROW": 1e-11,  # interval in which a critical load is known
    "PCR_DIFFERENCE": 1e-4,  # step of finite differences along the critical load
}
_SINGLE = {
    "PCR_ROUGH": 1e-3,
    "PCR_CLOSE": ROUNDING,
    "PCR_SAME_ANGLE": 1e-6,
    "PCR_MET": 1e-6,
    "PCR_NARROW": 1e-6,
    "PCR_DIFFERENCE": 1e-2,
}
_SMALLEST = 1.17549435e-38  # normal float
_TOKENS = re.compile(
    r"""(?P<kept>/\*.*?\*/|"(?:\\.|[^"\\\n])*"|//[^\n]*)|(?P<type>\bdouble\b)
    |\b(?P<function>a?(?:sin|cos|tan)h?|atan2|exp|expm1|log|log1p|sqrt|pow|hypot|f(?:abs|max|min|mod)|copysign|ceil|floor|rint)
     (?=\()
    |(?<![\w.])(?P<number>(?:\d+\.\d*|\.\d+)(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)(?![\w.])""",
    re.DOTALL | re.VERBOSE,
)


def tolerances(*, single: bool) -> dict[str, Any]:
    """Macros of ``pcr_config.h`` that depend on the precision."""
    return {"PCR_SINGLE": int(single)} | (_SINGLE if single else _DOUBLE)


def in_single(text: str) -> str:
    """C of doubles as C of floats: the type, the literals and the functions."""

    def other(found: re.Match[str]) -> str:
        if found["kept"]:
            return found["kept"]
        if found["number"] and 0.0 < float(found["number"]) < _SMALLEST:
            return f"{_SMALLEST}f"  # what keeps a divisor from zero must not become zero
        return "float" if found["type"] else f"{found['function'] or found['number']}f"

    return _TOKENS.sub(other, text)
