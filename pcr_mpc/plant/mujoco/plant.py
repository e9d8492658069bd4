"""The robot simulated by MuJoCo: a plant that shares with the models nothing but the robot's numbers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from ...errors import ConvergenceError, PCRError, checked_integer, checked_number, checked_vector
from ...frozen import Remade, set_once
from ..motion.plant import Plant
from ..robot import Robot
from ..statics.equilibrium import Equilibrium
from ..statics.solver import Snap
from .hinge_chain import settled_chains
from .mjcf import checked_links, coordinates, mjcf


@set_once(
    "make a new MuJoCoPlant with it",
    "robot",
    "links",
    "dt",
    "substeps",
    "extrapolated",
    "n_states",
    "method",
    "integrator",
    payload="call carry, which keeps the momentum, or reset, which takes it away",
)
class MuJoCoPlant(Remade):
    """The robot in motion as hinge chains in MuJoCo, behind the interface of `Plant`.

    Parameters
    ----------
    robot : Robot
        Its rods must have mass and not stretch.
    links : int
        Per rod. The error falls as their square: within a second of free motion of the default robot 1.8 mm at 20
        links, 0.44 mm at 40, 0.11 mm at 80.
    dt : float
        Step [s].
    substeps : int
        MuJoCo's steps in one of the plant's.
    extrapolated : bool
        MuJoCo's step is of first order. Each is made once whole and once in two halves, and twice the second result
        minus the first is of second order: at 1 ms better than MuJoCo alone at 0.05 ms.

    Notes
    -----
    The state's v is the velocity p' of the tip as MuJoCo has it (what `Plant.tip_velocity` gives; `Plant` itself keeps
    the tip's momentum there). The motors' angles follow their rates exactly: a motor is the rest angle of the spring
    between clamp and first link, given to MuJoCo for the end of each of its steps.

    The links have a state of their own, which x does not hold: the plant keeps it from one step to the next if x is
    what the last step returned. Any other x finds the chains in equilibrium, moving with the tip, on the branch that
    leads there from the last such x.

    What it was made of can be read and not set. A pickled or copied plant is made of the same, and starts with a
    `reset`.

    A rod that snaps does so in its own time; it is motion like any other, and ``snaps`` remains empty.
    """

    def __init__(
        self, robot: Robot, *, links: int = 40, dt: float = 1e-3, substeps: int = 2, extrapolated: bool = True
    ) -> None:
        self.payload: float
        self._mujoco = _imported()
        links = checked_links(robot, links)
        if not 0.0 < dt < np.inf:
            raise ValueError(f"dt is {dt} s, expected a positive number")
        self.robot = robot
        self.links = links
        self.dt = dt
        self.substeps = checked_integer("substeps", substeps)
        self.extrapolated = extrapolated
        self.n_states = 4 + robot.n_rods
        self.method = f"MuJoCo {self._mujoco.__version__}, {links} links"
        self.integrator = f"discrete at {1e6 * dt / substeps:g} us{' extrapolated' if extrapolated else ''}"
        self._take(0.0)
        self._rods = Plant(robot)  # for the shapes in which the chains start
        self._last: np.ndarray | None = None

    @property
    def snaps(self) -> list[Snap]:
        """Empty: see the class."""
        return []

    @property
    def rungs(self) -> dict[str, int]:
        """Empty: no statics are solved."""
        return {}

    @property
    def gap(self) -> float:
        """Largest distance of a rod's end from the pin [m]."""
        self._mujoco.mj_kinematics(self._model, self._data)
        pin = self._data.site("pin").xpos
        return max(float(np.linalg.norm(self._data.site(f"end{i}").xpos - pin)) for i in range(self.robot.n_rods))

    def reset(self, x: Any, guess: Equilibrium | None = None) -> None:
        """Put the chains in equilibrium at x on the branch of ``guess``, or on that of least energy (None)."""
        x = checked_vector("x", x, self.n_states)
        if self.payload:
            self._take(0.0)
        self._rods.reset(x, guess)
        self._settle(x)

    def carry(self, payload: float, x: Any) -> np.ndarray:
        """Let the tip carry a payload from state x on; see `Plant.carry`. The pin passes the impulse on to the chains.

        Parameters
        ----------
        payload : float
            All that is carried from now on [kg].
        x : array_like, shape (4 + n,)
            State [m, m/s, rad].

        Returns
        -------
        ndarray, shape (4 + n,)
            State just after.
        """
        payload = checked_number("payload", payload, minimum=0.0)
        x = checked_vector("x", x, self.n_states)
        if self._last is None or (x != self._last).any():
            self._settle(x)
        share = min(1.0, (self.robot.tip_mass + self.payload) / (self.robot.tip_mass + payload))
        before = self._data
        self._take(payload)
        self._data.qpos[:], self._data.qvel[:] = before.qpos, before.qvel
        self._data.qvel[-2:] *= share
        self._last = np.concatenate([x[:2], self._data.qvel[-2:], x[4:]])
        return self._last.copy()

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
            The chains have no equilibrium at a state from outside, or MuJoCo gave up; the exception carries the
            ``state`` at the start of the step.
        """
        x = checked_vector("x", x, self.n_states)
        u = checked_vector("u", u, self.robot.n_rods)
        f_ext = checked_vector("f_ext", f_ext, 2)
        q, rate = x[4:], self.robot.motor_rates(u, x[4:], self.dt)
        try:
            if self._last is None or (x != self._last).any():
                self._settle(x)
            self._data.qfrc_applied[-2:] = f_ext
            self._advance(q, rate)
        except PCRError as error:
            error.details["state"] = x.copy()
            raise
        self._last = np.concatenate([self._data.qpos[-2:], self._data.qvel[-2:], q + self.dt * rate])
        return self._last.copy()

    def _take(self, payload: float) -> None:
        self.__dict__["payload"] = payload
        loaded = replace(self.robot, tip_mass=self.robot.tip_mass + payload)
        self._model = self._mujoco.MjModel.from_xml_string(
            mjcf(loaded, links=self.links, timestep=self.dt / self.substeps, visible=False)
        )
        self._data = self._mujoco.MjData(self._model)

    def _settle(self, x: np.ndarray) -> None:
        state = settled_chains(self._rods.equilibrium(x), x[2:4], self.links)
        self._mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:], self._data.qvel[:] = coordinates(state, x[:2], x[2:4])
        self._last = x.copy()

    def _advance(self, q: np.ndarray, rate: np.ndarray) -> None:
        model, data, step = self._model, self._data, self._mujoco.mj_step
        h = self.dt / self.substeps
        before = data.qpos.copy(), data.qvel.copy()
        with _WARNINGS.heard(self._mujoco) as complaints:
            for k in range(self.substeps):
                start, end = q + k * h * rate, q + (k + 1) * h * rate
                if self.extrapolated:
                    qpos, qvel = data.qpos.copy(), data.qvel.copy()
                data.ctrl[:] = end
                step(model, data)
                if self.extrapolated:
                    qpos_whole, qvel_whole = data.qpos.copy(), data.qvel.copy()
                    data.qpos[:], data.qvel[:] = qpos, qvel
                    model.opt.timestep = h / 2
                    data.ctrl[:] = (start + end) / 2
                    step(model, data)
                    data.ctrl[:] = end
                    step(model, data)
                    model.opt.timestep = h
                    data.qpos[:] = 2 * data.qpos - qpos_whole
                    data.qvel[:] = 2 * data.qvel - qvel_whole
        if complaints:
            last = data.qpos.copy()
            self._mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = before
            raise ConvergenceError(
                f"MuJoCo gave up: {complaints[0].strip()} Take shorter steps or fewer links",
                residual=np.nan,
                iterations=0,
                last=last,
            )


class _Warnings:
    """Warnings of MuJoCo, which it would print and write into a file in the working directory.

    It knows one listener for all threads, and warns in the thread that steps.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._steps = 0  # under way, in all threads
        self._before: Callable[[str], None] | None = None
        self._heard = threading.local()

    @contextmanager
    def heard(self, mujoco: Any) -> Iterator[list[str]]:
        """Those of this thread."""
        complaints: list[str] = []
        self._heard.here = complaints
        with self._lock:
            if not self._steps:
                self._before = mujoco.get_mju_user_warning()
                mujoco.set_mju_user_warning(self._listen)
            self._steps += 1
        try:
            yield complaints
        finally:
            self._heard.here = None
            with self._lock:
                self._steps -= 1
                if not self._steps:
                    mujoco.set_mju_user_warning(self._before)

    def _listen(self, message: str) -> None:
        here = getattr(self._heard, "here", None)
        if here is not None:
            here.append(message)
        elif self._before is not None:
            self._before(message)


_WARNINGS = _Warnings()


def _imported() -> Any:
    try:
        import mujoco
    except ImportError as error:
        raise PCRError("MuJoCo is not installed; pip install 'pcr_mpc[mujoco]'") from error
    return mujoco
