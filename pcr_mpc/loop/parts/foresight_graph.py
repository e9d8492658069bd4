"""The first half of a control step as one graph: from what is measured to linear models along the plan, and to the QP.

The estimate is corrected, the commands on the way are applied, and the rods are taken along to every place that needs
a linear model: one for each period of delay, one where the robot will then be, one for each later period of the last
plan. These places are a line in time: in the next control period each is where its neighbour is now, so that the rods
of a place start from its neighbour's, and only the last of them has a way to go.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import casadi as ca

from ...buffered import dense, graph_cache, listed
from ...control.observer import correction
from ...linearisation.linearise import STIFFEST
from ...linearisation.model_graph import force_graph, model_graph, model_list, sizes
from ...plant.motion.step_graph import LARGEST_DRIFT, StepModel
from ...plant.rods.follower import BRANCH_CHANGE
from ...plant.rods.method import is_short

# What a verdict of `model_graph` may be: the pose is solved far better than a controller can tell, K and G to 1e-4.
_SOLVED, _DERIVATIVES = 1e-8, 1e-4
_LARGEST_STEP = 0.1  # of the motor target in a period [rad]
_NEAR = 1e-2  # residual from which Newton's method is as good as sure to get there, on the branch that it is on
_LATEST = 10.0  # periods that motors may be late
_SINGULAR = 1e-9  # det(G G') relative to its diagonal, below which the motors have lost a direction


@dataclass(frozen=True)
class Places:
    """How many places need a linear model.

    Attributes
    ----------
    delay : int
        Periods that commands are on the way.
    models : int
        Of the plan: 1, or its horizon.
    horizon : int
        Of the reference window.
    """

    delay: int
    models: int
    horizon: int

    @property
    def count(self) -> int:
        """All of them."""
        return self.delay + self.models


@graph_cache(maxsize=16)
def foresight_graph(
    model: StepModel,
    target: StepModel,
    places: Places,
    condense: Any | None,
    *,
    commanded: bool = True,
    inline: bool = False,
    rounding: float = 0.0,
) -> Any:
    """Build the graph.

    Parameters
    ----------
    model, target : StepModel
        Of the plant that is linearised, and of the one whose rods carry the observed force.
    places : Places
    condense : casadi.Function or None
        See `condensing`. None: no QP is wanted.
    commanded : bool
        Angles that are planned from may differ from the measured ones; else ``pull`` is 1, and the graph leaves out
        what comes to nothing then.
    inline : bool
        Make one list of instructions of it, or at least of each model, for CasADi's interpreter; else calls, for a
        compiler.
    rounding : float
        Residual below which the numbers that it will be computed in cannot come.

    Returns
    -------
    casadi.Function
        With named inputs and outputs; one column of ``followed`` (records) and ``models`` for each place. ``good`` is 1
        for each place, and then for the motor target, whose rods have followed, 1/2 where they are so near that the
        graph should be evaluated again from there, else 0. ``decisions`` are [the least of
        ``good``, how far the sum of the commands is from the angles ahead [rad], and what `condensing` calls sizes].
        What the next period starts from is, from the second record on, in the order of the inputs ``records`` to
        ``reckoned``; from the models of the plan on, the outputs are those that `checking` takes in.
    """
    if not inline:
        model, target = model.for_compiler(), target.for_compiler()
    n, count = model.kind.n_rods, places.count
    size, of_target = sizes(model), sizes(target)
    inputs = {
        "estimate": ca.MX.sym("estimate", 6 + n),  # x, force
        "measured": ca.MX.sym("measured", 2 + n),  # p, q
        "on_the_way": ca.MX.sym("on_the_way", n, places.delay),
        "u_previous": ca.MX.sym("u_previous", n),
        "path": ca.MX.sym("path", 4 + n, places.models - 1),  # of the last plan, from the second place on
        "window": ca.MX.sym("window", 6 + 2 * n, places.horizon),  # of the reference: states, rates, forces on the rods
        "payloads": ca.MX.sym("payloads", 1, count),
        "records": ca.MX.sym("records", size.record, count),
        "target": ca.MX.sym("target", of_target.record),
        "shift": ca.MX.sym("shift", n),
        "reckoned": ca.MX.sym("reckoned", n),  # where the commands have led, whatever was measured [rad]
        "lead": ca.MX.sym("lead", n),  # of the angles to plan from, over the sum of the commands [rad]
        "moves": ca.MX.sym("moves", 4, n),  # of the tip in the last period, for an angle that was not foreseen
        "lags": ca.MX.sym("lags", 2),  # of the motors: sums over reference rates times what is on its way, and squared
        "pull": ca.MX.sym("pull"),  # of measured angles on those to plan from, in a period; 1: these are the measured
        "prior": ca.MX.sym("prior", 2),  # what ``lags`` have beside
        "carries": ca.MX.sym("carries"),  # 1: the motor target carries the observed force, 0: it stays
        "numbers": ca.MX.sym("numbers", model.kind.size),
        "target_numbers": ca.MX.sym("target_numbers", target.kind.size),
        "mass": ca.MX.sym("mass", 2 + n, 2 + n),
        "gain": ca.MX.sym("gain", 6, 2),
        "half_step": ca.MX.sym("half_step"),
        "weights": ca.MX.sym("weights", 4),
        "terminal": ca.MX.sym("terminal", 4 + n, 4 + n),
        "bounds": ca.MX.sym("bounds", n, 4),
        "dt": ca.MX.sym("dt"),
    }
    given = SimpleNamespace(**inputs)
    given.states, given.inputs, given.forces = ca.vertsplit(given.window, [0, 4 + n, 4 + 2 * n, 6 + 2 * n])
    corrected = _corrected(given, n, commanded=commanded)
    x, force = corrected[:-2], corrected[-2:]
    graph_of = model_list if inline else model_graph
    found: list[tuple[Any, ...]] = []
    ahead = arriving = x
    for j in range(places.delay):
        u = given.on_the_way[:, j]
        found.append(_place(graph_of, model, given, ahead, u, force, j, rounding, last=False))
        ahead = _moved(found[j][1], ahead, u, n)
        arriving = ahead if j == 0 else arriving
    due, rates = _due(given, places.horizon) if commanded else (ca.DM(n, places.horizon + 1), ca.DM(n, 1))
    planned = [given.path[:, j] - ca.vertcat(ca.DM(4, 1), due[:, j + 1]) for j in range(places.models - 1)]
    line, u = [ahead, *planned], given.inputs[:, 0]
    for j, there in enumerate(line):
        if j + 1 < len(line):  # else the last rates stay
            u = (line[j + 1][4:] - there[4:]) / given.dt
        at = places.delay + j
        found.append(_place(graph_of, model, given, there, u, force, at, rounding, last=at == count - 1))
    records, models, good, states_of = (ca.horzcat(*columns) for columns in zip(*found, strict=True))
    shift, target_record, target_good = _shifted(target, given, force, n, rounding)
    states = given.states + ca.vertcat(
        ca.DM.zeros(4, places.horizon), ca.repmat(shift, 1, places.horizon) + due[:, 1:]
    )  # fmt: skip
    reckoned, of_plan = given.reckoned + given.dt * given.u_previous, models[:, places.delay :]
    changes = (due[:, 1:] - due[:, :-1]) / given.dt
    lags, moves = ca.DM.zeros(2), ca.DM.zeros(4, n)
    if commanded:
        # Angles that commands lead to and that are not measured are on their way, or slowly given up for lost.
        had_followed = ahead[4:] + due[:, 0]
        planned = had_followed + (1 - given.pull) * (reckoned + given.lead - had_followed)
        lags = (1 - given.pull) * given.lags + ca.vertcat(ca.dot(rates, planned - ahead[4:]), ca.sumsqr(rates))
        lags = (given.pull < 1) * lags
        ahead = ca.vertcat(ahead[:4], planned)
        by_rate = ca.reshape(models[(4 + n) * (5 + n) : (4 + n) * (5 + 2 * n), 0], 4 + n, n)[:4, :]
        moves = (given.pull < 1) * by_rate / given.dt
        behind = _behind(n, of_plan[:, 0].sparsity())
        of_plan = ca.horzcat(*(behind(of_plan[:, j], due[:, j], changes[:, j]) for j in range(places.models)))
    of_plan = ca.densify(of_plan)  # once, for the QP and for the result
    qp: Any = [ca.MX(0, 1)] * 5
    measures = ca.MX.zeros(3)
    if condense is not None:
        *qp, measures = condense(of_plan, ahead, states, given.inputs + changes, given.u_previous, given.weights,
                                 given.terminal, given.bounds, given.dt)  # fmt: skip
    good = ca.vertcat(good.T, target_good)
    outputs = {
        "first": models[:, 0], "corrected": corrected, "arriving": arriving, "places": states_of, "wanted": states,
        "carried": given.forces + force, "signs": _signs(model, given, records[:, places.delay]), "good": good,
        "decisions": ca.vertcat(ca.mmin(good), ca.norm_inf(reckoned - ahead[4:]), measures),
        "followed": records, "stays": records[:, -1], "followed_target": target_record, "moved_shift": shift,
        "moved_reckoned": reckoned, "moved_lead": ahead[4:] - reckoned, "next_moves": moves, "next_lags": lags,
        "now": models[:, : places.delay], "models": of_plan, "ahead": ahead, "P": qp[0], "q": qp[1], "l": qp[2],
        "u": qp[3], "free": qp[4],
    }  # fmt: skip
    graph = ca.Function("foresight", list(inputs.values()), list(outputs.values()), list(inputs), list(outputs))
    rods_are_lists = all(is_short(one.method.newton) for one in (model, target))
    short = inline and rods_are_lists and (condense is None or condense.is_a("SXFunction"))
    return listed(dense(graph)) if short else graph


def _corrected(given: Any, n: int, *, commanded: bool) -> Any:
    """State and force after the measurement; the tip has moved with the angles as they are measured to have turned."""
    estimate, measured = given.estimate, given.measured
    if not commanded:  # the angles were foreseen
        return correction(n)(estimate, measured, given.gain, given.half_step)
    p, q = estimate[:2], estimate[4:-2]
    turned = ca.fmin(ca.fmax(q, measured[2:] - given.half_step), measured[2:] + given.half_step) - q
    tip = estimate[:4] + given.moves @ turned
    # A tip that is told to be exactly where it was expected was not measured.
    missing = ca.logic_and(measured[0] == p[0], measured[1] == p[1])
    seen = ca.vertcat(ca.if_else(missing, tip[0], measured[0]), ca.if_else(missing, tip[1], measured[1]))
    return correction(n)(ca.vertcat(tip, estimate[4:]), ca.vertcat(seen, measured[2:]), given.gain, given.half_step)


def _due(given: Any, horizon: int) -> tuple[Any, Any]:
    """Angles by which commands that track the reference are ahead of the motors, at the ends of the periods, the start
    first, and the rates of the reference there.

    A motor that is late by a time, or lags with it as a time constant, is behind by that time's way. The time is fitted
    to what is on its way; the reference, and no answer of the controller, says when.
    """
    rates = given.inputs
    time = ca.fmin(ca.fmax((given.prior[0] + given.lags[0]) / (given.prior[1] + given.lags[1]), 0), _LATEST * given.dt)
    ends: list[Any] = [rates[:, 0], rates[:, -1]]
    if horizon > 1:
        ends = [1.5 * rates[:, 0] - 0.5 * rates[:, 1], 1.5 * rates[:, -1] - 0.5 * rates[:, -2]]
    between = (rates[:, 1:] + rates[:, :-1]) / 2
    return time * ca.horzcat(ends[0], between, ends[1]), ends[0]


def _behind(n: int, sparsity: Any) -> Any:
    """Graph (model of that sparsity, due (n), change (n)) -> model, dense, of a tip whose motors are behind the angles
    of its state by ``due``, which changes at a rate."""
    packed, due, change = ca.SX.sym("model", sparsity), ca.SX.sym("due", n), ca.SX.sym("change", n)
    n_states = 4 + n
    ends = [0, n_states**2, n_states * (n_states + 1), n_states * (n_states + 1 + n), packed.size1()]
    parts: list[Any] = ca.vertsplit(packed, ends)
    a, c, b, e = parts
    by_angle, by_rate = ca.reshape(a, n_states, n_states)[:4, 4:], ca.reshape(b, n_states, n)[:4, :]
    moved = ca.vertcat(a, c[:4] - by_angle @ due - by_rate @ change, c[4:], b, e)
    return ca.Function("behind", [packed, due, change], [ca.densify(moved)])


def _place(
    graph_of: Callable[[StepModel, int], Any],
    model: StepModel,
    given: Any,
    x: Any,
    rates: Any,
    force: Any,
    j: int,
    rounding: float,
    *,
    last: bool,
) -> tuple[Any, ...]:
    """Record and linear model of place j, whether its rods have followed, and x, where it is."""
    memory = given.records[: sizes(model).memory, j]
    graph = graph_of(model, 2 if last else 1)
    record, packed, verdict = graph(x, rates, force, given.payloads[j], memory, given.numbers, given.mass, given.dt)
    return record, packed, _grade(verdict, [*_verdict(rounding), STIFFEST, STIFFEST]), x


def _verdict(rounding: float) -> list[float]:
    return [max(_SOLVED, rounding), max(_DERIVATIVES, rounding), BRANCH_CHANGE, 0.0, LARGEST_DRIFT]


def _grade(verdict: Any, limits: list[float]) -> Any:
    """1 where no entry exceeds its limit, 1/2 where only the residuals do, and not by far, else 0; NaN exceeds all."""
    near = [_NEAR, math.inf, *limits[2:4], math.inf, *limits[5:]]
    return (ca.mmin(verdict <= ca.DM(limits)) + ca.mmin(verdict <= ca.DM(near))) / 2


def _moved(packed: Any, x: Any, u: Any, n: int) -> Any:
    """State one period later by a linear model."""
    n_states = 4 + n
    ends = [0, n_states**2, n_states * (n_states + 1), n_states * (n_states + 1 + n), packed.size1()]
    a, c, b, _ = ca.vertsplit(packed, ends)
    return ca.reshape(a, n_states, n_states) @ x + ca.reshape(b, n_states, n) @ u + c


def _shifted(target: StepModel, given: Any, force: Any, n: int, rounding: float) -> tuple[Any, Any, Any]:
    """Angles to add to those of the reference so that the rods carry the observed force too, at the end of the window.

    One Newton iteration a period: where tip and force do not change it converges, which is what makes the controller
    free of offset under a constant load. The least motion does it, G'(G G')^-1, two by two for any number of motors.
    """
    end = given.states[:, -1]
    pose = ca.vertcat(end[:2], end[4:] + given.shift)
    memory = given.target[: sizes(target).memory]
    record, verdict, found, _, g = force_graph(target, 1)(pose, memory, given.target_numbers)
    grade = _grade(verdict, [max(_DERIVATIVES, rounding), *_verdict(rounding)[1:]])
    numbers = target.kind.unpack(given.target_numbers)
    square = g @ g.T
    a, b, d = square[0, 0], square[0, 1], square[1, 1]
    determinant = a * d - b * b
    missing = given.forces[:, -1] + force + numbers.tip_mass * numbers.gravity - found
    step = g.T @ ca.vertcat(d * missing[0] - b * missing[1], a * missing[1] - b * missing[0]) / determinant
    step = step * ca.fmin(1, _LARGEST_STEP / ca.fmax(ca.norm_inf(step), 1e-300))
    moves = ca.logic_and(given.carries, ca.logic_and(grade >= 1, determinant >= _SINGULAR * a * d))
    return ca.if_else(moves, given.shift + step, given.shift), ca.if_else(grade, record, given.target), grade


def _signs(model: StepModel, given: Any, record: Any) -> Any:
    """By what limits of a pose come near: see `LimitWatch.far`."""
    n, width = model.kind.n_rods, model.method.newton.size1_in(0)
    ends = [0, width * n, (4 * width + 3) * n, (4 * width + 6) * n, (4 * width + 15) * n, record.size1()]
    parts: list[Any] = ca.vertsplit(record, ends)
    unknowns, _, loads, slopes, _ = parts
    loads, slopes = ca.reshape(loads, 3, n), ca.reshape(slopes, 3, 3 * n)
    torques: list[Any] = []
    k: Any = ca.MX(2, 2)
    for i, rod in enumerate(model.kind.unpack(given.numbers).rods):
        torques.append(-rod.bending_stiffness / rod.length * loads[2, i])
        k += rod.bending_stiffness / rod.length**3 * slopes[:2, 3 * i : 3 * i + 2]
    softest = (k[0, 0] + k[1, 1]) / 2 - ca.sqrt(((k[0, 0] - k[1, 1]) / 2) ** 2 + k[0, 1] ** 2)
    shapes = ca.reshape(unknowns, width, n)[:2, :]
    return ca.vertcat(softest, *torques, ca.vec(shapes.T))
