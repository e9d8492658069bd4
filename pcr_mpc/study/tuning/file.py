"""Writing a tuning as TOML."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from ...control.tuning import Tuning, load_tuning
from ...errors import ModelError, StudyError
from ...files import replacing, require_free, stamped
from ...loop.scene.file import load_scene
from ...loop.scene.scene import Scene
from ...toml_table import read_toml


def default_path(scene_file: Path, name: str) -> Path:
    """Where the tuning of a scene belongs: beside the one that its file names."""
    own = read_toml(scene_file).table("control").text("tuning")
    return Path(os.path.normpath(scene_file.parent / own)).with_name(f"{name}.toml")


def to_tune(scene_file: Path, start: Path | None = None) -> tuple[Scene, Tuning | None]:
    """Scene with the tuning that a search is to beat, and what an earlier search has found for it.

    By default that is the scene's own tuning. One that bears the scene's name, in a file of that name, is from an
    earlier search: then it is default.toml beside it, as it was for that search, and what was found is there to be
    found again.

    Raises
    ------
    ModelError
        The scene has nothing to track, or there is no default.toml to start from.
    """
    scene, known = load_scene(scene_file), None
    if scene.trajectory is None:
        raise ModelError(
            f"{scene_file}: scene {scene.name} has nothing to track, and so no controller to tune; give it a reference",
            file=str(scene_file),
            key="reference.kind",
        )
    named = Path(read_toml(scene_file).table("control").text("tuning")).name
    if (
        scene.tuning is not None
        and scene.tuning.name == scene.name
        and named == default_path(scene_file, scene.name).name
    ):
        known = scene.tuning
        if start is None and not (start := default_path(scene_file, "default")).is_file():
            raise ModelError(
                f"{start}: no such file; the tuning of scene {scene.name} is from an earlier search, which started "
                "from there: name the tuning to start from with --start",
                file=str(start),
            )
    return (scene.tuned(load_tuning(start)) if start else scene), known


def write_tuning(tuning: Tuning, path: Path, comments: Sequence[str], *, force: bool = False) -> None:
    """Write a tuning of the linear MPC that reads back as it is, under some lines of comment.

    Raises
    ------
    StudyError
        It does not read back as it is; nothing is written.
    OutputError
        There is a file that was not written here, or was changed since, and ``force`` is not given.
    """
    require_free(path, force=force)
    with replacing(path) as draft:
        draft.write_text(stamped(_toml(tuning, comments)), encoding="utf-8")
        if not _reads_back(draft, tuning):
            raise StudyError(f"{path}: tuning {tuning} has settings that this version cannot write", path=str(path))


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
        *([] if model.method is None else [f'method = "{model.method}"']),
        f"segments = {model.segments}",
        f"steps = {model.steps}",
        f'scheme = "{model.scheme}"',
        f'inertia = "{model.inertia}"',
        f'linearise = "{model.linearise}"',
        f"payload = {str(model.payload).lower()}",
        f"predict_delay = {str(model.predict_delay).lower()}",
        f'angles = "{model.angles}"',
        f"motor_lag = {model.motor_lag:g}",
    ]
    if observer is not None:
        lines += [
            "",
            "[observer]",
            f"{'on = true':26}# tip velocity and an unknown force from the measured tip and angles",
            _line("latency", observer.latency, "s, age of a measured tip when it arrives"),
            _line("tip_noise", observer.tip_noise, "m, at least; a scene's sensor may be worse"),
            _line("force_noise", observer.force_noise, "N, forces that come and go"),
            _line("force_walk", observer.force_walk, "N, change of the unknown force in a period"),
        ]
        if observer.adapts:
            named = ", ".join(f'"{name}"' for name in observer.adapts)
            lines += [
                f"{f'adapts = [{named}]':26}# estimated while the robot moves",
                _line("adapt_walk", observer.adapt_walk, "relative change in a period"),
            ]
    if tuning.learning is not None:
        lines += [
            "",
            "[learning]",
            f"{'on = true':26}# of the feed-forward, from lap to lap",
            _line("gain", tuning.learning.gain, "share of a lap's error that is taken off the next one"),
            _line("bandwidth", tuning.learning.bandwidth, "Hz, of what is learnt"),
        ]
    return "\n".join(lines) + "\n"


def _line(key: str, value: float, comment: str) -> str:
    return f"{f'{key} = {value!r}':26}# {comment}"
