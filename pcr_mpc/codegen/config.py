"""Sizes and settings of what is generated, ``pcr_config.h``."""

from __future__ import annotations

import math
from itertools import accumulate
from typing import Any

from ..control.qp.limited import PENALTY
from ..linearisation.model_graph import sizes
from ..linearisation.strain_watch import strain_graphs
from ..loop.hardware.camera import IDEAL as NO_CAMERA
from ..loop.hardware.lag import Lag
from ..loop.parts.assembled import tip_noise
from ..loop.run.untold_delay import UntoldDelay
from ..plant.rods.closed_form.chart import critical_load_table
from .ctext import defines
from .loss import Loss
from .precision import tolerances
from .subject import Subject
from .tables import input_sizes, output_sizes, places_of_solutions, solver_room, unknowns

_LOG_TAUT = -15.0  # see strain.quarter_period


def _offsets(prefix: str, names: list[str], lengths: list[int]) -> dict[str, Any]:
    """Where each input or output of a graph begins in the memory of all of them."""
    starts = [0, *accumulate(lengths)]
    found = {f"{prefix}_{name.upper()}": start for name, start in zip(names, starts, strict=False)}
    return found | {f"{prefix}_SIZE": starts[-1]}


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
        "PCR_WIDTH": unknowns(model),
        "PCR_TARGET_WIDTH": unknowns(target),
        "PCR_WATCH_WIDTH": unknowns(watched),
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
        "PCR_LIMITED_DOUBLES": max(solver_room(subject, shape)[0] for shape in subject.limited),
        "PCR_LIMITED_INTS": max(solver_room(subject, shape)[1] for shape in subject.limited),
        "PCR_LIMITED_LAST": places_of_solutions(subject)[-1],
        "PCR_RATES_A": subject.rates.matrix.nnz,
        "PCR_RATES_DOUBLES": solver_room(subject, subject.rates)[0],
        "PCR_RATES_INTS": solver_room(subject, subject.rates)[1],
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
        strain = strain_graphs(watched.kind, unknowns(watched) // 4)
        values |= {"PCR_STRAIN_POINTS": strain.points, "PCR_STRAIN_INTERVALS": strain.intervals}  # fmt: skip
    values["PCR_PLANT_CONSTANT"] = int(subject.plant.inertia == "constant")
    values |= {f"PCR_{part.upper()}": size for part, size in rooms.items()}
    values |= {f"PCR_PLANT_{part.upper()}": size for part, size in plant_rooms.items()}
    values |= _offsets("PCR_IN", *input_sizes(foresight)) | {"PCR_INS": foresight.n_in()}
    outs = _offsets("PCR_OUT", *output_sizes(foresight))
    values |= outs | {"PCR_OUTS": foresight.n_out()}
    # What the next period starts from; see `Foresight`.
    after = outs["PCR_OUT_FOLLOWED"] + sizes(model).record
    values |= {"PCR_OUT_NEXT": after, "PCR_NEXT": outs["PCR_OUT_NOW"] - after,
               "PCR_OUT_RECKONED": outs["PCR_OUT_MOVED_RECKONED"]}  # fmt: skip
    names = ["models", "x", "p", "q", "l", "u", "bounds", "dt", "clear", "inputs", "y"]
    values |= _offsets("PCR_CHECK", names, input_sizes(check)[1])
    values["PCR_CHECK_IN_SIZE"] = values.pop("PCR_CHECK_SIZE")
    values["PCR_CHECK_OUT_SIZE"] = sum(output_sizes(check)[1])
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
