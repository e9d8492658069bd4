"""How well a robot's numbers are known: standard deviations and correlations, from the robot's file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import ModelError, checked_array
from ..frozen import Frozen
from ..toml_table import Table, read_toml

# Rounding of a matrix that is written with six digits and more.
_ROUNDING = 1e-5


@dataclass(frozen=True, eq=False)
class Uncertainty(Frozen):
    """A normal distribution about the numbers of a robot.

    Attributes
    ----------
    names : tuple of str
        Of K numbers, as in `Kind`: ``rods[0].bending_stiffness``, ``tip_mass`` and so on.
    sd : ndarray, shape (K,)
        Standard deviations, each in the unit of its number; greater than zero.
    correlation : ndarray, shape (K, K)
        Positive semidefinite, with ones on its diagonal.
    """

    names: tuple[str, ...]
    sd: np.ndarray
    correlation: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        size = len(self.names)
        if len(set(self.names)) < size:
            raise ModelError(f"names has one twice: {', '.join(self.names)}", key="names")
        for name, shape in (("sd", (size,)), ("correlation", (size, size))):
            try:
                object.__setattr__(self, name, checked_array(name, getattr(self, name), shape).copy())
            except ValueError as error:
                raise ModelError(str(error), key=name) from None
        if not (self.sd > 0.0).all():
            raise ModelError(f"sd is {self.sd.tolist()}, expected numbers greater than zero", key="sd")
        matrix = self.correlation
        sound = np.allclose(matrix, matrix.T, atol=_ROUNDING) and np.allclose(np.diag(matrix), 1.0, atol=_ROUNDING)
        if not sound or np.linalg.eigvalsh(matrix)[0] < -size * _ROUNDING:
            raise ModelError(
                "correlation is no matrix of correlations: expected a symmetric one with ones on its diagonal and no "
                "negative eigenvalue",
                key="correlation",
            )
        super().__post_init__()

    @property
    def covariance(self) -> np.ndarray:
        """Shape (K, K), in products of units."""
        return np.asarray(self.correlation * np.outer(self.sd, self.sd))


def read_uncertainty(file: Table) -> Uncertainty | None:
    """Take a robot's [uncertainty] table, if it has one."""
    if not file.has("uncertainty"):
        return None
    with file.table("uncertainty") as table:
        names = table.texts("names")
        sd = table.vector("sd", len(names))
        correlation = table.matrix("correlation", len(names), None)
        return Uncertainty(names, np.array(sd), np.eye(len(names)) if correlation is None else np.array(correlation))


def load_uncertainty(path: str | Path) -> Uncertainty | None:
    """Read how well a robot's numbers are known, from its file; None where that does not say.

    Raises
    ------
    ModelError
        There is no such file, or its [uncertainty] table is wrong.
    """
    return read_uncertainty(read_toml(path))
