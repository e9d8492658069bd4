"""A generated controller, called from Python: with the protocol of `Controller`, for tests, timing and the server."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import interrupt
from ..control.plan import Plan
from ..errors import CompilerError, MeasurementError, PCRError
from ..loop.parts.controllers import Decision
from ..plant.statics.equilibrium import Equilibrium
from .subject import KIND_BITS, Subject
from .vectors import RUNGS

_SOLVED = (
    "solved", "solved inaccurate", "primal infeasible", "dual infeasible", "maximum iterations reached",
    "non convex", "crossed bounds", "no linear model",
)  # fmt: skip
_LIMITS = {"rate": 1, "rate change": 2, "angle": 4} | KIND_BITS
_FIRST_MEASUREMENT = 3


def run_make(folder: Path, *words: str) -> None:
    """Let make do what the words say in a generated folder.

    Raises
    ------
    CompilerError
        There is no compiler or no make, or they failed.
    """
    command = ["make", "-s", "-C", str(folder), *words]
    try:
        done = interrupt.completed(command)
    except OSError as error:
        raise CompilerError(
            f"cannot build {folder}: {error}; it needs make and a C compiler", command=command
        ) from None
    if done.returncode:
        raise CompilerError(f"cannot build {folder}: {done.stderr.strip()}", command=command)


def build(folder: Path, *words: str) -> Path:
    """Compile a generated folder into a library that can be loaded; ``words`` are variables of its Makefile.

    Raises
    ------
    CompilerError
        There is no compiler or no make, or they failed.
    """
    run_make(folder, *words, "libpcr.so")
    return folder / "libpcr.so"


def _structures(n: int, horizon: int, real: Any) -> tuple[Any, Any]:
    """``pcr_measurement`` and ``pcr_output``."""
    whole, states = ctypes.c_int, 4 + n

    class Measurement(ctypes.Structure):
        _fields_ = (
            ("p", real * 2), ("v", real * 2), ("q", real * n),
            ("window", ctypes.c_void_p), ("payloads", ctypes.c_void_p),
        )  # fmt: skip

    class Output(ctypes.Structure):
        _fields_ = (
            ("u", real * n), ("rung", whole), ("solver", whole), ("iterations", whole),
            ("primal_residual", real), ("dual_residual", real), ("active", whole), ("slack", real * 8),
            ("doubts", whole), ("estimate", real * states), ("force", real * 2), ("stiffness", real),
            ("torque", real * n), ("inputs", real * n * horizon), ("states", real * states * (horizon + 1)),
        )  # fmt: skip

    return Measurement, Output


class GeneratedController:
    """The controller of a generated library.

    Parameters
    ----------
    library : Path
        See `build`.
    subject : Subject
        That the library was generated of.
    """

    def __init__(self, library: Path, subject: Subject) -> None:
        self.name = f"{subject.tuning.name} in C"
        self.n = subject.robot.n_rods
        self._real: Any = ctypes.c_float if subject.single else ctypes.c_double
        self._code = ctypes.CDLL(str(Path(library).resolve()))
        self._code.pcr_controller_size.restype = ctypes.c_ulong
        self._memory = ctypes.create_string_buffer(self._code.pcr_controller_size() + 64)
        # Where its doubles are aligned.
        self._at = ctypes.c_void_p((ctypes.addressof(self._memory) + 63) // 64 * 64)
        measurement, output = _structures(self.n, subject.tuning.horizon, self._real)
        self._measured, self.output = measurement(), output()

    def start(self, pose: Equilibrium | None = None) -> None:
        """Get ready in a pose; None: where the scene starts.

        Raises
        ------
        PCRError
            The rods cannot follow there from where the scene starts.
        """
        at = None if pose is None else (self._real * (2 + self.n))(*pose.p, *pose.q)
        if code := self._code.pcr_controller_init(self._at, at):
            raise PCRError(f"the generated controller cannot start there: result {code} of pcr_controller_init")

    def set_parameters(self, values: dict[str, np.ndarray | float]) -> None:
        """Let other parameters take effect; ``values`` are those of `tables.parameters`, all of them.

        Raises
        ------
        PCRError
            They are refused.
        """
        flat = np.concatenate([np.ravel(value) for value in values.values()]).astype(float)
        if code := self._code.pcr_controller_set_parameters(self._at, (self._real * len(flat))(*flat)):
            raise PCRError(f"the generated controller refuses these parameters: result {code}")

    def raw_step(self, x: Sequence[float] | np.ndarray) -> int:
        """Decide from a measured state; return the result, with ``output`` filled."""
        self._measured.p[:], self._measured.v[:], self._measured.q[:] = x[:2], x[2:4], x[4:]
        return int(self._code.pcr_controller_step(self._at, ctypes.byref(self._measured), ctypes.byref(self.output)))

    def checked_step(self, x: Sequence[float] | np.ndarray) -> None:
        """Decide from a measured state; what is decided is in ``output``.

        Raises
        ------
        MeasurementError
            The first measurement is in other units, or wrapped.
        PCRError
            It was not started.
        """
        code = self.raw_step(x)
        if code == _FIRST_MEASUREMENT:
            raise MeasurementError(f"first measurement: {x} is in other units, or wrapped")
        if code:
            raise PCRError(f"the generated controller failed: result {code} of pcr_controller_step; was it started?")

    def step(self, k: int, x: np.ndarray) -> Decision:
        """See `Controller`; errors as `checked_step`."""
        self.checked_step(x)
        out = self.output
        status, rung = _SOLVED[out.solver], RUNGS[out.rung]
        states = np.array(out.states)
        plan = Plan(
            inputs=np.array(out.inputs),
            states=None if np.isnan(states).any() else states,
            models=None,
            status=status,
            fallback=None if rung == "solved" else rung,
            active=tuple(kind for kind, bit in _LIMITS.items() if out.active & bit),
            slack={kind: out.slack[bit.bit_length() - 1] for kind, bit in _LIMITS.items()
                   if out.slack[bit.bit_length() - 1]},
            iterations=out.iterations,
            primal_residual=out.primal_residual,
            dual_residual=out.dual_residual,
        )  # fmt: skip
        return Decision(np.array(out.u), plan, 0.0, np.array(out.estimate), np.array(out.force))
