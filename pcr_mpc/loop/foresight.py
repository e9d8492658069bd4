"""What a controller knows when it decides: where commands take the robot, and linear models from there on."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..buffered import BufferedFunction
from ..compiled import fastest, has_compiler
from ..errors import ConvergenceError, PCRError
from ..linearisation.linear_model import LinearModels
from ..linearisation.linearise import linearise
from ..plant.motion.plant import Plant
from ..plant.statics.equilibrium import Equilibrium
from .foresight_graph import Places, foresight_graph


@dataclass(frozen=True, eq=False)
class Outlook:
    """Result of a `Foresight`: views of its memory, valid until its next call.

    Attributes
    ----------
    ahead : ndarray, shape (4 + n,)
        State when the decision reaches the motors.
    arriving : ndarray, shape (4 + n,)
        State at the end of the period; without a delay the one at its start.
    now, models : LinearModels
        For the period that begins now, length 1; from there on, length 1 or N.
    record : ndarray
        Of the rods there (see `warm_calls`).
    shift : ndarray, shape (n,)
        Added to the angles of the reference [rad].
    states : ndarray, shape (N, 4 + n)
        The reference with that.
    signs : ndarray
        See `LimitWatch.far`.
    qp : list of ndarray
        P, q, l, u and sizes, if wanted (see `condensing`).
    """

    ahead: np.ndarray
    arriving: np.ndarray
    now: LinearModels
    models: LinearModels
    record: np.ndarray
    shift: np.ndarray
    states: np.ndarray
    signs: np.ndarray
    qp: list[np.ndarray]


class Foresight:
    """`foresight_graph` with its memory: the rods at every place, and the motor target.

    Rods that one or two Newton iterations do not bring along take the ladder of `Plant`.

    Parameters
    ----------
    plant, target : Plant
        The one that is linearised, and the one whose rods carry the observed force.
    places : Places
    period : float
        [s].
    condense : casadi.Function or None
        See `condensing`.
    compiled : bool
        Whether to run as machine code where there is a compiler.

    Attributes
    ----------
    inputs : dict of str to ndarray
        Of the graph: what a caller writes before a call.
    rows : dict of str to ndarray
        Those of its inputs that have a column for each period or place: views with a row for each.
    corrected : ndarray, shape (6 + n,)
        State and force after the last measurement, also where the rods could not follow.
    """

    def __init__(
        self,
        plant: Plant,
        target: Plant,
        places: Places,
        period: float,
        condense: Any | None,
        *,
        compiled: bool = False,
    ) -> None:
        assert plant.step_model is not None
        assert target.step_model is not None
        self._plant, self._target_plant, self.places, self._period = plant, target, places, period
        inline = not (compiled and has_compiler())
        graph = foresight_graph(plant.step_model, target.step_model, places, condense, inline=inline)
        self._graph = BufferedFunction(fastest(graph, compiled))
        self.inputs = dict(zip(graph.name_in(), self._graph.inputs, strict=True))
        self._outputs = dict(zip(graph.name_out(), self._graph.outputs, strict=True))
        self.rows = {name: _rows(self.inputs[name]) for name in ("states", "inputs", "path", "on_the_way", "payloads")}
        self._records, self._followed = _rows(self.inputs["records"]), _rows(self._outputs["followed"])
        self.inputs["dt"][:] = period
        self.inputs["target_numbers"][:] = target.numbers
        found, first = self._outputs, places.delay
        columns, force = found["models"].reshape(-1, places.count, order="F"), found["corrected"][-2:]
        self.corrected = found["corrected"]
        self._outlook = Outlook(
            ahead=_column(found["places"], first),
            arriving=found["arriving"],
            now=LinearModels(columns[:, :1], period, force),
            models=LinearModels(columns[:, first:], period, force),
            record=_column(found["followed"], first),
            shift=found["moved_shift"],
            states=_rows(found["wanted"]),
            signs=found["signs"],
            qp=[found[name] for name in ("P", "q", "l", "u", "sizes") if name in found],
        )

    def reset(self, x: np.ndarray, pose: Equilibrium) -> None:
        """All rods are in ``pose``, and there is no force."""
        self._plant.reset(x, pose)
        self._target_plant.reset(x, pose)
        self.inputs["numbers"][:] = self._plant.numbers
        self.inputs["mass"][:] = self._plant.mass(x[:2], x[4:])[0]
        self.inputs["target"][:] = self._target_plant.record
        self.inputs["shift"][:] = 0.0
        self._records[:] = self._plant.record

    def pose(self, x: np.ndarray) -> Equilibrium:
        """Equilibrium at the state x at which the next period will begin, following the branch."""
        self._plant.recall(self._records[0])
        return self._plant.equilibrium(x)

    def target_from(self, other: Foresight) -> None:
        """Go on with the motor target of another one of the same robot."""
        self.inputs["target"][:], self.inputs["shift"][:] = other.inputs["target"], other.inputs["shift"]

    def __call__(self) -> Outlook:
        """Evaluate for the inputs, and keep the rods for the next period.

        Raises
        ------
        UnreachableError, ConvergenceError, UnstableError, ValueError
            As `linearise`, at one of the places; the rods are then where they were.
        """
        good = self._outputs["good"]
        self._graph()
        if good.min() < 1.0:
            self._bring_along()
        inputs, found = self.inputs, self._outputs
        # In the next period each place is where its neighbour is now.
        self._records[:-1], self._records[-1] = self._followed[1:], self._followed[-1]
        inputs["target"][:], inputs["shift"][:] = found["followed_target"], found["moved_shift"]
        return self._outlook

    def _bring_along(self) -> None:
        """Take the ladder for the rods that have not followed, one place after the other."""
        good, found = self._outputs["good"], self._outputs
        payloads, force = self.inputs["payloads"].ravel(), found["corrected"][-2:]
        for j in range(self.places.count):
            if good[j] < 1.0:
                self._plant.recall(self._records[j])
                x = found["places"].reshape(-1, self.places.count, order="F")[:, j].copy()
                self._plant.carry(float(payloads[j]), x)
                linearise(self._plant, x, np.zeros(len(x) - 4), self._period, force)
                self._records[j] = self._plant.record
                # What comes after stands on this place.
                self._graph()
                if good[j] < 1.0:
                    raise ConvergenceError(
                        f"no linear model at p = {x[:2]} m, q = {x[4:]} rad, {j} periods ahead: the rods get there, "
                        "and do not stay; keep away from this pose",
                        residual=float("nan"), iterations=0, last=x,
                    )  # fmt: skip
        if good[-1] < 1.0:
            self._follow_target()

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
