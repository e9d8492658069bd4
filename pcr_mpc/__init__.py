"""Model-predictive control of planar parallel continuum robots.

The public names are loaded when they are first asked for: the command line says what is wrong with its arguments, and
can be interrupted, before two seconds of loading.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .control.mpc import LinearMPC
    from .control.plan import Plan
    from .control.qp import QuadraticProgram, Reference, build_qp
    from .control.tuning import Limits, Tuning, load_tuning
    from .errors import (
        CompilerError,
        ConvergenceError,
        InfeasibleError,
        MeasurementError,
        ModelError,
        PCRError,
        SimulationError,
        UnreachableError,
        UnstableError,
    )
    from .linearisation.linear_model import LinearModel
    from .linearisation.linearise import linearise
    from .loop.controllers import HoldMotors
    from .loop.feasibility import check_scene
    from .loop.run import Run, load_run
    from .loop.scene import Scene, load_scene
    from .loop.simulate import simulate
    from .loop.tracking import TrackingController, make_controller
    from .plant.dynamics import Plant
    from .plant.equilibria import Equilibria
    from .plant.equilibrium import Equilibrium
    from .plant.free_tip import forward_statics, inverse_statics
    from .plant.robot import Robot, Rod, load_robot
    from .plant.rollout import Rollout, rollout
    from .plant.sensitivities import Sensitivities, sensitivities
    from .plant.stability import Stability, all_equilibria, assess_stability, distance_to_fold
    from .plant.statics import solve_statics
    from .plant.statics_batch import solve_statics_batch

__all__ = [
    "CompilerError",
    "ConvergenceError",
    "Equilibria",
    "Equilibrium",
    "HoldMotors",
    "InfeasibleError",
    "Limits",
    "LinearMPC",
    "LinearModel",
    "MeasurementError",
    "ModelError",
    "PCRError",
    "Plan",
    "Plant",
    "QuadraticProgram",
    "Reference",
    "Robot",
    "Rod",
    "Rollout",
    "Run",
    "Scene",
    "Sensitivities",
    "SimulationError",
    "Stability",
    "TrackingController",
    "Tuning",
    "UnreachableError",
    "UnstableError",
    "all_equilibria",
    "assess_stability",
    "build_qp",
    "check_scene",
    "distance_to_fold",
    "forward_statics",
    "inverse_statics",
    "linearise",
    "load_robot",
    "load_run",
    "load_scene",
    "load_tuning",
    "make_controller",
    "rollout",
    "sensitivities",
    "simulate",
    "solve_statics",
    "solve_statics_batch",
]

_WHERE = {
    "control.mpc": ("LinearMPC",),
    "control.plan": ("Plan",),
    "control.qp": ("QuadraticProgram", "Reference", "build_qp"),
    "control.tuning": ("Limits", "Tuning", "load_tuning"),
    "errors": (
        "CompilerError",
        "ConvergenceError",
        "InfeasibleError",
        "MeasurementError",
        "ModelError",
        "PCRError",
        "SimulationError",
        "UnreachableError",
        "UnstableError",
    ),
    "linearisation.linear_model": ("LinearModel",),
    "linearisation.linearise": ("linearise",),
    "loop.controllers": ("HoldMotors",),
    "loop.feasibility": ("check_scene",),
    "loop.run": ("Run", "load_run"),
    "loop.scene": ("Scene", "load_scene"),
    "loop.simulate": ("simulate",),
    "loop.tracking": ("TrackingController", "make_controller"),
    "plant.dynamics": ("Plant",),
    "plant.equilibria": ("Equilibria",),
    "plant.equilibrium": ("Equilibrium",),
    "plant.free_tip": ("forward_statics", "inverse_statics"),
    "plant.robot": ("Robot", "Rod", "load_robot"),
    "plant.rollout": ("Rollout", "rollout"),
    "plant.sensitivities": ("Sensitivities", "sensitivities"),
    "plant.stability": ("Stability", "all_equilibria", "assess_stability", "distance_to_fold"),
    "plant.statics": ("solve_statics",),
    "plant.statics_batch": ("solve_statics_batch",),
}
_MODULES = {name: module for module, names in _WHERE.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
