"""A folder that compiles by itself."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from ..control.tuning import SOLVERS
from ..errors import GenerationError
from ..files import require_free, results, write_text
from ..loop.run.run import Run
from .readme import readme
from .solver import licence, sources
from .subject import Subject
from .tables import config, tables
from .vectors import vectors

_RUNTIME = Path(__file__).parent / "c"
_OSQP = {"osqp/src": "src", "osqp/public": "inc/public", "osqp/private": "inc/private"}
_DAQP = ("src", "include", "unit")


def require_free_folder(folder: Path, solver: str, *, force: bool = False) -> None:
    """Raise if a file of the folder is somebody's work, or that of another solver.

    Raises
    ------
    OutputError
        Names the file, and what to do.
    GenerationError
        The folder was generated with another solver.
    """
    for other in SOLVERS:
        if other != solver and (folder / other).is_dir():
            raise GenerationError(f"{folder} was generated with {other}, whose files would be compiled too; remove it, "
                                  "or take another folder by --out", part="solver")  # fmt: skip
    for path in (*_files(folder, solver), *_copies(folder, solver)):
        require_free(path, force=force)


def write_folder(subject: Subject, run: Run | None, folder: Path) -> None:
    """Write all of it.

    Parameters
    ----------
    subject : Subject
    run : Run or None
        The scene as Python runs it. None: what compiles to the library is enough.
    folder : Path
    """
    solver = subject.tuning.solver
    writers: list[Callable[[], str]] = [
        lambda: config(subject),
        lambda: tables(subject),
        lambda: subject.graphs.source,
        licence if solver == "osqp" else (_RUNTIME / "daqp" / "LICENSE").read_text,
    ]
    if run is not None:
        writers += [lambda: vectors(subject, run), lambda: readme(subject, run)]
    texts = dict(zip(_files(folder, solver), writers, strict=False))
    copies = _copies(folder, solver)
    for place in dict.fromkeys(path.parent for path in (*texts, *copies)):
        with results(place) as staged:
            for path, write in texts.items():
                if path.parent == place:
                    write_text(staged / path.name, write())
            for path, source in copies.items():
                if path.parent == place:
                    shutil.copyfile(source, staged / path.name)


def _files(folder: Path, solver: str) -> list[Path]:
    names = ["pcr_config.h", "pcr_tables.c", "pcr_graphs.c", f"{solver}/LICENSE", "pcr_vectors.c", "README.md"]
    return [folder / name for name in names]


def _copies(folder: Path, solver: str) -> dict[Path, Path]:
    """Files that are copied as they are, and where from."""
    own = [path for path in sorted(_RUNTIME.iterdir()) if path.is_file() and path.name != "readme.md"]
    found = {folder / path.name: path for path in (*own, *sorted((_RUNTIME / solver).glob("*.[ch]")))}
    if solver == "daqp":
        sources_of = {f"daqp/{name}": sorted((_RUNTIME / "daqp" / name).glob("*.[ch]")) for name in _DAQP}
        return found | {folder / place / path.name: path for place, paths in sources_of.items() for path in paths}
    for place, inside in _OSQP.items():
        found |= {folder / place / path.name: path for path in sorted((sources() / inside).glob("*.[ch]"))}
    return found
