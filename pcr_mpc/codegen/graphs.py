"""The graphs of plant and controller as one C file, rods and models as calls, and what working memory they need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from ..buffered import building
from ..control.mpc import LinearMPC
from ..control.qp.condensing import checking
from ..linearisation.strain_watch import strain_graphs
from ..loop.parts.foresight_graph import Places, foresight_graph
from ..plant.motion.plant import Plant
from ..plant.motion.step_graph import StepModel, step_graph
from ..plant.rods.closed_form import elastica
from ..plant.rods.method import warm_calls

# Kept to one translation unit, where what nobody calls falls away.
_HEAD = """/* Written by CasADi from the graphs of pcr_mpc; the functions at the end are what pcr_graphs.h declares. */
#define CASADI_SYMBOL_EXPORT static
#ifdef __GNUC__
/* All functions have the same parameters, and companions that only a loader of libraries asks. */
#pragma GCC diagnostic ignored "-Wunused-parameter"
#pragma GCC diagnostic ignored "-Wunused-function"
#endif
"""


@dataclass(frozen=True)
class Graphs:
    """All functions by the names that ``pcr_graphs.h`` gives them.

    Attributes
    ----------
    functions : dict of str to casadi.Function
    source : str
        C of all of them.
    """

    functions: dict[str, Any]
    source: str

    def room(self, *names: str) -> dict[str, int]:
        """Largest sizes of arg, res, iw and w of some of them, or of all but those."""
        found = [self.functions[name] for name in names]
        return {part: max(1, *(getattr(f, f"sz_{part}")() for f in found)) for part in ("arg", "res", "iw", "w")}


@building
def make_graphs(
    model: StepModel,
    target: StepModel,
    watched: StepModel,
    places: Places,
    law: LinearMPC,
    plant: Plant,
    *,
    rounding: float = 0.0,
) -> Graphs:
    """Put together the C of a controller's graphs and of a plant's.

    Parameters
    ----------
    model, target, watched : StepModel
        Of the controller's model, of the rods that carry the observed force, and of those whose limits are watched.
    places : Places
        Of the controller.
    law : LinearMPC
    plant : Plant
    rounding : float
        See `foresight_graph`.
    """
    n, commanded = model.kind.n_rods, law.tuning.model.angles == "commanded"
    assert plant.step_model is not None
    condense = law.condensing(n, places.models, inline=False)
    steps = [step_graph(plant.step_model, count, details=False, inline=False) for count in (1, 2)]
    functions = {
        "foresight": _called(
            foresight_graph(model, target, places, condense, commanded=commanded, rounding=rounding), "look_ahead"
        ),
        "check": _called(checking(places.horizon, n, places.models, inline=False), "look_back"),
        "follow": _rods(model, 2, "follow"),
        "finish": _rods(model, 1, "finish"),
        "target_follow": _rods(target, 2, "target_follow"),
        "target_finish": _rods(target, 1, "target_finish"),
        "watch_follow": _rods(watched, 2, "watch_follow"),
        "watch_finish": _rods(watched, 1, "watch_finish"),
        "plant_once": _called(steps[0], "plant_once"),
        "plant_twice": _called(steps[1], "plant_twice"),
        "determinant": _called(elastica.tip_determinant(), "determinant"),
        "curvature": _called(elastica.rod_curvature(inline=False), "curvature"),
    }
    if watched.kind.layout is not None:
        strain = strain_graphs(watched.kind, watched.method.newton.size1_in(0) // 4)
        functions |= {
            "strain_nodes": _called(strain.nodes, "strain_nodes"),
            "strain_along": _called(strain.along, "strain_along"),
            "strain_there": _called(strain.there, "strain_there"),
        }
    generator = ca.CodeGenerator("pcr_graphs.c", {"casadi_int": "int"})
    for function in functions.values():
        generator.add(function)
    ends = [_entry(name, function.name()) for name, function in functions.items()]
    return Graphs(functions, _HEAD + '#include "pcr_graphs.h"\n' + generator.dump() + "\n" + "\n".join(ends))


def _entry(name: str, function: str) -> str:
    arguments = "const double **arg, double **res, int *iw, double *w"
    return f"int pcr_graph_{name}({arguments}) {{ return {function}(arg, res, iw, w, 0); }}\n"


def _rods(model: StepModel, iterations: int, name: str) -> Any:
    """`warm_calls` of the rods of a plant, with their weight where they bend under it."""
    kind = model.kind
    target, vector = ca.MX.sym("target", 2 + kind.n_rods), ca.MX.sym("numbers", kind.size)
    memory = ca.MX.sym("memory", model.widths[0])
    numbers = vector if model.weight == "exact" else kind.weightless(vector)
    results = warm_calls(kind, model.method, iterations)(target, memory, numbers)
    return ca.Function(name, [target, memory, vector], list(results))


def _called(function: Any, name: str) -> Any:
    """The function under another name, its results dense."""
    symbols = [ca.MX.sym(f"i{i}", *function.size_in(i)) for i in range(function.n_in())]
    results = [ca.densify(result) for result in function.call(symbols)]
    return ca.Function(name, symbols, results, function.name_in(), function.name_out())
