"""Whether what was found about a scene's rung still holds."""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from ...plain import plain
from ..references.reading import built_in
from ..references.trajectory import sampled
from ..scene.scene import Scene

_MOVES_NOTHING = ("thickness_ratio", "strain_limit")


def digest(scene: Scene) -> str:
    """Digest of what the tip error of the scene's rung rests on: robot, motion, loads, need and rung.

    Not the controller's tuning, whose part in the motion is small, and nothing that has its default, so that a new
    property of robots does not make old findings void; nor what tells the rods' strain, which moves nothing.
    """
    kept = ("robot", "duration", "start_tip", "start_motors", "start_mode", "start_velocity", "plant",
            "period", "force", "delay", "payload", "need")  # fmt: skip
    facts = {name: _facts(getattr(scene, name)) for name in kept}
    if scene.untold_delay:
        facts["untold_delay"] = _facts(scene.untold_delay)
    if scene.motors is not None:
        facts["motors"] = _facts(scene.motors)
    if scene.camera is not None:
        facts["camera"] = _facts(scene.camera)
    facts["trajectory"] = own_motion(scene) or _facts(scene.trajectory)
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:12]


def own_motion(scene: Scene) -> dict[str, str] | None:
    """Type and digest of the samples of a trajectory that is not the toolkit's; None: it says what it is itself."""
    trajectory = scene.trajectory
    if trajectory is None or built_in(trajectory):
        return None
    samples = sampled(trajectory, scene.period * np.arange(scene.n_periods + 1))
    return {"type": type(trajectory).__name__, "samples": hashlib.sha256(samples.tobytes()).hexdigest()[:12]}


def _facts(value: Any) -> Any:
    if is_dataclass(value):
        given = {
            f.name: getattr(value, f.name)
            for f in fields(value)
            if plain(getattr(value, f.name)) != plain(f.default) and f.name not in _MOVES_NOTHING
        }
        return {"type": type(value).__name__, **{name: _facts(each) for name, each in given.items()}}
    if isinstance(value, tuple | list | np.ndarray):
        return [_facts(each) for each in value]
    return str(value) if isinstance(value, float) else plain(value)


def verified(scene: Scene) -> bool:
    """Whether the scene's rung was found to meet its need, and nothing that this rests on has changed since."""
    need, finding = scene.need, scene.finding
    return (
        need is not None
        and finding is not None
        and finding.digest == digest(scene)
        and finding.tip_error <= need.tip_accuracy
    )
