"""What a study's figures rest on, in a form that can be stored and held against another."""

from __future__ import annotations

import hashlib
import json
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ...control.tuning import Tuning
from ...loop.controller.own_controller import OwnController
from ...loop.run.finding import own_motion
from ...loop.scene.scene import Scene
from ...plain import plain
from .episodes import Maker
from .spread import Spread

_PACKAGE = Path(__file__).parent.parent


def described(scene: Scene, tuning: Tuning | Maker, spread: Spread) -> dict[str, Any]:
    """Everything that decides what an episode of a given seed does, ready for JSON."""
    scene = scene.tuned(tuning) if isinstance(tuning, Tuning) else scene
    reference: dict[str, Any] = {"reference": type(scene.trajectory).__name__}
    if own := own_motion(scene):
        reference["trajectory"] = own
    if not isinstance(tuning, Tuning):
        reference["controller"] = tuning.described() if isinstance(tuning, OwnController) else plain(tuning)
    # What is compared must have been through JSON, too.
    return dict(json.loads(json.dumps({"scene": plain(scene) | reference, "spread": plain(spread)})))


def differences(old: Any, new: Any, name: str = "") -> list[str]:
    """Where two records differ, as "scene.robot.tip_mass was 0.25, is 0.3"."""
    if isinstance(old, dict) and isinstance(new, dict):
        keys = sorted({*old, *new})
        return [line for key in keys for line in differences(old.get(key), new.get(key), f"{name}.{key}".strip("."))]
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        pairs = enumerate(zip(old, new, strict=True))
        return [line for i, (a, b) in pairs for line in differences(a, b, f"{name}[{i}]")]
    return [] if old == new else [f"{name} was {old}, is {new}"]


def source_digest() -> str:
    """Digest of the package's code: rows of a study that was resumed must come from the same."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def commit() -> str:
    """Git commit of the code, "-dirty" if the code was changed since; the package's version outside a clone."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=_PACKAGE, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        # A package installed into somebody else's repository is not of it.
        git("ls-files", "--error-unmatch", "errors.py")
        return git("rev-parse", "--short=12", "HEAD") + ("-dirty" if git("status", "--porcelain", ".") else "")
    except (OSError, subprocess.CalledProcessError):
        return f"version {version('pcr_mpc')}"
