"""What a page is told: of a robot once, of its motion frame by frame, in short numbers.

Lengths are metres, but for centrelines: these are whole tenths of millimetres, and curvatures whole hundredths of 1/m.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from ..loop.scene.scene import Scene
from ..plant.robot import Robot
from ..plant.rods.equations import sample_rod
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.stability import rod_margins
from .live.session import FASTEST, SLOWEST, Session
from .live.settings import NAMES

POINTS = 33  # of a centreline
_TOLD = 6  # last events in a frame: a page that misses frames misses no event
_PATH_POINTS = 400
_LONGEST_PATH = 20.0  # s


def rounded(values: Any, digits: int = 6) -> Any:
    """Numbers for JSON; what is not finite is None."""
    if isinstance(values, np.ndarray | list | tuple):
        return [rounded(value, digits) for value in (values.tolist() if isinstance(values, np.ndarray) else values)]
    return round(float(values), digits) if math.isfinite(values) else None


def centrelines(eq: Equilibrium) -> tuple[list[list[int]], list[list[int]]]:
    """Centrelines as x, y, x, y, ... and curvatures of all rods (units as above)."""
    lines, curvatures = [], []
    for rod, nodes, physics in zip(eq.robot.rods, eq.nodes, eq.physics, strict=True):
        x, y, theta = sample_rod(nodes, POINTS, physics)[:3]
        xy = np.array(rod.base)[:, None] + rod.length * np.stack([x, y])
        lines.append(np.rint(1e4 * xy.T).astype(int).ravel().tolist())
        bent = np.gradient(theta, rod.length / (POINTS - 1))
        curvatures.append(np.rint(1e2 * bent).astype(int).tolist())
    return lines, curvatures


def pose_frame(eq: Equilibrium, mode: str) -> dict[str, Any]:
    """The rods in a frame: shapes, torques and margins; the mode is told, for it costs as much as the shapes."""
    lines, curvatures = centrelines(eq)
    return {
        "p": rounded(eq.p, 8), "q": rounded(eq.q, 5), "rods": lines, "bend": curvatures, "mode": mode,
        "torque": rounded(eq.motor_torque, 4), "margin": rounded(rod_margins(eq), 4),
        "soft": rounded(eq.stiffness_eigenvalues[0], 3), "energy": rounded(eq.energy, 6),
    }  # fmt: skip


def frame(session: Session, eq: Equilibrium) -> dict[str, Any]:
    """One frame of a session whose rods are in ``eq``."""
    rig, decision, recorder = session.rig, session.decision, session.recorder
    target, plan = session.target(), None if decision is None else decision.plan
    found = pose_frame(eq, session.mode_now) | {
        "t": round(session.t, 4), "v": rounded(rig.x[2:4], 4), "target": None if target is None else rounded(target, 8),
        "u": rounded(rig.applied, 4), "pull": None if rig.pull is None else rounded(rig.pull),
        "force": rounded(rig.force, 4), "hand": rig.hand and [rig.hand[0], round(rig.hand[1], 4)],
        "plan": None, "rung": None, "limits": [], "iterations": None, "estimated": None,
        "controller": session.chosen, "start": session.mode,
        "following": session.pilot.following, "steers": session.pilot.steers,
        "paused": session.paused, "speed": session.speed, "load": round(rig.plant.payload, 5),
        "set": {name: rounded(getattr(session.settings, name)) for name in NAMES},
        "events": list(session.events)[-_TOLD:],
        "recording": None if recorder is None else round(recorder.duration, 2),
    }  # fmt: skip
    if plan is not None:
        found |= {"rung": plan.fallback or "solved", "limits": list(plan.active), "iterations": plan.iterations}
        if plan.states is not None:
            found["plan"] = rounded(plan.states[:, :2], 5)
    if decision is not None and decision.force is not None:
        found["estimated"] = rounded(decision.force, 4)
    return found


def about_robot(robot: Robot) -> dict[str, Any]:
    """What does not change of a robot."""
    return {
        "robot": robot.name, "bases": rounded(robot.bases), "lengths": rounded(robot.lengths),
        "angles": rounded(robot.angle_limits, 4), "tip_mass": robot.tip_mass,
        "torque_limit": rounded(robot.torque_limit),
        "rate_limit": rounded(robot.rate_limit), "gravity": list(robot.gravity),
    }  # fmt: skip


def path_of(scene: Scene) -> list[list[float]] | None:
    """The reference as a line of points [m]; None where there is none."""
    if scene.trajectory is None:
        return None
    t = np.linspace(0.0, min(scene.duration, _LONGEST_PATH), _PATH_POINTS)
    found: list[list[float]] = rounded(scene.trajectory(t)[:, 0], 5)
    return found


def limits_of(scene: Scene) -> dict[str, Any]:
    """Limits of poses that a controller keeps."""
    limits = scene.pose_limits
    return {"rod_margin": limits.rod_margin, "stiffness": limits.stiffness, "torque": rounded(scene.torque_limit)}


def about(session: Session) -> dict[str, Any]:
    """What a page must know of a session before the first frame."""
    scene, n = session.scene, session.scene.robot.n_rods
    dials = {
        name: {"label": dial.label, "unit": dial.unit, "scale": dial.scale, "least": dial.least, "most": dial.most,
               "told": dial.told} for name, dial in session.dials.items()
    }  # fmt: skip
    modes = ["".join(letters) for letters in itertools.product("LR", repeat=n)] if n <= 4 else []
    return about_robot(scene.robot) | {
        "scene": scene.name, "live": True, "path": path_of(scene), "period": session.period, "dials": dials,
        "controllers": session.choice.names, "modes": modes, "limits": limits_of(scene),
        "speeds": [SLOWEST, FASTEST], "spring": round(session.rig.stiffness, 6),
    }  # fmt: skip
