"""Linear models as a graph: what `linearise` does for a plant, with the rods' memory as an input and an output."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from ..buffered import graph_cache
from ..plant.motion.mass_matrix import mass_calls
from ..plant.motion.step_graph import StepModel
from ..plant.rods.method import inlined, warm_calls
from ..plant.rods.numbers import Kind
from ..plant.statics.weight import robot_weight
from .linearise import discretisation


@dataclass(frozen=True)
class Sizes:
    """Lengths of the vectors of a `model_graph`.

    Attributes
    ----------
    memory : int
        What the rods start from; the first part of a record.
    record : int
        All about the rods at the pose (see `warm_calls`).
    model : int
        A, c, B and E, column by column.
    """

    memory: int
    record: int
    model: int


def sizes(model: StepModel) -> Sizes:
    """Lengths for a plant's ``step_model``."""
    n, width = model.kind.n_rods, model.method.newton.size1_in(0)
    n_states = 4 + n
    return Sizes((4 * width + 3) * n, (4 * width + 20) * n, n_states * (n_states + 1 + n + 2))


@graph_cache(maxsize=16)
def force_graph(model: StepModel, iterations: int) -> Any:
    """The rods' force and its derivatives with everything that weighs on it.

    Returns
    -------
    casadi.Function
        ([p, q] (2 + n), memory, numbers) -> record, verdict (5) (see `warm_calls`), F (2) [N], K (2, 2) [N/m],
        G (2, n) [N/rad].
    """
    kind, n = model.kind, model.kind.n_rods
    target, memory = ca.MX.sym("target", 2 + n), ca.MX.sym("memory", sizes(model).memory)
    vector = ca.MX.sym("numbers", kind.size)
    of_rods = vector if model.weight == "exact" else kind.weightless(vector)
    record, verdict, result = warm_calls(kind, model.method, iterations)(target, memory, of_rods)
    force, k, g = result[:2], ca.reshape(result[2:6], 2, 2), ca.reshape(result[6:], 2, n)
    if model.weight == "condensed":
        unknowns = ca.reshape(record[: model.method.newton.size1_in(0) * n], -1, n)
        first, second = robot_weight(kind)
        force += first(unknowns, target[2:], vector)[1][:2]
        curvature = second(unknowns, target[2:], vector)
        k, g = k + curvature[:2, :2], g + curvature[:2, 2:]
    return ca.Function("force", [target, memory, vector], [record, verdict, force, k, g])


@graph_cache(maxsize=16)
def model_graph(model: StepModel, iterations: int) -> Any:
    """Linear model about a state, the rods following from a memory; nothing is decided in here.

    Returns
    -------
    casadi.Function
        (x (4 + n), u (n) [rad/s], f_ext (2) [N], payload [kg], memory, numbers, M (2 + n, 2 + n), dt) -> record, model
        (see `Sizes`), verdict (7): that of `warm_step`, then K dt^2/m and (c dt/m)^2 (see `linearise`). M is the mass
        matrix where the inertia is "constant", and not used otherwise.
    """
    kind, n = model.kind, model.kind.n_rods
    x, f_ext, payload = ca.MX.sym("x", 4 + n), ca.MX.sym("f_ext", 2), ca.MX.sym("payload")
    memory, vector = ca.MX.sym("memory", sizes(model).memory), ca.MX.sym("numbers", kind.size)
    constant, dt = ca.MX.sym("mass", 2 + n, 2 + n), ca.MX.sym("dt")
    rates = ca.MX.sym("rates", n)
    numbers = kind.unpack(vector)
    record, verdict, force, k, g = force_graph(model, iterations)(ca.vertcat(x[:2], x[4:]), memory, vector)
    if model.inertia == "none":
        packed, ratios = _of_point_mass(kind)(force, k, g, f_ext, payload, x, vector, dt)
        return ca.Function("model", [x, rates, f_ext, payload, memory, vector, constant, dt],
                           [record, packed, ca.vertcat(verdict, ratios)])  # fmt: skip
    tip = numbers.tip_mass + payload
    slopes = ca.DM.zeros((2 + n) ** 2, 2 + n)
    if model.inertia == "constant":
        mass = constant
    else:
        of_rods = vector if model.weight == "exact" else kind.weightless(vector)
        unknowns = ca.reshape(record[: model.method.newton.size1_in(0) * n], -1, n)
        mass, slopes = mass_calls(kind, model.method)(unknowns, x[4:], of_rods)
    mass = mass + ca.diag(ca.vertcat(payload, payload, ca.DM.zeros(n)))
    push = force - f_ext - tip * numbers.gravity
    packed = discretisation(n)(k, g, push, x, ca.vertcat(numbers.drag, dt), mass, slopes, rates)
    return ca.Function(
        "model", [x, rates, f_ext, payload, memory, vector, constant, dt],
        [record, packed, ca.vertcat(verdict, _ratios(k, numbers, dt))],
    )  # fmt: skip


@graph_cache(maxsize=16)
def _of_point_mass(kind: Kind) -> Any:
    """Graph (F, K, G, f_ext, payload, x, numbers, dt) -> model, and the last two of the verdict: all that a massless
    rod's model needs from its force on, as one list of instructions."""
    n = kind.n_rods
    force, k, g = ca.SX.sym("force", 2), ca.SX.sym("k", 2, 2), ca.SX.sym("g", 2, n)
    f_ext, payload, x = ca.SX.sym("f_ext", 2), ca.SX.sym("payload"), ca.SX.sym("x", 4 + n)
    vector, dt = ca.SX.sym("numbers", kind.size), ca.SX.sym("dt")
    numbers = kind.unpack(vector)
    tip = numbers.tip_mass + payload
    mass = ca.diag(ca.vertcat(tip, tip, ca.SX.zeros(n)))
    push = force - f_ext - tip * numbers.gravity
    packed = discretisation(n, point=True)(
        k, g, push, x, ca.vertcat(numbers.drag, dt), mass, ca.SX.zeros((2 + n) ** 2, 2 + n), ca.SX.zeros(n)
    )
    return ca.Function("discretise", [force, k, g, f_ext, payload, x, vector, dt], [packed, _ratios(k, numbers, dt)],
                       {"cse": True})  # fmt: skip


def _ratios(k: Any, numbers: Any, dt: Any) -> Any:
    stiffness, damping = ca.norm_inf(ca.vec(k)) * dt**2 / numbers.tip_mass, numbers.drag * dt / numbers.tip_mass
    return ca.vertcat(stiffness, damping**2)


@graph_cache(maxsize=16)
def model_list(model: StepModel, iterations: int) -> Any:
    """`model_graph` as one list of instructions, if that is not too long: an eighth faster, and slow to compile."""
    return inlined(model_graph(model, iterations), model.method.newton)
