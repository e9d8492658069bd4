"""What a controller answers, and how it came about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..frozen import Frozen, made
from ..linearisation.linear_model import LinearModel

# From the best answer to the last resort.
RUNGS = ("softened", "shifted_plan", "lqr", "hold")


@dataclass(frozen=True, eq=False)
class Plan(Frozen):
    """Result of one control step: the motor rates, and the certificate that goes with them.

    Attributes
    ----------
    inputs : ndarray, shape (N, n)
        Motor rates; the first row is to be applied [rad/s].
    states : ndarray, shape (N + 1, 4 + n), or None
        Predicted states, the current one first; None where nothing predicts.
    models : LinearModel or sequence of N, or None
        What they were predicted with.
    status : str
        "solved", or what went wrong.
    fallback : {None, "softened", "shifted_plan", "lqr", "hold"}
        Rung of the ladder that answered instead (see `LinearMPC`).
    active : tuple of str
        Kinds of limits that shape the plan: "rate", "rate change", "angle" and the kinds of `LinearLimits`.
    slack : dict
        By how much limits had to give, by kind, in their own units ([rad], [N m], [m], 1, [N/m]); only those that did.
    iterations : int
        Of the solver; 1 where no limit acts, and none was asked.
    primal_residual, dual_residual : float
        Recomputed from the problem's data; NaN if unsolved.
    update_time, solve_time, solver_time : float
        Assembling the problem; handing it over and solving it; of that, inside the solver's own code [s].
    """

    inputs: np.ndarray
    states: np.ndarray | None
    models: LinearModel | Sequence[LinearModel] | None
    status: str
    fallback: str | None = None
    active: tuple[str, ...] = ()
    slack: dict[str, float] = field(default_factory=dict)
    iterations: int = 0
    primal_residual: float = float("nan")
    dual_residual: float = float("nan")
    update_time: float = 0.0
    solve_time: float = 0.0
    solver_time: float = 0.0

    @classmethod
    def found(cls, fields: dict[str, Any]) -> Plan:
        """A plan with all its fields given, in a fifth of the time: for the control step."""
        fields["inputs"].setflags(write=False)
        if fields["states"] is not None:
            fields["states"].setflags(write=False)
        return made(cls, fields)

    def spanning(self, horizon: int) -> Plan:
        """Return its rates over another horizon, the last ones held beyond its end; nothing else of it."""
        rows = np.minimum(np.arange(horizon), len(self.inputs) - 1)
        return Plan(self.inputs[rows], None, None, self.status, self.fallback)
