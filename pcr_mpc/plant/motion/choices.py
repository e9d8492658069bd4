"""Which choices of a plant go together."""

from __future__ import annotations

import numpy as np

from ..robot import Robot
from ..rods.closed_form.inertia import INERTIAS
from ..statics.held_tip import default_method
from ..statics.weight import WEIGHTS
from .integrators import INTEGRATORS

ON_SNAP = ("raise", "jump")
_MOST_MODES = 64


def checked_choices(
    robot: Robot,
    method: str | None,
    inertia: str,
    modes: int,
    weight: str | None,
    integrator: str,
    dt: float,
    on_snap: str,
) -> tuple[str, str, Robot]:
    """Return method, weight and the robot whose gravity bends the rods, or say what does not go together.

    Raises
    ------
    ValueError
        Names the argument.
    """
    if on_snap not in ON_SNAP:
        raise ValueError(f"on_snap is {on_snap!r}, expected one of {', '.join(ON_SNAP)}")
    if inertia not in INERTIAS:
        raise ValueError(f"inertia is {inertia!r}, expected one of {', '.join(INERTIAS)}")
    if integrator not in (*INTEGRATORS, "gauss"):
        raise ValueError(f"integrator is {integrator!r}, expected one of {', '.join(INTEGRATORS)}, gauss")
    if (inertia == "full") != (integrator == "gauss"):
        raise ValueError(f"inertia={inertia!r} does not go with integrator={integrator!r}: 'full' needs 'gauss'")
    if weight is not None and weight not in WEIGHTS:
        raise ValueError(f"weight is {weight!r}, expected one of {', '.join(WEIGHTS)}")
    if weight is None:
        heavy = any(robot.gravity) and any(rod.line_density for rod in robot.rods)
        weight = "none" if not heavy else "condensed" if method == "closed_form" else "exact"
    rods = robot if weight == "exact" else robot.weightless()
    method = method or default_method(rods)
    if weight == "condensed" and method != "closed_form":
        raise ValueError(f"weight='condensed' needs method='closed_form', not {method!r}; take weight='exact'")
    if weight == "condensed" and inertia == "full":
        raise ValueError("inertia='full' does not condense the rods' weight; take weight='exact' or 'none'")
    if inertia != "none" and method == "single_shooting":
        raise ValueError(f"inertia={inertia!r} needs method='closed_form' or 'multiple_shooting', not {method!r}")
    if not 0.0 < dt < np.inf:
        raise ValueError(f"dt is {dt} s, expected a positive number")
    if isinstance(modes, bool) or not isinstance(modes, int | np.integer) or not 4 <= modes <= _MOST_MODES:
        raise ValueError(f"modes = {modes!r} must be a whole number from 4 to {_MOST_MODES}")
    return method, weight, rods
