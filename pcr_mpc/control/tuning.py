"""What a controller is told: its weights, and its solver's settings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..errors import ModelError, checked_integer, checked_number, checked_vector
from ..files import name_problem
from ..methods import METHODS
from ..toml_table import Table, read_toml
from .observer import ObserverTuning

SCHEMES = ("rk4", "rk8")
LAWS = ("linear_mpc", "nonlinear_mpc", "lqr", "pd", "feed_forward")
# Single shooting is no graph, and keeps to no branch.
PREDICTING = tuple(method for method in METHODS if method != "single_shooting")
LINEARISE = ("here", "along_plan")
INERTIAS = ("none", "constant", "condensed")
FALLBACKS = ("ladder", "raise")
ANGLES = ("measured", "commanded")
# Matrices grow with the square of the horizon: at this one they are made in half a minute.
LONGEST_HORIZON = 400
SOLVERS = ("osqp", "daqp")


@dataclass(frozen=True)
class Model:
    """What the controller predicts with.

    Attributes
    ----------
    method : {"closed_form", "multiple_shooting"}, optional
        Statics of the rods. None: the closed form where the robot's rods have one, else multiple shooting.
    segments, steps, scheme
        Discretisation of rods that are shot (see `solve_statics`).
    inertia : {"none", "constant", "condensed"}
        Of the rods (see `Plant`).
    linearise : {"here", "along_plan"}
        Once, at the current state, or at every period of the last plan (real-time iteration).
    payload : bool
        Follow the scene's time table of what the tip carries, in the feed-forward and in what is linearised.
    predict_delay : bool
        Plan from where the commands that are on the way will have brought the robot.
    angles : {"measured", "commanded"}
        Plan from the measured motor angles; or from those to which the commands lead, to which the measured ones pull
        slowly. Then a motor that lags or is late, by whatever time, is not told to turn twice; and what the motors do
        is no surprise to the observer.
    motor_lag : float
        Time by which the motors are known to be late, or to lag, with "commanded" angles [s]. It is where the fit to
        their measured angles begins.
    compiled : bool
        Run as machine code where there is a C compiler: the same numbers, several times faster.
    """

    method: str | None = None
    segments: int = 8
    steps: int = 1
    scheme: str = "rk8"
    inertia: str = "none"
    linearise: str = "here"
    payload: bool = True
    predict_delay: bool = True
    angles: str = ANGLES[0]
    motor_lag: float = 0.0
    compiled: bool = True

    def __post_init__(self) -> None:
        for name in ("segments", "steps"):
            object.__setattr__(self, name, checked_integer(name, getattr(self, name)))
        for name, choices in (
            *((("method", PREDICTING),) if self.method is not None else ()),
            ("scheme", SCHEMES),
            ("inertia", INERTIAS),
            ("linearise", LINEARISE),
            ("angles", ANGLES),
        ):
            _check_choice(name, getattr(self, name), choices)
        object.__setattr__(self, "motor_lag", checked_number("motor_lag", self.motor_lag, minimum=0.0))
        if self.motor_lag and self.angles == "measured":
            raise ModelError(
                f"motor_lag is {self.motor_lag} s, and measured angles know none: set angles = 'commanded'",
                key="angles",
            )


@dataclass(frozen=True)
class LearningTuning:
    """How the feed-forward is learnt from lap to lap.

    Attributes
    ----------
    gain : float
        Share of a lap's error that is taken off the next one, at most 1.
    bandwidth : float
        Of what is learnt [Hz].
    """

    gain: float = 0.7
    bandwidth: float = 4.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "gain", checked_number("gain", self.gain, above=0.0, maximum=1.0))
        object.__setattr__(self, "bandwidth", checked_number("bandwidth", self.bandwidth, above=0.0))


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
        Of the QP's solver, absolute and relative; the absolute one is of angles turned in a hundred periods [rad],
        which at 10 ms are rates in rad/s.
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
    learning : LearningTuning or None
        Of a reference that comes round. None: every lap is as the first.
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
    learning: LearningTuning | None = None

    def __post_init__(self) -> None:
        for name, count in (("horizon", self.horizon), ("max_iterations", self.max_iterations)):
            object.__setattr__(self, name, checked_integer(name, count))
        if problem := name_problem(self.name):
            raise ModelError(f"name: {problem}", key="name")
        if problem := _horizon_problem(self.horizon):
            raise ModelError(f"horizon {problem}", key="horizon")
        _check_choice("law", self.law, LAWS)
        for name in ("position_weight", "input_weight", "tolerance"):
            object.__setattr__(self, name, checked_number(name, getattr(self, name), above=0.0))
        for name in ("velocity_weight", "angle_weight"):
            object.__setattr__(self, name, checked_number(name, getattr(self, name), minimum=0.0))
        _check_choice("fallback", self.fallback, FALLBACKS)
        _check_choice("solver", self.solver, SOLVERS)
        object.__setattr__(self, "pd", tuple(checked_vector("pd", self.pd, 2).tolist()))
        if self.period is not None:
            object.__setattr__(self, "period", checked_number("period", self.period, above=0.0))


def time_unit(dt: float) -> float:
    """Unit of time of a problem with control period dt, a hundred periods [s].

    What a solver is handed, and its tolerances, are counted in it, lest they mean something else where everything is
    quicker. At 10 ms it is a second.
    """
    return 100.0 * dt


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name} is {value!r}, expected one of {', '.join(choices)}")


def _horizon_problem(horizon: int) -> str | None:
    if horizon <= LONGEST_HORIZON:
        return None
    return f"is {horizon}, expected at most {LONGEST_HORIZON}; take a longer period to look further"


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
        file.table("learning", {}) as learning,
    ):
        observed = observer.boolean("on", False)
        noise = ObserverTuning(
            tip_noise=observer.number("tip_noise", ObserverTuning.tip_noise, above=0.0),
            force_noise=observer.number("force_noise", ObserverTuning.force_noise, above=0.0),
            force_walk=observer.number("force_walk", ObserverTuning.force_walk, above=0.0),
            adapts=observer.texts("adapts") if observer.has("adapts") else (),
            adapt_walk=observer.number("adapt_walk", ObserverTuning.adapt_walk, above=0.0),
            latency=observer.number("latency", ObserverTuning.latency, minimum=0.0),
        )
        law = file.text("law", LAWS[0], choices=LAWS)
        predicts, weighs = law.endswith("mpc"), law.endswith("mpc") or law == "lqr"
        gains = (pd.number("position"), pd.number("velocity", 0.0)) if law == "pd" else (0.0, 0.0)
        period = file.number("period", 0.0, minimum=0.0)
        horizon, name = file.integer("horizon") if predicts else 1, file.text("name")
        if problem := name_problem(name):
            raise file.fail("name", problem)
        if problem := _horizon_problem(horizon):
            raise file.fail("horizon", problem)
        return Tuning(
            name=name,
            law=law,
            period=period or None,
            pd=gains,
            horizon=horizon,
            position_weight=weights.number("position", above=0.0) if weighs else 1.0,
            velocity_weight=weights.number("velocity", 0.0, minimum=0.0),
            angle_weight=weights.number("angle", 0.0, minimum=0.0),
            input_weight=weights.number("input", above=0.0) if weighs else 1.0,
            tolerance=solver.number("tolerance", 1e-5, above=0.0),
            max_iterations=solver.integer("max_iterations", 4000),
            fallback=solver.text("fallback", FALLBACKS[0], choices=FALLBACKS),
            solver=solver.text("name", SOLVERS[0], choices=SOLVERS),
            model=Model(
                method=model.text("method", None, choices=PREDICTING),
                segments=model.integer("segments", Model.segments),
                steps=model.integer("steps", Model.steps),
                scheme=model.text("scheme", Model.scheme, choices=SCHEMES),
                inertia=model.text("inertia", Model.inertia, choices=INERTIAS),
                linearise=model.text("linearise", Model.linearise, choices=LINEARISE),
                payload=model.boolean("payload", Model.payload),
                predict_delay=model.boolean("predict_delay", Model.predict_delay),
                angles=model.text("angles", Model.angles, choices=ANGLES),
                motor_lag=model.number("motor_lag", Model.motor_lag, minimum=0.0),
                compiled=model.boolean("compiled", Model.compiled),
            ),
            observer=noise if observed else None,
            learning=_learning(learning),
        )


def _learning(table: Table) -> LearningTuning | None:
    on = table.boolean("on", False)
    found = LearningTuning(
        gain=table.number("gain", LearningTuning.gain, above=0.0, maximum=1.0),
        bandwidth=table.number("bandwidth", LearningTuning.bandwidth, above=0.0),
    )
    return found if on else None
