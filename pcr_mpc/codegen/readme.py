"""What a generated folder says of itself."""

from __future__ import annotations

import platform
from importlib.metadata import version
from pathlib import Path

from ..loop.run.run import Run
from .loss import Loss
from .solver import flops
from .subject import Subject

_LICENCES = {
    "osqp": "`osqp/` is OSQP with QDLDL, as its own wheel carries them for generated code, under the Apache License "
    "2.0 (`osqp/LICENSE`).",
    "daqp": "`daqp/src` and `daqp/include` are files of DAQP 0.11.0, as they are, under the MIT License "
    "(`daqp/LICENSE`).",
}
# Folders in which a compiler finds the headers of a solver.
HEADERS = {"osqp": ("osqp/public", "osqp/private"), "daqp": ("daqp/include",)}
TEXT = Path(__file__).parent / "c" / "project" / "readme.md"


def readme(subject: Subject, run: Run, loss: Loss | None = None) -> str:
    """Text of ``README.md``: the API, and the figures of this scene."""
    scene, tuning, summary = subject.scene, subject.tuning, run.summary()
    kind = subject.work.foresight.step_models[0].kind
    watched = ", ".join(subject.kinds) or "none"
    worst = tuning.max_iterations
    each = flops(subject.limited[-1], tuning.solver, tuning.horizon * subject.robot.n_rods)
    units = "\n".join(f"| {i} | `{name}` | {unit} |" for i, (name, unit) in enumerate(kind.units.items()))
    values = {
        "scene": scene.name,
        "tuning": tuning.name,
        "rms": f"{summary['rms_mm']:.12f}",
        "largest": f"{summary['max_mm']:.6g}",
        "periods": str(scene.n_periods),
        "period": f"{scene.period:g}",
        "plant_step": f"{subject.plant.dt:g}",
        "horizon": str(tuning.horizon),
        "row": str(6 + 2 * subject.robot.n_rods),
        "delay": str(subject.work.delay),
        "watched": watched,
        "iterations": f"p50 {summary['qp_iterations']['p50']:g}, max {summary['qp_iterations']['max']:g}",
        "worst": str(worst),
        "worst_flops": f"{worst * each:.2g}",
        "include": " ".join(f"-isystem {folder}" for folder in HEADERS[tuning.solver]),
        "licence": _LICENCES[tuning.solver],
        "numbers": units,
        "precision": "double" if not subject.single else f"single, which costs: {loss or 'not measured'}",
        "versions": f"casadi {version('casadi')}, {tuning.solver} {version(tuning.solver)}, "
        f"Python {platform.python_version()}",
    }
    text = TEXT.read_text(encoding="utf-8")
    for name, value in values.items():
        text = text.replace("{{" + name + "}}", value)
    return text
