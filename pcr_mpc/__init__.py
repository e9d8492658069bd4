"""Model-predictive control of planar parallel continuum robots.

The public names are loaded when they are first asked for: the command line says what is wrong with its arguments, and
can be interrupted, before two seconds of loading.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .catalogue import shipped
    from .control.motor_limits import Limits
    from .control.mpc import LinearMPC
    from .control.plan import Plan
    from .control.qp.program import QuadraticProgram, Reference, build_qp
    from .control.tuning import Tuning, load_tuning
    from .errors import (
        AmbiguousPoseError,
        CompilerError,
        ConvergenceError,
        IdentificationError,
        InfeasibleError,
        LogError,
        MarginsError,
        MeasurementError,
        ModelError,
        PCRError,
        SimulationError,
        UnreachableError,
        UnstableError,
    )
    from .linearisation.linear_model import LinearModel
    from .linearisation.linearise import linearise
    from .loop.controller.make_controller import make_controller
    from .loop.controller.tracking import TrackingController
    from .loop.demand.feasibility import check_scene
    from .loop.hardware.camera import Camera
    from .loop.hardware.motors import Motors
    from .loop.parts.controllers import Controller, Decision, HoldMotors
    from .loop.references.blended import Blended
    from .loop.references.on_curves import Circle, Line, Polygon, Spline, Waypoints
    from .loop.references.path_file import load_path
    from .loop.references.tabulated import Tabulated
    from .loop.references.trajectory import Hold, Lemniscate, PickAndPlace, Trajectory
    from .loop.run.run import Run, load_run
    from .loop.run.simulate import simulate
    from .loop.scene.file import load_scene
    from .loop.scene.scene import Scene
    from .loop.scene.sensors import Sensors
    from .plant.materials import MATERIALS, Material, Section
    from .plant.motion.plant import Plant
    from .plant.motion.rollout import Rollout, rollout
    from .plant.motion.sensitivities import Sensitivities, sensitivities
    from .plant.robot import Robot, load_robot
    from .plant.rod import Rod
    from .plant.statics.equilibrium import Equilibrium
    from .plant.statics.free_tip import forward_statics, inverse_statics
    from .plant.statics.held_tip import solve_statics
    from .plant.statics.many_poses.batch import solve_statics_batch
    from .plant.statics.many_poses.equilibria import Equilibria
    from .plant.statics.stability import Stability, all_equilibria, assess_stability, distance_to_fold
    from .plant.uncertainty import Uncertainty, load_uncertainty
    from .report.plots import animate_run, plot_equilibria, plot_equilibrium, plot_run
    from .report.tables import equilibria_table, equilibrium_table, summary_table
    from .study.episodes.episodes import run_episode, simulate_episode
    from .study.episodes.spread import Spread
    from .study.excitation.design import Excitation, excite
    from .study.identification.identify import identify
    from .study.identification.logs.log import Log, read_log
    from .study.identification.result import Identification
    from .study.margins.measured import measure_delay_margin
    from .study.margins.predicted import Margins, predict_delay_margin, predict_margins
    from .study.planning.limits import PlanLimits
    from .study.planning.plan import plan_timing
    from .study.planning.timed_path import TimedPath

__all__ = [
    "MATERIALS",
    "AmbiguousPoseError",
    "Blended",
    "Camera",
    "Circle",
    "CompilerError",
    "Controller",
    "ConvergenceError",
    "Decision",
    "Equilibria",
    "Equilibrium",
    "Excitation",
    "Hold",
    "HoldMotors",
    "Identification",
    "IdentificationError",
    "InfeasibleError",
    "Lemniscate",
    "Limits",
    "Line",
    "LinearMPC",
    "LinearModel",
    "Log",
    "LogError",
    "Margins",
    "MarginsError",
    "Material",
    "MeasurementError",
    "ModelError",
    "Motors",
    "PCRError",
    "PickAndPlace",
    "Plan",
    "PlanLimits",
    "Plant",
    "Polygon",
    "QuadraticProgram",
    "Reference",
    "Robot",
    "Rod",
    "Rollout",
    "Run",
    "Scene",
    "Section",
    "Sensitivities",
    "Sensors",
    "SimulationError",
    "Spline",
    "Spread",
    "Stability",
    "Tabulated",
    "TimedPath",
    "TrackingController",
    "Trajectory",
    "Tuning",
    "Uncertainty",
    "UnreachableError",
    "UnstableError",
    "Waypoints",
    "all_equilibria",
    "animate_run",
    "assess_stability",
    "build_qp",
    "check_scene",
    "distance_to_fold",
    "equilibria_table",
    "equilibrium_table",
    "excite",
    "forward_statics",
    "identify",
    "inverse_statics",
    "linearise",
    "load_path",
    "load_robot",
    "load_run",
    "load_scene",
    "load_tuning",
    "load_uncertainty",
    "make_controller",
    "measure_delay_margin",
    "plan_timing",
    "plot_equilibria",
    "plot_equilibrium",
    "plot_run",
    "predict_delay_margin",
    "predict_margins",
    "read_log",
    "rollout",
    "run_episode",
    "sensitivities",
    "shipped",
    "simulate",
    "simulate_episode",
    "solve_statics",
    "solve_statics_batch",
    "summary_table",
]

_WHERE = {
    "catalogue": ("shipped",),
    "control.mpc": ("LinearMPC",),
    "control.plan": ("Plan",),
    "control.qp.program": ("QuadraticProgram", "Reference", "build_qp"),
    "control.motor_limits": ("Limits",),
    "control.tuning": ("Tuning", "load_tuning"),
    "errors": (
        "AmbiguousPoseError",
        "CompilerError",
        "ConvergenceError",
        "IdentificationError",
        "InfeasibleError",
        "LogError",
        "MarginsError",
        "MeasurementError",
        "ModelError",
        "PCRError",
        "SimulationError",
        "UnreachableError",
        "UnstableError",
    ),
    "linearisation.linear_model": ("LinearModel",),
    "linearisation.linearise": ("linearise",),
    "loop.parts.controllers": ("Controller", "Decision", "HoldMotors"),
    "loop.demand.feasibility": ("check_scene",),
    "loop.references.blended": ("Blended",),
    "loop.references.on_curves": ("Circle", "Line", "Polygon", "Spline", "Waypoints"),
    "loop.references.path_file": ("load_path",),
    "loop.references.tabulated": ("Tabulated",),
    "loop.run.run": ("Run", "load_run"),
    "loop.scene.scene": ("Scene",),
    "loop.scene.file": ("load_scene",),
    "loop.scene.sensors": ("Sensors",),
    "loop.run.simulate": ("simulate",),
    "loop.controller.tracking": ("TrackingController",),
    "loop.hardware.camera": ("Camera",),
    "loop.hardware.motors": ("Motors",),
    "loop.controller.make_controller": ("make_controller",),
    "loop.references.trajectory": ("Hold", "Lemniscate", "PickAndPlace", "Trajectory"),
    "plant.motion.plant": ("Plant",),
    "plant.statics.many_poses.equilibria": ("Equilibria",),
    "plant.statics.equilibrium": ("Equilibrium",),
    "plant.statics.free_tip": ("forward_statics", "inverse_statics"),
    "plant.materials": ("MATERIALS", "Material", "Section"),
    "plant.robot": ("Robot", "load_robot"),
    "plant.rod": ("Rod",),
    "plant.motion.rollout": ("Rollout", "rollout"),
    "plant.motion.sensitivities": ("Sensitivities", "sensitivities"),
    "plant.statics.stability": ("Stability", "all_equilibria", "assess_stability", "distance_to_fold"),
    "plant.statics.held_tip": ("solve_statics",),
    "plant.statics.many_poses.batch": ("solve_statics_batch",),
    "report.plots": ("animate_run", "plot_equilibria", "plot_equilibrium", "plot_run"),
    "report.tables": ("equilibria_table", "equilibrium_table", "summary_table"),
    "plant.uncertainty": ("Uncertainty", "load_uncertainty"),
    "study.episodes.episodes": ("run_episode", "simulate_episode"),
    "study.episodes.spread": ("Spread",),
    "study.excitation.design": ("Excitation", "excite"),
    "study.identification.identify": ("identify",),
    "study.identification.logs.log": ("Log", "read_log"),
    "study.identification.result": ("Identification",),
    "study.margins.measured": ("measure_delay_margin",),
    "study.margins.predicted": ("Margins", "predict_delay_margin", "predict_margins"),
    "study.planning.limits": ("PlanLimits",),
    "study.planning.plan": ("plan_timing",),
    "study.planning.timed_path": ("TimedPath",),
}
_MODULES = {name: module for module, names in _WHERE.items() for name in names}


if not TYPE_CHECKING:  # else type checkers believe that there is any name

    def __getattr__(name: str) -> Any:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
