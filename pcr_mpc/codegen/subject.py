"""What is generated: a scene's controller as it stands at its start, and its plant."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..control.mpc import LinearMPC, riccati
from ..control.tuning import Tuning
from ..linearisation.pose_limits import PoseLimits
from ..loop.controller.control_step import ControlStep
from ..loop.controller.make_controller import make_controller
from ..loop.controller.tracking import TrackingController
from ..loop.parts.assembled import resting_model, resting_state
from ..loop.run.drive import drive_of
from ..loop.scene.scene import Scene
from ..plant.motion.plant import Plant
from ..plant.motion.step_graph import StepModel
from ..plant.robot import Robot
from ..plant.statics.equilibrium import Equilibrium
from .graphs import Graphs, make_graphs
from .precision import ROUNDING
from .scope import check_scope
from .solver import Shape, limited_shapes, rates_shape

# Kinds of limits on poses in their order, and their bits in the output of a step.
KIND_BITS = {"torque": 8, "tip region": 16, "rod margin": 32, "stiffness": 64, "strain": 128}


@dataclass(frozen=True, eq=False)
class Subject:
    """All that the generated files are about.

    Attributes
    ----------
    scene : Scene
        As it is tracked.
    tuning : Tuning
    pose : Equilibrium
        At the start.
    controller : TrackingController
        Started there.
    plant : Plant
        At rest there.
    single : bool
        C is to compute in single precision.
    """

    scene: Scene
    tuning: Tuning
    pose: Equilibrium
    controller: TrackingController
    plant: Plant
    single: bool = False

    @classmethod
    def of_scene(cls, scene: Scene, tuning: Tuning | None = None, *, single: bool = False) -> Subject:
        """Start controller and plant of a scene.

        Raises
        ------
        GenerationError
            The scene is beyond what C has.
        """
        tuning = check_scope(scene, tuning or scene.tuning)
        pose = scene.start()
        controller = make_controller(scene, tuning)
        assert isinstance(controller, TrackingController)
        controller.start(pose)
        plant = scene.plant.make(scene.robot)
        plant.reset(resting_state(pose), pose)
        return cls(scene, tuning, pose, controller, plant, single)

    @property
    def rounding(self) -> float:
        """Residual below which rods cannot come."""
        return ROUNDING if self.single else 0.0

    @property
    def robot(self) -> Robot:
        """What the controller believes it to be."""
        return self.controller.robot

    @property
    def work(self) -> ControlStep:
        """The parts of the controller."""
        return self.controller.work

    @property
    def law(self) -> LinearMPC:
        """Its control law."""
        assert isinstance(self.work.law, LinearMPC)
        return self.work.law

    @property
    def limits(self) -> PoseLimits:
        """Limits on poses that are watched."""
        return self.work.watch.limits

    @cached_property
    def kinds(self) -> dict[str, int]:
        """Kinds of limits on poses that are watched, and their rows."""
        return {kinds[0]: len(kinds) for kinds in self.work.watch.combinations() if len(set(kinds)) == 1}

    @cached_property
    def graphs(self) -> Graphs:
        """C of all graphs."""
        model, target = self.work.foresight.step_models
        return make_graphs(
            model, target, self.watched, self.work.foresight.places, self.law, self.plant, rounding=self.rounding
        )

    @property
    def watched(self) -> StepModel:
        """Of the rods whose limits are watched."""
        model = self.work.watch.plant.step_model
        assert model is not None
        return model

    @cached_property
    def rates(self) -> Shape:
        """Of the QP with the limits on the rates alone."""
        return rates_shape(self.tuning.horizon, self.robot.n_rods)

    @cached_property
    def limited(self) -> list[Shape]:
        """Of the QPs with soft rows, by the bits of the kinds that are near."""
        return limited_shapes(self.tuning.horizon, self.robot.n_rods, list(self.kinds.values()))

    @property
    def drives(self) -> bool:
        """Whether the motors do not follow at once."""
        return drive_of(self.scene, self.plant.dt, self.pose) is not None

    @property
    def plant_as_model(self) -> bool:
        """Whether the plant's rods, which have no mass then, are those of the model: C can follow them elsewhere."""
        plant, (model, _) = self.plant.step_model, self.work.foresight.step_models
        assert plant is not None
        alike = (plant.kind, plant.method, plant.weight) == (model.kind, model.method, model.weight)
        return alike and plant.inertia == "none" and plant.weight != "condensed"

    def resting(self) -> Any:
        """Linear model about the start, and the gain of the LQR of the terminal weight."""
        model = resting_model(self.robot, self.tuning.model, self.pose, self.scene.period)
        return model, riccati(model, self.tuning)[0]

    def reference(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows of the reference from the first period on, the row that is held after it, and payloads [kg]."""
        track, last, delay = self.work.track, self.scene.n_periods, self.work.delay
        rows = [track.window(k, 0)[0] for k in range(last)]
        rows += [track.window(last - 1, j)[0] for j in range(1, delay + 1)]
        rows += list(track.window(last - 1, delay)[1:])
        end = track.window(last, 0)[0].copy()
        count = last + self.work.foresight.places.count
        payloads = track.payloads(0, count) if track.carries else np.zeros(1)
        return np.array(rows), end, payloads
