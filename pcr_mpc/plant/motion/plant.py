"""The plant: a point mass at the joint on quasi-static rods, paper eq. (7), with or without the rods' own mass."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ...errors import PCRError, checked_number, checked_vector
from ...frozen import Remade, set_once
from ..robot import Robot
from ..rods.numbers import Kind
from ..statics.equilibrium import Equilibrium
from ..statics.held_tip import checked_shooting
from ..statics.solver import RodSolver, Snap
from ..statics.state import RobotState
from .choices import ON_SNAP, checked_choices
from .followed_rods import FollowedRods
from .integrators import INTEGRATORS
from .mass_matrix import MassMatrix
from .modal_step import ModalStep
from .quick_step import QuickStep
from .step_graph import PREDICTOR_ACCURACY, StepModel
from .step_limit import longest_step


@set_once(
    "make a new Plant with it",
    "robot",
    "method",
    "shooting",
    "inertia",
    "weight",
    "integrator",
    "dt",
    "compiled",
    "n_states",
    payload="call carry, which keeps the momentum, or reset, which takes it away",
)
class Plant(Remade):
    """The robot in motion: m p'' + c p' = -F(p, q) + m g + F_ext, motor angles driven by their rates.

    The state is x = [p (2), v (2), q (n)] in [m, m/s, rad], the input u = q' (n) in rad/s.
    Rods that have mass add theirs to m, and couple the tip to the motors (see ``inertia``).

    Parameters
    ----------
    robot : Robot
    method : {"closed_form", "multiple_shooting", "single_shooting"}, optional
        Statics of the rods. None: the closed form where it is exact, else multiple shooting.
    segments, steps, scheme
        Discretisation, see `solve_statics`.
    inertia : {"none", "constant", "condensed", "full"}
        Of the rods: none, the paper's; the mass matrix M(p, q) that their quasi-static shapes carry (see `inertia`)
        as it was at the last `reset`; M(p, q) with its Coriolis terms; or distributed mass in strain modes, the
        yardstick (see `strain_modes`). Single shooting knows none but the first.
    modes : int
        Strain modes per rod, of inertia "full": 12 are within 1e-6 mm of 14 on the default robot.
    weight : {"none", "condensed", "exact"}, optional
        Of the rods; the tip's is always there. None; to first order in mu g, by its potential at the weightless shape,
        which needs the closed form (see `weight`); or distributed along rods that sag, which needs multiple shooting.
        By default what the method can do: "exact" or "condensed".
    integrator : {"semi_implicit_euler", "velocity_verlet", "rk4", "gauss"}
        The paper's first-order scheme, a second-order one, both with one force evaluation a step, and the
        classical fourth-order one with four; "gauss" belongs to inertia "full" and to nothing else, implicit and of
        fourth order.
    dt : float
        Step [s].
    on_snap : {"raise", "jump"}
        Where a rod's branch ends: `UnstableError`, or the rod falls at once to the stable shape that the descent of
        its energy reaches, which is recorded in ``snaps`` with the energy lost (RK4 looks ahead within a step, so
        that the tip position recorded may be off by that much).
    compiled : bool
        Whether `step` and `rollout` run as machine code: the same numbers, faster by half to three times, after a
        second or so of compiling at the first step; needs a C compiler (`CompilerError` where there is none). Rods
        that are shot follow by machine code too, where there is a compiler.

    Notes
    -----
    A state does not say on which branch the rods are, so the plant follows them by continuity from one call
    to the next; `reset` starts elsewhere. Motors saturate: rates are clipped to the limit and angles stop at
    theirs. (The limit on the change of rate concerns commands, and is the controller's.) What the tip carries besides
    its own mass is the plant's ``payload`` [kg], see `carry`. What the plant was made of can be read and not set. A
    pickled or copied plant is made of the same, and starts with a `reset`.

    A motor's rate jumps from one step to the next, and a rod's mass makes that an impulse on the tip: the momentum
    M_pp p' + M_pq u has no jump, p' has one. The state's v is therefore M_pp^-1 times the momentum: the velocity
    that the tip would have if the motors stopped there and then. While they turn it moves with v - M_pp^-1 M_pq u
    (`tip_velocity`; the difference is 0.2 mm/s for each rad/s on the default robot). Without rod mass both are p'.

    With inertia "full" the rods have a state of their own, which x does not hold: the plant keeps it from one step
    to the next, as it keeps the branch, if x is what the last step returned; any other x finds the rods in
    equilibrium, moving with the tip. Forces, Jacobians, mass and equilibrium are those of the rods at rest at (p, q).
    """

    def __init__(
        self,
        robot: Robot,
        *,
        method: str | None = None,
        segments: int = 8,
        steps: int = 1,
        scheme: str = "rk8",
        inertia: str = "none",
        modes: int = 12,
        weight: str | None = None,
        integrator: str = "semi_implicit_euler",
        dt: float = 1e-3,
        on_snap: str = "raise",
        compiled: bool = False,
    ) -> None:
        method, weight, rods = checked_choices(robot, method, inertia, modes, weight, integrator, dt, on_snap)
        self.robot = robot
        self.method = method
        self.inertia = inertia
        self.weight = weight
        self.integrator = integrator
        self.dt = dt
        self.compiled = compiled
        self.n_states = 4 + robot.n_rods
        self._modal = ModalStep(rods, int(modes)) if inertia == "full" else None
        self._advance = self._modal or INTEGRATORS[integrator](robot.n_rods)
        self.shooting = checked_shooting(segments, steps, scheme)
        self._rods = FollowedRods(
            robot,
            rods,
            method,
            self.shooting,
            inertia=inertia,
            weight=weight,
            snapping=on_snap == "jump",
            compiled=compiled,
        )
        self.payload = 0.0
        self._tip_weight = robot.tip_weight
        self.step_model: StepModel | None = None
        if isinstance(self._rods.solver, RodSolver):
            of_rods = self._rods.solver.method
            kind = Kind(robot.n_rods, of_rods.layout)
            self.numbers = kind.pack(robot)
            if inertia != "full":
                self.step_model = StepModel(kind, of_rods, integrator, inertia, weight, dt)
        self._quick: QuickStep | None = None
        self._quick_at: list[float] | None = None

    def of(self, robot: Robot) -> Plant:
        """Return a plant that simulates another robot in the same way; errors as `Plant`."""
        _, settings = self.__dict__["_made_of"]
        return Plant(**{**settings, "robot": robot})

    def reset(self, x: Any, guess: Equilibrium | None = None) -> None:
        """Put the rods on the branch of ``guess`` at state x, or on the branch of least energy (None)."""
        x = checked_vector("x", x, self.n_states)
        p, q = x[:2], x[4:]
        self.robot.require_reachable(p)
        self._take(0.0)
        self._rods.start(p, q, guess)
        if self._modal is not None:
            self._modal.forget()

    def carry(self, payload: float, x: Any) -> np.ndarray:
        """Let the tip carry a payload besides its own mass from state x on; a `reset` takes it away.

        What is picked up was at rest: the momentum stays, and the tip becomes slower. What is put down leaves with the
        velocity of the tip, which stays.

        Parameters
        ----------
        payload : float
            All that is carried from now on [kg]; it has weight where there is gravity.
        x : array_like, shape (4 + n,)
            State [m, m/s, rad].

        Returns
        -------
        ndarray, shape (4 + n,)
            State just after.
        """
        payload = checked_number("payload", payload, minimum=0.0)
        after = checked_vector("x", x, self.n_states).copy()
        p, v, q = after[:2], after[2:4], after[4:]
        picked_up, momentum = payload - self.payload, self.mass(p, q)[0][:2, :2] @ v
        self._take(payload)
        if picked_up <= 0.0:
            return after
        if self._modal is not None and (vibrating := self._modal.pick_up(self, picked_up, after)) is not None:
            return vibrating
        v[:] = np.linalg.solve(self.mass(p, q)[0][:2, :2], momentum)
        return after

    def _take(self, payload: float) -> None:
        if payload == self.payload:
            return
        self._rods.carry(payload)
        self.__dict__["payload"] = payload
        self._tip_weight = self.robot.tip_weight + payload * np.array(self.robot.gravity)
        if self.step_model is not None:
            kind = self.step_model.kind
            self.numbers = kind.pack(replace(self.robot, tip_mass=self.robot.tip_mass + payload))
            if self._quick is not None:
                self._quick.hand_over()
                self._quick_at = None  # the memory has the mass matrix
                self._quick.of(self.numbers)
        if self._modal is not None:
            self._modal.rods.tip_mass = self.robot.tip_mass + payload

    @property
    def tip_weight(self) -> np.ndarray:
        """Of tip mass and payload, shape (2,) [N]."""
        return self._tip_weight

    @property
    def snaps(self) -> list[Snap]:
        """Snaps since the reset, in order."""
        return self._rods.solver.snaps

    @property
    def residual(self) -> float:
        """Residual of the rods at the last pose that was solved, added up over them; not for single shooting."""
        return float(self._rods.keeping("residual").state.residual)

    @property
    def rungs(self) -> dict[str, int]:
        """How many poses each rung of the solver's ladder has solved (see `RodSolver`)."""
        return dict(self._rods.solver.rungs)

    def step(self, x: Any, u: Any, f_ext: Any = (0.0, 0.0)) -> np.ndarray:
        """Advance by one time step with the motor rates held.

        Parameters
        ----------
        x : array_like, shape (4 + n,)
            State [m, m/s, rad].
        u : array_like, shape (n,)
            Motor rates [rad/s].
        f_ext : array_like, shape (2,)
            External force on the tip besides its weight [N].

        Returns
        -------
        ndarray, shape (4 + n,)

        Raises
        ------
        UnreachableError, ConvergenceError, UnstableError
            The rods could not follow, or dt is too long for the tip, which is said; the exception carries the
            ``state`` at the start of the step.
        """
        x = checked_vector("x", x, self.n_states)
        u = checked_vector("u", u, self.robot.n_rods)
        f_ext = checked_vector("f_ext", f_ext, 2)
        try:
            end = self._step_quickly(x, u, f_ext)
            if end is None:
                rate = self.robot.motor_rates(u, x[4:], self.dt)
                end = self._advance(self, x, rate, f_ext + self.tip_weight)
        except PCRError as error:
            error.details["state"] = x.copy()
            if too_long := self._step_too_long():
                raise type(error)(f"{too_long} (what it came to: {error})", **error.details) from None
            raise
        return np.asarray(end)

    @property
    def record(self) -> np.ndarray:
        """All about the rods at the last pose that was solved, in one vector (see `recall`)."""
        return self._rods.keeping("record").state.record

    def recall(self, record: np.ndarray) -> None:
        """Put the rods back to a pose whose ``record`` was copied."""
        self._rods.recall(record)

    def _step_too_long(self) -> str | None:
        """Whether the integrator is unstable on the stiffness of the rods at the reset, in words."""
        # Not where they are: a tip that was thrown away has pulled them taut.
        stiffness, mass = self._rods.stiffness, self._rods.last_mass()[:2, :2]
        if stiffness is None:
            return None
        longest, omega = longest_step(self.integrator, stiffness, mass, self.robot.drag)
        if self.dt < longest:
            return None
        return (
            f"a step of {self.dt:.3g} s is too long for this tip: its fastest swing has omega dt = "
            f"{omega * self.dt:.3g}, where {self.integrator} is unstable; take dt below {longest:.2g} s"
        )

    def memory(self, x: np.ndarray) -> np.ndarray:
        """Return what a `step_graph` of ``step_model`` starts from at state x, following the branch."""
        assert self.step_model is not None
        force, mass = self.force_and_mass(x[:2], x[4:])
        return self.step_model.memory(self._rods.keeping("record").state.start, force, mass)

    def _step_quickly(self, x: np.ndarray, u: np.ndarray, f_ext: np.ndarray) -> np.ndarray | None:
        """Step in one call, or None where that is not possible."""
        if self.step_model is None:
            return None
        if self._quick is None or self._quick.model is not self.step_model:
            solver = self._rods.keeping("record")
            self._quick_at = None
            self._quick = self._rods.ahead = QuickStep(self.step_model, solver, self.numbers, compiled=self.compiled)
        at = x.tolist()
        del at[2:4]
        if self._rods.at is not self._quick_at or at != self._rods.at:
            self._quick.load(self.memory(x))
            self._quick_at = self._rods.at
        end = self._quick(x, u, f_ext)
        if end is None:
            return None
        at = end.tolist()
        del at[2:4]
        self._rods.at = self._quick_at = at
        self._rods.accuracy = PREDICTOR_ACCURACY
        return end.copy()

    def force(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        """F at (p, q), following the branch [N]; the tip is at rest where it is the tip's weight plus F_ext."""
        return self._rods.force(p, q)

    def force_and_jacobians(
        self, p: np.ndarray, q: np.ndarray, accuracy: float | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """F [N], K [N/m] and G [N/rad] at (p, q), following the branch.

        ``accuracy`` bounds the residual of the iterate at which K and G were taken; None: at the solution.
        """
        return self._rods.force_and_jacobians(p, q, accuracy)

    def rods(self, p: np.ndarray, q: np.ndarray) -> RobotState:
        """Unknowns, loads and derivatives of all rods at (p, q), following the branch; not for single shooting.

        A condensed weight, which bends no rod, is no part of them. Valid until the plant moves on.
        """
        return self._rods.state(p, q)

    def mass(self, p: np.ndarray, q: np.ndarray) -> MassMatrix:
        """Mass matrix at (p, q), following the branch, for the velocities w = [p', q'].

        Returns
        -------
        M : ndarray, shape (2 + n, 2 + n)
            Of tip mass and rods [kg, kg m, kg m^2]; kinetic energy is w' M w / 2.
        slopes : ndarray, shape ((2 + n)^2, 2 + n)
            d vec(M) / d(p, q), columns of M stacked; zero where the inertia is "none" or "constant".
        """
        return self._rods.mass(p, q)

    def force_and_mass(self, p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, MassMatrix]:
        """`force` and `mass` at the same pose."""
        return self._rods.force_and_mass(p, q)

    def tip_velocity(self, x: Any, u: Any) -> np.ndarray:
        """Velocity p' of the tip at state x while the motors turn at the rates u, shape (2,) [m/s]."""
        x, u = checked_vector("x", x, self.n_states), checked_vector("u", u, self.robot.n_rods)
        mass = self.mass(x[:2], x[4:])[0]
        return np.asarray(x[2:4] - np.linalg.solve(mass[:2, :2], mass[:2, 2:] @ u))

    def equilibrium(self, x: Any) -> Equilibrium:
        """Everything about the rods at state x, following the branch."""
        x = checked_vector("x", x, self.n_states)
        return self._rods.equilibrium(x[:2], x[4:])


__all__ = ["INTEGRATORS", "ON_SNAP", "Plant"]
