"""How long the parts of the loop take, each on its own and back to back, against the budgets of real time."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from .. import interrupt
from ..compiled import has_compiler
from ..loop.feed_forward import feed_forward
from ..loop.run import Run
from ..loop.scene import Scene
from ..loop.simulate import simulate
from ..loop.tracking import TrackingController, make_controller
from ..methods import METHODS
from ..plant.dynamics import DERIVATIVE_ACCURACY, Plant
from .machine import machine, versions
from .overhead import call_overhead
from .stopwatch import WARM_UP, Times, distribution, measure

PLANT_HZ = (1000.0,)
CONTROL_HZ = (100.0, 200.0, 500.0)
# Fewer calls of what is slow say as much.
_SHARE = {"closed_form": 1.0, "multiple_shooting": 0.2, "single_shooting": 0.01}
PARTS = ("linearise", "QP update", "QP handed over", "inside OSQP", "observer", "rest")
_BINS = np.geomspace(1.0, 1e5, 101)  # us


def time_scene(scene: Scene, steps: int = 100_000, *, progress: bool = False) -> dict[str, Any]:
    """Measure plant steps, the linearisation's solves and control steps along a closed-loop run of a scene.

    Everything is replayed on the states and inputs of that run, over and over, back to back. Plant steps are those of
    the scene's plant, and with every statics method velocity Verlet at 1 ms (one force evaluation each).

    Parameters
    ----------
    steps : int
        Plant steps, and control steps; a fifth and a hundredth of them by multiple and single shooting.

    Returns
    -------
    dict
        ``components``: list of {name, method, p50, p95, p99, p99.9, max, mean, n} in us of wall time without the first
        20 calls, and of the steps themselves ``cpu`` (the same of CPU time), ``first`` (those 20), ``collector_on``,
        ``collector_off``, ``collections``, ``interrupted`` and ``misses`` (see `stopwatch`); plant steps also have
        ``force_error``, the largest relative error of F along the run. ``histogram``: counts of the steps by time.
        ``control_parts``: mean times [us] of what a control step consists of, and ``iterations``: times [us] by number
        of QP iterations, both of steps that nobody interrupted. ``overhead``: see `call_overhead`. ``machine``, with
        its load before and after; ``versions``.
    """
    before = machine()
    scene = replace(scene, duration=max(scene.duration, 3 * WARM_UP * scene.period))
    controller = make_controller(scene)
    run = simulate(scene, scene.make_plant(), controller, progress=progress)
    components: list[dict[str, Any]] = []
    result: dict[str, Any] = {"scene": scene.name, "components": components}
    histogram = {}

    own = _plant_times(scene.make_plant(), scene, run, steps, "plant step" if progress else None)
    components.append(own.record("plant step of the scene", run.plant, (1 / scene.plant.dt,)))
    histogram["plant step"] = own
    for plant, kind in _plants(scene):
        n = max(WARM_UP + 10, round(steps * _SHARE[plant.method]))
        times = _plant_times(plant, scene, run, n, f"plant, {kind}" if progress else None)
        component = times.record("plant step", kind, PLANT_HZ)
        components.append({**component, "force_error": _force_error(plant, scene, run)})
        if not plant.compiled:
            components.append(_force_times(plant, run, n).record("F, K and G", kind))
    if isinstance(controller, TrackingController):
        times, parts, iterations = _control_times(scene, run, steps, "control step" if progress else None)
        model = scene.tuning.model.method if scene.tuning else ""
        components.append(times.record("control step", model, CONTROL_HZ))
        components += [{"name": name, "method": model, **distribution(part)} for name, part in parts.items()]
        between = distribution(run.control_time[WARM_UP:, 0])
        components.append({"name": "control step between plant steps", "method": model, **between})
        histogram["control step"] = times
        calm = times.undisturbed
        result["control_parts"] = {name: 1e6 * float(part[calm].mean()) for name, part in parts.items()}
        wall = times.wall[WARM_UP:]
        result["iterations"] = [
            {"iterations": int(count), **distribution(wall[calm & (iterations == count)])}
            for count in np.unique(iterations[calm])
        ]
    result["histogram"] = {"edges_us": _BINS.tolist(), **{name: _counts(times) for name, times in histogram.items()}}
    result["overhead"] = call_overhead(scene.robot, run.pose)
    after = machine()
    return {**result, "machine": {**before, "load_after": after["load"]}, "versions": versions()}


def _counts(times: Times) -> dict[str, list[int]]:
    """Steps by their time, with the collector on and off; what is beyond the ends counts at the ends."""
    us = np.clip(1e6 * times.wall[WARM_UP:], _BINS[0], _BINS[-1])
    on = times.collecting[WARM_UP:]
    found = {"collector on": us[on], "collector off": us[~on]}
    return {name: np.histogram(values, _BINS)[0].tolist() for name, values in found.items()}


def _plants(scene: Scene) -> list[tuple[Plant, str]]:
    """Plants by method, and what to call that; the fastest also as machine code where there is a compiler."""
    methods = METHODS if scene.robot.needs_shooting is None else ("multiple_shooting",)
    settings = scene.plant
    common: dict[str, Any] = {"integrator": "velocity_verlet", "dt": 1e-3, "segments": settings.segments,
                              "steps": settings.steps, "scheme": settings.scheme}  # fmt: skip
    plants = [(Plant(scene.robot, method=method, **common), method) for method in methods]
    if has_compiler():
        plants.insert(1, (Plant(scene.robot, method=methods[0], compiled=True, **common), f"{methods[0]}, compiled"))
    return plants


def _plant_times(plant: Plant, scene: Scene, run: Run, n: int, label: str | None) -> Times:
    """Times of n plant steps; when the run's inputs are used up, it starts again from the beginning."""
    per = max(1, round(scene.period / plant.dt))
    lap = len(run.u) * per
    x = run.x[0]

    def restart(k: int) -> None:
        nonlocal x
        if k % lap == 0:
            x = run.x[0]
            plant.reset(x, run.pose)

    def step(k: int) -> None:
        nonlocal x
        x = plant.step(x, run.u[k % lap // per], scene.force)

    return measure(step, n, restart, label)


def _force_times(plant: Plant, run: Run, n: int) -> Times:
    """Times of n warm solves for force and Jacobians along the run, as the controller's linearisation calls them."""

    def restart(k: int) -> None:
        if k % len(run.x) == 0:
            plant.reset(run.x[0], run.pose)

    def solve(k: int) -> None:
        x = run.x[k % len(run.x)]
        plant.force_and_jacobians(x[:2], x[4:], DERIVATIVE_ACCURACY)

    return measure(solve, n, restart)


def _force_error(plant: Plant, scene: Scene, run: Run) -> float:
    """Largest error of F along the run against the closed form, relative to the rods' forces."""
    exact = Plant(scene.robot)
    worst = 0.0
    exact.reset(run.x[0], run.pose)
    plant.reset(run.x[0], run.pose)
    for x in run.x[:: run.steps_per_period][:200]:
        interrupt.check()
        eq = exact.equilibrium(x)
        error = np.linalg.norm(plant.force(x[:2], x[4:]) - eq.force)
        worst = max(worst, float(error / np.linalg.norm(eq.rod_forces)))
    return worst


class _TimedObserver:
    """An observer that keeps the time of what it does."""

    def __init__(self, observer: Any) -> None:
        self._observer, self.spent = observer, 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._observer, name)

    def correct(self, *arguments: Any) -> None:
        self._clocked(self._observer.correct, *arguments)

    def predict(self, *arguments: Any) -> None:
        self._clocked(self._observer.predict, *arguments)

    def _clocked(self, call: Any, *arguments: Any) -> None:
        began = time.perf_counter()
        call(*arguments)
        self.spent += time.perf_counter() - began


def _control_times(
    scene: Scene, run: Run, n: int, label: str | None
) -> tuple[Times, dict[str, np.ndarray], np.ndarray]:
    """Times of n control steps on the states of the run, what they consist of, and QP iterations; without warm-up."""
    assert scene.tuning is not None
    tail = scene.tuning.horizon + scene.delay
    known = scene if scene.tuning.model.payload else replace(scene, payload=None)
    reference = feed_forward(known, scene.robot, run.pose, tail, scene.tuning.model.inertia)
    controller = make_controller(scene, reference=reference)
    assert isinstance(controller, TrackingController)
    states, lap = run.x[:: run.steps_per_period], len(run.u)
    parts, iterations = np.zeros((n, len(PARTS))), np.zeros(n, dtype=int)
    observer = _TimedObserver(None)

    def restart(k: int) -> None:
        nonlocal observer
        if k % lap == 0:
            controller.start(run.pose)
            observer = _TimedObserver(controller.observer)
            if controller.observer is not None:
                controller.observer = observer  # type: ignore[assignment]
        observer.spent = 0.0

    def step(k: int) -> None:
        decision = controller.step(k % lap, states[k % lap])
        plan = decision.plan
        assert plan is not None
        parts[k, :4] = (decision.linearise_time, plan.update_time, plan.solve_time - plan.solver_time, plan.solver_time)
        parts[k, 4] = observer.spent
        iterations[k] = plan.iterations

    times = measure(step, n, restart, label)
    parts[:, 5] = times.wall - parts[:, :5].sum(axis=1)
    parts = parts[WARM_UP:]
    return times, {name: parts[:, i] for i, name in enumerate(PARTS)}, iterations[WARM_UP:]
