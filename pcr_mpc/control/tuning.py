"""What a controller is told: its weights, its solver's settings, and the limits it must keep."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import checked_number
from ..frozen import Frozen
from ..toml_table import read_toml
from .observer import ObserverTuning

METHODS = ("closed_form", "multiple_shooting", "single_shooting")
SCHEMES = ("rk4", "rk8")
LAWS = ("linear_mpc", "nonlinear_mpc", "lqr", "pd", "feed_forward")
LINEARISE = ("here", "along_plan")
INERTIAS = ("none", "constant", "condensed")
FALLBACKS = ("ladder", "raise")
SOLVERS = ("osqp", "daqp")


@dataclass(frozen=True)
class Model:
    """What the controller predicts with.

    Attributes
    ----------
    method, segments, steps, scheme
        Discretisation of the rods (see `solve_statics`).
    inertia : {"none", "constant", "condensed"}
        Of the rods (see `Plant`).
    linearise : {"here", "along_plan"}
        Once, at the current state, or at every period of the last plan (real-time iteration).
    payload : bool
        Follow the scene's time table of what the tip carries, in the feed-forward and in what is linearised.
    predict_delay : bool
        Plan from where the commands that are on the way will have brought the robot.
    """

    method: str = "closed_form"
    segments: int = 8
    steps: int = 1
    scheme: str = "rk8"
    inertia: str = "none"
    linearise: str = "here"
    payload: bool = True
    predict_delay: bool = True


@dataclass(frozen=True)
class Tuning:
    """Tuning of a controller; what its law has no use for is ignored.

    Attributes
    ----------
    name : str
    horizon : int
        Control periods predicted.
    position_weight, velocity_weight, angle_weight : float
        On deviations from the reference, at every period [1/m^2], [1/(m/s)^2], [1/rad^2].
    input_weight : float
        On deviations of the motor rates from the feed-forward [1/(rad/s)^2].
    tolerance : float
        Of the QP's solver, absolute and relative.
    max_iterations : int
        After which the solver gives up.
    fallback : {"ladder", "raise"}
        What an unsolved QP leads to: the next best answer (see `LinearMPC`), or an error.
    model : Model
    observer : ObserverTuning or None
        None: the measured state is taken as it is, and no force is suspected.
    law : {"linear_mpc", "nonlinear_mpc", "lqr", "pd", "feed_forward"}
    pd : (float, float)
        Gains on the tip's error and on its rate [1], [s].
    period : float or None
        Control period for which it was tuned [s]. None: the scene's.
    solver : {"osqp", "daqp"}
        Of the QPs: a first-order method, or a dense active set.
    """

    name: str
    horizon: int
    position_weight: float
    velocity_weight: float
    angle_weight: float
    input_weight: float
    tolerance: float
    max_iterations: int
    fallback: str
    model: Model
    observer: ObserverTuning | None = None
    law: str = LAWS[0]
    pd: tuple[float, float] = (0.0, 0.0)
    period: float | None = None
    solver: str = SOLVERS[0]

    def __post_init__(self) -> None:
        for name, count in (("horizon", self.horizon), ("max_iterations", self.max_iterations)):
            if isinstance(count, bool) or not isinstance(count, int) or count < 1:
                raise ValueError(f"{name} = {count!r} must be a whole number of at least 1")
        if self.law not in LAWS:
            raise ValueError(f"law is {self.law!r}, expected one of {', '.join(LAWS)}")
        for name in ("position_weight", "input_weight", "tolerance"):
            checked_number(name, getattr(self, name), above=0.0)
        for name in ("velocity_weight", "angle_weight"):
            checked_number(name, getattr(self, name), minimum=0.0)
        if self.fallback not in FALLBACKS:
            raise ValueError(f"fallback is {self.fallback!r}, expected one of {', '.join(FALLBACKS)}")
        if self.solver not in SOLVERS:
            raise ValueError(f"solver is {self.solver!r}, expected one of {', '.join(SOLVERS)}")


@dataclass(frozen=True, eq=False)
class Limits(Frozen):
    """Hard limits on the motors.

    Attributes
    ----------
    rate : float
        Greatest |u| [rad/s].
    rate_change : float
        Greatest |u_k - u_{k-1}| between control periods [rad/s].
    angle_lower, angle_upper : ndarray, shape (n,)
        Least and greatest motor angles [rad].
    """

    rate: float
    rate_change: float
    angle_lower: np.ndarray
    angle_upper: np.ndarray

    def __post_init__(self) -> None:
        # Infinite limits are none; written so that NaN is refused.
        if not (self.rate > 0 and self.rate_change > 0):
            raise ValueError(f"rate = {self.rate} and rate_change = {self.rate_change} must be positive")
        lower, upper = np.asarray(self.angle_lower), np.asarray(self.angle_upper)
        if lower.ndim != 1 or lower.shape != upper.shape or not (lower <= upper).all():
            raise ValueError(f"angle_lower = {lower} and angle_upper = {upper} must be vectors, lower <= upper")
        for name, angles in (("angle_lower", lower), ("angle_upper", upper)):
            object.__setattr__(self, name, angles.astype(float))  # a copy, the limits' own
        super().__post_init__()

    def clipped(self, u: np.ndarray, u_previous: np.ndarray) -> np.ndarray:
        """Rates nearest to u that meet the limits on rate and change exactly; OSQP meets them to its tolerance."""
        rate, change = self.rate, self.rate_change  # on a few floats Python is faster than NumPy
        pairs = zip(u.tolist(), u_previous.tolist(), strict=True)
        return np.array(
            [max(-rate, min(rate, max(before - change, min(before + change, now)))) for now, before in pairs]
        )

    def within_stops(self, u: np.ndarray, q: np.ndarray, dt: float) -> np.ndarray:
        """Rates nearest to u that keep the angles within their limits for one period."""
        each = zip(u.tolist(), q.tolist(), self.angle_lower.tolist(), self.angle_upper.tolist(), strict=True)
        return np.array([max((low - at) / dt, min((high - at) / dt, rate)) for rate, at, low, high in each])

    def met_by(self, u: np.ndarray, u_previous: np.ndarray) -> tuple[str, ...]:
        """Which limits the clipped rates u meet: on the rate, on its change, or else on an angle."""
        met = {"rate": np.abs(u) >= self.rate, "rate change": np.abs(u - u_previous) >= self.rate_change - 1e-12}
        return tuple(kind for kind, where in met.items() if where.any()) or ("angle",)


def load_tuning(path: str | Path) -> Tuning:
    """Read a controller tuning from TOML (see ``controllers/default.toml``).

    Raises
    ------
    ModelError
        A key is missing, misspelt, of the wrong type or out of range.
    """
    with (
        read_toml(path) as file,
        file.table("weights", {}) as weights,
        file.table("pd", {}) as pd,
        file.table("solver", {}) as solver,
        file.table("model", {}) as model,
        file.table("observer", {}) as observer,
    ):
        observed = observer.boolean("on", False)
        noise = ObserverTuning(
            tip_noise=observer.number("tip_noise", ObserverTuning.tip_noise, above=0.0),
            force_noise=observer.number("force_noise", ObserverTuning.force_noise, above=0.0),
            force_walk=observer.number("force_walk", ObserverTuning.force_walk, above=0.0),
        )
        law = file.text("law", LAWS[0], choices=LAWS)
        predicts, weighs = law.endswith("mpc"), law.endswith("mpc") or law == "lqr"
        gains = (pd.number("position"), pd.number("velocity", 0.0)) if law == "pd" else (0.0, 0.0)
        period = file.number("period", 0.0, minimum=0.0)
        return Tuning(
            name=file.text("name"),
            law=law,
            period=period or None,
            pd=gains,
            horizon=file.integer("horizon") if predicts else 1,
            position_weight=weights.number("position", above=0.0) if weighs else 1.0,
            velocity_weight=weights.number("velocity", 0.0, minimum=0.0),
            angle_weight=weights.number("angle", 0.0, minimum=0.0),
            input_weight=weights.number("input", above=0.0) if weighs else 1.0,
            tolerance=solver.number("tolerance", 1e-5, above=0.0),
            max_iterations=solver.integer("max_iterations", 4000),
            fallback=solver.text("fallback", FALLBACKS[0], choices=FALLBACKS),
            solver=solver.text("name", SOLVERS[0], choices=SOLVERS),
            model=Model(
                method=model.text("method", Model.method, choices=METHODS),
                segments=model.integer("segments", Model.segments),
                steps=model.integer("steps", Model.steps),
                scheme=model.text("scheme", Model.scheme, choices=SCHEMES),
                inertia=model.text("inertia", Model.inertia, choices=INERTIAS),
                linearise=model.text("linearise", Model.linearise, choices=LINEARISE),
                payload=model.boolean("payload", Model.payload),
                predict_delay=model.boolean("predict_delay", Model.predict_delay),
            ),
            observer=noise if observed else None,
        )
