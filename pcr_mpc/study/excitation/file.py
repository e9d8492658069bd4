"""A motion worth recording as files: its path as CSV, and a scene that tracks it."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from ...errors import ModelError
from ...files import stamped, write_text
from ...loop.scene.file import load_scene
from .design import Excitation

PATH = "excited.csv"
SCENE = "excited.toml"
_COLUMNS = "t_s,x_m,y_m,vx_m_s,vy_m_s,ax_m_s2,ay_m_s2"
# Tables of a scene that are about another motion.
_OTHERS = re.compile(r"(?ms)^[ \t]*\[[ \t]*(reference|need|chosen|payload)[ \t]*\].*?(?=^[ \t]*\[|\Z)")
_DURATION = re.compile(r"(?m)^[ \t]*duration[ \t]*=.*$")
_NAME = re.compile(r"(?m)^[ \t]*name[ \t]*=.*$")
_PATHS = re.compile(r'(?m)^([ \t]*(?:robot|tuning)[ \t]*=[ \t]*)"([^"]*)"')


def write_path(found: Excitation, path: Path) -> None:
    """Write the motion at every control period, with velocities and accelerations."""
    t = found.scene.period * np.arange(found.scene.n_periods + 1)
    rows = np.column_stack([t, found.best.trajectory(t).reshape(len(t), 6)])
    lines = [
        f'# From pcr-mpc excite, for {found.scene.robot.name} and {found.scene.name}; [reference] kind = "file"',
        _COLUMNS,
        *(",".join(repr(value) for value in row) for row in rows.tolist()),
    ]
    write_text(path, stamped("\n".join(lines) + "\n"))


def write_scene(found: Excitation, scene_file: Path, where: Path, folder: Path) -> None:
    """Write a scene like the one in a file that tracks the path beside it.

    Parameters
    ----------
    where : Path
        Where to write it, beside the path.
    folder : Path
        Where both will be: paths of robot and tuning are relative to it.

    Raises
    ------
    ModelError
        It does not read back.
    """
    text = scene_file.read_text(encoding="utf-8-sig").replace("\r\n", "\n")

    def moved(match: re.Match[str]) -> str:
        target = Path(os.path.normpath(scene_file.resolve().parent / match[2]))
        return f'{match[1]}"{Path(os.path.relpath(target, folder.resolve())).as_posix()}"'

    text = _PATHS.sub(moved, _OTHERS.sub("", text))
    text = _DURATION.sub(f"duration = {found.scene.duration!r}", text, count=1)
    text = _NAME.sub('name = "excited"', text, count=1)
    text = f'{text.rstrip()}\n\n[reference]\nkind = "file"\nfile = "{PATH}"          # by pcr-mpc excite\n'
    write_text(where, stamped(text))


def require_readable(path: Path) -> None:
    """Raise `ModelError` where a scene that was written does not load."""
    try:
        load_scene(path)
    except ModelError as error:
        raise ModelError(
            f'{error}; the path {path.with_name(PATH)} is good: give it to a scene as [reference] kind = "file"',
            **error.details,
        ) from error
