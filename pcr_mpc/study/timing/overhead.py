"""What a call costs above the arithmetic: one time step of the plant, evaluated in every way that there is."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ... import interrupt
from ...buffered import BufferedFunction
from ...compiled import has_compiler
from ...errors import CompilerError
from ...plant.motion.plant import Plant
from ...plant.motion.rollout import rollout
from ...plant.motion.step_graph import step_function
from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium

_BATCHES, _CALLS = 15, 400
_ROLLED, _ROLLOUTS = 2000, 6


def call_overhead(robot: Robot, pose: Equilibrium) -> list[dict[str, Any]]:
    """Time of a velocity Verlet step of 1 ms from a slow swing about ``pose``.

    Returns
    -------
    list of {name, code, us}
        ``code``: "interpreted" by CasADi's virtual machine, or "compiled" C of the same graph, where there is a
        compiler. ``name``: "graph", the arithmetic alone, through a buffer; "plain call" of the graph as CasADi's
        manual has it; "Plant.step"; "rollout", a step of a thousand in one call. ``us`` is CPU
        time of the fastest of many batches, which others on the machine hardly change.
    """
    rows = []
    for compiled in (False, True) if has_compiler() else (False,):
        plant = Plant(robot, integrator="velocity_verlet", dt=1e-3, compiled=compiled)
        x = np.concatenate([pose.p, (0.05, -0.05), pose.q])
        plant.reset(x, pose)
        model = plant.step_model
        assert model is not None
        arguments = plant.memory(x), x, np.zeros(robot.n_rods + 2), plant.numbers
        try:
            function = step_function(model, 1, details=True, compiled=compiled)
        except CompilerError:
            break
        graph = BufferedFunction(function)
        for place, value in zip(graph.inputs, arguments, strict=True):
            place[:] = value
        calls: dict[str, Callable[[], Any]] = {
            "graph": graph,
            "plain call": partial(function, *arguments),
            "Plant.step": partial(_step, plant, [x], np.zeros(robot.n_rods)),
        }
        code = "compiled" if compiled else "interpreted"
        rows += [{"name": name, "code": code, "us": _fastest(call)} for name, call in calls.items()]
        inputs = np.zeros((_ROLLED, robot.n_rods))
        spent = []
        for _ in range(_ROLLOUTS):
            interrupt.check()
            began = time.thread_time()
            rollout(plant, x, inputs, guess=pose)
            spent.append(time.thread_time() - began)
        rows.append({"name": "rollout", "code": code, "us": 1e6 * min(spent) / _ROLLED})
    return rows


def _step(plant: Plant, state: list[np.ndarray], u: np.ndarray) -> None:
    state[0] = plant.step(state[0], u)


def _fastest(call: Callable[[], Any]) -> float:
    """CPU time of a call [us], by batches, so that the clock does not count."""
    best = math.inf
    for _ in range(_BATCHES):
        interrupt.check()
        began = time.thread_time()
        for _ in range(_CALLS):
            call()
        best = min(best, time.thread_time() - began)
    return 1e6 * best / _CALLS
