"""The rods of a plant, followed from pose to pose: forces, Jacobians and the mass that they add to the tip's."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ...errors import ConvergenceError, UnstableError
from ...frozen import read_only
from ..robot import Robot
from ..rods.method import Shooting
from ..statics.equilibrium import Equilibrium
from ..statics.held_tip import make_solver
from ..statics.solver import RodSolver
from ..statics.state import RobotState
from ..statics.weight import CondensedWeight
from .mass_matrix import CondensedMass, MassMatrix, tip_mass
from .step_graph import LARGEST_DRIFT, PREDICTOR_ACCURACY

# Residual of the statics at which derivatives may be taken for a linear model; their error is of this size.
DERIVATIVE_ACCURACY = 1e-6


class Ahead(Protocol):
    """Somebody who has moved the rods on without their solver."""

    def hand_over(self) -> None:
        """Tell the solver of the last pose."""


class FollowedRods:
    """Rods at (p, q), which their solver follows by continuity from one call to the next.

    Parameters
    ----------
    robot : Robot
    rods : Robot
        The same without what the method leaves out.
    method : str
    shooting : Shooting
    inertia, weight : str
        See `Plant`.
    snapping, compiled : bool
        See `make_solver`.

    Attributes
    ----------
    solver
        Of the rods.
    at : list of float or None
        Where they are, p and q; None: nowhere that is known. Another list for each pose.
    accuracy : float
        Residual at which their derivatives were taken there.
    ahead : Ahead or None
        Who may have gone on since.
    stiffness : ndarray, shape (2, 2), or None
        At the last start [N/m].
    """

    def __init__(
        self,
        robot: Robot,
        rods: Robot,
        method: str,
        shooting: Shooting,
        *,
        inertia: str,
        weight: str,
        snapping: bool,
        compiled: bool,
    ) -> None:
        self._robot, self._method, self._inertia = robot, method, inertia
        self.solver = make_solver(rods, method, shooting, snapping=snapping, compiled=compiled)
        self._sag = CondensedWeight(robot) if weight == "condensed" else None
        self._condensed: CondensedMass | None = None
        if inertia != "none" and isinstance(self.solver, RodSolver):
            self._condensed = CondensedMass(rods, self.solver.method)
        self._mass_moves = inertia in ("condensed", "full")
        self._payload = 0.0
        self._mass = tip_mass(robot)
        self._mass_at: list[float] | None = None
        self.at: list[float] | None = None
        self.accuracy = 0.0
        self.ahead: Ahead | None = None
        self.stiffness: np.ndarray | None = None

    def start(self, p: np.ndarray, q: np.ndarray, guess: Equilibrium | None) -> None:
        """Put them on the branch of a guess, or of least energy, at (p, q)."""
        self._forget()
        if guess is None:
            self.solver.start(p, q)
        else:
            self.solver.start(guess.p, guess.q, guess.nodes)
        self.go(p, q, None)
        self.stiffness = self.solver.jacobians()[0].copy()
        if self._inertia == "constant":
            assert self._condensed is not None
            self._mass = self._condensed(self._unknowns(), q)[0], self._mass[1]

    def _forget(self) -> None:
        self.at = None
        if self.ahead is not None:
            self.ahead.hand_over()

    def carry(self, payload: float) -> None:
        """Let the tip carry so much besides its own mass [kg]."""
        mass, slopes = self._mass
        more = np.diag([payload - self._payload] * 2 + [0.0] * self._robot.n_rods)
        self._mass, self._mass_at, self._payload = (read_only(mass + more), slopes), None, payload

    def keeping(self, what: str) -> RodSolver:
        """Return their solver with its state as it is now; ValueError if it keeps none of what is named."""
        if not isinstance(self.solver, RodSolver):
            raise ValueError(f"method {self._method} keeps no {what}")
        if self.ahead is not None:
            self.ahead.hand_over()
        return self.solver

    def recall(self, record: np.ndarray) -> None:
        """Put them back to a pose of which the solver's record was copied."""
        assert isinstance(self.solver, RodSolver)
        self._forget()
        self.solver.recall(record)

    def force(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        """See `Plant.force`."""
        q = np.asarray(q, dtype=float)
        self.go(np.asarray(p, dtype=float), q, PREDICTOR_ACCURACY)
        if self._sag is None:
            return self.solver.force()
        return read_only(self.solver.force() + self._sag.first(self._unknowns(), q)[1][:2])

    def force_and_jacobians(
        self, p: np.ndarray, q: np.ndarray, accuracy: float | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `Plant.force_and_jacobians`."""
        self.go(p, q, accuracy)
        k, g = self.solver.jacobians()
        if self._sag is None:
            return self.solver.force(), k, g
        slope, curvature = self._sag.first(self._unknowns(), q)[1], self._sag.second(self._unknowns(), q)
        return self.solver.force() + slope[:2], k + curvature[:2, :2], g + curvature[:2, 2:]

    def state(self, p: np.ndarray, q: np.ndarray) -> RobotState:
        """See `Plant.rods`."""
        solver = self.keeping("unknowns of the rods")
        self.go(p, q, DERIVATIVE_ACCURACY)
        return solver.state

    def mass(self, p: np.ndarray, q: np.ndarray) -> MassMatrix:
        """See `Plant.mass`."""
        return self.force_and_mass(p, q)[1] if self._mass_moves else self._mass

    def last_mass(self) -> np.ndarray:
        """Mass matrix where it was last asked for."""
        return self._mass[0]

    def force_and_mass(self, p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, MassMatrix]:
        """`force` and `mass` at the same pose."""
        force = self.force(p, q)
        if self._mass_moves and self._mass_at is not self.at:
            assert self._condensed is not None
            self._mass, self._mass_at = self._condensed(self._unknowns(), q, self._payload), self.at
        return force, self._mass

    def equilibrium(self, p: np.ndarray, q: np.ndarray) -> Equilibrium:
        """Everything about them at (p, q)."""
        self.go(p, q, None)
        eq = self.solver.equilibrium(p, q)
        return eq if self._sag is None else self._sag.added(eq, self._unknowns())

    def _unknowns(self) -> np.ndarray:
        assert isinstance(self.solver, RodSolver)
        return self.solver.state.unknowns

    def go(self, p: np.ndarray, q: np.ndarray, derivatives: float | None) -> None:
        """Move them to (p, q), with derivatives taken at so small a residual, or at the solution (None).

        Raises
        ------
        UnreachableError, ConvergenceError, UnstableError
        """
        at, accuracy = [*p.tolist(), *q.tolist()], derivatives or 0.0
        if self.ahead is not None:
            self.ahead.hand_over()
        if at == self.at and self.accuracy <= accuracy:
            return
        self.at = None
        try:
            self.solver.move(p, q, derivatives=derivatives)
        except ConvergenceError:
            self._robot.require_reachable(p)  # the plainer reason, if it is the reason
            raise
        drift = self.solver.drift()
        if not drift <= LARGEST_DRIFT:
            self.solver.go_back()
            raise ConvergenceError(
                f"the rods at p = {p} m, q = {q} rad are too taut for this discretisation: their invariant drifts by "
                f"{drift:.1e} (at most {LARGEST_DRIFT:.0e}); use more segments or steps",
                residual=drift,
                iterations=0,
                last=None,
            )
        unstable = self.solver.unstable_rods()
        if unstable:
            self.solver.go_back()
            raise UnstableError(
                f"rod {unstable[0]} is unstable at p = {p} m, q = {q} rad: it would snap to another shape; "
                "slow down or keep away from this pose",
                rod=unstable[0],
            )
        self.at, self.accuracy = at, accuracy
