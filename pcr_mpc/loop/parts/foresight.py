"""What a controller knows when it decides: where commands take the robot, and linear models from there on."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...buffered import BufferedFunction
from ...compiled import fastest, has_compiler
from ...control.qp.program import QuadraticProgram, Reference, constraint_matrix
from ...errors import ConvergenceError, PCRError
from ...linearisation.linear_model import LinearModel, LinearModels
from ...linearisation.linearise import linearise
from ...plant.motion.plant import Plant
from ...plant.motion.step_graph import StepModel
from ...plant.rods.numbers import Kind
from ...plant.statics.equilibrium import Equilibrium
from .foresight_graph import Places, foresight_graph

_NEAR = 0.5  # of ``good``: see `foresight_graph`
_AGAIN = 3  # evaluations at most for rods that are near


@dataclass(frozen=True, eq=False)
class Outlook:
    """Result of a `Foresight`: views of its memory, valid until its next call.

    Attributes
    ----------
    ahead : ndarray, shape (4 + n,)
        State when the decision reaches the motors.
    arriving : ndarray, shape (4 + n,)
        State at the end of the period; without a delay the one at its start.
    now, first, models : LinearModels
        For the period that begins now, length 1, of angles that are planned from and of the motors' own; from there on,
        length 1 or N.
    record : ndarray
        Of the rods there (see `warm_calls`).
    shift : ndarray, shape (n,)
        Added to the angles of the reference [rad].
    reference : Reference
        Over the horizon, with the shift and the observed force.
    reckoned : ndarray, shape (n,)
        Where the commands have led [rad].
    signs : ndarray
        See `LimitWatch.far`.
    qp : QuadraticProgram or None
        None: none was wanted.
    """

    ahead: np.ndarray
    arriving: np.ndarray
    now: LinearModels
    first: LinearModels
    models: LinearModels
    record: np.ndarray
    shift: np.ndarray
    reference: Reference
    reckoned: np.ndarray
    signs: np.ndarray
    qp: QuadraticProgram | None

    @property
    def states(self) -> np.ndarray:
        """The reference with the shift, shape (N, 4 + n)."""
        return self.reference.states


class Foresight:
    """`foresight_graph` with its memory: the rods at every place, and the motor target.

    Rods that one or two Newton iterations do not bring along take as many again, all places at once, and those that are
    not near then take the ladder of `Plant`.

    Parameters
    ----------
    plant, target : Plant
        The one that is linearised, and the one whose rods carry the observed force.
    places : Places
    period : float
        [s].
    condense : casadi.Function or None
        See `condensing`.
    commanded : bool
        See `foresight_graph`.
    compiled : bool
        Whether to run as machine code where there is a compiler.

    Attributes
    ----------
    inputs : dict of str to ndarray
        Of the graph: what a caller writes before a call.
    rows : dict of str to ndarray
        Those of its inputs that have a column for each period or place: views with a row for each.
    measured, u_previous, pull : ndarray
        Those of its inputs that are written or read in every period.
    expected, force : ndarray
        State (4 + n) at the next measurement, and force (2) on the tip, as they are estimated: parts of an input.
    window : ndarray, shape (N, 6 + 2n)
        The reference: states at the ends of the periods, rates in them, forces that the rods carry at their ends.
    corrected : ndarray, shape (6 + n,)
        State and force after the last measurement, also where the rods could not follow.
    outlook : Outlook
        Of the last call.
    strayed : float
        How far the sum of the commands is from the angles ahead [rad].
    """

    def __init__(
        self,
        plant: Plant,
        target: Plant,
        places: Places,
        period: float,
        condense: Any | None,
        *,
        commanded: bool = True,
        compiled: bool = False,
    ) -> None:
        assert plant.step_model is not None
        assert target.step_model is not None
        self._plant, self._target_plant, self.places, self._period = plant, target, places, period
        inline = not (compiled and has_compiler())
        function = foresight_graph(
            plant.step_model, target.step_model, places, condense, commanded=commanded, inline=inline
        )
        self._graph = graph = BufferedFunction(fastest(function, compiled))
        n, ends = plant.robot.n_rods, np.cumsum([view.size for view in graph.outputs]).tolist()
        self.inputs = given = dict(zip(function.name_in(), graph.inputs, strict=True))
        self._outputs = found = dict(zip(function.name_out(), graph.outputs, strict=True))
        ends = dict(zip(found, ends, strict=True))
        self.rows = {name: _rows(given[name]) for name in ("path", "on_the_way", "payloads", "records")}
        self.window = _rows(given["window"])
        self.rows |= {"states": self.window[:, : 4 + n], "inputs": self.window[:, 4 + n : -2]}
        given["end_force"] = self.window[-1, -2:]
        self.measured, self.u_previous, self.pull = (given[name] for name in ("measured", "u_previous", "pull"))
        self.expected: np.ndarray = given["estimate"][:-2]
        self.force: np.ndarray = given["estimate"][-2:]
        given["dt"][:], given["target_numbers"][:] = period, target.numbers
        given["pull"][:], given["prior"][:] = 1.0, (0.0, 1.0)  # from measured angles, with motors that follow at once
        # What the next period starts from: in it each place is where its neighbour is now.
        names = "records", "target", "shift", "reckoned", "lead", "moves", "lags"
        before = sum(view.size for name, view in zip(function.name_in(), graph.inputs, strict=True)
                     if function.index_in(name) < function.index_in(names[0]))  # fmt: skip
        self._memory = graph.memory_in[before : before + sum(given[name].size for name in names)]
        self._next = graph.memory_out[ends["next_lags"] - self._memory.size : ends["next_lags"]]
        self._records = self.rows["records"]
        self._decisions = found["decisions"]
        self.corrected, self.strayed = found["corrected"], 0.0
        force = self.corrected[-2:]
        now, models = (LinearModels(found[name].reshape(len(found["models"]), -1, order="F"), period, force)
                       for name in ("now", "models"))  # fmt: skip
        qp = None
        if condense is not None:
            qp = QuadraticProgram(
                found["P"], found["q"], constraint_matrix(places.horizon, n), found["l"], found["u"],
                self._decisions[2:], found["free"], graph.memory_out[ends["now"] : ends["u"]],
            )  # fmt: skip
        self.outlook = Outlook(
            ahead=found["ahead"],
            arriving=found["arriving"],
            now=(now if places.delay else models)[:1],
            first=LinearModels(found["first"].reshape(-1, 1), period, force),
            models=models,
            record=_column(found["followed"], places.delay),
            shift=found["moved_shift"],
            reference=Reference(_rows(found["wanted"]), self.rows["inputs"], _rows(found["carried"])),
            reckoned=found["moved_reckoned"],
            signs=found["signs"],
            qp=qp,
        )

    @property
    def step_models(self) -> tuple[StepModel, StepModel]:
        """Of the plant that is linearised, and of the one whose rods carry the observed force."""
        model, target = self._plant.step_model, self._target_plant.step_model
        assert model is not None
        assert target is not None
        return model, target

    @property
    def kinds(self) -> tuple[Kind, Kind]:
        """What ``numbers`` and ``target_numbers`` of the inputs hold."""
        assert self._plant.step_model is not None
        assert self._target_plant.step_model is not None
        return self._plant.step_model.kind, self._target_plant.step_model.kind

    def reset(self, x: np.ndarray, pose: Equilibrium) -> None:
        """All rods are in ``pose``, and there is no force."""
        self._plant.reset(x, pose)
        self._target_plant.reset(x, pose)
        self.inputs["numbers"][:] = self._plant.numbers
        self.inputs["mass"][:] = self._plant.mass(x[:2], x[4:])[0]
        self.inputs["target"][:] = self._target_plant.record
        self.inputs["shift"][:], self.inputs["u_previous"][:] = 0.0, 0.0
        self.inputs["reckoned"][:] = x[4:]
        for name in ("lead", "moves", "lags"):
            self.inputs[name][:] = 0.0
        self._records[:] = self._plant.record

    def follow(self, x: np.ndarray, pose: Equilibrium) -> LinearModel:
        """All rods are in ``pose`` at the state x, and nothing else changes; return the linear model there."""
        self._plant.reset(x, pose)
        self._plant.carry(float(self.inputs["payloads"].ravel()[0]), x)
        model = linearise(self._plant, x, np.zeros(len(x) - 4), self._period, self.force)
        self._records[:] = self._plant.record
        return model

    def pose(self, x: np.ndarray) -> Equilibrium:
        """Equilibrium at the state x at which the next period will begin, following the branch."""
        self._plant.recall(self._records[0])
        return self._plant.equilibrium(x)

    def plant_at(self, x: np.ndarray, period: float) -> Plant:
        """Make a plant that moves as the model does, by steps of a period, from the state x where the next begins."""
        model = self._plant
        shooting = model.shooting
        plant = Plant(
            model.robot, method=model.method, segments=shooting.segments, steps=shooting.steps, scheme=shooting.scheme,
            inertia=model.inertia, integrator="rk4", dt=period,
        )  # fmt: skip
        plant.reset(x, self.pose(x))
        return plant

    def target_from(self, other: Foresight) -> None:
        """Go on with the motor target, and the sum of the commands, of another one of the same robot."""
        for name in ("target", "shift", "reckoned", "lead", "moves", "lags"):
            self.inputs[name][:] = other.inputs[name]

    def __call__(self) -> Outlook:
        """Evaluate for the inputs, and keep the rods for the next period.

        Raises
        ------
        UnreachableError, ConvergenceError, UnstableError, ValueError
            As `linearise`, at one of the places; the rods are then where they were, or nearer to where they had to go.
        """
        self._graph()
        worst, self.strayed, *_ = self._decisions.tolist()
        if not worst >= 1.0:  # NaN is not good
            try:
                self._bring_along()
            except BaseException:
                self.inputs["reckoned"][:] = self.outlook.reckoned
                raise
        self._memory[:] = self._next
        return self.outlook

    def _go_on(self) -> bool:
        """Evaluate again from where the rods have come that are near, all places at once; False if there are none."""
        found, good = self._outputs, self._outputs["good"]
        near = (good == _NEAR).tolist()
        if not any(near):
            return False
        for j, record in enumerate(_rows(found["followed"])):
            if near[j]:
                self._records[j] = record
        if near[-1]:
            self.inputs["target"][:] = found["followed_target"]
        self._graph()
        return True

    def _bring_along(self) -> None:
        """Bring along the rods that have not followed: more iterations, then the ladder, one place after the other."""
        good, late = self._outputs["good"], dict[int, np.ndarray]()
        for _ in range(_AGAIN):
            if not self._go_on():
                break
        try:
            for j in range(self.places.count):
                if good[j] < 1.0:
                    before = self._records[j].copy()
                    self._climb(j)
                    late[j] = before
                    if j < self.places.delay:
                        self._look_again(late)  # the next place stands on this one
        finally:
            self._look_again(late)
        if good[-1] < 1.0:
            self._follow_target()

    def _climb(self, j: int) -> None:
        """Take the rods of place j along by the ladder."""
        x = self._place(j)
        self._plant.recall(self._records[j])
        self._plant.carry(float(self.inputs["payloads"].ravel()[j]), x)
        linearise(self._plant, x, np.zeros(len(x) - 4), self._period, self.corrected[-2:])
        self._records[j] = self._plant.record

    def _look_again(self, late: dict[int, np.ndarray]) -> None:
        """Evaluate with the records of places that have climbed, and raise for the first whose rods do not stay.

        ``late`` are their records before that, which those after it get back; it is emptied.
        """
        if not late:
            return
        self._graph()
        places = list(late)
        for j in places:
            if self._outputs["good"][j] < 1.0:
                for later in places[places.index(j) + 1 :]:
                    self._records[later] = late[later]
                late.clear()
                x = self._place(j)
                raise ConvergenceError(
                    f"no linear model at p = {x[:2]} m, q = {x[4:]} rad, {j} periods ahead: the rods get there, "
                    "and do not stay; keep away from this pose",
                    residual=float("nan"), iterations=0, last=x,
                )  # fmt: skip
        late.clear()

    def _place(self, j: int) -> np.ndarray:
        """State at place j."""
        places = self._outputs["places"].reshape(-1, self.places.count, order="F")
        return np.array(places[:, j])

    def _follow_target(self) -> None:
        """Take the ladder for the rods of the motor target; where it leads nowhere, they stay where they are."""
        inputs, plant = self.inputs, self._target_plant
        end = self.rows["states"][-1]
        plant.recall(inputs["target"])
        with suppress(PCRError):
            plant.force(end[:2], end[4:] + inputs["shift"])
            inputs["target"][:] = plant.record
            self._graph()


def _rows(columns: np.ndarray) -> np.ndarray:
    """View of a graph's columns as rows."""
    return columns[None] if columns.ndim == 1 else columns.T


def _column(block: np.ndarray, j: int) -> np.ndarray:
    return block if block.ndim == 1 else block[:, j]
