"""CasADi functions as machine code, where there is a C compiler: a third of the time of CasADi's own interpreter."""

from __future__ import annotations

import os
import shlex
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import casadi as ca

from .errors import CompilerError

# Without -ffast-math the results are those of the interpreter, bit for bit.
_FLAGS = ("-O2", "-ffp-contract=off", "-fPIC", "-shared")


def compiled(function: Any) -> Any:
    """Return the same function, compiled by the C compiler that the variable CC names (by default "cc").

    Takes half a second for a time step of the plant; what it makes is gone with the process.

    Raises
    ------
    CompilerError
        There is no compiler, or it failed.
    """
    command = [*shlex.split(os.environ.get("CC", "cc")), *_FLAGS]
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / f"{function.name()}.c", Path(folder) / f"{function.name()}.so"
        generator = ca.CodeGenerator(source.name)
        generator.add(function)
        generator.generate(f"{folder}{os.sep}")
        command += [str(source), "-o", str(library), "-lm"]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True)
        except (OSError, subprocess.CalledProcessError) as error:
            said = str(getattr(error, "stderr", "") or error).strip()
            raise CompilerError(
                f"cannot compile {function.name()} with {command[0]!r}: {said}; set CC to a C compiler, "
                "or do without compiled=True",
                command=command,
            ) from None
        return ca.external(function.name(), str(library))
