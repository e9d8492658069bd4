"""A scene: which robot does what, for how long, simulated how."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from ...control.tuning import Tuning
from ...errors import ConvergenceError, ModelError, PCRError
from ...linearisation.pose_limits import PoseLimits
from ...plant.motion.plant import Plant
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.free_tip import forward_statics, inverse_statics
from ..hardware.camera import Camera
from ..hardware.motors import Motors
from ..references.trajectory import Trajectory
from .checks import LATE, begins, check_scene, is_multiple, require_within_stops
from .settings import Finding, Need, Payload, PlantSettings

# Distance of the start that is found from the reference that is taken for the same place, in rod lengths.
_START_TOLERANCE = 2.5e-3
_LOST = 0.1  # of the shortest rod


@dataclass(frozen=True)
class Scene:
    """One experiment.

    Attributes
    ----------
    name : str
    robot : Robot
        With the scene's own limits, if it has some.
    duration : float
        [s].
    start_tip : (float, float) or None
        Tip position at the start [m]; the motors are found by inverse statics in working mode ``start_mode``.
    start_motors : tuple of float or None
        Motor angles at the start [rad]; the tip is found by forward statics. One of the two is given.
    start_mode : str or None
    start_velocity : (float, float)
        Tip velocity at the start [m/s].
    trajectory : Trajectory or None
        What to track. None: the motors stay where they are.
    plant : PlantSettings
    period : float
        Control period [s], a multiple of the plant's step.
    tuning : Tuning or None
        Of the scene's controller. None: the motors stay where they are.
    force : (float, float)
        External force on the tip, unknown to the controller [N].
    tip_noise : float
        Standard deviation of the measured tip position [m].
    angle_step : float
        Resolution of the encoders: measured angles are whole multiples of it [rad]. Zero: exact.
    delay : int
        Control periods that pass before a command reaches the motors.
    untold_delay : float
        Time beside it by which they get commands later than any controller was told [s]; need not be whole periods.
    deadline : float
        Time after the start of a period [s] up to which a decision still counts as taken at its start, at most the
        period. A later one reaches the motors as late as it is, but no later than at the end of its period. Infinite:
        lateness is not simulated.
    late : {"hold", "shifted_plan"}
        What the motors do until a late decision arrives: go on as before, or as the last plan foresaw.
    pose_limits : PoseLimits
        Torque, tip region and stability margins, which a controller keeps if it can.
    payload : Payload or None
    need : Need or None
        What is asked of the simulation.
    finding : Finding or None
        What is known of the plant's rung.
    own_period : float or None
        Control period of the scene [s], where its tuning asks for another.
    wrapped : bool
        Encoders tell angles in (-pi, pi] only.
    tracking_error : float or None
        Distance of the tip from the reference beyond which a run counts as lost [m]. None: a tenth of the shortest rod.
    motors : Motors or None
        How the motors follow their commands, which no controller is told. None: at once.
    delay_margin : float or None
        Further delay that the loop of a tuning must bear [s] (see `predict_delay_margin`). None: nothing is asked.
    camera : Camera or None
        How the measured tip reaches the controller, which is told how often, and not how late. None: at once.
    """

    name: str
    robot: Robot
    duration: float
    start_tip: tuple[float, float] | None
    start_motors: tuple[float, ...] | None
    start_mode: str | None
    start_velocity: tuple[float, float]
    trajectory: Trajectory | None
    plant: PlantSettings
    period: float
    tuning: Tuning | None
    force: tuple[float, float]
    tip_noise: float
    angle_step: float = 0.0
    delay: int = 0
    deadline: float = math.inf
    late: str = LATE[0]
    pose_limits: PoseLimits = field(default_factory=PoseLimits)
    payload: Payload | None = None
    need: Need | None = None
    finding: Finding | None = None
    own_period: float | None = None
    wrapped: bool = False
    tracking_error: float | None = None
    untold_delay: float = 0.0
    motors: Motors | None = None
    delay_margin: float | None = None
    camera: Camera | None = None

    @property
    def allowed_error(self) -> float:
        """Distance of the tip from the reference beyond which a run counts as lost [m]."""
        if self.tracking_error is not None:
            return self.tracking_error
        return _LOST * float(self.robot.lengths.min())

    def __post_init__(self) -> None:
        check_scene(self)
        if not is_multiple(self.period, self.plant.dt):
            raise ModelError(
                f"period is {self.period} s, not a multiple of the plant's step {self.plant.dt} s", key="period"
            )
        if self.period < self.deadline < math.inf:
            raise ModelError(
                f"deadline is {self.deadline} s, longer than the control period {self.period} s, at whose end the next "
                "decision is due; take at most the period, or a delay of whole periods for a controller that is slower",
                key="deadline",
            )
        if self.duration < self.period:
            raise ModelError(f"period is {self.period} s, longer than the duration {self.duration} s", key="period")
        if not is_multiple(self.duration, self.period):
            whole = math.floor(self.duration / self.period)
            raise ModelError(
                f"duration is {self.duration} s, which is no whole number of control periods of {self.period} s; "
                f"take {whole * self.period:.10g} or {(whole + 1) * self.period:.10g} s",
                key="duration",
            )

    def carried(self, t: np.ndarray) -> np.ndarray:
        """Payload at the times t [s], same shape [kg]."""
        return np.zeros(np.shape(t)) if self.payload is None else self.payload.carried(t)

    @property
    def n_periods(self) -> int:
        """Control periods in the run."""
        return round(self.duration / self.period)

    def tuned(self, tuning: Tuning) -> Scene:
        """Return the scene with another tuning, and with the control period that it asks for.

        Raises
        ------
        ModelError
            That period is not a multiple of the plant's step, the duration not one of it, or the deadline beyond it.
        """
        own = self.own_period or self.period
        period = tuning.period or own
        if not (is_multiple(period, self.plant.dt) and is_multiple(self.duration, period)):
            raise ModelError(
                f"{tuning.name}: period {period} s does not fit scene {self.name}: it must be a multiple of the "
                f"plant's step {self.plant.dt} s, and the duration {self.duration} s a multiple of it",
                key="period",
            )
        return replace(self, tuning=tuning, period=period, own_period=own if tuning.period else None)

    @property
    def torque_limit(self) -> float:
        """Of the motors, or of the poses if that is less [N m]."""
        return min(self.robot.torque_limit, self.pose_limits.torque or math.inf)

    @property
    def strain_limits(self) -> np.ndarray:
        """Of the rods' materials, or of the poses if that is less, shape (n,) [-]; infinite where there is none."""
        return np.asarray(np.minimum(self.robot.strain_limits, self.pose_limits.strains(self.robot)))

    def start(self) -> Equilibrium:
        """Solve for the pose in which the robot starts, in balance without load.

        Raises
        ------
        ConvergenceError
            No pose of the mode holds the tip.
        ModelError
            Nor where the reference begins, if that is where the tip is; or the free tip at ``start_motors`` is not
            where the reference begins, these are beyond a stop, or to hold the start takes more torque than the motors
            have.
        """
        eq = self._start()
        i = int(np.abs(eq.motor_torque).argmax())
        torque = float(eq.motor_torque[i])
        if abs(torque) > self.torque_limit:
            raise ModelError(
                f"{self.name}: to rest at the start, p = {eq.p} m, q = {eq.q} rad, takes {torque:.4g} N m of motor "
                f"{i}, which has {self.torque_limit:.4g} N m; give the motors more torque, or start from another pose",
                key="torque",
                torque=torque,
                limit=self.torque_limit,
            )
        return eq

    def _start(self) -> Equilibrium:
        if self.start_motors is not None:
            require_within_stops(self)
            eq = _resting(self.robot, self.start_motors)
            if self.trajectory is not None:
                begin = self.trajectory(np.zeros(1))[0, 0]
                if np.hypot(*(begin - eq.p)) > _START_TOLERANCE * self.robot.lengths.mean():
                    raise ModelError(
                        f"{self.name}: at start.motors the free tip rests at {eq.p} m (mode {eq.mode}), but "
                        f"the reference begins at {begin} m; start from that tip and a mode instead",
                        key="start.motors",
                    )
            return eq
        assert self.start_tip is not None
        try:
            return _held(self.robot, self.start_tip, self.start_mode)
        except ConvergenceError as error:
            if not begins(self):
                raise
            raise ModelError(
                f"{self.name}: where the reference begins, {error}{self._if_exchanged()}", key="reference", t=0.0
            ) from error

    def _if_exchanged(self) -> str:
        """Whether x and y of a start that cannot be held may have been exchanged."""
        assert self.start_tip is not None
        try:
            # By multiple shooting a search in vain takes long.
            if self.robot.needs_shooting is None and self.start_tip[0] != self.start_tip[1]:
                _held(self.robot, self.start_tip[::-1], self.start_mode)
                return "; with x and y exchanged there is one: are they exchanged in the reference?"
        except PCRError:
            pass
        return ""

    def make_plant(self) -> Plant:
        """Build the plant of this scene."""
        return self.plant.make(self.robot)


# A search takes up to a second, and checks, studies and every run of a scene ask for the same.
@lru_cache(maxsize=32)
def _held(robot: Robot, tip: tuple[float, float], mode: str | None) -> Equilibrium:
    return inverse_statics(robot, tip, mode=mode)


@lru_cache(maxsize=32)
def _resting(robot: Robot, motors: tuple[float, ...]) -> Equilibrium:
    return forward_statics(robot, motors)
