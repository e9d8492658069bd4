"""The closed loop: a controller drives the nonlinear plant."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np
from tqdm import tqdm

from ... import interrupt
from ...control.tuning import Tuning
from ...errors import PCRError, SimulationError, checked_array, checked_integer
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ..demand.feasibility import demand_line, reference_demand, reference_excess, reference_of
from ..demand.feed_forward import InverseDynamics
from ..hardware.camera import IDEAL, Pictures
from ..parts.controllers import Controller, decision_of, name_of
from ..scene.scene import Scene
from .drive import drive_of
from .foreign_parts import check_parts
from .record import versions
from .run import Run
from .simulated_plant import SimulatedPlant
from .untold_delay import UntoldDelay


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
        Sees the measured state only, and predicts with a model of its own. Any object with ``start`` and ``step``.
    seed : int
        Of the measurement noise.
    spent : callable, optional
        (period, measured seconds) -> seconds that the decision is taken to have cost, against the scene's deadline
        and the control period. None: what was measured (then the run is not repeatable).
    progress : bool
        Show a progress bar on stderr, and before it what the reference asks for and the robot cannot do.

    Returns
    -------
    Run
        Its events begin with what the reference asks for in vain, where the controller knows its inverse dynamics; with
        a progress bar in any case.

    Raises
    ------
    ModelError
        The start cannot be held (see `Scene.start`).
    SimulationError
        The plant or the controller failed, in whatever way, or the run was interrupted; its ``run`` holds everything
        until then, and its ``__cause__`` is the failure.
    ValueError
        Before the start: names what plant or controller lack.
    """
    check_parts(plant, controller, carries=scene.payload is not None)
    seed = checked_integer("seed", seed, minimum=0)
    per = round(scene.period / plant.dt)
    if per < 1 or abs(per * plant.dt - scene.period) > 1e-9 * scene.period:
        raise ValueError(f"plant.dt = {plant.dt} s does not divide the control period {scene.period} s")
    pose = scene.start()
    x = np.concatenate([pose.p, scene.start_velocity, pose.q])
    n_periods, n = scene.n_periods, scene.robot.n_rods
    # Before the start, lest the record of a whole run fails for it.
    wanted = _reference(scene, plant.dt * np.arange(n_periods * per + 1))
    plant.reset(x, pose)
    controller.start(pose)
    interrupt.check()
    noise = np.random.default_rng(seed)
    # Rates, how many steps late they come, and what the plan foresaw for the period after.
    still = np.zeros(scene.robot.n_rods)
    on_the_way = deque([(still, 0, still)] * scene.delay)
    later = UntoldDelay(scene.untold_delay, plant.dt, n)

    drive = drive_of(scene, plant.dt, pose)
    pictures = None if scene.camera in (None, IDEAL) else Pictures(scene.camera, plant.dt, seed)
    states = np.empty((n_periods * per + 1, len(x)))
    inputs = np.empty((n_periods, n))
    plant_time = np.empty(n_periods * per)
    control_time = np.zeros((n_periods, 6))
    costs = np.zeros(n_periods)
    measurements, estimates = np.empty((n_periods, len(x))), np.full((n_periods, len(x)), np.nan)
    forces, applied = np.full((n_periods, 2), np.nan), np.empty((n_periods * per, n))
    iterations = np.zeros(n_periods, dtype=int)
    active: Counter[str] = Counter()
    slack: dict[str, float] = {}
    events: list[dict[str, Any]] = []
    # What only some controllers know of themselves.
    dynamics, tuning, believed = (getattr(controller, name, None) for name in ("reference", "tuning", "robot"))
    known = believed if isinstance(believed, Robot) else scene.robot
    asked, said = _foreseen(scene, dynamics if isinstance(dynamics, InverseDynamics) else None, known, pose, progress)
    for line in said:
        events.append({"t": 0.0, "kind": "warning", "message": line})
        if progress:
            print(f"{scene.name}: warning: {line}", file=sys.stderr)
    states[0] = x
    done, decided, snapped = 0, 0, 0
    meanwhile = np.zeros(n)
    carries = scene.plant.payload == "carried"
    payloads = carries * scene.carried(plant.dt * np.arange(n_periods * per))
    changes = set(np.flatnonzero(np.diff(payloads, prepend=0.0)).tolist())

    def record() -> Run:
        t = plant.dt * np.arange(done + 1)
        return Run(
            scene=scene,
            controller=name_of(controller),
            plant=f"{plant.method}, {plant.integrator}, dt = {1e3 * plant.dt:g} ms",
            seed=seed,
            pose=pose,
            dt=plant.dt,
            t=t,
            x=states[: done + 1].copy(),
            reference=wanted[: done + 1].copy(),
            u=inputs[:decided].copy(),
            plant_time=plant_time[:done].copy(),
            control_time=control_time[:decided].copy(),
            iterations=iterations[:decided].copy(),
            active_limits=dict(active),
            slack=slack,
            rungs=plant.rungs,
            events=events,
            rung=scene.plant if scene.plant.describes(plant, scene.robot) else None,
            measured=measurements[:decided].copy(),
            estimate=estimates[:decided].copy(),
            estimated_force=forces[:decided].copy(),
            applied=applied[:done].copy(),
            decision_time=costs[:decided].copy(),
            tuning=tuning if isinstance(tuning, Tuning) else None,
            believed=believed if isinstance(believed, Robot) else None,
            versions=versions(),
            asked=asked,
        )

    try:
        for k in tqdm(range(n_periods), desc=scene.name, unit="period", disable=not progress):
            interrupt.check()
            measured = x.copy()
            if drive is not None:
                measured[4:] = drive.angles(x)
            if pictures is not None:
                measured[:2] = pictures.tip(k, states[: done + 1])
            if scene.tip_noise:
                measured[:2] += noise.normal(0.0, scene.tip_noise, 2)
            if scene.angle_step:
                measured[4:] = scene.angle_step * np.round(measured[4:] / scene.angle_step)
            if scene.wrapped:
                measured[4:] -= 2 * np.pi * np.ceil(measured[4:] / (2 * np.pi) - 0.5)
            measurements[k] = measured
            began, began_cpu = time.perf_counter(), time.thread_time()
            answer = controller.step(k, measured)
            control_time[k, 0] = time.perf_counter() - began
            control_time[k, 5] = time.thread_time() - began_cpu
            decision = decision_of(answer, n)
            inputs[k] = decision.u
            if decision.estimate is not None:
                estimates[k] = decision.estimate
            if decision.force is not None:
                forces[k] = decision.force
            cost = float(control_time[k, 0]) if spent is None else spent(k, float(control_time[k, 0]))
            costs[k] = cost
            decided = k + 1
            events += [{"t": k * scene.period, **event} for event in decision.events]
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
            after = decision.plan.inputs[1] if foreseen and decision.plan is not None else inputs[k]
            on_the_way.append((inputs[k], late, after))
            arrived, waiting, after = on_the_way.popleft()
            for j in range(per):
                interrupt.check()
                u = later(meanwhile if j < waiting else arrived)
                if done in changes:
                    x = plant.carry(float(payloads[done]), x)
                if drive is not None:
                    u = drive.turn(x, u)
                    events += drive.news(done * plant.dt)
                applied[done] = u
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
    except BaseException as error:  # whatever it is, a foreign controller's sys.exit() too, the run so far is kept
        what = "interrupted" if isinstance(error, KeyboardInterrupt) else f"{type(error).__name__}: {error}"
        t = done * plant.dt
        events.append({"t": t, "kind": "failure", "message": what})
        raise SimulationError(
            f"{scene.name} stopped at t = {t:.4f} s of {scene.duration:g} s: {what}", run=record(), t=t
        ) from error
    return record()


def _reference(scene: Scene, t: np.ndarray) -> np.ndarray:
    """Wanted tip positions at the times t, shape (len(t), 2) [m]; NaN if there is nothing to track."""
    if scene.trajectory is None:
        return np.full((len(t), 2), np.nan)
    return checked_array("what the scene's trajectory returns", scene.trajectory(t), (len(t), 3, 2))[:, 0]


def _foreseen(
    scene: Scene, dynamics: InverseDynamics | None, robot: Robot, pose: Equilibrium, progress: bool
) -> tuple[dict[str, Any] | None, list[str]]:
    """What the reference asks for at most, and in vain; a controller of one's own need not know its dynamics.

    Who looks on is told before the run, and by how much slower it must be is solved for; else it is to first order.
    """
    if scene.trajectory is None or (dynamics is None and not progress):
        return None, []
    if dynamics is None:
        robot = scene.robot
        try:
            dynamics = reference_of(scene, pose)
        except PCRError as error:
            return None, [str(error)]
    asked = reference_demand(scene, dynamics)
    if progress:
        print(f"{scene.name}: the reference asks for at most {demand_line(asked)}", file=sys.stderr)
    return asked, reference_excess(scene, dynamics, pose if progress else None, robot)
