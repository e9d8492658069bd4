"""Files that the toolkit writes: whole or not at all, and over nothing that it did not write itself.

A text file says in its last line that it was written here, with a digest of the rest; a picture says so in its
metadata; a folder of results has a list of its files with their digests. What does not, or was changed since, is
somebody's work.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from .errors import OutputError

_MADE: list[Path] = []  # folders, by the command that runs
_LIST = ".pcr-mpc.json"
_STAMP = "written by pcr-mpc"
_LONGEST_NAME = 100
_RESERVED = {"CON", "PRN", "AUX", "NUL", *(f"{port}{i}" for port in ("COM", "LPT") for i in range(1, 10))}
# Where the metadata of a picture names the program that made it.
_CREATOR = {".png": "Software", ".svg": "Creator", ".pdf": "Creator", ".ps": "Creator", ".eps": "Creator"}


def name_problem(name: Any) -> str | None:
    """What keeps a name from being a file's on every system, which it becomes in results; None if nothing does."""
    if not isinstance(name, str) or not name.strip():
        return f"expected a name, found {name!r}"
    if len(name) > _LONGEST_NAME:
        return f"has {len(name)} characters, expected at most {_LONGEST_NAME}; files are named after it"
    bad = sorted({c for c in name if c in '/\\:*?"<>|' or not c.isprintable()})
    if bad:
        return f"{name!r} has {', '.join(map(repr, bad))} in it; files are named after it"
    if name != name.strip() or name.startswith(".") or name.endswith(".") or name.split(".")[0].upper() in _RESERVED:
        return f"{name!r} is no name for a file; files are named after it"
    return None


def stamped(text: str, comment: tuple[str, str] = ("# ", "")) -> str:
    """Text with a last line of comment that says who wrote it; ``comment`` is what begins and ends such a line."""
    return f"{text}{_line(_digest(text.encode()), comment)}"


def _line(digest: str, comment: tuple[str, str] = ("# ", "")) -> str:
    said = f"{_STAMP} ({digest}); once changed by hand it is not overwritten without --force"
    return f"{comment[0]}{said}{comment[1]}\n"


def picture_metadata(path: Path) -> dict[str, str] | None:
    """Metadata by which a picture is known to be ours; None for formats that have none."""
    key = _CREATOR.get(path.suffix.lower())
    return {key: _STAMP} if key else None


def ours(path: Path) -> bool:
    """Whether a file was written here and not changed since."""
    content = path.read_bytes()
    if _listed(path.parent).get(path.name) == _digest(content):
        return True
    if path.suffix.lower() in _CREATOR:
        return _STAMP.encode() in content
    *rest, last = content.splitlines(keepends=True) or [b""]
    found = re.search(rf"{_STAMP} \((\w+)\)".encode(), last)
    return found is not None and found[1].decode() == _digest(b"".join(rest))


def stamp_archive(path: Path) -> None:
    """Let the comment of a ZIP archive say who wrote it, in the last line of the file."""
    with zipfile.ZipFile(path, "a") as archive:
        archive.comment = b"\n" + _line("0" * len(_digest(b""))).encode()
    content = b"".join(path.read_bytes().splitlines(keepends=True)[:-1])
    path.write_bytes(content + _line(_digest(content)).encode())


def require_free(path: Path, *, force: bool = False) -> None:
    """Make the folder of a file that is to be written, and raise if that cannot be, or would destroy what is not ours.

    Raises
    ------
    OutputError
        Names the file or the folder, and what to do.
    """
    path = path.resolve()
    missing = [folder for folder in path.parents if not folder.exists()]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _MADE.extend(missing)
    except (FileExistsError, NotADirectoryError):
        file = next(place for place in (path.parent, *path.parents) if place.is_file())
        raise OutputError(f"{file}: a file is where a folder is wanted; give another name", path=str(file)) from None
    except OSError as error:
        raise OutputError(f"{path.parent}: cannot be made: {error.strerror}", path=str(path.parent)) from None
    if path.is_dir():
        raise OutputError(f"{path}: is a folder, a file is wanted; name one in it", path=str(path))
    try:
        with tempfile.TemporaryFile(dir=path.parent) as probe:
            probe.write(b"a full disk takes names, but no bytes")
        if path.exists() and not force and not ours(path):
            raise OutputError(
                f"{path} is not as pcr-mpc wrote it, and is left alone: give another name, or --force (statics: "
                "--overwrite) to overwrite it",
                path=str(path),
            )
    except OSError as error:
        raise OutputError(f"{path.parent}: cannot be written to: {error.strerror}", path=str(path.parent)) from None


@contextmanager
def leaving_no_empty_folders() -> Iterator[None]:
    """Remove the folders that `require_free` makes in here if what is done fails before anything is in them."""
    _MADE.clear()
    try:
        yield
    except BaseException:
        for folder in sorted(_MADE, key=lambda folder: -len(folder.parts)):
            with suppress(OSError):  # it has files, or is gone
                folder.rmdir()
        raise


def require_folder(folder: Path, names: Iterable[str], *, force: bool = False) -> None:
    """As `require_free` for all files that are to be written into a folder."""
    for name in names:
        require_free(folder / name, force=force)


def require_absent(paths: Iterable[Path], *, force: bool = False) -> None:
    """As `require_free`, of files that become somebody's own: one that is there is left alone, whoever wrote it.

    Raises
    ------
    OutputError
        Names the file or the folder, and what to do.
    """
    for path in paths:
        if path.exists() and not path.is_dir() and not force:
            raise OutputError(f"{path}: is there already; give another folder, or --force", path=str(path))
        require_free(path, force=force)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Where to write what is to take the place of ``path`` once it is whole; a link stays one."""
    path = Path(path).resolve()
    # The suffix stays: it is what the format is known by.
    draft = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        yield draft
        if path.exists():
            shutil.copymode(path, draft)
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with replacing(path) as draft, open(draft, "w", encoding="utf-8", newline="") as handle:
        handle.write(text)


@contextmanager
def results(folder: Path, *, keep: Iterable[str] = ()) -> Iterator[Path]:
    """Where to write the files of a folder of results; they appear in it together.

    What an earlier call has left there is removed, but for ``keep`` and for what was changed since: a folder holds one
    run.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".pcr-mpc-") as staged:
        yield Path(staged)
        known, new = _listed(folder), sorted(Path(staged).iterdir())
        digests = {name: digest for name, digest in known.items() if name in keep}
        for name in set(known) - set(digests) - {path.name for path in new}:
            if (folder / name).is_file() and ours(folder / name):
                (folder / name).unlink()
        digests |= {path.name: _digest(path.read_bytes()) for path in new}
        write_text(folder / _LIST, json.dumps({"written by pcr-mpc": digests}, indent=2) + "\n")
        for path in new:
            os.replace(path, folder / path.name)


def saved(write: Callable[[Path], Any], folder: Path) -> tuple[Path, str]:
    """Let ``write`` write into a folder, or where that fails into a temporary one: what was computed is never lost.

    Returns
    -------
    folder : Path
        Where it is.
    problem : str
        Why it is not where it should be; empty if it is.
    """
    try:
        write(folder)
        return folder, ""
    except (OSError, OutputError) as error:
        elsewhere = Path(tempfile.mkdtemp(prefix="pcr-mpc-"))
        write(elsewhere)
        return elsewhere, f"{folder}: {error}; what was computed is in {elsewhere}"


def _listed(folder: Path) -> dict[str, str]:
    try:
        found = json.loads((folder / _LIST).read_text(encoding="utf-8"))["written by pcr-mpc"]
        return {str(name): str(digest) for name, digest in found.items() if Path(name).name == name}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
