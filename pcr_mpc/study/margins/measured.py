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
from ...errors import MarginsError, PCRError, SimulationError
from ...loop.make_controller import make_controller
from ...loop.run import Run
from ...loop.scene import Scene
from ...loop.simulate import simulate
from ...loop.trajectory import Hold
from .poses import LINEAR_LAWS

_PERIODS = 300  # that a pose is held
_PUSH = 1e-5  # of the shortest rod, by which the tip would move in a period
_FLOOR = 1e-3  # of the largest deviation: below, what is left of a push is the solver's tolerance
_FAR = 1e-3  # of the shortest rod: no such way of a small push has died away
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
    """What became of a small push.

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


def push(believed: Scene, true: Scene) -> Pushed:
    """Push the tip a little at the start of the nonlinear simulation, and see whether that dies away.

    Two runs differ by the push alone. It dies away if less of their difference is left in the last third of the time
    than in the second, or next to nothing.

    Parameters
    ----------
    believed : Scene
        Of which the controller is made, with its tuning.
    true : Scene
        That is simulated.
    """
    speed = _PUSH * float(true.robot.lengths.min()) / true.period
    quiet = replace(true, tip_noise=0.0, angle_step=0.0, deadline=math.inf)
    pushed = replace(quiet, start_velocity=(quiet.start_velocity[0] + speed, quiet.start_velocity[1] + speed))
    runs: list[Run] = []
    for each in (quiet, pushed):
        try:
            runs.append(simulate(each, each.make_plant(), make_controller(believed)))
        except PCRError as error:  # a robot that is lost, or cannot stand at all
            interrupt.pass_on(error)
            ended = runs[0] if runs else error.run if isinstance(error, SimulationError) else None
            return Pushed(False, ended, str(error))
    tips = np.linalg.norm(runs[0].x[:, :2] - runs[1].x[:, :2], axis=1)
    first, second, last = (float(np.sqrt(np.mean(part**2))) for part in np.array_split(tips, 3))
    largest = float(tips[: len(tips) // 3].max())
    grown = last >= _LOST * first or last >= _FAR * float(true.robot.lengths.min())
    return Pushed(not grown and (last < second or last < _FLOOR * largest), runs[0])


def push_dies_away(believed: Scene, true: Scene) -> bool:
    """Whether a small push dies away (see `push`)."""
    return push(believed, true).dies_away


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

    def holds(time: float) -> bool:
        return push_dies_away(here, replace(here, untold_delay=here.untold_delay + time))

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
    return _measured(lambda value: push_dies_away(here, change(here, value)), nominal, about, desc, progress)


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
