"""The closed loop: a controller drives the nonlinear plant."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np
from tqdm import tqdm

from ..errors import SimulationError, checked_integer
from .controllers import Controller
from .run import Run
from .scene import Scene
from .simulated_plant import SimulatedPlant


def simulate(
    scene: Scene,
    plant: SimulatedPlant,
    controller: Controller,
    seed: int = 0,
    *,
    spent: Callable[[int, float], float] | None = None,
    progress: bool = False,
) -> Run:
    """Run a scene in closed loop.

    Parameters
    ----------
    scene : Scene
    plant : SimulatedPlant
        What really moves; its step must divide the scene's control period.
    controller : Controller
        Sees the measured state only, and predicts with a model of its own.
    seed : int
        Of the measurement noise.
    spent : callable, optional
        (period, measured seconds) -> seconds that the decision is taken to have cost, where the scene has a deadline.
        None: what was measured (then the run is not repeatable).
    progress : bool
        Show a progress bar on stderr.

    Returns
    -------
    Run

    Raises
    ------
    SimulationError
        The plant or the controller failed, or the run was interrupted; its ``run`` holds everything until
        then, and its ``__cause__`` is the failure.
    """
    seed = checked_integer("seed", seed, minimum=0)
    per = round(scene.period / plant.dt)
    if per < 1 or abs(per * plant.dt - scene.period) > 1e-9 * scene.period:
        raise ValueError(f"plant.dt = {plant.dt} s does not divide the control period {scene.period} s")
    pose = scene.start()
    x = np.concatenate([pose.p, scene.start_velocity, pose.q])
    plant.reset(x, pose)
    controller.start(pose)
    noise = np.random.default_rng(seed)
    # Rates, how many steps late they come, and what the plan foresaw for the period after.
    still = np.zeros(scene.robot.n_rods)
    on_the_way = deque([(still, 0, still)] * scene.delay)
    n_periods, n = scene.n_periods, scene.robot.n_rods

    states = np.empty((n_periods * per + 1, len(x)))
    inputs = np.empty((n_periods, n))
    plant_time = np.empty(n_periods * per)
    control_time = np.zeros((n_periods, 6))
    iterations = np.zeros(n_periods, dtype=int)
    active: Counter[str] = Counter()
    slack: dict[str, float] = {}
    events: list[dict[str, Any]] = []
    states[0] = x
    done, decided, snapped = 0, 0, 0
    meanwhile = np.zeros(n)
    carries = scene.plant.payload == "carried"
    payloads = carries * scene.carried(plant.dt * np.arange(n_periods * per))
    changes = set(np.flatnonzero(np.diff(payloads, prepend=0.0)).tolist())

    def record() -> Run:
        t = plant.dt * np.arange(done + 1)
        reference = np.full((done + 1, 2), np.nan) if scene.trajectory is None else scene.trajectory(t)[:, 0]
        return Run(
            scene=scene,
            controller=controller.name,
            plant=f"{plant.method}, {plant.integrator}, dt = {1e3 * plant.dt:g} ms",
            seed=seed,
            pose=pose,
            dt=plant.dt,
            t=t,
            x=states[: done + 1].copy(),
            reference=reference,
            u=inputs[:decided].copy(),
            plant_time=plant_time[:done].copy(),
            control_time=control_time[:decided].copy(),
            iterations=iterations[:decided].copy(),
            active_limits=dict(active),
            slack=slack,
            rungs=plant.rungs,
            events=events,
            rung=scene.plant if scene.plant.describes(plant, scene.robot) else None,
        )

    try:
        for k in tqdm(range(n_periods), desc=scene.name, unit="period", disable=not progress):
            measured = x.copy()
            if scene.tip_noise:
                measured[:2] += noise.normal(0.0, scene.tip_noise, 2)
            if scene.angle_step:
                measured[4:] = scene.angle_step * np.round(measured[4:] / scene.angle_step)
            began, began_cpu = time.perf_counter(), time.thread_time()
            decision = controller.step(k, measured)
            control_time[k, 0] = time.perf_counter() - began
            control_time[k, 5] = time.thread_time() - began_cpu
            inputs[k] = decision.u
            decided = k + 1
            cost = float(control_time[k, 0]) if spent is None else spent(k, float(control_time[k, 0]))
            late = 0
            if cost > scene.deadline:
                late = min(per, math.ceil(cost / plant.dt))
                events.append(
                    {"t": k * scene.period, "kind": "late", "message": f"{1e3 * cost:.3g} ms, {scene.late} until then"}
                )
            if decision.plan is not None:
                plan = decision.plan
                control_time[k, 1:5] = decision.linearise_time, plan.update_time, plan.solve_time, plan.solver_time
                iterations[k] = plan.iterations
                active.update(plan.active)
                slack |= {kind: max(amount, slack.get(kind, 0.0)) for kind, amount in plan.slack.items()}
                if plan.fallback:
                    events.append(
                        {
                            "t": k * scene.period,
                            "kind": "fallback",
                            "rung": plan.fallback,
                            "message": f"{plan.fallback}: {plan.status}",
                        }
                    )
            foreseen = scene.late == "shifted_plan" and decision.plan is not None and len(decision.plan.inputs) > 1
            after = decision.plan.inputs[1] if foreseen and decision.plan is not None else decision.u
            on_the_way.append((decision.u, late, after))
            arrived, waiting, after = on_the_way.popleft()
            for j in range(per):
                u = meanwhile if j < waiting else arrived
                if done in changes:
                    x = plant.carry(float(payloads[done]), x)
                began = time.perf_counter()
                x = plant.step(x, u, scene.force)
                plant_time[done] = time.perf_counter() - began
                done += 1
                states[done] = x
                for snap in plant.snaps[snapped:]:
                    events.append(
                        {
                            "t": done * plant.dt,
                            "kind": "snap",
                            "message": f"rod {snap.rod} snapped at p = {snap.p} m, q{snap.rod} = {snap.q:.4f} rad "
                            f"and lost {snap.energy_lost:.4g} J",
                        }
                    )
                snapped = len(plant.snaps)
            meanwhile = after
    except (Exception, KeyboardInterrupt) as error:  # whatever it is, the run so far is kept
        what = "interrupted" if isinstance(error, KeyboardInterrupt) else f"{type(error).__name__}: {error}"
        t = done * plant.dt
        events.append({"t": t, "kind": "failure", "message": what})
        raise SimulationError(
            f"{scene.name} stopped at t = {t:.4f} s of {scene.duration} s: {what}", run=record(), t=t
        ) from error
    return record()
