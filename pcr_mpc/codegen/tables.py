"""The two generated files that are about the scene's numbers: ``pcr_config.h`` and ``pcr_tables.c``."""

from __future__ import annotations

import math
from itertools import accumulate
from typing import Any

import numpy as np

from ..control.qp.limited import PENALTY
from ..control.qp.program import stage_weights
from ..errors import GenerationError
from ..linearisation.model_graph import sizes
from ..linearisation.strain_watch import strain_graphs
from ..loop.hardware.camera import IDEAL as NO_CAMERA
from ..loop.hardware.lag import Lag
from ..loop.parts.assembled import tip_noise
from ..loop.run.untold_delay import UntoldDelay
from ..plant.motion.step_graph import StepModel
from ..plant.motion.step_graph import limits as step_limits
from ..plant.rods.closed_form.chart import critical_load_table
from ..plant.rods.numbers import Kind
from .ctext import array, block, defines, number, structure
from .loss import Loss
from .precision import tolerances
from .solver import Shape, daqp_room
from .subject import KIND_BITS, Subject

_LOG_TAUT = -15.0  # see strain.quarter_period


def _offsets(prefix: str, names: list[str], lengths: list[int]) -> dict[str, Any]:
    """Where each input or output of a graph begins in the memory of all of them."""
    starts = [0, *accumulate(lengths)]
    found = {f"{prefix}_{name.upper()}": start for name, start in zip(names, starts, strict=False)}
    return found | {f"{prefix}_SIZE": starts[-1]}


def _inputs(function: Any) -> tuple[list[str], list[int]]:
    return list(function.name_in()), [function.numel_in(i) for i in range(function.n_in())]


def _outputs(function: Any) -> tuple[list[str], list[int]]:
    return list(function.name_out()), [function.numel_out(i) for i in range(function.n_out())]


def config(subject: Subject, loss: Loss | None = None) -> str:
    """Text of ``pcr_config.h``."""
    scene, tuning, work, graphs = subject.scene, subject.tuning, subject.work, subject.graphs
    n, horizon, places = subject.robot.n_rods, tuning.horizon, work.foresight.places
    (model, target), watched = work.foresight.step_models, subject.watched
    foresight, check = graphs.functions["foresight"], graphs.functions["check"]
    reference, _, payloads = subject.reference()
    rooms = graphs.room(*(name for name in graphs.functions if not name.startswith("plant")))
    plant_rooms = graphs.room("plant_once", "plant_twice", "follow", "finish")
    of_plant = subject.plant.step_model
    assert of_plant is not None
    kinds = subject.kinds
    largest = subject.limited[-1]
    columns, rows, _, of_a, _ = largest.sizes
    observer = work.observer
    values: dict[str, Any] = {
        "PCR_N": n,
        "PCR_STATES": 4 + n,
        "PCR_HORIZON": horizon,
        "PCR_INPUTS": horizon * n,
        "PCR_TRIANGLE": horizon * n * (horizon * n + 1) // 2,
        "PCR_DELAY": places.delay,
        "PCR_MODELS": places.models,
        "PCR_PLACES": places.count,
        "PCR_ROW": 6 + 2 * n,
        "PCR_MODEL": sizes(model).model,
        "PCR_RECORD": sizes(model).record,
        "PCR_TARGET": sizes(target).record,
        "PCR_WIDTH": _width(model),
        "PCR_TARGET_WIDTH": _width(target),
        "PCR_WATCH_WIDTH": _width(watched),
        "PCR_LARGEST_RECORD": max(sizes(one).record for one in (model, target, watched)),
        "PCR_FOLLOWING": max(model.method.following, subject.rounding),
        "PCR_TARGET_FOLLOWING": max(target.method.following, subject.rounding),
        "PCR_WATCH_FOLLOWING": max(watched.method.following, subject.rounding),
        "PCR_WATCH_FOLLOWS": int(work.watch.follows_model),
        "PCR_WATCH_SHOT": int(watched.kind.layout is not None),
        "PCR_WATCH_RECORD": sizes(watched).record,
        "PCR_WATCH_NUMBERS": watched.kind.size,
        "PCR_TARGET_NUMBERS": target.kind.size,
        "PCR_NUMBERS": model.kind.size,
        "PCR_ROD_NUMBERS": model.kind.names.index("rods[1].bending_stiffness"),
        "PCR_PERIOD": float(scene.period),
        "PCR_PERIODS": scene.n_periods,
        "PCR_PLANT_STEP": float(subject.plant.dt),
        "PCR_STEPS_A_PERIOD": round(scene.period / subject.plant.dt),
        "PCR_REAL_DELAY": scene.delay,
        "PCR_REFERENCE_ROWS": len(reference),
        "PCR_PAYLOAD_ROWS": len(payloads),
        "PCR_TOLERANCE": float(tuning.tolerance),
        "PCR_MAX_ITERATIONS": tuning.max_iterations,
        "PCR_PENALTY": PENALTY,
        "PCR_OBSERVER": int(observer is not None),
        "PCR_TIP_NOISE": tip_noise(scene, tuning),
        "PCR_ANGLE_STEP": float(scene.angle_step),
        "PCR_WRAPPED": int(scene.wrapped),
        "PCR_COMMANDED": int(tuning.model.angles == "commanded"),
        "PCR_PULL": float(subject.work.foresight.inputs["pull"][0]),
        "PCR_PRIOR_LAG": float(subject.work.foresight.inputs["prior"][0]),
        "PCR_PRIOR": float(subject.work.foresight.inputs["prior"][1]),
        "PCR_LOG_TAUT": _LOG_TAUT,
        "PCR_CRITICAL": len(critical_load_table()[0]),
        "PCR_WATCHES_TORQUE": int("torque" in kinds),
        "PCR_WATCHES_TIP": int("tip region" in kinds),
        "PCR_WATCHES_MARGIN": int("rod margin" in kinds),
        "PCR_WATCHES_STIFFNESS": int("stiffness" in kinds),
        "PCR_WATCHES_STRAIN": int("strain" in kinds),
        "PCR_POSE_KINDS": len(kinds),
        "PCR_POSE_ROWS": sum(kinds.values()),
        "PCR_LIMITED_N": columns,
        "PCR_LIMITED_M": rows,
        "PCR_LIMITED_A": of_a,
        "PCR_LIMITED_ROWS": rows - (columns - horizon * n),
        "PCR_LIMITED_DOUBLES": max(_room(subject, shape)[0] for shape in subject.limited),
        "PCR_LIMITED_INTS": max(_room(subject, shape)[1] for shape in subject.limited),
        "PCR_LIMITED_LAST": _places(subject)[-1],
        "PCR_RATES_A": subject.rates.matrix.nnz,
        "PCR_RATES_DOUBLES": _room(subject, subject.rates)[0],
        "PCR_RATES_INTS": _room(subject, subject.rates)[1],
        "PCR_PLANT_MEMORY": sum(of_plant.widths),
        "PCR_PLANT_MASSLESS": int(of_plant.inertia == "none"),
        # Then the model's rods, followed to another pose, say what the plant's are there.
        "PCR_PLANT_AS_MODEL": int(subject.plant_as_model),
        "PCR_PLANT_NUMBERS": of_plant.kind.size,
        "PCR_PLANT_TIP_MASS": of_plant.kind.names.index("tip_mass"),
        "PCR_PLANT_ROD_NUMBERS": of_plant.kind.names.index("rods[1].bending_stiffness"),
        "PCR_PLANT_START": of_plant.widths[0],
    }  # fmt: skip
    values |= _hardware(subject) | tolerances(single=subject.single) | _losses(subject, loss)
    values["PCR_PHYSICS"] = watched.kind.layout.size if watched.kind.layout is not None else 0
    if watched.kind.layout is not None:
        strain = strain_graphs(watched.kind, _width(watched) // 4)
        values |= {"PCR_STRAIN_POINTS": strain.points, "PCR_STRAIN_INTERVALS": strain.intervals}  # fmt: skip
    values["PCR_PLANT_CONSTANT"] = int(subject.plant.inertia == "constant")
    values |= {f"PCR_{part.upper()}": size for part, size in rooms.items()}
    values |= {f"PCR_PLANT_{part.upper()}": size for part, size in plant_rooms.items()}
    values |= _offsets("PCR_IN", *_inputs(foresight)) | {"PCR_INS": foresight.n_in()}
    outs = _offsets("PCR_OUT", *_outputs(foresight))
    values |= outs | {"PCR_OUTS": foresight.n_out()}
    # What the next period starts from; see `Foresight`.
    after = outs["PCR_OUT_FOLLOWED"] + sizes(model).record
    values |= {"PCR_OUT_NEXT": after, "PCR_NEXT": outs["PCR_OUT_NOW"] - after,
               "PCR_OUT_RECKONED": outs["PCR_OUT_MOVED_RECKONED"]}  # fmt: skip
    names = ["models", "x", "p", "q", "l", "u", "bounds", "dt", "clear", "inputs", "y"]
    values |= _offsets("PCR_CHECK", names, _inputs(check)[1])
    values["PCR_CHECK_IN_SIZE"] = values.pop("PCR_CHECK_SIZE")
    values["PCR_CHECK_OUT_SIZE"] = sum(_outputs(check)[1])
    return (
        f"/* Sizes and settings of the controller {tuning.name!r} of the scene {scene.name!r}. */\n"
        f"#ifndef PCR_CONFIG_H\n#define PCR_CONFIG_H\n\n{defines(values)}\n#endif\n"
    )


def _hardware(subject: Subject) -> dict[str, Any]:
    """Macros of sensors and motors that are late: what the controller knows of them, then what plant and example do."""
    scene, dt = subject.scene, subject.plant.dt
    camera = scene.camera or NO_CAMERA
    observer = subject.tuning.observer
    age = 0.0 if observer is None else observer.latency / scene.period
    motors = scene.motors if subject.drives else None
    lag = Lag.of(motors.time_constant if motors else 0.0, dt)
    untold = UntoldDelay(scene.untold_delay, dt, subject.robot.n_rods)
    return {
        "PCR_EVERY": camera.every,
        "PCR_PAST": math.ceil(age - 1e-9) or 1 if age > 0.0 else 0,
        "PCR_PAST_AGE": age,
        "PCR_MOTORS": int(motors is not None),
        "PCR_MOTOR_LAG": motors.time_constant if motors else 0.0,
        "PCR_MOTOR_MEAN": lag.mean,
        "PCR_MOTOR_LEFT": lag.left,
        "PCR_MOTOR_PLAY": motors.backlash / 2 if motors else 0.0,
        "PCR_MOTOR_ANGLES": int(motors is not None and motors.command == "angle"),
        "PCR_PICTURE_AGE": camera.latency / dt,
        "PCR_WAITING": untold.steps + (untold.fraction > 0.0),
        "PCR_WITHIN": untold.fraction,
    }


def _losses(subject: Subject, loss: Loss | None) -> dict[str, Any]:
    """By how much the example may differ from Python [mm], [rad/s], [periods], and its plant alone in any state."""
    names = ("PCR_RMS_LOSS", "PCR_RATES_LOSS", "PCR_OTHER_PERIODS", "PCR_APART")
    if not subject.single:
        return dict(zip(names, (1e-9, 1e-9, 0, 1e-12), strict=True))
    if loss is None:
        return dict(zip(names, (math.inf, math.inf, subject.scene.n_periods, math.inf), strict=True))
    # Another compiler rounds otherwise.
    rms = max(2 * abs(loss.rms_mm - loss.double_rms_mm), 0.1 * loss.double_rms_mm)
    worst = rms, 2 * loss.same, 2 * loss.others + 1, 2 * loss.apart
    return dict(zip(names, worst, strict=True))


def _width(model: StepModel) -> int:
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
        array("int", "pcr_in_places", np.array([0, *np.cumsum(_inputs(foresight)[1])[:-1]])),
        array("int", "pcr_out_places", np.array([0, *np.cumsum(_outputs(foresight)[1])[:-1]])),
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
        array("int", "pcr_limited_places", np.array(_places(subject)[:-1])),
        array("int", "pcr_rates_starts", matrix.indptr),
        array("int", "pcr_rates_rows", matrix.indices),
        array("double", "pcr_rates_values", matrix.data),
    ]


def _places(subject: Subject) -> list[int]:
    """Where the last solution of each combination of kinds is kept, and the end of all of them."""
    return [0, *accumulate(sum(shape.sizes[:2]) for shape in subject.limited)]


def _room(subject: Subject, shape: Shape) -> tuple[int, int]:
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
