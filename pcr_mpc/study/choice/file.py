"""The chosen rung written into its scene file, so that runs are repeatable."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...errors import ModelError
from ...files import replacing
from ...loop.run.finding import digest
from ...loop.scene.file import load_scene
from ...loop.scene.settings import PlantSettings
from .choice import Choice
from .rungs import ladders, named

_DIGITS = 3  # of figures in a scene file
_SECTION = {
    name: re.compile(rf"(?ms)^[ \t]*\[[ \t]*{name}[ \t]*\][^\n]*\n?.*?(?=^[ \t]*\[|\Z)") for name in ("plant", "chosen")
}
_HEADER = re.compile(r"\s*\[[^\]]*\]\s*(?P<comment>#.*)?$")
_ENTRY = re.compile(r"""\s*(?P<key>[\w-]+|"[^"]*"|'[^']*')\s*=\s*("[^"]*"|'[^']*'|[^#"'])*?\s*(?P<comment>#.*)?$""")
# Comments that are written here; all others are by hand.
_OURS = (
    "# the lowest rung that meets the need, by pcr-mpc choose --write",
    "# s",
    r"# against ((inertia|weight|rods|payload|motors) \w+(, )?)*",
    "# mm, largest over the duration",
    "# mm of it, for what the yardstick leaves out",
    "# of robot, motion, need and rung: tells whether this still holds",
)


def require_plant_table(path: Path) -> None:
    """Raise `ModelError` if a scene file has no [plant] table that could be rewritten."""
    if not _SECTION["plant"].search(_read(path)[0]):
        raise ModelError(f"{path}: has no [plant] table", file=str(path), key="plant")


def write_rung(choice: Choice, path: Path) -> None:
    """Put the chosen rung into the [plant] table of a scene file, and say in [chosen] what was found about it.

    Everything else stays as it is, comments in these two tables, too.

    Raises
    ------
    ModelError
        The file has no [plant] table, or the rung does not read back as it is; nothing is written.
    """
    require_plant_table(path)
    text, ending = _read(path)
    old = _others(text)
    draft_text = _renewed(text, "plant", _plant_table(choice), keep=("on_snap",))
    with replacing(path) as draft:

        def put(content: str) -> None:
            draft.write_bytes(content.replace("\n", ending).encode())

        put(draft_text)
        scene = load_scene(draft)
        # A weight that nobody asks for is none.
        if replace(scene.plant, weight=scene.plant.weight or "none", on_snap="raise") != choice.chosen.rung:
            rung = named(choice.scene, choice.chosen.rung)
            raise ModelError(f"{path}: rung {rung} does not read back as it is", file=str(path), key="plant")
        draft_text = _renewed(draft_text, "chosen", _finding(choice, digest(scene)))
        put(draft_text)
        load_scene(draft)
        if _others(draft_text) != old:
            raise ModelError(
                f"{path}: cannot be rewritten without a change to other tables; put the [plant] table on lines of its "
                "own",
                file=str(path),
                key="plant",
            )


def _read(path: Path) -> tuple[str, str]:
    """Text of a file with lines that end in a newline, and what they really end in."""
    text = path.read_bytes().decode("utf-8")
    return text.replace("\r\n", "\n"), "\r\n" if "\r\n" in text else "\n"


def _others(text: str) -> dict[str, Any]:
    """What a scene file says outside the two tables."""
    found = tomllib.loads(text.removeprefix("\ufeff"))
    return {key: value for key, value in found.items() if key not in _SECTION}


def _renewed(text: str, name: str, lines: list[str], keep: tuple[str, ...] = ()) -> str:
    """The text with a table whose entries are those of ``lines``, a header and one key each.

    Comments that were written by hand stay where they are; those of an entry that is gone stay on a line of their own.
    A table that is not there comes after [plant].
    """
    found = _SECTION[name].search(text)
    if found is None:
        end = _SECTION["plant"].search(text)
        assert end is not None
        body = "\n".join(lines) + "\n"
        before, after = text[: end.end()].rstrip("\n") + "\n\n", text[end.end() :]
        return before + body + ("\n" + after if after else "")
    header, *own = found[0].splitlines()
    new = {line.split(" ", 1)[0]: line for line in lines[1:]}
    kept, place = [_with_comment(header, lines[0])], 1
    for line in own:
        entry = _ENTRY.match(line)
        if entry is None:
            kept.append(line)
            continue
        key = entry["key"].strip("\"'")
        if key in new:
            kept.append(_with_comment(line, new.pop(key)))
        elif key in keep:
            kept.append(line)
        elif _by_hand(line):
            kept.append(_comment(line))
        else:
            continue
        place = len(kept)
    kept[place:place] = new.values()
    return text[: found.start()] + "\n".join(kept) + "\n" + text[found.end() :]


def _with_comment(old: str, new: str) -> str:
    """The new line, under the comment of the old one if that was written by hand."""
    if not _by_hand(old):
        return new
    bare = new.split("#")[0].rstrip()
    return f"{bare:26}{_comment(old)}"


def _comment(line: str) -> str:
    found = _ENTRY.match(line) or _HEADER.match(line)
    return (found["comment"] or "") if found else ""


def _by_hand(line: str) -> bool:
    comment = _comment(line)
    return bool(comment) and not any(re.fullmatch(ours, comment) for ours in _OURS)


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
