"""Which file is meant by what somebody wrote: a path, or the name of what comes with the package."""

from __future__ import annotations

from pathlib import Path

from ..catalogue import is_name, kinds_of, nearest, shipped
from ..toml_table import Table, near_file, read_toml

# What only files of a kind have, by which one is known that is given in the place of another.
_MARKS = {"robot": ("rods",), "scene": ("robot", "control"), "tuning": ("weights", "horizon", "pd", "law")}


def found(given: str, kinds: tuple[str, ...], command: str) -> tuple[Path, bool]:
    """File that is meant, and whether it is by a name that it comes with the package.

    Raises
    ------
    ModelError
        There is none, or it is none of the kinds that the command takes there.
    """
    own = kinds_of(given) if is_name(given) else []
    kind = next((one for one in own if one in kinds), None)
    if kind is not None:
        return shipped(given, kind), True
    path = Path(given)
    if path.is_dir():
        raise _error(f"{given}: is a folder, and {command} takes {_of(kinds)}{_within(path, kinds)}", given)
    if is_name(given) and not path.is_file():
        if own:
            raise _error(f"{given} is a {own[0]}, and {command} takes {_of(kinds)}; pcr-mpc models lists them", given)
        if near := near_file(path):
            names = next(filter(None, (nearest(given, one) for one in kinds)), None)
            hint = f" (did you mean {names!r}?)" if names else ""
            raise _error(f"no {kinds[0]} named {given!r} comes with the package{hint}, and there is no such file; did "
                         f"you mean {near}?", given)  # fmt: skip
        return shipped(given, next((one for one in kinds if nearest(given, one)), kinds[0])), True
    table = read_toml(path)
    is_kind = next((one for one, marks in _MARKS.items() if any(table.peek(mark) is not None for mark in marks)), None)
    if is_kind is not None and is_kind not in kinds:
        raise _error(f"{given}: is a {is_kind}, and {command} takes {_of(kinds)}{_within(path.parent, kinds, table)}",
                     given)  # fmt: skip
    return path, False


def _of(kinds: tuple[str, ...]) -> str:
    return " or ".join(f"a {kind}" for kind in kinds)


def _within(folder: Path, kinds: tuple[str, ...], instead: Table | None = None) -> str:
    """Ask for a file of the kinds: the robot of a scene that was given instead, or one in the folder."""
    named = None if instead is None or "robot" not in kinds else instead.peek("robot")
    files = [folder / named] if isinstance(named, str) else [folder / f"{kind}.toml" for kind in kinds]
    near = next((file for file in files if file.is_file()), None)
    return "" if near is None else f"; did you mean {near}?"


def _error(text: str, file: str) -> Exception:
    from ..errors import ModelError  # loads NumPy, which the parser must not wait for

    return ModelError(text, file=file)
