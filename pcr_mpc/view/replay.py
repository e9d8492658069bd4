"""A recorded run as a page that needs no server."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from .. import interrupt
from ..errors import PCRError
from ..files import stamped, write_text
from ..loop.run.run import Run
from ..plant.motion.plant import Plant
from .frames import about_robot, limits_of, path_of, pose_frame, rounded
from .page import page

_FRAMES = 30.0  # a second
_MOST = 1500  # frames of a run
_MODE_EVERY = 6  # frames


def write_replay(run: Run, path: Path) -> None:
    """Write the page of a run, whole or not at all.

    Parameters
    ----------
    run : Run
    path : Path
        Of the HTML file.

    Raises
    ------
    PCRError
        The rods cannot be followed from the start of the run.
    """
    write_text(Path(path), stamped(page(replay_data(run)), ("<!-- ", " -->")))


def replay_data(run: Run) -> dict[str, Any]:
    """What the page needs of a run: ``about``, ``frames`` and ``events``; errors as `write_replay`."""
    scene, robot = run.scene, run.scene.robot
    path = path_of(scene)
    if path is None and np.isfinite(run.reference).all():
        path = rounded(run.reference[:: max(1, len(run.t) // 400)], 5)
    about = about_robot(robot) | {
        "scene": scene.name, "live": False, "path": path, "limits": limits_of(scene), "controller": run.controller,
        "duration": round(float(run.t[-1]), 4), "hash": run.hash(),
    }  # fmt: skip
    events = [
        {"n": i + 1, "t": round(float(event["t"]), 4), "kind": event["kind"], "message": event["message"]}
        for i, event in enumerate(sorted(run.events, key=lambda event: float(event["t"])))
    ]
    frames, snaps = _frames(run)
    for snap in snaps:  # where and with which energy: the record tells it in words only
        for event in events:
            if event["kind"] == "snap" and abs(event["t"] - snap["t"]) < 1.5 * run.dt and "energy" not in event:
                event.update(snap)
                break
    return {"about": about, "frames": frames, "events": events}


def _frames(run: Run) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Frames at even times, and the snaps that the rods took on the way."""
    scene = run.scene
    settings = scene.plant if run.rung is None else run.rung
    # Another engine's rods, or those of a yardstick, are drawn as the quasi-static ones at the same tip and angles.
    robot = scene.robot.plain() if settings.rods == "plain" else scene.robot
    plant = Plant(robot, on_snap="raise" if robot.needs_shooting else "jump", dt=run.dt)
    plant.reset(run.x[0], run.pose)
    stride = max(1, round(1.0 / (_FRAMES * run.dt)), math.ceil(len(run.t) / _MOST))
    last = len(run.t) - 1
    wanted = {*range(0, last + 1, stride), last}
    answers = {round(event["t"] / scene.period): event.get("rung", "") for event in run.events
               if event["kind"] == "fallback"}  # fmt: skip
    payloads = scene.carried(run.t)
    frames: list[dict[str, Any]] = []
    snaps: list[dict[str, Any]] = []
    mode = ""
    for k in range(last + 1):
        interrupt.check()
        try:
            if k not in wanted:
                plant.force(run.x[k, :2], run.x[k, 4:])
            else:
                eq = plant.equilibrium(run.x[k])
                if len(frames) % _MODE_EVERY == 0:
                    mode = eq.mode
                frames.append(pose_frame(eq, mode) | _told(run, k, answers, float(payloads[k])))
        except PCRError:  # where a run lost its rods it is over
            if not frames:
                raise
            break
        for snap in plant.snaps[len(snaps) :]:
            snaps.append({"t": round(float(run.t[k]), 4), "rod": snap.rod, "p": list(snap.p),
                          "energy": snap.energy_lost})  # fmt: skip
    return frames, snaps


def _told(run: Run, k: int, answers: dict[int, str], payload: float) -> dict[str, Any]:
    """What a run says of step k besides the rods."""
    m = min(k // run.steps_per_period, len(run.u) - 1)
    tracked = bool(np.isfinite(run.reference[k]).all())
    force = run.estimated_force[m] if m >= 0 else np.full(2, np.nan)
    decided = run.tuning is not None and m >= 0
    return {
        "t": round(float(run.t[k]), 4), "v": rounded(run.x[k, 2:4], 4),
        "target": rounded(run.reference[k], 8) if tracked else None,
        "u": rounded(run.applied[min(k, len(run.applied) - 1)], 4) if len(run.applied) else [0.0] * len(run.x[k, 4:]),
        "estimated": rounded(force, 4) if np.isfinite(force).all() else None,
        "rung": (answers.get(m) or "solved") if decided else None,
        "iterations": int(run.iterations[m]) if decided else None, "limits": [], "load": round(payload, 5),
        "controller": run.controller,
    }  # fmt: skip
