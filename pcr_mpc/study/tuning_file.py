"""Writing a tuning as TOML."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Sequence
from pathlib import Path

from ..control.tuning import Tuning, load_tuning
from ..errors import ModelError, StudyError
from ..loop.scene import Scene, load_scene


def default_path(scene_file: Path, name: str) -> Path:
    """Where the tuning of a scene belongs: beside the one that its file names."""
    own = tomllib.loads(scene_file.read_text(encoding="utf-8"))["control"]["tuning"]
    return Path(os.path.normpath(scene_file.parent / own)).with_name(f"{name}.toml")


def to_tune(scene_file: Path, start: Path | None = None) -> tuple[Scene, Tuning | None]:
    """Scene with the tuning that a search is to beat, and what an earlier search has found for it.

    By default that is the scene's own tuning. One that bears the scene's name is from an earlier search: then it is
    default.toml beside it, as it was for that search, and what was found is there to be found again.
    """
    scene, known = load_scene(scene_file), None
    if scene.tuning is not None and scene.tuning.name == scene.name:
        known, start = scene.tuning, start or default_path(scene_file, "default")
    return (scene.tuned(load_tuning(start)) if start else scene), known


def write_tuning(tuning: Tuning, path: Path, comments: Sequence[str]) -> None:
    """Write a tuning of the linear MPC that reads back as it is, under some lines of comment.

    Raises
    ------
    StudyError
        It does not read back as it is; nothing is written.
    """
    draft = path.with_name(f".{path.name}")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        draft.write_text(_toml(tuning, comments), encoding="utf-8")
        if not _reads_back(draft, tuning):
            raise StudyError(f"{path}: tuning {tuning} has settings that this version cannot write", path=str(path))
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def _reads_back(path: Path, tuning: Tuning) -> bool:
    try:
        return load_tuning(path) == tuning
    except ModelError:
        return False


def _toml(tuning: Tuning, comments: Sequence[str]) -> str:
    model, observer = tuning.model, tuning.observer
    lines = [
        *(f"# {comment}".rstrip() for comment in comments),
        "# SI units; weights act on squared deviations from the reference.",
        f'name = "{tuning.name}"',
        f'law = "{tuning.law}"',
        _line("horizon", tuning.horizon, "control periods"),
    ]
    if tuning.period is not None:
        lines.append(_line("period", tuning.period, "s, between control steps; instead of the scene's"))
    lines += [
        "",
        "[weights]",
        _line("position", tuning.position_weight, "1/m^2"),
        _line("velocity", tuning.velocity_weight, "1/(m/s)^2"),
        _line("angle", tuning.angle_weight, "1/rad^2"),
        _line("input", tuning.input_weight, "1/(rad/s)^2, on the deviation from the feed-forward"),
        "",
        "[solver]",
        f'name = "{tuning.solver}"',
        _line("tolerance", tuning.tolerance, "absolute and relative"),
        _line("max_iterations", tuning.max_iterations, "in all; then the ladder answers"),
        f'fallback = "{tuning.fallback}"',
        "",
        "[model]                   # what is linearised",
        f'method = "{model.method}"',
        f"segments = {model.segments}",
        f"steps = {model.steps}",
        f'scheme = "{model.scheme}"',
        f'inertia = "{model.inertia}"',
        f'linearise = "{model.linearise}"',
        f"payload = {str(model.payload).lower()}",
        f"predict_delay = {str(model.predict_delay).lower()}",
    ]
    if observer is not None:
        lines += [
            "",
            "[observer]",
            f"{'on = true':26}# tip velocity and an unknown force from the measured tip and angles",
            _line("tip_noise", observer.tip_noise, "m, at least; a scene's sensor may be worse"),
            _line("force_noise", observer.force_noise, "N, forces that come and go"),
            _line("force_walk", observer.force_walk, "N, change of the unknown force in a period"),
        ]
    return "\n".join(lines) + "\n"


def _line(key: str, value: float, comment: str) -> str:
    return f"{f'{key} = {value!r}':26}# {comment}"
