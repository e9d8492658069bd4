"""What the data tell of the parameters, and what they cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from .parameters import SCALED, Parameters
from .problem import Problem

# A direction in which the data tell less than what was believed is not told by them.
_UNTOLD = 1.0
# Share of an untold direction that makes a parameter part of it.
_PART = 0.25
# Correlation that is worth a line.
_STRONG = 0.9


@dataclass(frozen=True, eq=False)
class Information:
    """About the free parameters' z, at the end of a search.

    Attributes
    ----------
    covariance : ndarray, shape (F, F)
        Of z, after the data; that of what was believed is the inverse of ``root' root``.
    of_data : ndarray, shape (F, F)
        Information of the data alone, starts and missing commands unknown.
    unidentified : tuple of str
        Sentences on what the data cannot tell.
    correlations : tuple of (str, str, float)
        The strong ones that are left.
    """

    covariance: np.ndarray
    of_data: np.ndarray
    unidentified: tuple[str, ...]
    correlations: tuple[tuple[str, str, float], ...]


def information(problem: Problem, jacobian: np.ndarray, z: np.ndarray, widened: float = 1.0) -> Information:
    """Read the information off a (weighted) Jacobian of all residuals.

    Parameters
    ----------
    widened : float
        By which factor the variance of the data's answer is larger than the Jacobian says, where residuals are not
        independent of each other.
    """
    parameters, free = problem.parameters, len(problem.parameters.free)
    if not free:
        return Information(np.zeros((0, 0)), np.zeros((0, 0)), (), ())
    # The triangle's last block is what is known of z with all else unknown; the last rows are what was believed.
    triangle = qr(jacobian[:-free], mode="r", check_finite=False)[0]
    root = triangle[: jacobian.shape[1]][-free:, -free:] / np.sqrt(widened)
    both = qr(np.vstack([root, parameters.root]), mode="r", check_finite=False)[0][:free]
    inverse = np.linalg.inv(both)
    covariance = inverse @ inverse.T
    of_data = root.T @ root
    sentences = _untold(parameters, root, z)
    sd = np.sqrt(np.diag(covariance))
    matrix = covariance / np.outer(sd, sd)
    pairs = [(i, j) for i in range(free) for j in range(i) if abs(matrix[i, j]) > _STRONG]
    pairs.sort(key=lambda pair: -abs(matrix[pair]))
    strong = tuple((parameters.free[j].name, parameters.free[i].name, float(matrix[i, j])) for i, j in pairs)
    return Information(covariance, of_data, sentences, strong)


def _untold(parameters: Parameters, root: np.ndarray, z: np.ndarray) -> tuple[str, ...]:
    """Sentences on the directions of z in which the data know less than was believed."""
    free = parameters.free
    sentences: list[str] = []
    whole = np.linalg.inv(parameters.root)
    # In units in which what was believed is the unit sphere.
    within = root @ whole
    scale = parameters.root @ scale_direction(parameters, z)
    if scale.any() and np.linalg.norm(within @ scale) < _UNTOLD * np.linalg.norm(scale):
        names = [one.name for one in free if one.last in SCALED]
        sentences.append(
            f"{_spoken(names)} share one scale, which motion does not show: forces and masses in proportion move "
            "alike; give one of them (weigh the tip: --fix tip_mass=KILOGRAMS), or a log with motor torque"
        )
        along = scale / np.linalg.norm(scale)
        # What is left is beside it.
        within = np.vstack([within - np.outer(within @ along, along), 2.0 * _UNTOLD * along])
    _, values, directions = np.linalg.svd(within)
    for value, direction in reversed(list(zip(values, directions, strict=True))):
        if value >= _UNTOLD:
            break
        parts = np.abs(whole @ direction)  # in standard deviations of each
        names = [one.name for one, part in zip(free, parts, strict=True) if part > _PART * parts.max()]
        if len(names) == 1:
            sentences.append(f"{names[0]} stays where it was believed: the data do not tell it")
        else:
            sentences.append(f"{_spoken(names)} go together: the data tell a combination of them, not each")
    return tuple(dict.fromkeys(sentences))


def scale_direction(parameters: Parameters, z: np.ndarray) -> np.ndarray:
    """Direction of z in which all forces and masses that are free grow in proportion, shape (F,)."""
    values = parameters.values(z)
    grown = np.array([values[one.name] if one.last in SCALED else 0.0 for one in parameters.free])
    return np.asarray(np.linalg.lstsq(parameters.gradient(z), grown, rcond=None)[0])


def _spoken(names: Sequence[str]) -> str:
    """Names in words: those that all rods or both axes have, once."""
    groups: dict[str, list[str]] = {}
    for name in names:
        last = name.split(".")[-1]
        groups.setdefault(last, []).append(name)
    words = []
    for last, members in groups.items():
        rods = [name for name in members if name.startswith("rods[")]
        if len(rods) > 1:
            words.append(f"{last} of {'both' if len(rods) == 2 else 'all'} rods")
        else:
            words += members
    if "force_x" in words and "force_y" in words:
        words = [word for word in words if word != "force_y"]
        words[words.index("force_x")] = "force"
    return f"{', '.join(words[:-1])} and {words[-1]}" if len(words) > 1 else words[0]
