"""What is known of a rod that is solved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# How a pose was reached, from cheap to dear; see `RodSolver`.
RUNGS = ("warm", "newton", "continuation", "cold", "snap")


@dataclass(frozen=True, eq=False)
class RodState:
    """One solved rod: normalised pose, unknowns, and what the last linear solve gave."""

    pose: np.ndarray  # (3,) tip relative to base / L, clamp angle
    unknowns: np.ndarray
    tangent: np.ndarray  # d unknowns / d pose
    loads: np.ndarray  # (3,) n_x, n_y at the tip, m at the base
    load_tangent: np.ndarray  # (3, 3) d loads / d pose
    scalars: np.ndarray  # (5,) residual, step length, energy, conjugate points, drift
    residual: float
    iterations: int
    rung: str = "newton"

    @property
    def stable(self) -> bool:
        """Whether there is no conjugate point along the rod."""
        return not self.scalars[3]

    @property
    def energy(self) -> float:
        """Elastic energy in EI/L."""
        return float(self.scalars[2])
