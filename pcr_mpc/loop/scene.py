"""A scene: which robot does what, for how long, simulated how."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..control.tuning import Tuning, load_tuning
from ..errors import ModelError, UnreachableError
from ..linearisation.pose_limits import PoseLimits
from ..plant.materials import check_unit
from ..plant.motion.plant import Plant
from ..plant.robot import Robot, load_robot
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.free_tip import forward_statics, inverse_statics
from ..toml_table import Table, read_toml
from .hardware.motors import Motors, read_motors
from .references.blended import duration_of
from .references.reading import read_reference
from .scene_checks import LATE, check_scene, is_multiple
from .settings import Finding, Need, Payload, PlantSettings, read_finding, read_need, read_payload, read_plant
from .trajectory import Trajectory, sampled

# Distance of the start from the reference that is taken for the same place, in rod lengths: found, and as given.
_START_TOLERANCE, _START_ROUNDING = 2.5e-3, 2.5e-9
_TENS = 10  # control periods, of which a duration that follows from the reference is a multiple
_MILLIMETRES = 10.0  # times too far, from which a reference may be in other units
_LOST = 0.1  # of the shortest rod
# Least 1 - lambda / lambda_c of a rod, and least eigenvalue of K in units of sum EI/L^3, that a controller leaves.
_LEAST_ROD_MARGIN, _LEAST_STIFFNESS = 0.05, 1.0


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
        ModelError
            The free tip at ``start_motors`` is not where the reference begins, these are beyond a stop, or to hold
            the start takes more torque than the motors have.
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
            _require_within_stops(self)
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
        return _held(self.robot, self.start_tip, self.start_mode)

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


def load_scene(path: str | Path) -> Scene:
    """Read a scene from TOML (see ``models/scenes/lemniscate.toml``); paths of its robot and tuning are relative to it.

    Raises
    ------
    ModelError
        A key is missing, misspelt, of the wrong type or out of range, in the scene or in its robot; the motors start
        beyond a stop; a rod is too short for the start or for the reference; or the scene's own limit on torque is too
        low for the start. What else takes statics to see is seen at the start of a run, or by `check_scene`.
    """
    with read_toml(path) as file:
        name = file.text("name")
        robot = load_robot(file.path.parent / file.text("robot"))
        with file.table("reference") as reference:
            trajectory = read_reference(reference)
        with file.table("limits", {}) as limits:
            own_torque = limits.has("torque")
            robot = replace(
                robot,
                rate_limit=limits.number("rate", robot.rate_limit, above=0.0),
                acceleration_limit=limits.number("acceleration", robot.acceleration_limit, above=0.0),
                torque_limit=limits.number("torque", robot.torque_limit, above=0.0),
            )
            pose_limits = _pose_limits(limits, robot)
            tracking_error = limits.number("tracking_error", 0.0, above=0.0) or None
        with file.table("world", {}) as world:
            robot = replace(robot, gravity=world.vector("gravity", 2, robot.gravity))
        with file.table("start") as start:
            tip = start.vector("tip", 2, None)
            motors = start.vector("motors", robot.n_rods, None)
            mode = start.text("mode", None)
            velocity = start.vector("velocity", 2, (0.0, 0.0))
            if tip is None and motors is None and mode is not None and trajectory is not None:
                tip = tuple(trajectory(np.zeros(1))[0, 0].tolist())
            if (tip is None) == (motors is None) or (tip is None) != (mode is None):
                raise start.fail("tip", "give either tip and mode, or motors")
        with file.table("plant") as table:
            plant = read_plant(table, robot)
        with file.table("control") as control:
            period = control.number("period", above=0.0)
            duration = _duration(file, trajectory, period)
            tuning = control.text("tuning", None)
            delay = control.integer("delay", 0, minimum=0)
            untold_delay = control.number("untold_delay", 0.0, minimum=0.0)
            deadline = control.number("deadline", math.inf, minimum=0.0)
            late = control.text("late", LATE[0], choices=LATE)
        with file.table("load", {}) as load, file.table("sensor", {}) as sensor:
            force = load.vector("force", 2, (0.0, 0.0))
            noise = sensor.number("tip_noise", 0.0, minimum=0.0)
            angle_step = sensor.number("angle_step", 0.0, minimum=0.0)
            wrapped = sensor.boolean("wrapped", False)
        payload = read_payload(file)
        need, finding, moved_by = read_need(file), read_finding(file), read_motors(file)
        scene = Scene(name, robot, duration, tip, motors, mode, velocity, trajectory, plant, period,
                      tuning and load_tuning(file.path.parent / tuning), force, noise, angle_step,
                      delay, deadline, late, pose_limits, payload, need, finding,
                      wrapped=wrapped, tracking_error=tracking_error, untold_delay=untold_delay,
                      motors=moved_by)  # fmt: skip
    if (trajectory is None) != (tuning is None):
        raise ModelError(
            f"{path}: a reference needs control.tuning, and reference.kind = 'none' has no use for it",
            file=str(path),
            key="control.tuning",
        )
    if tip is not None and trajectory is not None:
        begin = trajectory(np.zeros(1))[0, 0]
        if np.hypot(*(begin - tip)) > _START_ROUNDING * robot.lengths.mean():
            raise ModelError(
                f"{path}: start.tip {tip} is not where the reference begins, {tuple(begin.tolist())}; without "
                "start.tip it starts there",
                file=str(path),
                key="start.tip",
            )
    try:
        _require_within_stops(scene)
        _require_reach(scene)
        if own_torque:
            scene.start()
    except ModelError as error:
        raise ModelError(f"{path}: {error}", file=str(path), **error.details) from None
    return scene if scene.tuning is None else scene.tuned(scene.tuning)


def _duration(file: Table, trajectory: Trajectory | None, period: float) -> float:
    """As stated, or as long as the reference takes, in tens of control periods: other periods are to fit, too."""
    if file.has("duration") or trajectory is None or math.isinf(duration_of(trajectory)):
        return file.number("duration", above=0.0)
    return _TENS * period * math.ceil(duration_of(trajectory) / (_TENS * period) - 1e-9)


def _require_within_stops(scene: Scene) -> None:
    for i, angle in enumerate(scene.start_motors or ()):
        lower, upper = scene.robot.angle_limits[i]
        if not lower <= angle <= upper:
            raise ModelError(
                f"{scene.name}: start.motors: motor {i} is to start at {angle:g} rad, beyond its stops, "
                f"[{lower:g}, {upper:g}] rad; start within them",
                key="start.motors",
            )


def _require_reach(scene: Scene) -> None:
    """Raise if a rod is too short for the start or for the reference, which costs no statics to see."""
    if scene.start_tip is not None:
        try:
            scene.robot.require_reachable(np.array(scene.start_tip))
        except UnreachableError as error:
            units = _units_hint(error.distance - error.length, scene.robot)
            raise ModelError(f"{scene.name}: start.tip: {error}{units}", key="start.tip", **error.details) from None
    if scene.trajectory is None:
        return
    t = scene.period * np.arange(scene.n_periods + 1)
    tips = sampled(scene.trajectory, t)[:, 0]
    robot = scene.robot
    beyond = np.linalg.norm(tips[:, None] - robot.bases, axis=2) - robot.lengths
    if not (outside := (beyond >= 0).any(axis=1)).any():
        return
    first, farthest = int(outside.argmax()), np.unravel_index(int(beyond.argmax()), beyond.shape)
    most = float(beyond[farthest])
    try:
        robot.require_reachable(tips[first])
    except UnreachableError as error:
        worst = f"; at t = {t[farthest[0]]:.3f} s rod {farthest[1]} is {1e3 * most:.4g} mm too short"
        raise ModelError(
            f"{scene.name}: reference at t = {t[first]:.3f} s: {error}{worst if most > 0 else ''}"
            f"{_units_hint(most, robot)}",
            key="reference",
            t=float(t[first]),
            **error.details,
        ) from None


def _units_hint(short: float, robot: Robot) -> str:
    return "; is it in millimetres?" if short > _MILLIMETRES * float(robot.lengths.max()) else ""


def _pose_limits(table: Table, robot: Robot) -> PoseLimits:
    """Stability margins have defaults, for nobody wants a snap by surprise; 0 switches one off."""
    corners = [table.vector(key, 2, None) for key in ("tip_lower", "tip_upper")]
    if (corners[0] is None) != (corners[1] is None):
        raise table.fail("tip_lower", "give both tip_lower and tip_upper, or neither")
    if corners[0] is not None and not all(low < high for low, high in zip(*corners, strict=True)):
        raise table.fail("tip_lower", f"{corners[0]} is not below tip_upper {corners[1]}")
    usual = default_margins(robot)
    return PoseLimits(
        robot.torque_limit,
        corners[0],
        corners[1],
        table.number("rod_margin", usual.rod_margin or 0.0, minimum=0.0, maximum=0.9) or None,
        table.number("stiffness", usual.stiffness or 0.0, minimum=0.0) or None,
        _strain_limit(table, robot),
    )


def _strain_limit(table: Table, robot: Robot) -> float | tuple[float, ...] | None:
    """Of the rods' materials unless the scene has its own."""
    if table.has("strain"):
        own = table.number("strain", minimum=0.0)
        check_unit("strain", own)
        if own and all(rod.half_thickness is None for rod in robot.rods):
            raise table.fail("strain", f"no rod of {robot.name} has a section, and so no strain is known; state it")
        return own or None
    return default_margins(robot).strain


def default_margins(robot: Robot) -> PoseLimits:
    """Limits of poses that are kept if nobody says otherwise: torque, margins to the folds, strain of the materials."""
    softness = _LEAST_STIFFNESS * float((robot.stiffnesses / robot.lengths**3).sum())
    limits = robot.strain_limits
    strain = tuple(limits.tolist()) if np.isfinite(limits).any() else None
    return PoseLimits(robot.torque_limit, None, None, _LEAST_ROD_MARGIN, softness, strain)
