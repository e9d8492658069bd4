"""Whether what was found about a scene's rung still holds."""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields, is_dataclass
from typing import Any

from .scene import Scene


def digest(scene: Scene) -> str:
    """Digest of what the tip error of the scene's rung rests on: robot, motion, loads, need and rung.

    Not the controller's tuning, whose part in the motion is small, and nothing that has its default, so that a new
    property of robots does not make old findings void.
    """
    kept = ("robot", "duration", "start_tip", "start_motors", "start_mode", "start_velocity", "trajectory", "plant",
            "period", "force", "delay", "payload", "need")  # fmt: skip
    facts = {name: _facts(getattr(scene, name)) for name in kept}
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:12]


def _facts(value: Any) -> Any:
    if is_dataclass(value):
        given = {f.name: getattr(value, f.name) for f in fields(value) if getattr(value, f.name) != f.default}
        return {"type": type(value).__name__, **{name: _facts(each) for name, each in given.items()}}
    if isinstance(value, tuple):
        return [_facts(each) for each in value]
    return str(value) if isinstance(value, float) else value


def verified(scene: Scene) -> bool:
    """Whether the scene's rung was found to meet its need, and nothing that this rests on has changed since."""
    need, finding = scene.need, scene.finding
    return (
        need is not None
        and finding is not None
        and finding.digest == digest(scene)
        and finding.tip_error <= need.tip_accuracy
    )
