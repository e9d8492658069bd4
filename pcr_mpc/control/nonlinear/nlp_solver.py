"""IPOPT behind a wrapper that cannot fail silently."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ...buffered import BUILDING
from ...errors import InfeasibleError
from .collocation import Transcription

# Of every solution, recomputed from the NLP, in its own units.
LARGEST_RESIDUAL = 1e-7
_IPOPT = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-8,
    # A point that is merely acceptable is no solution here.
    "acceptable_iter": 0,
    # Limits are hard: by default they would give by 1e-8.
    "bound_relax_factor": 0.0,
    # The unknowns are of order one in the transcription's units.
    "nlp_scaling_method": "none",
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-6,
    "warm_start_bound_frac": 1e-6,
    "warm_start_slack_bound_push": 1e-6,
    "warm_start_slack_bound_frac": 1e-6,
    "warm_start_mult_bound_push": 1e-6,
    # From the last solution two iterations are enough; with the default strategy it takes four.
    "mu_strategy": "adaptive",
    "mu_init": 1e-6,
}


@dataclass(frozen=True, eq=False)
class Point:
    """Primal and dual variables of the NLP, one row a period.

    Attributes
    ----------
    unknowns : ndarray, shape (N, width)
    of_bounds : ndarray, shape (N, width)
        Multipliers of the bounds of the unknowns.
    of_constraints : ndarray, shape (N, height)
        Multipliers of the constraints.
    """

    unknowns: np.ndarray
    of_bounds: np.ndarray
    of_constraints: np.ndarray

    def shifted(self) -> Point:
        """One period on; the unknowns of the new last period continue the line of the last two."""
        last, before = self.unknowns[-1:], self.unknowns[-2:][:1]
        duals = (np.concatenate([row[1:], row[-1:]]) for row in (self.of_bounds, self.of_constraints))
        return Point(np.concatenate([self.unknowns[1:], 2 * last - before]), *duals)


@dataclass(frozen=True, eq=False)
class NLPSolution:
    """A solution, and what it is worth.

    Attributes
    ----------
    point : Point
    iterations : int
    primal_residual, dual_residual : float
        Largest violation of a constraint or bound, and of stationarity, recomputed outside IPOPT.
    """

    point: Point
    iterations: int
    primal_residual: float
    dual_residual: float


class NLPSolver:
    """Solves a transcription again and again.

    Parameters
    ----------
    nlp : Transcription
    max_iterations : int
        After which IPOPT gives up.
    """

    def __init__(self, nlp: Transcription, max_iterations: int) -> None:
        self._nlp = nlp
        ipopt = {**_IPOPT, "max_iter": max_iterations}
        # A trial step to where the model is NaN is cut short by IPOPT itself.
        options: dict[str, Any] = {"ipopt": ipopt, "print_time": False, "show_eval_warnings": False}
        with BUILDING:
            self._solver = ca.nlpsol("nonlinear_mpc", "ipopt", nlp.problem, options)

    def solve(self, parameters: np.ndarray, start: Point) -> NLPSolution:
        """Solve from a start.

        Parameters
        ----------
        parameters : ndarray
            See `Transcription`.
        start : Point

        Raises
        ------
        InfeasibleError
            IPOPT did not succeed, or its solution breaks the equations or has a rod past its limit of stability;
            carries ``status`` and ``iterations``.
        """
        nlp = self._nlp
        found = self._solver(
            x0=start.unknowns.ravel(),
            lam_x0=start.of_bounds.ravel(),
            lam_g0=start.of_constraints.ravel(),
            p=parameters,
            lbx=nlp.lower.ravel(),
            ubx=nlp.upper.ravel(),
            lbg=nlp.g_lower.ravel(),
            ubg=nlp.g_upper.ravel(),
        )
        stats = self._solver.stats()
        status, iterations = stats["return_status"], int(stats["iter_count"])
        x, of_bounds, of_constraints = (found[name].full().ravel() for name in ("x", "lam_x", "lam_g"))
        g, slope, unstable = (result.full().ravel() for result in nlp.verdict(x, parameters, of_constraints))
        primal = max(
            *(float(excess.max()) for excess in (nlp.g_lower.ravel() - g, g - nlp.g_upper.ravel())),
            *(float(excess.max()) for excess in (nlp.lower.ravel() - x, x - nlp.upper.ravel())),
            0.0,
        )
        dual = float(np.abs(slope + of_bounds).max())
        # Written so that NaN is a failure.
        if status == "Solve_Succeeded" and not primal <= LARGEST_RESIDUAL:
            status = f"broken equations: {primal:.1e}"
        elif status == "Solve_Succeeded" and unstable[0] > 0:
            status = "a rod past its limit of stability"
        if status != "Solve_Succeeded":
            raise InfeasibleError(
                f"the NLP was not solved: {status} after {iterations} iterations, primal residual {primal:.1e}, dual "
                f"{dual:.1e}; relax limits or the reference, or allow a fall-back",
                status=status,
                iterations=iterations,
                limit=None,
            )
        shape = nlp.lower.shape
        point = Point(x.reshape(shape), of_bounds.reshape(shape), of_constraints.reshape(nlp.g_lower.shape))
        return NLPSolution(point, iterations, primal, dual)
