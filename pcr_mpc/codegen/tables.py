"""The scene's numbers, ``pcr_tables.c``."""

from __future__ import annotations

import math
from itertools import accumulate
from typing import Any

import numpy as np

from ..control.qp.program import stage_weights
from ..errors import GenerationError
from ..plant.motion.step_graph import StepModel
from ..plant.motion.step_graph import limits as step_limits
from ..plant.rods.closed_form.chart import critical_load_table
from ..plant.rods.numbers import Kind
from .ctext import array, block, number, structure
from .solver import Shape, daqp_room
from .subject import KIND_BITS, Subject


def input_sizes(function: Any) -> tuple[list[str], list[int]]:
    """Names and sizes of a graph's inputs."""
    return list(function.name_in()), [function.numel_in(i) for i in range(function.n_in())]


def output_sizes(function: Any) -> tuple[list[str], list[int]]:
    """Names and sizes of a graph's outputs."""
    return list(function.name_out()), [function.numel_out(i) for i in range(function.n_out())]


def unknowns(model: StepModel) -> int:
    """Unknowns of a rod."""
    return int(model.method.newton.size1_in(0))


def _among(numbers: Kind, model: Kind) -> np.ndarray:
    """Where each number of one kind is among those of another; -1: nowhere."""
    return np.array([model.names.index(name) if name in model.names else -1 for name in numbers.names])


def parameters(subject: Subject) -> dict[str, np.ndarray | float]:
    """Members of ``pcr_parameters`` in their order."""
    n, work, limits = subject.robot.n_rods, subject.work, subject.limits
    motors, given = work.limits, work.foresight.inputs
    model, gain = subject.resting()
    none = math.inf
    return {
        "numbers": given["numbers"],
        "weights": np.array(stage_weights(subject.tuning)),
        "terminal": subject.law.terminal.ravel(order="F"),
        "gain": gain.ravel(),
        "observer_gain": given["gain"].ravel(order="F"),
        "rate": motors.rate,
        "rate_change": motors.rate_change,
        "angle_lower": motors.angle_lower,
        "angle_upper": motors.angle_upper,
        "reach": model.reach,
        "torque": none if limits.torque is None else limits.torque,
        "tip_lower": np.array(limits.tip_lower or (-none, -none)),
        "tip_upper": np.array(limits.tip_upper or (none, none)),
        "rod_margin": -none if limits.rod_margin is None else limits.rod_margin,
        "stiffness": -none if limits.stiffness is None else limits.stiffness,
        "strain": limits.strains(subject.robot) if "strain" in subject.kinds else np.full(n, none),
    }


def tables(subject: Subject) -> str:
    """Text of ``pcr_tables.c``."""
    work, pose, graphs = subject.work, subject.pose, subject.graphs
    foresight, given = graphs.functions["foresight"], work.foresight.inputs
    reference, end, payloads = subject.reference()
    model, _ = subject.resting()
    column = np.concatenate([model.A.ravel("F"), model.c, model.B.ravel("F"), model.E.ravel("F")])
    plant, robot = subject.plant, subject.robot
    x = np.concatenate([pose.p, [0.0, 0.0], pose.q])
    assert plant.step_model is not None
    record = work.foresight.rows["records"][0]
    rows, loads = critical_load_table()
    ratios = np.array([rod.thickness_ratio or math.nan for rod in robot.rods])
    kinds, (of_model, target) = list(subject.kinds), work.foresight.step_models
    model_kind = of_model.kind
    texts = [
        f"/* Numbers of the scene {subject.scene.name!r} and of its controller {subject.tuning.name!r}. */\n"
        '#include "pcr_tables.h"\n\n#include <math.h>\n#include <stddef.h>\n',
        structure("pcr_parameters", "pcr_scene_parameters",
                  [number(v) if isinstance(v, float) else block(v) for v in parameters(subject).values()]),
        structure("pcr_pose", "pcr_scene_pose", [block(pose.p), block(pose.q)]),
        array("double", "pcr_scene_record", record),
        array("double", "pcr_scene_target_record", given["target"]),
        array("double", "pcr_scene_watch_record", work.watch.plant.record),
        array("double", "pcr_scene_watch_result", work.watch.plant.rods(pose.p, pose.q).result),
        array("double", "pcr_scene_target_numbers", given["target_numbers"]),
        array("double", "pcr_scene_watch_numbers", work.watch.plant.numbers),
        array("int", "pcr_target_places", _among(target.kind, model_kind)),
        array("int", "pcr_watch_places", _among(subject.watched.kind, model_kind)),
        array("double", "pcr_scene_model", column),
        array("double", "pcr_scene_mass", given["mass"].ravel(order="F")),
        array("double", "pcr_scene_memory", plant.memory(x)),
        array("double", "pcr_scene_plant_numbers", plant.numbers),
        array("double", "pcr_number_ranges", model_kind.ranges),
        array("double", "pcr_plant_number_ranges", plant.step_model.kind.ranges),
        array("double", "pcr_plant_limits", np.fmax(step_limits(plant.step_model), [subject.rounding, 0, 0, 0, 0])),
        array("int", "pcr_in_places", np.array([0, *np.cumsum(input_sizes(foresight)[1])[:-1]])),
        array("int", "pcr_out_places", np.array([0, *np.cumsum(output_sizes(foresight)[1])[:-1]])),
        array("double", "pcr_scene_reference", _without_rates(subject, reference)),
        array("double", "pcr_scene_end", end),
        array("double", "pcr_scene_payloads", payloads),
        array("double", "pcr_critical_rows", rows),
        array("double", "pcr_critical_loads", loads),
        array("double", "pcr_thickness", ratios),
        array("int", "pcr_kind_rows", np.array([*subject.kinds.values(), 0])),
        array("int", "pcr_kind_bits", np.array([*(KIND_BITS[kind] for kind in kinds), 0])),
        *_shapes(subject),
    ]  # fmt: skip
    return "\n".join(texts)


def _without_rates(subject: Subject, reference: np.ndarray) -> np.ndarray:
    """Rows of the reference without the rates, which C finds as the differences of the angles, from the start on."""
    n, period = subject.robot.n_rods, subject.scene.period
    start = np.concatenate([subject.controller.reference.states[0], [0.0, 0.0]])
    rows = np.vstack([start, np.delete(reference, slice(4 + n, 4 + 2 * n), axis=1)])
    if not np.array_equal(np.diff(rows[:, 4:-2], axis=0) / period, reference[:, 4 + n : 4 + 2 * n]):
        raise GenerationError(f"{subject.scene.name}: the reference's rates are not the differences of its angles, "
                              "which C takes them for", part="reference")  # fmt: skip
    return rows


def _shapes(subject: Subject) -> list[str]:
    orders: dict[int, str] = {}
    texts = []
    daqp = subject.tuning.solver == "daqp"
    for shape in () if daqp else (subject.rates, *subject.limited):
        if id(shape) not in orders:
            orders[id(shape)] = f"order_{len(orders)}"
            texts.append("static " + array("unsigned short", orders[id(shape)], shape.order))
    matrix = subject.rates.matrix
    return [
        *texts,
        f"const pcr_qp_shape pcr_rates_shape = {_shape(subject, subject.rates, orders)};\n",
        f"const pcr_qp_shape pcr_limited_shapes[{len(subject.limited)}] = {{\n"
        + ",\n".join(_shape(subject, shape, orders) for shape in subject.limited)
        + "\n};\n",
        array("int", "pcr_limited_places", np.array(places_of_solutions(subject)[:-1])),
        array("int", "pcr_rates_starts", matrix.indptr),
        array("int", "pcr_rates_rows", matrix.indices),
        array("double", "pcr_rates_values", matrix.data),
    ]


def places_of_solutions(subject: Subject) -> list[int]:
    """Where the last solution of each combination of kinds is kept, and the end of all of them."""
    return [0, *accumulate(sum(shape.sizes[:2]) for shape in subject.limited)]


def solver_room(subject: Subject, shape: Shape) -> tuple[int, int]:
    """Memory of a solver [doubles], [ints]."""
    if subject.tuning.solver == "daqp":
        return daqp_room(shape, subject.tuning.horizon * subject.robot.n_rods)
    return shape.doubles, shape.ints


def _shape(subject: Subject, shape: Shape, orders: dict[int, str]) -> str:
    n, m, of_p, of_a, of_k = shape.sizes
    if subject.tuning.solver == "daqp":
        soft = (n - subject.tuning.horizon * subject.robot.n_rods) // 2 if shape.identity else 0
        return f"{{{n}, {m}, {int(shape.identity)}, {soft}}}"
    numbers = [n, m, int(shape.identity), of_p, of_a, of_k, shape.factor]
    return "{" + ", ".join(map(str, numbers)) + f", {orders[id(shape)]}}}"
