"""The choice of the physics that a scene needs: rungs measured on the scene's own motion, the lowest that will do."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from tqdm import tqdm

from ... import interrupt
from ...errors import NoRungError, PCRError, SimulationError
from ...loop.controller.make_controller import make_controller
from ...loop.parts.controllers import Replay
from ...loop.run.run import Run
from ...loop.run.simulate import simulate
from ...loop.scene.scene import Scene
from ...loop.scene.settings import Need, PlantSettings
from ...plant.uncertainty import Uncertainty
from .estimates import Estimate, Estimates
from .numbers_cost import NumbersCost, numbers_cost
from .rungs import all_physics, discretisations, height, named

# The yardstick's step: omega dt at most this for the fastest swing of the tip, within these parts of a period.
_SMALL_STEP, _PARTS = 0.2, (10, 20, 40)


@dataclass(frozen=True, eq=False)
class Measured:
    """A rung on the scene's motion.

    Attributes
    ----------
    rung : PlantSettings
    error : float
        Largest distance of the tip from the yardstick's [m]; infinite if it failed.
    step_time : float
        Of a plant step, median [s].
    failure : str
        Why it did not get to the end.
    tips : ndarray, shape (K + 1, 2)
        At its own steps [m], if it got to the end.
    """

    rung: PlantSettings
    error: float
    step_time: float
    failure: str = ""
    tips: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))


@dataclass(frozen=True)
class Choice:
    """What was measured, and what follows.

    Attributes
    ----------
    scene : Scene
    estimates : Estimates
    yardstick : PlantSettings
        The highest rung that is available: the one that leaves out least, as far as estimates go.
    lacking : dict
        What the yardstick leaves out, as estimated; it is added to every error.
    step_error : float
        Of the yardstick: what twice its time step changes [m].
    unavailable : list of (PlantSettings, str)
        Rungs that the plant refuses, and why.
    physics, discretisations : list of Measured
        Every physics in its best discretisation, lowest first; of the one chosen cheaper discretisations, up to the one
        that was taken.
    control_step : float or None
        Of a control step with the scene's tuning, median [s]. None: nothing is controlled.
    chosen : Measured
    numbers : NumbersCost or None
        What the robot's numbers cost on the same motion, because they are not known better. None: it cannot be told.
    """

    scene: Scene
    estimates: Estimates
    yardstick: PlantSettings
    lacking: dict[str, Estimate]
    step_error: float
    unavailable: list[tuple[PlantSettings, str]]
    physics: list[Measured]
    discretisations: list[Measured]
    control_step: float | None
    chosen: Measured
    numbers: NumbersCost | None = None

    @property
    def unmeasured(self) -> float:
        """What the yardstick itself may be off [m]."""
        return self.step_error + sum(estimate.error for estimate in self.lacking.values())

    @property
    def tip_error(self) -> float:
        """Of the chosen rung: measured, and what the yardstick may be off [m]."""
        return self.chosen.error + self.unmeasured

    def worth_its_time(self, one: Measured) -> bool:
        """Whether a physics is no finer than the numbers deserve: none below it is within a third of what they cost."""
        if self.numbers is None:
            return True
        below = self.physics[: self.physics.index(one)]
        return not any(other.error + self.unmeasured <= self.numbers.least for other in below)


class Bench:
    """Measures rungs on one motion: a closed-loop run on the yardstick, whose motor rates are given to every rung.

    Parameters
    ----------
    scene : Scene

    Raises
    ------
    PCRError
        The scene cannot be run on any rung.
    """

    def __init__(self, scene: Scene) -> None:
        # Whether a decision comes late is not on trial, and would not be repeatable.
        self.scene = replace(scene, deadline=math.inf)
        pose = scene.start()
        self.estimates = Estimates(scene, pose)
        dt = next((scene.period / n for n in _PARTS if self.estimates.fastest * scene.period / n <= _SMALL_STEP),
                  scene.period / _PARTS[-1])  # fmt: skip
        self.rungs: list[PlantSettings] = []
        self.unavailable: list[tuple[PlantSettings, str]] = []
        x = np.concatenate([pose.p, scene.start_velocity, pose.q])
        for rung in all_physics(scene, dt):
            interrupt.check()
            try:
                plant = rung.make(scene.robot)
                plant.reset(x, pose)
                plant.step(x, np.zeros(scene.robot.n_rods))
                self.rungs.append(rung)
            except (PCRError, ValueError) as error:
                self.unavailable.append((rung, str(error)))
        if not self.rungs:
            raise NoRungError(f"{scene.name}: no rung can be simulated: {self.unavailable[-1][1]}", need=scene.need)
        self.yardstick = min(self.rungs, key=lambda rung: (self.estimates.total(rung), -height(scene, rung)))
        self._run = self._simulate(self.yardstick, None)
        self._best = Measured(self.yardstick, 0.0, float(np.median(self._run.plant_time)), tips=self._run.x[:, :2])
        self.step_error = self.measure(replace(self.yardstick, dt=2 * dt)).error

    def numbers_cost(self, known: Uncertainty | None) -> NumbersCost | None:
        """What the robot's numbers cost on the same motion (see `numbers_cost`)."""
        return numbers_cost(self._run, self.estimates.fastest, known)

    @property
    def control_step(self) -> float | None:
        """Median time of a control step [s]."""
        return float(np.median(self._run.control_time[:, 0])) if self.scene.tuning is not None else None

    def measure(self, rung: PlantSettings) -> Measured:
        """Error and time of a rung."""
        try:
            run = self._simulate(rung, self._run.u)
        except SimulationError as error:
            interrupt.pass_on(error)
            times = error.run.plant_time
            return Measured(rung, math.inf, float(np.median(times)) if len(times) else math.nan, str(error))
        measured = Measured(rung, math.nan, float(np.median(run.plant_time)), tips=run.x[:, :2])
        return replace(measured, error=apart(measured, self._best))

    def _simulate(self, rung: PlantSettings, rates: np.ndarray | None) -> Run:
        scene = replace(self.scene, plant=rung)
        controller = make_controller(scene) if rates is None else Replay(rates)
        return simulate(scene, scene.make_plant(), controller)


def apart(one: Measured, other: Measured) -> float:
    """Largest distance of two rungs' tips at the times that both have [m]; infinite if one did not get to the end."""
    coarse, fine = sorted((one, other), key=lambda each: len(each.tips))
    if not len(coarse.tips):
        return math.inf
    stride = (len(fine.tips) - 1) // (len(coarse.tips) - 1)
    return float(np.linalg.norm(coarse.tips - fine.tips[::stride], axis=1).max())


def choose(scene: Scene, *, uncertainty: Uncertainty | None = None, progress: bool = False) -> Choice:
    """Find the lowest rung that a scene needs.

    Parameters
    ----------
    scene : Scene
        With a `Need`.
    uncertainty : Uncertainty, optional
        How well the robot's numbers are known. None: default ranges.
    progress : bool
        Show a progress bar on stderr.

    Raises
    ------
    ValueError
        The scene states no need.
    NoRungError
        No rung meets it.
    """
    if scene.need is None:
        raise ValueError(
            f"scene {scene.name} states no need; give it a [need] table with tip_accuracy [mm], plant_step and "
            "control_step [us]"
        )
    bench = Bench(scene)
    bar = tqdm(bench.rungs, desc="rungs", unit="rung", disable=not progress)
    physics = [bench.measure(rung) for rung in bar]
    lacking = bench.estimates.of(bench.yardstick)
    unmeasured = bench.step_error + sum(estimate.error for estimate in lacking.values())
    tried, chosen = lowest(
        scene, scene.need, physics, bench.measure, unmeasured=unmeasured, control_step=bench.control_step
    )
    return Choice(
        scene, bench.estimates, bench.yardstick, lacking, bench.step_error, bench.unavailable, physics, tried,
        bench.control_step, chosen, bench.numbers_cost(uncertainty),
    )  # fmt: skip


def lowest(
    scene: Scene,
    need: Need,
    physics: Iterable[Measured],
    measure: Callable[[PlantSettings], Measured],
    *,
    unmeasured: float = 0.0,
    control_step: float | None = None,
) -> tuple[list[Measured], Measured]:
    """Pick the lowest physics that is accurate and quick enough in some discretisation, and the cheapest of those.

    Parameters
    ----------
    physics : iterable of Measured
        Rungs from the lowest on, in their best discretisation.
    measure : callable
        Measures a discretisation.
    unmeasured : float
        What the yardstick may be off [m].
    control_step : float or None
        Of a control step [s].

    Returns
    -------
    tried : list of Measured
        Discretisations of the physics chosen, up to the one that was taken.
    chosen : Measured

    Raises
    ------
    NoRungError
        ``need``, ``best_error`` [m] and ``rejected``: the rungs with what each missed.
    """
    allowed = need.tip_accuracy - unmeasured
    rejected: list[str] = []
    best = math.inf
    if control_step is not None and control_step > need.control_step:
        raise NoRungError(
            f"{scene.name}: a control step takes {1e6 * control_step:.0f} us, at most {1e6 * need.control_step:g} are "
            "allowed; take another tuning or a longer period",
            need=need, best_error=best, rejected=rejected,
        )  # fmt: skip
    for candidate in physics:
        best = min(best, candidate.error)
        if candidate.error > allowed:
            rejected.append(f"{named(scene, candidate.rung)} {1e3 * (candidate.error + unmeasured):.3g} mm")
            continue
        tried = []
        for rung in discretisations(scene, candidate.rung):
            tried.append(measure(rung))
            if tried[-1].error <= allowed and tried[-1].step_time <= need.plant_step:
                return tried, tried[-1]
        quickest = min((one.step_time for one in tried if one.error <= allowed), default=math.inf)
        rejected.append(f"{named(scene, candidate.rung)} {1e6 * quickest:.0f} us a step")
    share = f", {1e3 * unmeasured:.2g} mm of each by which the yardstick may be off" if unmeasured else ""
    raise NoRungError(
        f"{scene.name} needs the tip to {1e3 * need.tip_accuracy:g} mm at {1e6 * need.plant_step:g} us a plant step, "
        f"and no rung gives that: {'; '.join(rejected)}{share}. Allow more, or drive the robot more gently",
        need=need, best_error=best + unmeasured, rejected=rejected,
    )  # fmt: skip
