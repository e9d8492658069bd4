"""The commands of the command line about robots, scenes and tunings that travel with the package."""

from __future__ import annotations

import argparse
import json
import re
import shlex
import sys
from pathlib import Path

from ..catalogue import KINDS, description, kinds_of, names_of, shipped
from ..files import require_absent, write_text
from ..toml_table import read_toml

_TITLES = {"scene": "scenes", "robot": "robots", "tuning": "tunings"}


def list_models(options: argparse.Namespace) -> int:
    """Run `pcr-mpc models`."""
    found = {
        kind: [(name, description(shipped(name, kind)), str(shipped(name, kind))) for name in names_of(kind)]
        for kind in KINDS
    }
    if options.json:
        record = {
            _TITLES[kind]: [{"name": name, "is": text, "file": file} for name, text, file in rows]
            for kind, rows in found.items()
        }
        print(json.dumps(record))
        return 0
    width = max(len(name) for rows in found.values() for name, *_ in rows)
    for kind, rows in found.items():
        print(_TITLES[kind])
        print("\n".join(f"  {name.ljust(width)}  {text}" for name, text, _ in rows), end="\n\n")
    print("A command takes such a name where it takes a file. pcr-mpc copy NAME FOLDER makes a copy to change.")
    return 0


def copy(options: argparse.Namespace) -> int:
    """Run `pcr-mpc copy`."""
    kinds = kinds_of(options.name)
    if options.kind is None and not kinds:
        every = [name for kind in KINDS for name in names_of(kind)]
        shipped(options.name, next((kind for kind in KINDS if options.name in every), KINDS[0]))
    files = _files(shipped(options.name, options.kind or kinds[0]), options.kind or kinds[0])
    folder = options.folder
    require_absent((folder / name for name in files), force=options.overwrite)
    for name, text in files.items():
        write_text(folder / name, text)
    record = {"name": options.name, "files": {name: str(folder / name) for name in files}}
    print(json.dumps(record) if options.json else f"copied {options.name} to {folder}: {', '.join(files)}")
    first = next(iter(files))
    following = {
        "scene.toml": "pcr-mpc check {0}, pcr-mpc track {0}",
        "robot.toml": "pcr-mpc check {0}",
        "tuning.toml": "pcr-mpc track SCENE --controller {0}",
    }
    print(f"next: {following[first].format(shlex.quote(str(folder / first)))}", file=sys.stderr)
    return 0


def _files(path: Path, kind: str) -> dict[str, str]:
    """What is to be copied: name of the copy -> text; a scene comes with all that it names."""
    text = path.read_text(encoding="utf-8")
    if kind != "scene":
        return {f"{kind}.toml": text}
    scene = read_toml(path)
    control, reference = scene.table("control", {}), scene.table("reference", {})
    named = {"robot": scene.text("robot"), "tuning": control.text("tuning", None), "file": reference.text("file", None)}
    files = {"scene.toml": ""}
    for key, target in named.items():
        if target is not None:
            name = Path(target).name if key == "file" else f"{key}.toml"
            files[name] = (path.parent / target).read_text(encoding="utf-8")
            text = re.sub(rf'^(\s*{key}\s*=\s*)"{re.escape(target)}"', rf'\g<1>"{name}"', text, flags=re.MULTILINE)
    return {**files, "scene.toml": text}
