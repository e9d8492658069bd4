"""How long the parts of the loop take, each on its own and back to back."""

from __future__ import annotations

import os
import platform
import time
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import numpy as np
from tqdm import tqdm

from ..plant.dynamics import DERIVATIVE_ACCURACY, Plant
from ..plant.statics import METHODS
from .run import Run, percentiles
from .scene import Scene
from .simulate import simulate
from .tracking import make_controller

_WARM_UP = 20
# One SciPy solve takes milliseconds: fewer of them say as much.
_SLOW = {"single_shooting": 0.1}


def time_scene(scene: Scene, steps: int = 2000, *, progress: bool = False) -> dict[str, Any]:
    """Measure plant steps of every statics method and the control step of a scene.

    Plant steps use velocity Verlet at 1 ms (one force evaluation each) with the scene's discretisation, driven
    by the inputs of a closed-loop run. Forces with their Jacobians are solved along the same run.
    Control steps are replayed on the states of that run: back to back, as on a computer that does nothing else,
    and as they were between the plant's steps.

    Returns
    -------
    dict
        ``components``: list of {name, method, p50, p95, p99, max, n} in us, plant steps also with ``force_error``,
        the largest relative error of F along the run; ``machine``; ``versions``.
    """
    scene = replace(scene, duration=max(scene.duration, 3 * _WARM_UP * scene.period))
    controller = make_controller(scene)
    run = simulate(scene, scene.make_plant(), controller, progress=progress)
    pose = run.pose
    components = []
    for method in METHODS if scene.robot.needs_shooting is None else ("multiple_shooting",):
        n = max(_WARM_UP + 10, int(steps * _SLOW.get(method, 1.0)))
        plant = Plant(
            scene.robot, method=method, segments=scene.plant.segments, steps=scene.plant.steps,
            scheme=scene.plant.scheme, integrator="velocity_verlet", dt=1e-3,
        )  # fmt: skip
        plant.reset(run.x[0], pose)
        component = _component("plant step", method, _plant_times(plant, scene, run, n, progress))
        components.append({**component, "force_error": _force_error(plant, scene, run)})
        components.append(_component("F, K and G", method, _force_times(plant, run, n)))
    if scene.trajectory is not None:
        controller.start(pose)
        states = run.x[:: run.steps_per_period]
        parts = np.empty((len(run.u), 5))
        for k in range(len(run.u)):
            began = time.perf_counter()
            decision = controller.step(k, states[k])
            parts[k, 0] = time.perf_counter() - began
            assert decision.plan is not None
            plan = decision.plan
            parts[k, 1:] = decision.linearise_time, plan.update_time, plan.solve_time, plan.solver_time
        model = scene.tuning.model.method if scene.tuning else ""
        for name, values in zip(
            ("control step", "linearise", "QP update", "QP solve", "inside OSQP"), parts.T, strict=True
        ):
            components.append(_component(name, model, values))
        components.append(_component("control step between plant steps", model, run.control_time[:, 0]))
    return {"scene": scene.name, "components": components, "machine": machine(), "versions": versions()}


def _plant_times(plant: Plant, scene: Scene, run: Run, n: int, progress: bool) -> np.ndarray:
    """Times of n plant steps; when the run's inputs are used up, it starts again from the beginning."""
    per = max(1, round(scene.period / plant.dt))
    times = np.empty(n)
    lap = len(run.u) * per
    x = run.x[0]
    for k in tqdm(range(n), desc=f"plant, {plant.method}", unit="step", disable=not progress):
        if k % lap == 0:
            x = run.x[0]
            plant.reset(x, run.pose)
        u = run.u[k % lap // per]
        began = time.perf_counter()
        x = plant.step(x, u, scene.force)
        times[k] = time.perf_counter() - began
    return times


def _force_times(plant: Plant, run: Run, n: int) -> np.ndarray:
    """Times of n warm solves for force and Jacobians along the run, as the controller's linearisation calls them."""
    times = np.empty(n)
    for k in range(n):
        x = run.x[k % len(run.x)]
        if k % len(run.x) == 0:
            plant.reset(x, run.pose)
        p, q = x[:2].copy(), x[4:].copy()
        began = time.perf_counter()
        plant.force_and_jacobians(p, q, DERIVATIVE_ACCURACY)
        times[k] = time.perf_counter() - began
    return times


def _force_error(plant: Plant, scene: Scene, run: Run) -> float:
    """Largest error of F along the run against the closed form, relative to the rods' forces."""
    exact = Plant(scene.robot)
    worst = 0.0
    exact.reset(run.x[0], run.pose)
    plant.reset(run.x[0], run.pose)
    for x in run.x[:: run.steps_per_period][:200]:
        eq = exact.equilibrium(x)
        error = np.linalg.norm(plant.force(x[:2], x[4:]) - eq.force)
        worst = max(worst, float(error / np.linalg.norm(eq.rod_forces)))
    return worst


def _component(name: str, method: str, seconds: np.ndarray) -> dict[str, Any]:
    kept = seconds[_WARM_UP:]
    return {"name": name, "method": method, **percentiles(1e6 * kept), "n": len(kept)}


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    return {
        "platform": platform.platform(),
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


def versions() -> dict[str, str]:
    """Versions of what does the arithmetic."""
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in ("casadi", "numpy", "scipy", "osqp")},
    }
