"""Model-predictive control of planar parallel continuum robots."""

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
from .plant.equilibrium import Equilibrium
from .plant.free_tip import forward_statics, inverse_statics
from .plant.robot import Robot, Rod, load_robot
from .plant.rollout import Rollout, rollout
from .plant.stability import Stability, all_equilibria, assess_stability, distance_to_fold
from .plant.statics import solve_statics

__all__ = [
    "CompilerError",
    "ConvergenceError",
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
    "simulate",
    "solve_statics",
]
