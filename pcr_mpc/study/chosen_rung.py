"""The chosen rung written into its scene file, so that runs are repeatable."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from ..errors import ModelError
from ..loop.finding import digest
from ..loop.scene import load_scene
from ..loop.settings import PlantSettings
from .choice import Choice
from .rungs import ladders, named

_DIGITS = 3  # of figures in a scene file


def write_rung(choice: Choice, path: Path) -> None:
    """Replace the [plant] table of a scene file by the chosen rung, and say in [chosen] what was found about it.

    Raises
    ------
    ModelError
        The file has no [plant] table, or the rung does not read back as it is; nothing is written.
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
        # A weight that nobody asks for is none.
        if replace(scene.plant, weight=scene.plant.weight or "none", on_snap="raise") != choice.chosen.rung:
            rung = named(choice.scene, choice.chosen.rung)
            raise ModelError(f"{path}: rung {rung} does not read back as it is", file=str(path), key="plant")
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
