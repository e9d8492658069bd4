"""A whole time step of the plant as one graph: what `Plant.step` tries first, and what `rollout` repeats.

It is put together from the graphs that the slow way calls one by one (see `integrators`, `warm_step`, `robot_mass`):
the same arithmetic, without Python in between.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ...buffered import graph_cache
from ...compiled import compiled as machine_code
from ..rods.follower import BRANCH_CHANGE
from ..rods.method import RodMethod, for_compiler, warm_calls, warm_step
from ..rods.numbers import Kind
from ..statics.weight import robot_weight
from .integrators import RK4_STAGES, euler_graph, first_half_graph, second_half_graph, stage_graph, stop_graph
from .mass_matrix import mass_calls, robot_mass

# Newton iterations for a force, to be tried in this order.
CORRECTIONS = (1, 2)
# Poses that a step of each integrator moves the rods to.
SOLVES = {"semi_implicit_euler": 1, "velocity_verlet": 1, "rk4": 4}
# A simulation uses the derivatives only to predict the next pose.
PREDICTOR_ACCURACY = 1e-2
# Relative drift of a rod's invariant beyond which its force may be off by per cents.
LARGEST_DRIFT = 1e-3


@dataclass(frozen=True)
class StepModel:
    """What a step is a step of.

    Attributes
    ----------
    kind : Kind
        Of the robot; its numbers are an input.
    method : RodMethod
        Of its rods.
    integrator : {"semi_implicit_euler", "velocity_verlet", "rk4"}
    inertia : {"none", "constant", "condensed"}
    weight : {"none", "condensed", "exact"}
        Of the rods.
    dt : float
        [s].
    """

    kind: Kind
    method: RodMethod
    integrator: str
    inertia: str
    weight: str
    dt: float

    def for_compiler(self) -> StepModel:
        """Return the same with the graphs of its rods as a C compiler should be given them."""
        return replace(self, method=for_compiler(self.method))

    @property
    def widths(self) -> tuple[int, int, int]:
        """Numbers of a memory: what starts the rods, F, and M with its derivatives as far as they are not fixed."""
        n = self.kind.n_rods
        mass = {"none": 0, "constant": (2 + n) ** 2, "condensed": (2 + n) ** 2 * (3 + n)}[self.inertia]
        return (4 * self.method.newton.size1_in(0) + 3) * n, 2, mass

    def memory(self, start: np.ndarray, force: np.ndarray, mass: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Put a memory together."""
        kept = {"none": (), "constant": mass[:1], "condensed": mass}[self.inertia]
        return np.concatenate([start, force, *(matrix.ravel(order="F") for matrix in kept)])


class Motion(ABC):
    """Rods and mass on their way through a step, as expressions; a subclass says how the rods follow.

    Parameters
    ----------
    model : StepModel
    vector : casadi
        Numbers of the robot.
    told, q, f_ext : casadi
        What the motors are told, their angles at the start of the step, and the force on the tip besides its weight.
    inline : bool
        Make one list of instructions of the rods, if it is not too long; else calls, for a compiler.
    """

    def __init__(
        self, model: StepModel, vector: Any, told: Any, q: Any, f_ext: Any, *, inline: bool = True
    ) -> None:  # fmt: skip
        self.model, self.n, self.inline = model, model.kind.n_rods, inline
        self.vector, self.numbers = vector, model.kind.unpack(vector)
        self.of_rods = vector if model.weight == "exact" else model.kind.weightless(vector)
        self._push = f_ext + self.numbers.tip_mass * self.numbers.gravity
        # As Robot.motor_rates.
        lower, upper, limit = self.numbers.angle_lower, self.numbers.angle_upper, self.numbers.rate_limit
        rates = ca.fmin(ca.fmax(told, -limit), limit)
        rates = (ca.fmin(ca.fmax(q + model.dt * rates, lower), upper) - q) / model.dt
        self._rates = ca.fmin(ca.fmax(rates, -limit), limit)
        self.force: Any = None
        size, tip = 2 + self.n, self.numbers.tip_mass
        self.mass: tuple[Any, Any] = ca.diag(ca.vertcat(tip, tip, np.zeros(self.n))), ca.DM.zeros(size**2, size)

    def known(self) -> list[Any]:
        """First arguments of the graphs of `integrators`."""
        return [*self.mass, self._push - self.force, self._rates, ca.vertcat(self.numbers.drag, self.model.dt)]

    @abstractmethod
    def follow(self, p: Any, q: Any) -> tuple[Any, Any]:
        """Let the rods follow to (p, q), and return their unknowns (u, n) and the force that holds the tip."""

    def move(self, p: Any, q: Any) -> None:
        """Let all follow to (p, q)."""
        model = self.model
        unknowns, self.force = self.follow(p, q)
        if model.weight == "condensed":
            self.force += robot_weight(model.kind)[0](unknowns, q, self.vector)[1][:2]
        if model.inertia == "condensed":
            of_pose = (robot_mass if self.inline else mass_calls)(model.kind, model.method)
            self.mass = tuple(of_pose(unknowns, q, self.of_rods))

    def advance(self, x: Any) -> Any:
        """State at the end of a step from x, where all is."""
        return _INTEGRATORS[self.model.integrator](self, x)


class _WarmMotion(Motion):
    """Rods that start from a memory, in a fixed number of Newton iterations."""

    def __init__(self, memory: Any, corrections: int, *args: Any, inline: bool) -> None:
        super().__init__(*args, inline=inline)
        self._corrections = corrections
        start, force, mass = self.model.widths
        self.start, self.force, mass = ca.vertsplit(memory, [0, start, start + force, start + force + mass])
        size = 2 + self.n
        if self.model.inertia == "constant":
            self.mass = ca.reshape(mass, size, size), ca.DM.zeros(size**2, size)
        elif self.model.inertia == "condensed":
            self.mass = ca.reshape(mass[: size**2], size, size), ca.reshape(mass[size**2 :], size**2, size)
        self.verdict: Any = 0
        self.record: Any = None
        self.result: Any = None
        self.places: list[Any] = []

    def follow(self, p: Any, q: Any) -> tuple[Any, Any]:
        model = self.model
        warm = (warm_step if self.inline else warm_calls)(model.kind, model.method, self._corrections)
        self.record, verdict, self.result = warm(ca.vertcat(p, q), self.start, self.of_rods)
        self.verdict += verdict
        self.start = self.record[: model.widths[0]]
        unknowns = self.record[: model.method.newton.size1_in(0) * self.n]
        self.places.append(ca.vertcat(p, q, unknowns))
        return ca.reshape(unknowns, -1, self.n), self.result[:2]

    def memory(self) -> Any:
        """What the next step starts from."""
        kept = {"none": (), "constant": self.mass[:1], "condensed": self.mass}[self.model.inertia]
        return ca.vertcat(self.start, self.force, *(ca.vec(matrix) for matrix in kept))


def _semi_implicit_euler(motion: Motion, x: Any) -> Any:
    p, q, momentum = euler_graph(motion.n)(*motion.known(), x)
    motion.move(p, q)
    return ca.vertcat(p, stop_graph(motion.n)(*motion.known(), momentum), q)


def _velocity_verlet(motion: Motion, x: Any) -> Any:
    p, q, momentum = first_half_graph(motion.n)(*motion.known(), x)
    motion.move(p, q)
    return ca.vertcat(p, second_half_graph(motion.n)(*motion.known(), momentum), q)


def _rk4(motion: Motion, x: Any) -> Any:
    mass = motion.known()[0]
    y = start = total = ca.vertcat(x[:2], mass[:2, :2] @ x[2:4], x[4:])
    for i, (ahead, weight) in enumerate(RK4_STAGES):
        if i:
            motion.move(y[:2], y[4:])
        factors = motion.model.dt * ca.DM([ahead, weight])
        y, total = stage_graph(motion.n)(*motion.known(), y, start, total, factors)
    p, momentum, q = ca.vertsplit(total, [0, 2, 4, 4 + motion.n])
    motion.move(p, q)
    return ca.vertcat(p, stop_graph(motion.n)(*motion.known(), momentum), q)


_INTEGRATORS = {"semi_implicit_euler": _semi_implicit_euler, "velocity_verlet": _velocity_verlet, "rk4": _rk4}


def step_graph(model: StepModel, corrections: int, *, details: bool, inline: bool = True) -> Any:
    """One step from a pose that is solved to the next.

    Nothing is decided in here: the caller reads the verdict, and keeps the result or does not (see `limits`).

    Parameters
    ----------
    corrections : int
        Newton iterations for each force.
    details : bool
        Whether record and result are wanted.
    inline : bool
        See `Motion`.

    Returns
    -------
    casadi.Function
        (memory, x (4 + n), [u, f_ext] (n + 2), numbers) -> memory, x, verdict (5) and, with details, record and result
        at the end of the step (see `warm_step`). A memory is of the pose of its x. u is what the motors are told, f_ext
        comes on top of the tip's weight. The verdict is that of `warm_step`, added up over the solves of the step.
    """
    motion, arguments, results = _step(model, corrections, inline=inline)
    if details:
        results += [motion.record, motion.result]
    return ca.Function("step", arguments, [ca.densify(r) for r in results])


@graph_cache(maxsize=16)
def trail_graph(model: StepModel, corrections: int) -> Any:
    """`step_graph` with, as its last result, the places [p, q, unknowns] of all its solves in one vector."""
    motion, arguments, results = _step(model, corrections, inline=True)
    return ca.Function("step", arguments, [ca.densify(r) for r in [*results, ca.vertcat(*motion.places)]])


def _step(model: StepModel, corrections: int, *, inline: bool) -> tuple[_WarmMotion, list[Any], list[Any]]:
    """Rods on their way through a step, its arguments, and the results that every graph of it has."""
    graphs = [warm_step(model.kind, model.method, corrections)]
    if model.inertia == "condensed":
        graphs.append(robot_mass(model.kind, model.method))
    inline = inline and all(graph.is_a("SXFunction") for graph in graphs)
    symbol: Any = (ca.SX if inline else ca.MX).sym
    n = model.kind.n_rods
    memory, x, given = symbol("memory", sum(model.widths)), symbol("x", 4 + n), symbol("given", n + 2)
    vector = symbol("numbers", model.kind.size)
    motion = _WarmMotion(memory, corrections, model, vector, given[:n], x[4:], given[n:], inline=inline)
    end = motion.advance(x)
    return motion, [memory, x, given, vector], [motion.memory(), end, motion.verdict]


@graph_cache(maxsize=32)
def step_function(model: StepModel, corrections: int, *, details: bool, compiled: bool) -> Any:
    """`step_graph` as it is, or as machine code."""
    if not compiled:
        return step_graph(model, corrections, details=details)
    return machine_code(step_graph(model.for_compiler(), corrections, details=details))


def limits(model: StepModel) -> list[float]:
    """Largest entries of a verdict with which the rods have followed; NaN is beyond every limit."""
    return [model.method.following, PREDICTOR_ACCURACY, BRANCH_CHANGE, 0.0, LARGEST_DRIFT]
