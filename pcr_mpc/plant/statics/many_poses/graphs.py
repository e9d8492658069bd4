"""Graphs that solve many held poses in one call, and the memory that they are called through."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ....buffered import BufferedFunction, graph_cache, per_thread
from ....compiled import compiled as machine_code
from ...robot import Robot
from ...rods.method import RodMethod, for_compiler, warm_calls, warm_step
from ...rods.numbers import Kind
from ...rods.physics import robot_layout


@per_thread(maxsize=32)
def packed(robot: Robot) -> tuple[Kind, np.ndarray]:
    """Kind of a robot, and its numbers as the graphs take them."""
    kind = Kind(robot.n_rods, robot_layout(robot))
    return kind, kind.pack(robot)


@per_thread(maxsize=32)
def many(kind: Kind, method: RodMethod, count: int, along: bool, compiled: bool) -> BufferedFunction:
    """See `_many_graph`; the memory is the thread's own."""
    return BufferedFunction(_many_graph(kind, method, count, along, compiled))


@graph_cache(maxsize=8)
def _one_graph(kind: Kind, method: RodMethod, compiled: bool) -> Any:
    # A compiler is given a rod once, not as often as it is solved: a third of the time to build, the same bits.
    if compiled:
        return machine_code(warm_calls(kind, for_compiler(method), method.settling))
    return warm_step(kind, method, method.settling)


@graph_cache(maxsize=32)
def _many_graph(kind: Kind, method: RodMethod, count: int, along: bool, compiled: bool) -> Any:
    """(record or starts, targets, numbers) -> records, verdicts, results of ``count`` poses."""
    warm = _one_graph(kind, method, compiled)
    target, start, numbers = (ca.MX.sym(warm.name_in(i), *warm.size_in(i)) for i in range(3))
    if not along:
        found = warm(target, start, numbers)
        return ca.Function("pose", [start, target, numbers], found).map("poses", "serial", count, [2], [])
    step = _one_step(kind, method, compiled)
    targets = ca.MX.sym("targets", target.numel(), count)
    record = ca.MX.sym("record", step.numel_in(0))
    moved: Any = step.mapaccum("poses", count, 1, {})(record, targets, ca.repmat(numbers, 1, count))
    return ca.Function("path", [record, targets, numbers], list(moved))


@graph_cache(maxsize=8)
def _one_step(kind: Kind, method: RodMethod, compiled: bool) -> Any:
    """From a record to the next, for a path of any length.

    The whole record goes on from pose to pose, though only its first part is started from: it is there once.
    """
    warm = _one_graph(kind, method, compiled)
    target, start, numbers = (ca.MX.sym(warm.name_in(i), *warm.size_in(i)) for i in range(3))
    record = ca.MX.sym("record", warm.numel_out(0))
    step = ca.Function("pose", [record, target, numbers], warm(target, record[: start.numel()], numbers))
    return step.expand() if warm.is_a("SXFunction") else step
