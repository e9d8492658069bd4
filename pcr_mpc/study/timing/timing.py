"""How long the parts of the loop take, each on its own and back to back, against the budgets of real time."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ... import interrupt
from ...compiled import has_compiler
from ...errors import PCRError
from ...loop.controller.make_controller import make_controller
from ...loop.controller.tracking import TrackingController
from ...loop.demand.feed_forward import feed_forward
from ...loop.parts.assembled import make_model
from ...loop.run.run import Run
from ...loop.run.simulate import simulate
from ...loop.scene.scene import Scene
from ...methods import METHODS
from ...plant.motion.followed_rods import DERIVATIVE_ACCURACY
from ...plant.motion.plant import Plant
from .machine import machine, versions
from .overhead import call_overhead
from .stopwatch import WARM_UP, Times, distribution, measure

PLANT_HZ = (1000.0,)
CONTROL_HZ = (100.0, 200.0, 500.0)
# Fewer calls of what is slow say as much.
_SHARE = {"closed_form": 1.0, "multiple_shooting": 0.2, "single_shooting": 0.01}
SOLVERS = {"osqp": "OSQP", "daqp": "DAQP"}
_OTHER_SOLVER = 0.2  # share of the control steps that are repeated with another QP solver
_BINS = np.geomspace(1.0, 1e5, 101)  # us


def time_scene(
    scene: Scene, steps: int = 100_000, *, progress: bool = False,
    in_c: Callable[[Scene, str, int], dict[str, Any]] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Measure plant steps, the linearisation's solves and control steps along a closed-loop run of a scene.

    Everything is replayed on the states and inputs of that run, over and over, back to back. Plant steps are those of
    the scene's plant, and with every statics method velocity Verlet at 1 ms (one force evaluation each).

    Parameters
    ----------
    steps : int
        Plant steps, and control steps; a fifth and a hundredth of them by multiple and single shooting.
    in_c : callable, optional
        See `codegen.timing.time_in_c`: times the steps of the same scene in C. None: C is left out.

    Returns
    -------
    dict
        ``components``: list of {name, method, p50, p95, p99, p99.9, max, mean, n} in us of wall time without the first
        20 calls, and of the steps themselves ``cpu`` (the same of CPU time), ``first`` (those 20), ``collector_on``,
        ``collector_off``, ``collections``, ``interrupted`` and ``misses`` (see `stopwatch`); plant steps also have
        ``force_error``, the largest relative error of F along the run. ``histogram``: counts of the steps by time.
        ``control_parts``: mean times [us] of what a control step consists of, and ``iterations``: times [us] by number
        of QP iterations, both of steps that nobody interrupted. ``solvers``: of the linear MPC, the scene's QP solver
        and the others on the same states: {solver, step, inside, iterations, n}, with p50, p99 and max of the
        control step and of the solver [us], and of iterations. ``c``: for each QP solver of the linear MPC {solver,
        worst}, see ``in_c``, or {solver, missing}, why there is no C; its times are among the components, by the
        methods "C, OSQP" and "C, DAQP", closed loop, plant steps in between. ``overhead``: see `call_overhead`.
        ``machine``, with its load before and after; ``versions``.
    """
    before = machine()
    scene = replace(scene, duration=max(scene.duration, 3 * WARM_UP * scene.period))
    controller = make_controller(scene)
    run = simulate(scene, scene.make_plant(), controller, progress=progress)
    components: list[dict[str, Any]] = []
    result: dict[str, Any] = {"scene": scene.name, "components": components}
    histogram: dict[str, Times | dict[str, list[int]]] = {}

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
        model = make_model(scene.robot, scene.tuning.model).method if scene.tuning else ""
        result["solvers"] = _solvers(scene, run, (times, parts, iterations), steps, progress)
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
    result["overhead"] = call_overhead(scene.robot, run.pose)
    if in_c is not None and isinstance(controller, TrackingController):
        result["c"] = _in_c(in_c, scene, steps, components, histogram, progress=progress)
    result["histogram"] = {
        "edges_us": _BINS.tolist(),
        **{name: found if isinstance(found, dict) else _counts(found) for name, found in histogram.items()},
    }
    after = machine()
    return {**result, "machine": {**before, "load_after": after["load"]}, "versions": versions()}


def _solvers(
    scene: Scene, run: Run, own: tuple[Times, dict[str, np.ndarray], np.ndarray], steps: int, progress: bool
) -> list[dict[str, Any]]:
    """Control steps of the linear MPC with every QP solver, side by side; ``own`` are those of the scene's."""
    tuning = scene.tuning
    if tuning is None or tuning.law != "linear_mpc":
        return []
    rows = []
    for solver, name in SOLVERS.items():
        measured = own
        if solver != tuning.solver:
            other = scene.tuned(replace(tuning, solver=solver))
            n = max(WARM_UP + 10, round(steps * _OTHER_SOLVER))
            measured = _control_times(other, run, n, f"control step, {name}" if progress else None)
        times, parts, iterations = measured
        step, inside = times.wall[WARM_UP:], parts[f"inside {name}"]
        rows.append(
            {"solver": name, "step": _tail(1e6 * step), "inside": _tail(1e6 * inside), "iterations": _tail(iterations),
             "n": len(step)}
        )  # fmt: skip
    return rows


def _in_c(
    in_c: Callable[[Scene, str, int], dict[str, Any]], scene: Scene, steps: int, components: list[dict[str, Any]],
    histogram: dict[str, Any], *, progress: bool,
) -> list[dict[str, Any]]:  # fmt: skip
    """Steps in C with every QP solver; adds to ``components``, and the scene's own to ``histogram``."""
    tuning = scene.tuning
    if tuning is None or tuning.law != "linear_mpc":
        return []
    rows = []
    for solver, name in SOLVERS.items():
        own = solver == tuning.solver
        if progress:
            print(f"{scene.name}: C with {name} is generated, compiled and run, half a minute or more; Ctrl-C keeps "
                  "what was measured", file=sys.stderr)  # fmt: skip
        try:
            interrupt.check()
            found = in_c(scene, solver, max(WARM_UP + 10, round(steps * (1.0 if own else _OTHER_SOLVER))))
        except KeyboardInterrupt:  # what was measured is of use without it
            rows.append({"solver": name, "missing": "interrupted"})
            break
        except PCRError as error:
            rows.append({"solver": name, "missing": str(error)})
            continue
        for step in ("plant", "control") if own else ("control",):
            cpu, wall = found[step][WARM_UP:].T
            title = f"{step} step"
            component = {"name": title, "method": f"C, {name}" if step == "control" else "C"}
            components.append({**component, **distribution(wall), "cpu": distribution(cpu)})
            if own:
                histogram[f"{title} in C"] = {"no collector": _binned(1e6 * wall)}
        rows.append({"solver": name, "worst": found["worst"]})
    return rows


def _tail(values: np.ndarray) -> dict[str, float]:
    p50, p99, most = np.percentile(values, [50, 99, 100]).tolist()
    return {"p50": p50, "p99": p99, "max": most}


def _counts(times: Times) -> dict[str, list[int]]:
    """Steps by their time, with the collector on and off."""
    us, on = 1e6 * times.wall[WARM_UP:], times.collecting[WARM_UP:]
    return {"collector on": _binned(us[on]), "collector off": _binned(us[~on])}


def _binned(us: np.ndarray) -> list[int]:
    """Counts by `_BINS`; what is beyond the ends counts at the ends."""
    return [int(count) for count in np.histogram(np.clip(us, _BINS[0], _BINS[-1]), _BINS)[0]]


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
    inside = f"inside {SOLVERS[scene.tuning.solver]}"
    names = ("look ahead", "QP update", "QP handed over", inside, "rest")
    parts, iterations = np.zeros((n, len(names))), np.zeros(n, dtype=int)

    def restart(k: int) -> None:
        if k % lap == 0:
            controller.start(run.pose)

    def step(k: int) -> None:
        decision = controller.step(k % lap, states[k % lap])
        plan = decision.plan
        assert plan is not None
        parts[k, :4] = (decision.linearise_time, plan.update_time, plan.solve_time - plan.solver_time, plan.solver_time)
        iterations[k] = plan.iterations

    times = measure(step, n, restart, label)
    parts[:, 4] = times.wall - parts[:, :4].sum(axis=1)
    parts = parts[WARM_UP:]
    return times, {name: parts[:, i] for i, name in enumerate(names)}, iterations[WARM_UP:]
