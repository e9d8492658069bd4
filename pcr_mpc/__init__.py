"""Model-predictive control of planar parallel continuum robots."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .control.mpc import LinearMPC
    from .control.plan import Plan
    from .control.qp import QuadraticProgram, Reference, build_qp
    from .control.tuning import Limits, Tuning, load_tuning
    from .errors import (
        CompilerError,
        ConvergenceError,
        InfeasibleError,
        ModelError,
        PCRError,
        SimulationError,
        UnreachableError,
        UnstableError,
    )
    from .linearisation.linear_model import LinearModel
    from .linearisation.linearise import linearise
    from .loop.controllers import HoldMotors
    from .loop.run import Run
    from .loop.scene import Scene, load_scene
    from .loop.simulate import simulate
    from .loop.tracking import TrackingController, make_controller
    from .plant.dynamics import Plant
    from .plant.equilibrium import Equilibrium
    from .plant.free_tip import forward_statics, inverse_statics
    from .plant.robot import Robot, Rod, load_robot
    from .plant.rollout import Rollout, rollout
    from .plant.stability import Stability, all_equilibria, assess_stability, distance_to_fold
    from .plant.statics import solve_statics
else:
    # Loaded when it is asked for: a command that fails, or a script that wants one robot, should not wait for all.
    _HOMES = {
        "control.mpc": ("LinearMPC",),
        "control.plan": ("Plan",),
        "control.qp": ("QuadraticProgram", "Reference", "build_qp"),
        "control.tuning": ("Limits", "Tuning", "load_tuning"),
        "errors": (
            "CompilerError",
            "ConvergenceError",
            "InfeasibleError",
            "ModelError",
            "PCRError",
            "SimulationError",
            "UnreachableError",
            "UnstableError",
        ),
        "linearisation.linear_model": ("LinearModel",),
        "linearisation.linearise": ("linearise",),
        "loop.controllers": ("HoldMotors",),
        "loop.run": ("Run",),
        "loop.scene": ("Scene", "load_scene"),
        "loop.simulate": ("simulate",),
        "loop.tracking": ("TrackingController", "make_controller"),
        "plant.dynamics": ("Plant",),
        "plant.equilibrium": ("Equilibrium",),
        "plant.free_tip": ("forward_statics", "inverse_statics"),
        "plant.robot": ("Robot", "Rod", "load_robot"),
        "plant.rollout": ("Rollout", "rollout"),
        "plant.stability": ("Stability", "all_equilibria", "assess_stability", "distance_to_fold"),
        "plant.statics": ("solve_statics",),
    }

    def __getattr__(name):
        from importlib import import_module

        for module, names in _HOMES.items():
            if name in names:
                value = globals()[name] = getattr(import_module(f".{module}", __name__), name)
                return value
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__():
        return sorted({*globals(), *__all__})


__all__ = [
    "CompilerError",
    "ConvergenceError",
    "Equilibrium",
    "HoldMotors",
    "InfeasibleError",
    "Limits",
    "LinearMPC",
    "LinearModel",
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
    "SimulationError",
    "Stability",
    "TrackingController",
    "Tuning",
    "UnreachableError",
    "UnstableError",
    "all_equilibria",
    "assess_stability",
    "build_qp",
    "distance_to_fold",
    "forward_statics",
    "inverse_statics",
    "linearise",
    "load_robot",
    "load_scene",
    "load_tuning",
    "make_controller",
    "rollout",
    "simulate",
    "solve_statics",
]
