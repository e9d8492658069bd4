"""Variables of a functional mock-up unit: their names, units and start values, in the order of ``pcr_fmu.h``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np

from ..ctext import block, defines
from ..subject import Subject
from ..tables import parameters

PARTS = ("plant", "controller")
# Kinds of limits by the bits 2 to 7 of pcr_output, whose slack is told.
_SLACKS = {"angle": "rad", "torque": "N m", "tip_region": "m", "rod_margin": "", "stiffness": "N/m", "strain": ""}
_WEIGHTS = {"position": "1/m^2", "velocity": "s^2/m^2", "angle": "1/rad^2", "input": "s^2/rad^2"}


@dataclass(frozen=True)
class Variable:
    """One of them.

    Attributes
    ----------
    name : str
    unit : str
        Empty if it has none.
    text : str
        What it is.
    start : float or None
        None of an output.
    """

    name: str
    unit: str
    text: str
    start: float | None = None


@dataclass(frozen=True)
class Layout:
    """All variables of one part, by the names that C has for where they begin.

    Attributes
    ----------
    part : {"plant", "controller"}
    inputs, fixed, tunable, outputs, wholes : dict of str to list of Variable
        Inputs, parameters that are fixed, and such as may change, outputs, and those that are whole numbers. Their
        value references follow each other in this order.
    """

    part: str
    inputs: dict[str, list[Variable]]
    fixed: dict[str, list[Variable]]
    tunable: dict[str, list[Variable]]
    outputs: dict[str, list[Variable]]
    wholes: dict[str, list[Variable]]

    def flat(self, kind: str) -> list[Variable]:
        """Variables of ``inputs``, ``fixed``, ``tunable``, ``outputs`` or ``wholes`` in one list."""
        return [variable for group in getattr(self, kind).values() for variable in group]

    def config(self, step: float, token: str) -> str:
        """Text of ``pcr_fmu_config.h``; ``step`` [s] is the shortest that the model can take."""
        counts = [len(self.flat(kind)) for kind in ("inputs", "fixed", "tunable", "outputs")]
        ends = list(accumulate(counts))
        values: dict[str, Any] = {
            "FMU_OF_PLANT": int(self.part == "plant"),
            "FMU_TOKEN": f'"{token}"',
            "FMU_STEP": step,
            "FMU_INPUTS_END": ends[0],
            "FMU_FIXED_END": ends[1],
            "FMU_TUNABLE_END": ends[2],
            "FMU_REALS": ends[3],
            "FMU_WHOLES": len(self.wholes),
        }
        at = 0
        for groups in (self.inputs, self.fixed, self.tunable, self.outputs):
            for name, group in groups.items():
                values[f"FMU_{name}"] = at
                at += len(group)
        values |= {f"FMU_{name}": i for i, name in enumerate(self.wholes)}
        return (
            f"/* Variables of the {self.part} as a model of FMI. */\n"
            f"#ifndef PCR_FMU_CONFIG_H\n#define PCR_FMU_CONFIG_H\n\n{defines(values)}\n#endif\n"
        )

    def tables(self) -> str:
        """Text of ``pcr_fmu_tables.c``."""
        starts = [variable.start for kind in ("inputs", "fixed", "tunable") for variable in self.flat(kind)]
        names, tunables = (", ".join(f'"{variable.name}"' for variable in self.flat(kind)) or "0"
                           for kind in ("inputs", "tunable"))  # fmt: skip
        return (
            '/* Values with which a model starts. */\n#include "pcr_fmu.h"\n\n#include <math.h>\n\n'
            f"const double pcr_fmu_starts[FMU_TUNABLE_END] = {block(np.array(starts, dtype=float))};\n"
            f"const char *const pcr_fmu_inputs[FMU_INPUTS_END] = {{{names}}};\n"
            f"const char *const pcr_fmu_tunables[] = {{{tunables}}};\n"
        )


def layout(subject: Subject, part: str) -> Layout:
    """Variables of the plant or of the controller of a scene."""
    return _plant(subject) if part == "plant" else _controller(subject)


def _tip(name: str, unit: str, text: str, starts: Sequence[float] | np.ndarray | None = None) -> list[Variable]:
    return [
        Variable(f"{name}_{axis}", unit, f"{text}, {axis}", None if starts is None else float(starts[i]))
        for i, axis in enumerate("xy")
    ]


def _each(
    name: str, unit: str, text: str, count: int, starts: Sequence[float] | np.ndarray | None = None
) -> list[Variable]:
    return [
        Variable(f"{name}[{i}]", unit, f"{text} {i}", None if starts is None else float(starts[i]))
        for i in range(count)
    ]


def _matrix(name: str, values: np.ndarray, shape: tuple[int, int], order: Any, text: str) -> list[Variable]:
    places = np.array([f"{name}[{i},{j}]" for i in range(shape[0]) for j in range(shape[1])]).reshape(shape)
    flat = places.ravel(order=order)
    return [Variable(str(place), "", text, float(v)) for place, v in zip(flat, values, strict=True)]


def _start(subject: Subject) -> dict[str, list[Variable]]:
    pose, n = subject.pose, subject.robot.n_rods
    return {
        "START": [
            *_tip("start.p", "m", "where the tip rests at the start", pose.p),
            *_each("start.q", "rad", "angle at the start of motor", n, pose.q),
        ]
    }


def _plant(subject: Subject) -> Layout:
    plant, n = subject.plant, subject.robot.n_rods
    assert plant.step_model is not None
    massless = subject.plant_as_model
    inputs = {
        "U": _each("u", "rad/s", "rate of motor", n, np.zeros(n)),
        "FORCE": _tip("force", "N", "force on the tip besides its weight", subject.scene.force),
    }
    if massless or plant.inertia == "constant":
        inputs["PAYLOAD"] = [Variable("payload", "kg", "mass that the tip carries besides its own", 0.0)]
    units = plant.step_model.kind.units if massless else {}
    numbers = [
        Variable(name, unit, f"number of the robot: {name}", float(value))
        for (name, unit), value in zip(units.items(), plant.numbers, strict=False)
    ]
    outputs = [
        *_tip("p", "m", "position of the tip"),
        *_tip("v", "m/s", "velocity of the tip"),
        *_each("q", "rad", "angle of motor", n),
    ]
    wholes = {"CORRECTIONS": [Variable("corrections", "", "Newton iterations of the last step")]}
    return Layout("plant", inputs, _start(subject), {"NUMBERS": numbers}, {"X": outputs}, wholes)


def _controller(subject: Subject) -> Layout:
    n, pose = subject.robot.n_rods, subject.pose
    inputs = {"P": _tip("p", "m", "measured position of the tip; NaN: not measured", pose.p)}
    if subject.work.observer is None:
        inputs["V"] = _tip("v", "m/s", "measured velocity of the tip", (0.0, 0.0))
    inputs["Q"] = _each("q", "rad", "measured angle, NaN if not measured, of motor", n, pose.q)
    states = ["p_x", "p_y", "v_x", "v_y", *(f"q[{i}]" for i in range(n))]
    units = ["m", "m", "m/s", "m/s", *["rad"] * n]
    inputs |= _window(subject, states, units)
    outputs = {
        "U": _each("u", "rad/s", "rate for motor", n),
        "RESIDUALS": [
            Variable(f"{side}_residual", "", f"{side} residual of the QP, recomputed; NaN if it was not solved")
            for side in ("primal", "dual")
        ],
        "ESTIMATE": [
            Variable(f"estimate.{name}", unit, f"estimate of {name} at the measurement")
            for name, unit in zip(states, units, strict=True)
        ],
        "OBSERVED": _tip("observed_force", "N", "unknown force on the tip, as estimated"),
        "STIFFNESS": [Variable("stiffness", "N/m", "margin to a snap: least eigenvalue of the stiffness ahead")],
        "TORQUE": _each("torque", "N m", "torque ahead of motor", n),
        "SLACK": [Variable(f"slack.{name}", unit, f"by how much limits of {name} had to give way")
                  for name, unit in _SLACKS.items()],
    }  # fmt: skip
    wholes = {
        "RUNG": Variable("rung", "", "who has answered: 0 the QP, 1 the QP softened, 2 the last plan, 3 the LQR, "
                         "4 braking"),
        "SOLVER": Variable("solver", "", "how the QP was left: 0 solved, 1 inaccurate, 2 infeasible, 3 unbounded, "
                           "4 iterations spent, 5 not convex, 6 bounds cross, 7 no linear model"),
        "ITERATIONS": Variable("iterations", "", "of the solver"),
        "ACTIVE": Variable("active", "", "limits that shape the plan, as bits: 1 rate, 2 change of rate, 4 angle, "
                           "8 torque, 16 tip region, 32 rod margin, 64 stiffness, 128 strain"),
        "DOUBTS": Variable("doubts", "", "what of the measurement was not believed, as bits: 1 tip, 2 angles, 4 tip "
                           "insists, 8 angles insist"),
    }  # fmt: skip
    return Layout("controller", inputs, _start(subject), {"PARAMETERS": _parameters(subject)}, outputs,
                  {name: [variable] for name, variable in wholes.items()})  # fmt: skip


def _window(subject: Subject, states: list[str], units: list[str]) -> dict[str, list[Variable]]:
    """The reference that may be handed in, and whether it is."""
    n, horizon = subject.robot.n_rods, subject.tuning.horizon
    names = [*states, *(f"u[{i}]" for i in range(n)), "force_x", "force_y"]
    units = [*units, *["rad/s"] * n, "N", "N"]
    given = Variable("reference.given", "", "0: the scene's own reference is followed; else what reference[k] say", 0.0)
    rows = [
        Variable(f"reference[{k}].{name}", unit, f"{name} wanted in the period {k} later; a state or a force at "
                 "its end", float(start))
        for k, row in enumerate(subject.work.track.window(0, subject.work.delay)[:horizon])
        for name, unit, start in zip(names, units, row, strict=True)
    ]  # fmt: skip
    return {"GIVEN": [given], "WINDOW": rows}


def _parameters(subject: Subject) -> list[Variable]:
    """Of ``pcr_parameters``, in its order."""
    n, values = subject.robot.n_rods, parameters(subject)
    states = 4 + n
    kind = subject.work.foresight.step_models[0].kind

    def limit(name: str, unit: str, text: str) -> list[Variable]:
        value = values[name]
        if isinstance(value, float):
            return [Variable(f"limits.{name}", unit, text, value)]
        return _each(f"limits.{name}", unit, f"{text} of", n, value)

    numbers, weights = np.asarray(values["numbers"]), np.asarray(values["weights"])
    reach = float(np.asarray(values["reach"]))
    groups: dict[str, list[Variable]] = {
        "numbers": [Variable(name, unit, f"number of the robot that is believed: {name}", float(v))
                    for (name, unit), v in zip(kind.units.items(), numbers, strict=True)],
        "weights": [Variable(f"weights.{name}", unit, f"weight of {name}; what is zero stays zero", float(v))
                    for (name, unit), v in zip(_WEIGHTS.items(), weights, strict=True)],
        "terminal": _matrix("terminal", np.asarray(values["terminal"]), (states, states), "F", "terminal weight"),
        "gain": _matrix("gain", np.asarray(values["gain"]), (n, states), "C", "gain of the LQR"),
        "observer_gain": _matrix("observer_gain", np.asarray(values["observer_gain"]), (6, 2), "F",
                                 "gain of the observer; zero without one"),
        "rate": limit("rate", "rad/s", "greatest motor rate"),
        "rate_change": limit("rate_change", "rad/s", "greatest change of a motor rate in a period"),
        "angle_lower": limit("angle_lower", "rad", "lower stop of motor"),
        "angle_upper": limit("angle_upper", "rad", "upper stop of motor"),
        "reach": [Variable("reach", "m/rad", "way of the tip per angle, which prices soft limits", reach)],
        "torque": limit("torque", "N m", "greatest motor torque, where it is watched"),
        "tip_lower": _tip("limits.tip_lower", "m", "lower edge of the tip's region", np.asarray(values["tip_lower"])),
        "tip_upper": _tip("limits.tip_upper", "m", "upper edge of the tip's region", np.asarray(values["tip_upper"])),
        "rod_margin": limit("rod_margin", "", "least margin of a rod to its critical load"),
        "stiffness": limit("stiffness", "N/m", "least stiffness of the robot"),
        "strain": limit("strain", "", "greatest strain of rod"),
    }  # fmt: skip
    assert list(groups) == list(values)
    return [variable for group in groups.values() for variable in group]
