"""What single precision costs: the scene in C of floats against Python's doubles."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .. import interrupt
from ..errors import GenerationError
from .library import run_make

# Single precision is of no use, and is refused, where the RMS error is so many times that of double, and this share of
# a rod's length more.
_WORST_RATIO, _SLIGHT = 3.0, 1e-5


@dataclass(frozen=True)
class Loss:
    """How a run in single precision differs.

    Attributes
    ----------
    rms_mm, double_rms_mm : float
        RMS error of the tip in single precision, and in double [mm].
    rates : float
        Largest difference of motor rates in closed loop [rad/s].
    same : float
        The same for the same measurements [rad/s].
    others : int
        Periods of the same measurements in which rung or iterations differ.
    periods : int
        Of the run.
    apart : float
        Largest difference of a state of the plant alone, with the recorded rates [m, m/s or rad].
    """

    rms_mm: float
    double_rms_mm: float
    rates: float
    same: float
    others: int
    periods: int
    apart: float

    def __str__(self) -> str:
        return (
            f"RMS {self.rms_mm:.6g} mm, in double {self.double_rms_mm:.6g} mm; rates differ by at most "
            f"{self.rates:.2g} rad/s in closed loop, {self.same:.2g} for the same measurements; rung or iterations in "
            f"{self.others} of {self.periods} periods; the plant alone by {self.apart:.2g} m, m/s or rad"
        )


def measure_loss(scene: str, write: Callable[[Path], None], double_rms_mm: float, length: float) -> Loss:
    """Compile and run the example of a folder of floats.

    Parameters
    ----------
    scene : str
        Its name.
    write : callable
        Writes the folder.
    double_rms_mm : float
        As Python runs the scene [mm].
    length : float
        Of the rods [m].

    Raises
    ------
    GenerationError
        Single precision is of no use there.
    CompilerError
        There is no compiler, or it failed.
    """
    with tempfile.TemporaryDirectory(prefix="pcr-mpc-") as place:
        write(Path(place))
        run_make(Path(place), "CFLAGS=-O1", "GRAPH_CFLAGS=-O1", "example")
        done = interrupt.completed([str(Path(place) / "example")])
    said = done.stdout
    numbers = re.findall(r"differ by at most (\S+) rad/s, rung or iterations in (\d+) of (\d+)", said)
    rms = re.search(r"RMS error of the tip\s+(\S+) mm", said)
    apart = re.search(r"plant, recorded rates\s+differs by at most (\S+) m", said)
    if done.returncode or rms is None or apart is None or len(numbers) != 2:
        why = "; ".join(line for line in said.splitlines() if line) or f"status {done.returncode}"
        raise GenerationError(f"{scene}: in single precision it does not run to its end ({why}), where double has "
                              f"an RMS of {double_rms_mm:.6g} mm; leave --float32 out", part="float32")  # fmt: skip
    (rates, _, _), (same, others, periods) = numbers
    loss = Loss(float(rms[1]), double_rms_mm, float(rates), float(same), int(others), int(periods), float(apart[1]))
    # So written that NaN is of no use.
    if not loss.rms_mm <= _WORST_RATIO * double_rms_mm + 1e3 * _SLIGHT * length:
        raise GenerationError(f"{scene}: single precision is of no use here ({loss}); leave --float32 out",
                              part="float32")  # fmt: skip
    return loss
