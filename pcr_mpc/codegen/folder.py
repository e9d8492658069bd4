"""A folder that compiles by itself."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from ..control.tuning import SOLVERS
from ..errors import GenerationError
from ..files import require_free, results, write_text
from ..loop.run.run import Run
from .config import config
from .loss import Loss
from .precision import in_single
from .readme import TEXT, readme
from .solver import licence, sources
from .subject import Subject
from .tables import tables
from .vectors import vectors

_RUNTIME = Path(__file__).parent / "c"
_ROOMS = (".", "controller", "plant", "project")
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


def write_folder(subject: Subject, run: Run | None, folder: Path, loss: Loss | None = None) -> None:
    """Write all of it.

    Parameters
    ----------
    subject : Subject
    run : Run or None
        The scene as Python runs it. None: what compiles to the library is enough.
    folder : Path
    loss : Loss or None
        What single precision costs, if that is known.
    """
    solver = subject.tuning.solver
    writers: list[Callable[[], str]] = [
        lambda: config(subject, loss),
        lambda: tables(subject),
        lambda: subject.graphs.source,
        licence if solver == "osqp" else (_RUNTIME / "daqp" / "LICENSE").read_text,
    ]
    if run is not None:
        writers += [lambda: vectors(subject, run), lambda: readme(subject, run, loss)]
    texts = dict(zip(_files(folder, solver), writers, strict=False))
    copies = _copies(folder, solver)
    for place in dict.fromkeys(path.parent for path in (*texts, *copies)):
        with results(place) as staged:
            for path, write in texts.items():
                if path.parent == place:
                    text = write()
                    write_text(staged / path.name, in_single(text) if subject.single and _is_ours(path) else text)
            for path, source in copies.items():
                if path.parent == place and subject.single and _is_ours(path):
                    write_text(staged / path.name, in_single(source.read_text(encoding="utf-8")))
                elif path.parent == place:
                    shutil.copyfile(source, staged / path.name)


def _is_ours(path: Path) -> bool:
    """Whether a file is C of this package, which computes in one precision throughout; the solver has its own types."""
    return path.suffix in (".c", ".h") and path.stem.startswith("pcr")


def _files(folder: Path, solver: str) -> list[Path]:
    names = ["pcr_config.h", "pcr_tables.c", "pcr_graphs.c", f"{solver}/LICENSE", "pcr_vectors.c", "README.md"]
    return [folder / name for name in names]


def _copies(folder: Path, solver: str) -> dict[Path, Path]:
    """Files that are copied as they are, and where from."""
    # Rooms are for who reads the package: who compiles a folder has one place.
    own = [path for room in _ROOMS for path in sorted((_RUNTIME / room).iterdir()) if path.is_file() and path != TEXT]
    found = {folder / path.name: path for path in (*own, *sorted((_RUNTIME / solver).glob("*.[ch]")))}
    if solver == "daqp":
        sources_of = {f"daqp/{name}": sorted((_RUNTIME / "daqp" / name).glob("*.[ch]")) for name in _DAQP}
        return found | {folder / place / path.name: path for place, paths in sources_of.items() for path in paths}
    for place, inside in _OSQP.items():
        found |= {folder / place / path.name: path for path in sorted((sources() / inside).glob("*.[ch]"))}
    return found
