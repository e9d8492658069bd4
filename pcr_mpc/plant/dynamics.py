"""The plant: a point mass at the joint on quasi-static rods, paper eq. (7)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..errors import ConvergenceError, PCRError, UnstableError, checked_vector
from .equilibrium import Equilibrium
from .robot import Robot
from .rod_solver import RodSolver, Snap
from .rod_state import RobotState
from .statics import checked_shooting, make_solver

ON_SNAP = ("raise", "jump")
# A simulation uses the derivatives only to predict the next pose.
_PREDICTOR_ACCURACY = 1e-2
# Residual of the statics at which derivatives may be taken for a linear model; their error is of this size.
DERIVATIVE_ACCURACY = 1e-6
# Relative drift of a rod's invariant beyond which its force may be off by per cents.
_LARGEST_DRIFT = 1e-3


class Plant:
    """The robot in motion: m p'' + c p' = -F(p, q) + F_ext, motor angles driven by their rates.

    The state is x = [p (2), v (2), q (n)] in [m, m/s, rad], the input u = q' (n) in rad/s.

    Parameters
    ----------
    robot : Robot
    method : {"closed_form", "multiple_shooting", "single_shooting"}
        Statics of the rods.
    segments, steps, scheme
        Discretisation, see `solve_statics`.
    integrator : {"semi_implicit_euler", "velocity_verlet", "rk4"}
        The paper's first-order scheme, a second-order one, both with one force evaluation a step, and the
        classical fourth-order one with four.
    dt : float
        Step [s].
    on_snap : {"raise", "jump"}
        Where a rod's branch ends: `UnstableError`, or the rod falls at once to the stable shape that the descent of
        its energy reaches, which is recorded in ``snaps`` with the energy lost (RK4 looks ahead within a step, so
        that the tip position recorded may be off by that much).

    Notes
    -----
    A state does not say on which branch the rods are, so the plant follows them by continuity from one call
    to the next; `reset` starts elsewhere. Motors saturate: rates are clipped to the limit and angles stop at
    theirs. (The limit on the change of rate concerns commands, and is the controller's.)
    """

    def __init__(
        self,
        robot: Robot,
        *,
        method: str = "closed_form",
        segments: int = 8,
        steps: int = 1,
        scheme: str = "rk8",
        integrator: str = "semi_implicit_euler",
        dt: float = 1e-3,
        on_snap: str = "raise",
    ) -> None:
        if on_snap not in ON_SNAP:
            raise ValueError(f"on_snap is {on_snap!r}, expected one of {', '.join(ON_SNAP)}")
        if integrator not in INTEGRATORS:
            raise ValueError(f"integrator is {integrator!r}, expected one of {', '.join(INTEGRATORS)}")
        if not 0.0 < dt < np.inf:
            raise ValueError(f"dt is {dt} s, expected a positive number")
        self.robot = robot
        self.method = method
        self.integrator = integrator
        self.dt = dt
        self.n_states = 4 + robot.n_rods
        self._advance = INTEGRATORS[integrator]
        self._solver = make_solver(robot, method, checked_shooting(segments, steps, scheme), snapping=on_snap == "jump")
        self._at: tuple[float, ...] | None = None
        self._accuracy = 0.0  # of the derivatives there
        self._lower, self._upper = robot.angle_limits.T.copy()

    def reset(self, x: Any, guess: Equilibrium | None = None) -> None:
        """Put the rods on the branch of ``guess`` at state x, or on the branch of least energy (None)."""
        x = checked_vector("x", x, self.n_states)
        p, q = x[:2], x[4:]
        self.robot.require_reachable(p)
        self._at = None
        if guess is None:
            self._solver.start(p, q)
        else:
            self._solver.start(guess.p, guess.q, guess.nodes)
        self._go(p, q, None)

    @property
    def snaps(self) -> list[Snap]:
        """Snaps since the reset, in order."""
        return self._solver.snaps

    @property
    def rungs(self) -> dict[str, int]:
        """How many poses each rung of the solver's ladder has solved (see `RodSolver`)."""
        return dict(self._solver.rungs)

    def step(self, x: Any, u: Any, f_ext: Any = (0.0, 0.0)) -> np.ndarray:
        """Advance by one time step with the motor rates held.

        Parameters
        ----------
        x : array_like, shape (4 + n,)
            State [m, m/s, rad].
        u : array_like, shape (n,)
            Motor rates [rad/s].
        f_ext : array_like, shape (2,)
            External force on the tip [N].

        Returns
        -------
        ndarray, shape (4 + n,)

        Raises
        ------
        UnreachableError, ConvergenceError, UnstableError
            The rods could not follow; the exception carries the ``state`` at the start of the step.
        """
        x = checked_vector("x", x, self.n_states)
        u = checked_vector("u", u, self.robot.n_rods)
        f_ext = checked_vector("f_ext", f_ext, 2)
        limit = self.robot.rate_limit
        # A motor that would pass its stop within the step arrives there at the end of it; one that is beyond
        # its stop comes back no faster than it can.
        rate = np.minimum(np.maximum(u, -limit), limit)
        rate = (np.minimum(np.maximum(x[4:] + self.dt * rate, self._lower), self._upper) - x[4:]) / self.dt
        rate = np.minimum(np.maximum(rate, -limit), limit)
        try:
            return self._advance(self, x, rate, f_ext)
        except PCRError as error:
            error.details["state"] = x.copy()
            raise

    def force(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        """F at (p, q), following the branch [N]."""
        self._go(np.asarray(p, dtype=float), np.asarray(q, dtype=float), _PREDICTOR_ACCURACY)
        return self._solver.force()

    def force_and_jacobians(
        self, p: np.ndarray, q: np.ndarray, accuracy: float | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """F [N], K [N/m] and G [N/rad] at (p, q), following the branch.

        ``accuracy`` bounds the residual of the iterate at which K and G were taken; None: at the solution.
        """
        self._go(p, q, accuracy)
        k, g = self._solver.jacobians()
        return self._solver.force(), k, g

    def rods(self, p: np.ndarray, q: np.ndarray) -> RobotState:
        """Unknowns, loads and derivatives of all rods at (p, q), following the branch; not for single shooting.

        Valid until the plant moves on.
        """
        if not isinstance(self._solver, RodSolver):
            raise ValueError(f"method {self.method} keeps no unknowns of the rods")
        self._go(p, q, DERIVATIVE_ACCURACY)
        return self._solver.state

    def equilibrium(self, x: Any) -> Equilibrium:
        """Everything about the rods at state x, following the branch."""
        x = checked_vector("x", x, self.n_states)
        self._go(x[:2], x[4:], None)
        return self._solver.equilibrium(x[:2], x[4:])

    def _go(self, p: np.ndarray, q: np.ndarray, derivatives: float | None) -> None:
        at, accuracy = (*p.tolist(), *q.tolist()), derivatives or 0.0
        if at == self._at and self._accuracy <= accuracy:
            return
        self._at = None
        try:
            self._solver.move(p, q, derivatives=derivatives)
        except ConvergenceError:
            self.robot.require_reachable(p)  # the plainer reason, if it is the reason
            raise
        drift = self._solver.drift()
        if not drift <= _LARGEST_DRIFT:
            self._solver.go_back()
            raise ConvergenceError(
                f"the rods at p = {p} m, q = {q} rad are too taut for this discretisation: their invariant drifts by "
                f"{drift:.1e} (at most {_LARGEST_DRIFT:.0e}); use more segments or steps",
                residual=drift,
                iterations=0,
                last=None,
            )
        unstable = self._solver.unstable_rods()
        if unstable:
            self._solver.go_back()
            raise UnstableError(
                f"rod {unstable[0]} is unstable at p = {p} m, q = {q} rad: it would snap to another shape; "
                "slow down or keep away from this pose",
                rod=unstable[0],
            )
        self._at, self._accuracy = at, accuracy

    def _acceleration(self, p: np.ndarray, v: np.ndarray, q: np.ndarray, f_ext: np.ndarray) -> np.ndarray:
        return np.asarray((f_ext - self.force(p, q) - self.robot.drag * v) / self.robot.tip_mass)


def _semi_implicit_euler(plant: Plant, x: np.ndarray, rate: np.ndarray, f_ext: np.ndarray) -> np.ndarray:
    p, v, q = x[:2], x[2:4], x[4:]
    v = v + plant.dt * plant._acceleration(p, v, q, f_ext)
    return np.concatenate([p + plant.dt * v, v, q + plant.dt * rate])


def _velocity_verlet(plant: Plant, x: np.ndarray, rate: np.ndarray, f_ext: np.ndarray) -> np.ndarray:
    # Half a kick with implicit drag, drift, half a kick with explicit drag: each the adjoint of the other,
    # hence symmetric and of second order; the force at the end is the next step's first.
    p, v, q, dt = x[:2], x[2:4], x[4:], plant.dt
    half, damping = dt / (2 * plant.robot.tip_mass), dt * plant.robot.drag / (2 * plant.robot.tip_mass)
    v = (v + half * (f_ext - plant.force(p, q))) / (1.0 + damping)
    p, q = p + dt * v, q + dt * rate
    v = (1.0 - damping) * v + half * (f_ext - plant.force(p, q))
    return np.concatenate([p, v, q])


def _rk4(plant: Plant, x: np.ndarray, rate: np.ndarray, f_ext: np.ndarray) -> np.ndarray:
    def slope(y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[2:4], plant._acceleration(y[:2], y[2:4], y[4:], f_ext), rate])

    dt = plant.dt
    k1 = slope(x)
    k2 = slope(x + dt / 2 * k1)
    k3 = slope(x + dt / 2 * k2)
    k4 = slope(x + dt * k3)
    return np.asarray(x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4))


INTEGRATORS: dict[str, Callable[[Plant, np.ndarray, np.ndarray, np.ndarray], np.ndarray]] = {
    "semi_implicit_euler": _semi_implicit_euler,
    "velocity_verlet": _velocity_verlet,
    "rk4": _rk4,
}
