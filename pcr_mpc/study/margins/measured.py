"""Margins of the loop that runs: bisection in the nonlinear simulation, by whether a small push grows or dies away."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from tqdm import tqdm

from ... import interrupt
from ...control.tuning import Tuning
from ...errors import MarginsError, PCRError, SimulationError, UnstableError
from ...loop.controller.make_controller import make_controller
from ...loop.controller.tracking import TrackingController
from ...loop.demand.feed_forward import InverseDynamics
from ...loop.parts.controllers import Decision
from ...loop.references.trajectory import Hold
from ...loop.run.run import Run
from ...loop.run.simulate import simulate
from ...loop.scene.scene import Scene
from ...plant.statics.equilibrium import Equilibrium
from .poses import LINEAR_LAWS

_PERIODS = 300  # that a pose is held
_PUSH = 1e-5  # of the shortest rod, by which the tip would move in a period
_FLOOR = 1e-3  # of the largest deviation: below, what is left of a push is the solver's tolerance
_FAR = 1e-3  # of the shortest rod: no such way of a small push has died away
_ASTRAY, _DIVERGED = 0.25, 1e-2  # of it: a run so far from its reference, or from the one without a push, is lost
_GONE = "from where it should be"
_LOST = 30.0  # times the largest deviation of the first third
_TOLERANCE = 0.01  # of a margin
_STEP, _FURTHEST = 1.15, 6.0  # from one try to the next, and from the guess at most


@dataclass(frozen=True)
class Measured:
    """A measured margin.

    Attributes
    ----------
    value : float
        [s], or a factor; infinite if the loop bore all that was tried, what is nominal if it is not stable as it is.
    pairs : int
        Of simulations that it took.
    """

    value: float
    pairs: int

    def summary(self) -> dict[str, Any]:
        """Ready for JSON."""
        return {"value": self.value if math.isfinite(self.value) else None, "pairs": self.pairs}


def held_scene(scene: Scene, p: tuple[float, float]) -> Scene:
    """The scene with a robot that holds the tip at p [m], in the working mode of its start, for 300 periods."""
    mode, duration = scene.start().mode, _PERIODS * scene.period
    return replace(scene, trajectory=Hold(p), start_tip=p, start_mode=mode, start_motors=None,
                   start_velocity=(0.0, 0.0), duration=duration, payload=None)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Pushed:
    """What became of a small push (see `PushTest`).

    Attributes
    ----------
    dies_away : bool
    run : Run or None
        Without the push; None if it could not begin.
    failure : str
        Of a run that ended early; empty if none did.
    """

    dies_away: bool
    run: Run | None
    failure: str = ""


class PushTest:
    """Pushes of robots that one controller drives: what it is made of is made once.

    Two runs of the nonlinear simulation differ by a small push of the tip at the start alone. The push dies away if
    less of their difference is left in the last third of the time than in the second, or next to nothing. A run ends at
    once where it is lost beyond doubt.

    Parameters
    ----------
    believed : Scene
        Of which the controller is made, with its tuning.
    """

    def __init__(self, believed: Scene) -> None:
        # Encoder steps are left out of the runs, and no estimate is to rest between two of them. What a solver with a
        # tolerance leaves of a small push is no property of the loop: DAQP solves to rounding.
        assert believed.tuning is not None
        self._believed = replace(believed, angle_step=0.0, tuning=replace(believed.tuning, solver="daqp"))
        self._controller = self._made()

    def _made(self, reference: InverseDynamics | None = None) -> TrackingController:
        controller = make_controller(self._believed, reference=reference)
        assert isinstance(controller, TrackingController)
        return controller

    def __call__(self, true: Scene) -> Pushed:
        """Push the robot of a scene."""
        shortest = float(true.robot.lengths.min())
        quiet = replace(true, tip_noise=0.0, angle_step=0.0, deadline=math.inf)
        speed, (x, y) = _PUSH * shortest / true.period, quiet.start_velocity
        assert quiet.trajectory is not None
        run, failure = self._run(quiet, quiet.trajectory(quiet.period * np.arange(quiet.n_periods))[:, 0],
                                 _ASTRAY * shortest)  # fmt: skip
        if run is None or failure:
            return Pushed(False, run, failure)
        pushed = replace(quiet, start_velocity=(x + speed, y + speed))
        other, failure = self._run(pushed, run.measured[:, :2], _DIVERGED * shortest)
        if other is None or failure:
            return Pushed(False, run, "" if failure.endswith(_GONE) else failure)
        deviations = np.linalg.norm(run.x[:, :2] - other.x[:, :2], axis=1)
        first, second, last = (float(np.sqrt(np.mean(part**2))) for part in np.array_split(deviations, 3))
        largest = float(deviations[: len(deviations) // 3].max())
        grown = last >= _LOST * first or last >= _FAR * shortest
        return Pushed(not grown and (last < second or last < _FLOOR * largest), run)

    def _run(self, scene: Scene, tips: np.ndarray, furthest: float) -> tuple[Run | None, str]:
        """Run until the measured tip is further than that from ``tips``, one a period [m]; why it ended early."""
        watched = _Watched(self._controller, tips, furthest)
        try:
            return simulate(scene, scene.make_plant(), watched), ""
        except PCRError as error:  # a robot that is lost, or cannot stand at all
            interrupt.pass_on(error)
            return error.run if isinstance(error, SimulationError) else None, str(error)
        finally:
            if watched.started:
                self._controller = self._made(self._controller.reference)


class _Watched:
    """A controller that ends the run where the tip is too far from where it is expected."""

    def __init__(self, controller: TrackingController, tips: np.ndarray, furthest: float) -> None:
        self.name, self._controller, self._tips, self._furthest = controller.name, controller, tips, furthest
        self.started = False

    def start(self, pose: Equilibrium) -> None:
        self._controller.start(pose)
        self.started = True

    def step(self, k: int, x: np.ndarray) -> Decision:
        if float(np.hypot(*(x[:2] - self._tips[k]))) > self._furthest:  # not a number: no picture
            raise UnstableError(f"the tip is more than {1e3 * self._furthest:.3g} mm {_GONE}")
        return self._controller.step(k, x)


def push_dies_away(believed: Scene, true: Scene) -> bool:
    """Whether a small push dies away (see `PushTest`)."""
    return PushTest(believed)(true).dies_away


def measure_delay_margin(
    scene: Scene,
    tuning: Tuning | None = None,
    *,
    p: tuple[float, float] | None = None,
    guess: float | None = None,
    progress: bool = False,
) -> Measured:
    """Further delay that a loop bears, by bisection in the nonlinear simulation.

    Parameters
    ----------
    scene : Scene
    tuning : Tuning, optional
        Instead of the scene's own.
    p : (float, float), optional
        Tip that is held [m]. None: the scene's reference is followed.
    guess : float, optional
        About which it is looked for [s], as `predict_delay_margin` finds it. None: a control period.
    progress : bool

    Returns
    -------
    Measured
        To 1 % [s].

    Raises
    ------
    MarginsError
        There is no loop (see `predict_margins`).
    """
    scene = _tuned(scene, tuning)
    here = scene if p is None else held_scene(scene, p)

    test = PushTest(here)

    def holds(time: float) -> bool:
        return test(replace(here, untold_delay=here.untold_delay + time)).dies_away

    about = guess if guess and math.isfinite(guess) else scene.period
    return _measured(holds, 0.0, about, f"{'along the path' if p is None else 'held'}: delay", progress)


def measure_largest(
    scene: Scene,
    change: Callable[[Scene, float], Scene],
    *,
    p: tuple[float, float],
    nominal: float,
    guess: float,
    desc: str = "",
    progress: bool = False,
) -> Measured:
    """Largest value of what ``change`` makes of the true scene, from ``nominal`` up, for a tip that is held at p [m];
    else as `measure_delay_margin`.

    ``scene`` has its tuning; a ``guess`` that is infinite is taken for the double of what is nominal.
    """
    here = held_scene(scene, p)
    about = guess if math.isfinite(guess) and guess > nominal else 2.0 * nominal or scene.period
    test = PushTest(here)
    return _measured(lambda value: test(change(here, value)).dies_away, nominal, about, desc, progress)


def _measured(holds: Callable[[float], bool], nominal: float, guess: float, desc: str, progress: bool) -> Measured:
    """Where a property is lost, looked for from the guess down to where it holds or up to where it does not."""
    count = [0]  # a hidden bar does not count
    with tqdm(desc=desc, unit="pair", disable=not progress) as bar:

        def held(share: float) -> bool:
            interrupt.check()
            count[0] += 1
            bar.update()
            return holds(nominal + share * (guess - nominal))

        low = high = 1.0
        if held(1.0):
            while high < _FURTHEST:
                high *= _STEP
                if not held(high):
                    break
                low = high
            else:
                return Measured(math.inf, count[0])
        else:
            while low > 1.0 / _FURTHEST:
                low /= _STEP
                if held(low):
                    break
                high = low
            else:
                low = 0.0
                if not held(low):
                    return Measured(nominal, count[0])
        while high - low > _TOLERANCE * high:
            middle = (low + high) / 2
            low, high = (middle, high) if held(middle) else (low, middle)
        return Measured(nominal + low * (guess - nominal), count[0])


def _tuned(scene: Scene, tuning: Tuning | None) -> Scene:
    tuning = tuning or scene.tuning
    if scene.trajectory is None or tuning is None or tuning.law not in LINEAR_LAWS:
        raise MarginsError(f"scene {scene.name} has no loop to measure: it needs a reference, and one of the laws "
                           f"{', '.join(LINEAR_LAWS)}")  # fmt: skip
    return scene.tuned(tuning)
