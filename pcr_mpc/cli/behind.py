"""Which file is behind what is wrong with the parts of a scene, which know no files."""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path

from ..errors import PCRError
from ..toml_table import read_toml

# First word of the key.
_OF_TUNING, _OF_SCENE = ("model", "learning", "observer"), ("plant", "reference")


def file_behind(key: str, options: argparse.Namespace) -> Path | None:
    """Return the scene, or the path or the tuning that it names, or that the options name in its place.

    None where it is not known; a file that cannot be read any more hides no error.
    """
    with suppress(PCRError, OSError):
        return _file_behind(key, options)
    return None


def _file_behind(key: str, options: argparse.Namespace) -> Path | None:
    word, scene = key.split(".")[0], getattr(options, "scene", None) or getattr(options, "target", None)
    if scene is None or word not in (*_OF_TUNING, *_OF_SCENE):
        return None
    if word in _OF_SCENE:
        points = read_toml(scene).table("reference", {}).text("file", None) if word == "reference" else None
        return Path(scene) if points is None else Path(scene).parent / points
    if own := getattr(options, "controller", None):
        return own if isinstance(own, Path) else None
    named = read_toml(scene).table("control", {}).text("tuning", None)
    return None if named is None else Path(scene).parent / named
