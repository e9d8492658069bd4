"""CasADi functions as machine code, where there is a C compiler: a third of the time of CasADi's own interpreter.

What is built is kept in the user's cache folder, ``$XDG_CACHE_HOME/pcr_mpc`` or ``~/.cache/pcr_mpc``, under a name made
of the source, the machine, the compiler, its flags, and the library's own digest: a change of any of them builds anew,
two processes that build at once do not meet, and a file that is not what its name says is not loaded.
"""

from __future__ import annotations

import hashlib
import os
import platform
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

from . import interrupt
from .buffered import dense, graph_cache
from .errors import CompilerError

# Without -ffast-math the results are those of the interpreter, bit for bit. What is added to -O1 saves a fifth of the
# time: helpers of a line are inlined, roots set no errno, numbers are loaded before they are needed. -O3 saves a tenth
# more, and takes twice as long to build.
_ALWAYS = ("-fno-semantic-interposition", "-finline-small-functions", "-fno-math-errno", "-fno-trapping-math",
           "-ffp-contract=off", "-fPIC", "-shared")  # fmt: skip
_FLAGS = ("-O1", "-fschedule-insns", *_ALWAYS)
# Registers of what is very long are looked for in a time that grows with the square of its length: a graph of three
# rods takes 12 s. Without that search it takes two, and a tenth more each time that it is evaluated.
_LONG = 300_000  # characters of C
_LONG_FLAGS = ("-Og", *_ALWAYS)


def has_compiler() -> bool:
    """Whether there is the C compiler that the variable CC names (by default "cc"); where it is empty there is none."""
    command = _compiler()
    return bool(command) and _there(command[0], os.environ.get("PATH", ""))


@lru_cache
def _there(command: str, path: str) -> bool:
    return shutil.which(command, path=path or None) is not None


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
    """Machine code of a function, remembered: to look it up in the cache takes a good part of a second.

    It is made dense before, lest what makes it dense is interpreted around the machine code.
    """
    return compiled(dense(function))


def compiled(function: Any) -> Any:
    """Return the same function, compiled; what was compiled before is taken from the cache.

    Raises
    ------
    CompilerError
        There is no compiler, or it failed.
    """
    if not has_compiler():
        raise _failure(function.name(), "there is no such compiler")
    generator = ca.CodeGenerator(f"{function.name()}.c")
    generator.add(function)
    source = generator.dump()
    flags = _FLAGS if len(source) < _LONG else _LONG_FLAGS
    key = _digest("\0".join([source, platform.machine(), _version(), *_compiler(), *flags]).encode())
    cache = cache_folder()
    library = None if cache is None else _found(cache, key)
    if library is not None:
        return _loaded(function.name(), library)
    # Of a cache that others could write to, or that cannot be written at all, nothing is used.
    try:
        with tempfile.TemporaryDirectory(dir=cache) as folder:
            library = _built(function.name(), source, flags, Path(folder))
            if cache is None:
                return _loaded(function.name(), library)
            place = cache / f"{key}-{_digest(library.read_bytes())}.so"
            os.replace(library, place)
    except OSError as error:  # no room left, for one
        raise _failure(function.name(), str(error)) from None
    return _loaded(function.name(), place)


def _built(name: str, source: str, flags: tuple[str, ...], folder: Path) -> Path:
    path, library = folder / f"{name}.c", folder / f"{name}.so"
    path.write_text(source)
    print(f"building machine code of {name!r} ({len(source) // 1000} kB of C), once", file=sys.stderr)
    command = [*_compiler(), *flags, str(path), "-o", str(library), "-lm"]
    done = interrupt.completed(command)
    if done.returncode or not library.is_file():
        raise _failure(name, done.stderr.strip() or f"it ended with status {done.returncode} and said nothing")
    library.chmod(0o700)  # whatever the umask
    return library


def _loaded(name: str, library: Path) -> Any:
    try:
        return ca.external(name, str(library))
    except RuntimeError as error:  # where nothing may be run, for one
        raise _failure(name, str(error).strip().splitlines()[-1]) from None


def _failure(name: str, reason: str) -> CompilerError:
    command = _compiler()
    return CompilerError(
        f"cannot compile {name} with {shlex.join(command)!r}: {reason}; set CC to a C compiler, or to nothing to do "
        "without machine code",
        command=command,
    )


def _compiler() -> list[str]:
    command = os.environ.get("CC", "cc")
    try:
        return shlex.split(command)
    except ValueError:  # a quotation that does not end
        return [command]


def _version() -> str:
    """What the compiler says of itself."""
    return _version_of(*_compiler())


@lru_cache
def _version_of(*command: str) -> str:
    try:
        return subprocess.run(
            [*command, "--version"], check=False, capture_output=True, text=True, errors="replace"
        ).stdout
    except OSError:
        return ""


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:32]


def _found(cache: Path, key: str) -> Path | None:
    """Return the library under ``key``, if it is whole and nobody else could have written it."""
    for path in sorted(cache.glob(f"{key}-*.so")):
        try:
            if _private(path) and _digest(path.read_bytes()) == path.stem.removeprefix(f"{key}-"):
                return path
            path.unlink()
        except OSError:  # another process was faster to remove it, or it is no file at all
            continue
    return None


def cache_folder() -> Path | None:
    """Return the cache folder, made if need be; None where it cannot be written, or others could write to it."""
    try:
        # As the XDG base directory specification has it, a path that is not absolute does not count.
        given = Path(os.environ.get("XDG_CACHE_HOME", ""))
        folder = (given if given.is_absolute() else Path.home() / ".cache") / "pcr_mpc"
        for missing in reversed([one for one in (folder, *folder.parents) if not one.exists()]):
            missing.mkdir(mode=0o700, exist_ok=True)
        folder = folder.resolve()
        safe = _private(folder) and os.access(folder, os.W_OK) and all(map(_guarded, folder.parents))
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return None
    return folder if safe else None


def _private(path: Path) -> bool:
    """Whether it is mine, and nobody else can write to it."""
    found = path.lstat()
    return _mine(found) and not stat.S_ISLNK(found.st_mode) and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _guarded(folder: Path) -> bool:
    """Whether nobody but me and the administrator can put something else in the place of what is in it."""
    found = folder.stat()
    shared = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not found.st_mode & stat.S_ISVTX
    return (_mine(found) or found.st_uid == 0) and not shared


def _mine(found: os.stat_result) -> bool:
    return not hasattr(os, "getuid") or found.st_uid == os.getuid()
