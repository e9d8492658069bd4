"""Robots, scenes and tunings that travel with the package, each known by its name.

Loaders take paths and never search: where a name is meant, `shipped` is asked, by the command line for every name that
it is given, and by nobody else.
"""

from __future__ import annotations

import difflib
import os
import re
from pathlib import Path

# Kind -> its folder. Where a name has several kinds, the first is meant.
_FOLDERS = {"scene": "models/scenes", "robot": "models", "tuning": "controllers"}
KINDS = tuple(_FOLDERS)


def shipped(name: str, kind: str = "scene") -> Path:
    """Path of a robot, scene or tuning that travels with the package.

    Parameters
    ----------
    name : str
        Such as "lemniscate"; ``pcr-mpc models`` lists them.
    kind : {"scene", "robot", "tuning"}

    Returns
    -------
    Path
        Of the file, which is to be read only: ``pcr-mpc copy`` makes one that may be changed.

    Raises
    ------
    ModelError
        There is none of that name; says which is nearest.
    """
    if kind not in KINDS:
        raise ValueError(f"kind is {kind!r}, expected one of {', '.join(KINDS)}")
    names = names_of(kind)
    if name in names:
        return _folder(kind) / f"{name}.toml"
    from .errors import ModelError  # loads NumPy, which the parser of the command line must not wait for

    near = nearest(str(name), kind)
    hint = f"did you mean {near!r}?" if near else f"there are {', '.join(names)}"
    raise ModelError(f"no {kind} named {name!r} comes with the package; {hint}", key=kind, nearest=near)


def names_of(kind: str) -> list[str]:
    """Names of all that travels with the package and is of a kind."""
    return sorted(path.stem for path in _folder(kind).glob("*.toml"))


def nearest(name: str, kind: str) -> str | None:
    """What somebody may have meant by a name of nothing of a kind."""
    return next(iter(difflib.get_close_matches(name, names_of(kind), n=1)), None)


def kinds_of(name: str) -> list[str]:
    """What a name is the name of."""
    return [kind for kind in KINDS if name in names_of(kind)]


def is_name(text: str) -> bool:
    """Whether what somebody wrote is a name and no path: no folder, and no ".toml" at its end."""
    return bool(text) and os.path.basename(text) == text and not text.endswith(".toml") and text not in (".", "..")


def description(path: Path) -> str:
    """First sentence of the comment with which a file begins."""
    comment = []
    for line in path.read_text(encoding="utf-8-sig").splitlines():
        if not line.startswith("#"):
            break
        comment.append(line.lstrip("# ").rstrip())
    return re.split(r"\.\s+(?=[A-Z])", " ".join(comment))[0].rstrip(".")  # "Fig. 3" ends no sentence


def _folder(kind: str) -> Path:
    package = Path(__file__).parent
    # A wheel has them within the package, a clone and an editable install beside it.
    root = package / "data" if (package / "data").is_dir() else package.parent
    return root / _FOLDERS[kind]
