"""CasADi functions as machine code, where there is a C compiler: a third of the time of CasADi's own interpreter.

What is built is kept in the user's cache folder, ``$XDG_CACHE_HOME/pcr_mpc`` or ``~/.cache/pcr_mpc``, under a name made
of the source, the compiler, its flags, and the library's own digest: a change of any of them builds anew, two processes
that build at once do not meet, and a file that is not what its name says is not loaded.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import stat
import subprocess
import sys
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import casadi as ca

from .buffered import graph_cache
from .errors import CompilerError

# Without -ffast-math the results are those of the interpreter, bit for bit. -O2 takes half as long again to build, and
# nothing runs faster for it.
_FLAGS = ("-O1", "-ffp-contract=off", "-fPIC", "-shared")


def has_compiler() -> bool:
    """Whether there is the C compiler that the variable CC names (by default "cc"); where it is empty there is none."""
    command = _compiler()
    return bool(command) and shutil.which(command[0]) is not None


def fastest(function: Any, wanted: bool = True) -> Any:
    """Return the function compiled if that is wanted and can be had, else as it is: the same numbers."""
    if not wanted or not has_compiler():
        return function
    try:
        return _once(function, *_compiler(), os.environ.get("XDG_CACHE_HOME", ""))
    except CompilerError as error:
        print(f"{error}; interpreted meanwhile", file=sys.stderr)
        return function


@graph_cache(maxsize=64)
def _once(function: Any, *environment: str) -> Any:
    """Machine code of a function, remembered: to look it up in the cache takes a good part of a second."""
    return compiled(function)


def compiled(function: Any) -> Any:
    """Return the same function, compiled; what was compiled before is taken from the cache.

    Raises
    ------
    CompilerError
        There is no compiler, or it failed.
    """
    generator = ca.CodeGenerator(f"{function.name()}.c")
    generator.add(function)
    source = generator.dump()
    key = _digest("\0".join([source, _version(), *_compiler(), *_FLAGS]).encode())
    cache = _cache()
    library = None if cache is None else _found(cache, key)
    if library is not None:
        return ca.external(function.name(), str(library))
    # Of a cache that others could write to, or that cannot be written at all, nothing is used.
    with tempfile.TemporaryDirectory(dir=cache) as folder:
        built = _built(function.name(), source, Path(folder))
        if cache is None:
            return ca.external(function.name(), str(built))
        library = cache / f"{key}-{_digest(built.read_bytes())}.so"
        os.replace(built, library)
    return ca.external(function.name(), str(library))


def _built(name: str, source: str, folder: Path) -> Path:
    command = _compiler()
    path, library = folder / f"{name}.c", folder / f"{name}.so"
    path.write_text(source)
    print(f"building machine code of {name!r} ({len(source) // 1000} kB of C), once", file=sys.stderr)
    try:
        subprocess.run(
            [*command, *_FLAGS, str(path), "-o", str(library), "-lm"], check=True, capture_output=True, text=True
        )
    except (OSError, subprocess.CalledProcessError, IndexError) as error:
        said = str(getattr(error, "stderr", "") or error).strip()
        raise CompilerError(
            f"cannot compile {name} with {' '.join(command)!r}: {said}; set CC to a C compiler, "
            "or do without compiled=True",
            command=command,
        ) from None
    return library


def _compiler() -> list[str]:
    return shlex.split(os.environ.get("CC", "cc"))


def _version() -> str:
    """What the compiler says of itself."""
    return _version_of(*_compiler())


@lru_cache
def _version_of(*command: str) -> str:
    try:
        return subprocess.run([*command, "--version"], capture_output=True, text=True, check=False).stdout
    except OSError:
        return ""


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:32]


def _found(cache: Path, key: str) -> Path | None:
    """Return the library under ``key``, if it is whole and nobody else could have written it."""
    for path in sorted(cache.glob(f"{key}-*.so")):
        if _private(path) and _digest(path.read_bytes()) == path.stem.removeprefix(f"{key}-"):
            return path
        path.unlink(missing_ok=True)
    return None


def _cache() -> Path | None:
    """Return the cache folder, made if need be; None where it cannot be written, or others could write to it."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pcr_mpc"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return None
    safe = _private(folder) and os.access(folder, os.W_OK) and all(_guarded(parent) for parent in folder.parents)
    return folder if safe else None


def _private(path: Path) -> bool:
    """Whether it is mine, and nobody else can write to it."""
    found = path.lstat()
    mine = not hasattr(os, "getuid") or found.st_uid == os.getuid()
    return mine and not stat.S_ISLNK(found.st_mode) and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _guarded(folder: Path) -> bool:
    """Whether nobody but its owner can put something else in the place of what is in it."""
    mode = folder.stat().st_mode
    return not mode & (stat.S_IWGRP | stat.S_IWOTH) or bool(mode & stat.S_ISVTX)
