"""Parts of a scene: how the plant is simulated, what is asked of it, what the tip carries, and limits of poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import ModelError, check_numbers
from ...linearisation.pose_limits import PoseLimits
from ...methods import METHODS
from ...plant.materials import check_unit
from ...plant.motion.plant import INTEGRATORS, ON_SNAP, Plant
from ...plant.robot import Robot
from ...plant.rods.closed_form.inertia import INERTIAS
from ...plant.rods.equations import SCHEMES
from ...plant.statics.held_tip import default_method
from ...plant.statics.weight import WEIGHTS
from ...toml_table import Table

RODS = ("plain", "as_built")
PAYLOADS = ("ignored", "carried")
MOTORS = ("ideal", "as_built")
# Least 1 - lambda / lambda_c of a rod, and least eigenvalue of K in units of sum EI/L^3, that a controller leaves.
_LEAST_ROD_MARGIN, _LEAST_STIFFNESS = 0.05, 1.0
_NEEDS = ("tip_accuracy", "plant_step", "control_step")  # of the simulation
_EARLY = 1 - 1e-9  # of a time: what is no earlier comes at that time


@dataclass(frozen=True)
class PlantSettings:
    """How the plant is simulated: the arguments of `Plant`, and what of the robot and the scene is left out.

    Attributes
    ----------
    method, segments, steps, scheme, integrator, dt, on_snap, inertia, weight
        See `Plant`.
    rods : {"plain", "as_built"}
        Without or with curvature at rest, stiffness along the rods and stretch.
    payload : {"ignored", "carried"}
    motors : {"ideal", "as_built"}
        Whether they follow their commands at once, or as the scene's `Motors` do.
    """

    method: str
    segments: int
    steps: int
    scheme: str
    integrator: str
    dt: float
    on_snap: str
    inertia: str = "none"
    weight: str | None = None
    rods: str = "as_built"
    payload: str = "carried"
    motors: str = "as_built"

    def make(self, robot: Robot) -> Plant:
        """Build the plant of a robot; what `Plant` refuses is a `ModelError` of the table."""
        try:
            return Plant(
                robot.plain() if self.rods == "plain" else robot,
                method=self.method,
                segments=self.segments,
                steps=self.steps,
                scheme=self.scheme,
                integrator=self.integrator,
                dt=self.dt,
                on_snap=self.on_snap,
                inertia=self.inertia,
                weight=self.weight,
            )
        except ValueError as error:
            raise ModelError(f"[plant] {error}", key="plant", reason=str(error)) from error

    def describes(self, plant: object, robot: Robot) -> bool:
        """Whether a plant of a robot is simulated like this."""
        if not isinstance(plant, Plant):
            return False
        own = self.method, self.integrator, self.dt, self.inertia
        if own != (plant.method, plant.integrator, plant.dt, plant.inertia):
            return False
        alike = self.make(robot)
        return (alike.weight, alike.robot, alike.shooting) == (plant.weight, plant.robot, plant.shooting)


@dataclass(frozen=True)
class Need:
    """What is asked of the simulation of a scene.

    Attributes
    ----------
    tip_accuracy : float
        Largest error of the tip over the duration [m], motors moving as they do.
    plant_step, control_step : float
        Time that a step may take, median [s].
    """

    tip_accuracy: float
    plant_step: float
    control_step: float

    def __post_init__(self) -> None:
        check_numbers(self, {key: {"above": 0.0} for key in ("tip_accuracy", "plant_step", "control_step")})


@dataclass(frozen=True)
class Finding:
    """What `pcr-mpc choose` found about the rung that stands in the scene's [plant] table.

    Attributes
    ----------
    tip_error : float
        [m], the yardstick's own uncertainty included.
    estimated : float
        The part of it that is estimated, not measured [m].
    digest : str
        Of all that it rests on (see `finding.digest`).
    """

    tip_error: float
    estimated: float
    digest: str


@dataclass(frozen=True)
class Payload:
    """What the tip picks up, at rest, and puts down again.

    Attributes
    ----------
    mass : float
        [kg].
    pick, place : float
        When [s].
    """

    mass: float
    pick: float
    place: float

    def __post_init__(self) -> None:
        check_numbers(self, {"mass": {"above": 0.0}, "pick": {"minimum": 0.0}})
        check_numbers(self, {"place": {"above": self.pick}})

    def carried(self, t: np.ndarray) -> np.ndarray:
        """Mass that the tip carries from the times t on [kg], same shape."""
        # Times are sums of steps: rounding must not decide.
        return np.where((t >= _EARLY * self.pick) & (t < _EARLY * self.place), self.mass, 0.0)


def read_plant(table: Table, robot: Robot) -> PlantSettings:
    """Take the keys of a scene's [plant] table."""
    rods = table.text("rods", RODS[-1], choices=RODS)
    default = default_method(robot.plain() if rods == "plain" else robot)
    plant = PlantSettings(
        method=table.text("method", default, choices=METHODS),
        segments=table.integer("segments", 8),
        steps=table.integer("steps", 1),
        scheme=table.text("scheme", "rk8", choices=tuple(SCHEMES)),
        integrator=table.text("integrator", choices=(*INTEGRATORS, "gauss")),
        dt=table.number("dt", above=0.0),
        on_snap=table.text("on_snap", "raise", choices=ON_SNAP),
        inertia=table.text("inertia", "none", choices=INERTIAS),
        weight=table.text("weight", None, choices=WEIGHTS),
        rods=rods,
        payload=table.text("payload", PAYLOADS[-1], choices=PAYLOADS),
        motors=table.text("motors", MOTORS[-1], choices=MOTORS),
    )
    if (plant.inertia == "full") != (plant.integrator == "gauss"):
        raise table.fail("integrator", f"is {plant.integrator}: inertia 'full' needs 'gauss', and only it does")
    if plant.inertia != "none" and plant.method == "single_shooting":
        raise table.fail("inertia", f"is {plant.inertia}, which method 'single_shooting' does not know")
    return plant


def read_payload(file: Table) -> Payload | None:
    """Take a scene's [payload] table, if it has one."""
    if not file.has("payload"):
        return None
    with file.table("payload") as table:
        pick = table.number("pick", minimum=0.0)
        return Payload(table.number("mass", above=0.0), pick, table.number("place", above=pick))


def read_need(file: Table) -> tuple[Need | None, float | None]:
    """Take a scene's [need] table, if it has one: what is asked of the simulation, and of the delay margin [s]."""
    if not file.has("need"):
        return None, None
    with file.table("need") as table:
        margin = table.number("delay_margin", above=0.0) if table.has("delay_margin") else None
        if margin is not None and not any(map(table.has, _NEEDS)):
            return None, margin
        numbers = [table.number(key, above=0.0) for key in _NEEDS]
        return Need(1e-3 * numbers[0], 1e-6 * numbers[1], 1e-6 * numbers[2]), margin


def read_finding(file: Table) -> Finding | None:
    """Take a scene's [chosen] table, if it has one."""
    if not file.has("chosen"):
        return None
    with file.table("chosen") as table:
        tip_error = 1e-3 * table.number("tip_error", minimum=0.0)
        return Finding(tip_error, 1e-3 * table.number("estimated", minimum=0.0), table.text("digest"))


def read_pose_limits(table: Table, robot: Robot) -> PoseLimits:
    """Read limits of poses. Stability margins have defaults, for nobody wants a snap by surprise; 0 is none."""
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
