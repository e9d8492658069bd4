"""Plants and controllers of one's own: what they lack is said before the first step, not after the last."""

from __future__ import annotations

import inspect
from numbers import Real
from typing import Any

from ..parts.controllers import Controller
from .simulated_plant import SimulatedPlant

# What is called, with how many arguments; what is only read, and of which type; and what of that may be missing.
_CONTROLLER = {"start": 1, "step": 2}, {"name": str}
_OPTIONAL = ("name",)
_PLANT = (
    {"reset": 2, "carry": 2, "step": 3},
    {"method": str, "integrator": str, "dt": Real, "snaps": list, "rungs": dict},
)


def check_parts(plant: Any, controller: Any, *, carries: bool) -> None:
    """Check that plant and controller have what `simulate` calls and records; `carry` where there is a payload.

    Raises
    ------
    ValueError
        Names the object, and the attribute or the signature.
    """
    for role, part, (methods, attributes) in (("plant", plant, _PLANT), ("controller", controller, _CONTROLLER)):
        kind = type(part).__name__
        fitting: type = SimulatedPlant if role == "plant" else Controller
        hint = f"see {fitting.__module__}.{fitting.__qualname__}"
        if inspect.isclass(part):
            raise ValueError(f"{role} is the class {part.__name__}, expected an object: call it first")
        for name, wanted in attributes.items():
            if not hasattr(part, name) and name in _OPTIONAL:
                continue
            if not hasattr(part, name):
                raise ValueError(f"{role} {kind} has no {name!r}; {hint}")
            value = getattr(part, name)
            if not isinstance(value, wanted):
                raise ValueError(f"{role} {kind} has {name} = {value!r}, expected a {wanted.__name__}; {hint}")
        for name, count in methods.items():
            if name == "carry" and not carries:
                continue
            method = getattr(part, name, None)
            if not callable(method):
                raise ValueError(f"{role} {kind} has no method {name!r}; {hint}")
            try:
                signature = inspect.signature(method)
            except (TypeError, ValueError):  # of a builtin, which does not tell
                continue
            try:
                signature.bind(*[None] * count)
            except TypeError as error:
                raise ValueError(
                    f"{role} {kind}: {name}{signature} is called with {count} arguments, which does not fit: {error}; "
                    f"{hint}"
                ) from None
