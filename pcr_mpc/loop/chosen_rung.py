"""The chosen rung in its scene file: written there, so that runs are repeatable, and known again by its digest."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from ..errors import ModelError, NoRungError
from .choice import Choice
from .rungs import ladders, named
from .scene import Scene, load_scene
from .settings import PlantSettings

_DIGITS = 3  # of figures in a scene file


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


def write_rung(choice: Choice, path: Path) -> None:
    """Replace the [plant] table of a scene file by the chosen rung, and say in [chosen] what was found about it.

    Raises
    ------
    ModelError
        The file has no [plant] table of its own.
    NoRungError
        What was written would not be read back as it is; nothing is written.
    """
    text = path.read_text(encoding="utf-8")
    text = re.sub(r"(?ms)^\[chosen\].*?(?=^\[|\Z)", "", text)
    if not re.search(r"(?m)^\[plant\]", text):
        raise ModelError(f"{path}: has no [plant] table", file=str(path), key="plant")
    # With its comments, up to the next table.
    before, own, after = re.split(r"(?ms)(^\[plant\].*?)(?=^\[|\Z)", text, maxsplit=1)
    jump = [line for line in own.splitlines() if line.startswith("on_snap")]
    lines = [*_plant_table(choice), *jump, ""]
    draft = path.with_name(f".{path.name}")
    try:
        draft.write_text(before + "\n".join([*lines, after]), encoding="utf-8")
        scene = load_scene(draft)
        if scene.plant.make(scene.robot).weight != (choice.chosen.rung.weight or "none"):
            raise NoRungError(
                f"{path}: rung {named(choice.scene, choice.chosen.rung)} cannot be written", need=choice.scene.need
            )
        lines += [*_finding(choice, digest(scene)), ""]
        draft.write_text(before + "\n".join([*lines, after]).rstrip() + "\n", encoding="utf-8")
        load_scene(draft)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def _plant_table(choice: Choice) -> list[str]:
    rung, steps = choice.chosen.rung, ladders(choice.scene)
    lines = ["[plant]                   # the lowest rung that meets the need, by pcr-mpc choose --write"]
    lines += [f'{name} = "{getattr(rung, name)}"' for name in steps if len(steps[name]) > 1]
    lines.append(f'method = "{rung.method}"')
    if rung.method != "closed_form":
        lines += [f"segments = {rung.segments}", f"steps = {rung.steps}", f'scheme = "{rung.scheme}"']
    return [*lines, f'integrator = "{rung.integrator}"', _line("dt", rung.dt, "s")]


def _finding(choice: Choice, of: str) -> list[str]:
    estimated = sum(estimate.error for estimate in choice.lacking.values())
    against: PlantSettings = choice.yardstick
    return [
        f"[chosen]                  # against {named(choice.scene, against)}",
        _line("tip_error", _rounded(1e3 * choice.tip_error), "mm, largest over the duration"),
        _line("estimated", _rounded(1e3 * estimated), "mm of it, for what the yardstick leaves out"),
        _line("digest", f'"{of}"', "of robot, motion, need and rung: tells whether this still holds"),
    ]


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def _line(key: str, value: object, comment: str) -> str:
    return f"{f'{key} = {value}':26}# {comment}"
