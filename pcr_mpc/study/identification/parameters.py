"""What may be unknown: names, units, what was believed of it and how firmly."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...errors import IdentificationError
from ...plant.robot import Robot
from ...plant.uncertainty import Uncertainty

# Standard deviations where the robot's file does not say: those of the ranges of `Spread`, of which the reasons stand
# there; a uniform range of +-a has a / sqrt(3). Relative to the number, or to its natural size.
_STIFFNESS, _MASS, _DRAG = 0.1 / math.sqrt(3.0), 0.2 / math.sqrt(3.0), math.log(2.0) / math.sqrt(3.0)
_LENGTH, _DENSITY = 0.0025, 0.05
_BASE = 1.0e-3 / math.sqrt(3.0) / 0.4  # of the mean length
_FORCE = 0.8  # of sum EI / L^2
_ZERO = 0.01  # rad
_DELAY = 3.0  # rows of the log
# What a lab does not know.
DEFAULT = ("bending_stiffness", "tip_mass", "drag", "base", "delay", "force")
_OF_ROD = {"bending_stiffness": "N m^2", "length": "m", "base_x": "m", "base_y": "m", "line_density": "kg/m"}
# Parameters that share one scale, which motion does not show: forces in proportion, masses in proportion.
_FORCES = ("force_x", "force_y")
SCALED = ("bending_stiffness", "line_density", "tip_mass", "drag", *_FORCES)


@dataclass(frozen=True)
class Parameter:
    """One number that may be unknown.

    Attributes
    ----------
    name : str
    unit : str
    value : float
        What is believed.
    sd : float
        Standard deviation of that: of the number's logarithm if it is positive, else in its unit.
    positive : bool
    bounds : (float, float)
        That no estimate leaves.
    """

    name: str
    unit: str
    value: float
    sd: float
    positive: bool = False
    bounds: tuple[float, float] = (-math.inf, math.inf)

    @property
    def last(self) -> str:
        """Its name without whose it is."""
        return re.sub(r"\[\d+\]$", "", self.name.split(".")[-1])

    def at(self, z: float) -> float:
        """Value at z standard deviations from what is believed."""
        value = self.value * math.exp(min(max(self.sd * z, -50.0), 50.0)) if self.positive else self.value + self.sd * z
        return min(max(value, self.bounds[0]), self.bounds[1])

    def slope(self, z: float) -> float:
        """Derivative of `at`; zero at a bound."""
        value = self.at(z)
        if value in self.bounds:
            return 0.0
        return self.sd * (value if self.positive else 1.0)


@dataclass(frozen=True, eq=False)
class Parameters:
    """What is free, what is known of it together, and what is held.

    Attributes
    ----------
    robot : Robot
        As it is believed.
    free : tuple of Parameter
    held : dict
        Value of every other parameter by its name.
    root : ndarray, shape (F, F)
        W with W z the standardised deviation from what is believed: unit matrix where priors are independent.
    """

    robot: Robot
    free: tuple[Parameter, ...]
    held: dict[str, float]
    root: np.ndarray

    def values(self, z: np.ndarray) -> dict[str, float]:
        """Value of every parameter.

        A force is believed in proportion to the tip's mass, so that what motion does not show, one scale of all forces
        and masses, is a straight line in z.
        """
        values = self.held | {one.name: one.at(float(each)) for one, each in zip(self.free, z, strict=True)}
        heavier = values["tip_mass"] / self.robot.tip_mass
        return values | {one.name: heavier * values[one.name] for one in self.free if one.last in _FORCES}

    def gradient(self, z: np.ndarray) -> np.ndarray:
        """Derivatives of the free ones' values (rows) in z (columns), shape (F, F)."""
        slopes = np.array([one.slope(float(each)) for one, each in zip(self.free, z, strict=True)])
        gradient, mass, values = np.diag(slopes), self.index("tip_mass"), self.values(z)
        for i, one in enumerate(self.free):
            if one.last in _FORCES:
                gradient[i, i] *= values["tip_mass"] / self.robot.tip_mass
                if mass is not None:
                    gradient[i, mass] = values[one.name] * slopes[mass] / values["tip_mass"]
        return gradient

    def robot_at(self, z: np.ndarray) -> Robot:
        """Robot with these numbers.

        Raises
        ------
        ModelError
            There is no such robot.
        """
        return robot_with(self.robot, self.values(z))

    def index(self, name: str) -> int | None:
        """Place of a free parameter."""
        return next((i for i, one in enumerate(self.free) if one.name == name), None)


def robot_with(robot: Robot, values: Mapping[str, float]) -> Robot:
    """Robot with other numbers, as far as they are given."""
    rods = []
    for i, rod in enumerate(robot.rods):
        whose = f"rods[{i}]"
        rods.append(
            replace(
                rod,
                base=(values.get(f"{whose}.base_x", rod.base[0]), values.get(f"{whose}.base_y", rod.base[1])),
                length=values.get(f"{whose}.length", rod.length),
                bending_stiffness=values.get(f"{whose}.bending_stiffness", rod.bending_stiffness),
                line_density=values.get(f"{whose}.line_density", rod.line_density),
            )
        )
    tip_mass, drag = values.get("tip_mass", robot.tip_mass), values.get("drag", robot.drag)
    return replace(robot, rods=tuple(rods), tip_mass=tip_mass, drag=drag)


def force_names(log: int, logs: int) -> tuple[str, str]:
    """Names of the force on the tip in a log."""
    whose = "" if logs == 1 else f"logs[{log}]."
    return f"{whose}force_x", f"{whose}force_y"


def catalogue(robot: Robot, logs: int, delay: float, longest: float) -> list[Parameter]:
    """Every parameter there is, with default priors.

    Parameters
    ----------
    delay, longest : float
        First guess and bound [control periods]. The least is -1: clocks of a log may be a little off.
    """
    size = float(robot.lengths.mean())
    found = []
    for i, rod in enumerate(robot.rods):
        relative = {"bending_stiffness": _STIFFNESS, "length": _LENGTH, "line_density": _DENSITY}
        for name, unit in _OF_ROD.items():
            if name.startswith("base"):
                value, sd, positive = rod.base[name == "base_y"], _BASE * size, False
            else:
                value, sd, positive = getattr(rod, name), relative[name], getattr(rod, name) > 0.0
            found.append(Parameter(f"rods[{i}].{name}", unit, value, sd, positive))
    found.append(Parameter("tip_mass", "kg", robot.tip_mass, _MASS, True))
    # A drag that was thought to be nothing may be as much as a twentieth of critical.
    critical = 2.0 * math.sqrt(robot.tip_mass * robot.force_scale / size)
    drag = robot.drag > 0.0
    found.append(Parameter("drag", "N s/m", robot.drag, _DRAG if drag else 0.05 * critical, drag, (0.0, math.inf)))
    found += [Parameter(f"motor_zero[{i}]", "rad", 0.0, _ZERO) for i in range(robot.n_rods)]
    found += [Parameter(f"tip_offset_{axis}", "m", 0.0, _BASE * size) for axis in "xy"]
    found.append(Parameter("delay", "periods", delay, _DELAY, False, (-1.0, longest)))
    for log in range(logs):
        found += [Parameter(name, "N", 0.0, _FORCE * robot.force_scale) for name in force_names(log, logs)]
    return found


def chosen(
    robot: Robot,
    everything: Sequence[Parameter],
    *,
    free: Sequence[str] = ("default",),
    fixed: Mapping[str, float] | None = None,
    uncertainty: Uncertainty | None = None,
    inertia: bool = False,
) -> Parameters:
    """Sort parameters into free and held ones.

    Parameters
    ----------
    robot : Robot
    everything : sequence of Parameter
        See `catalogue`.
    free : sequence of str
        Names; a part of a name is all that have it: ``base``, ``length``, ``rods[0].base``; ``default`` is what a lab
        does not know.
    fixed : mapping, optional
        Names, likewise, and values.
    uncertainty : Uncertainty, optional
        Of the robot's numbers; instead of the default priors.
    inertia : bool
        Whether the model has the rods' mass; else their density does not matter.

    Raises
    ------
    IdentificationError
        No such name; nothing is left free; a name of the uncertainty that is no parameter.
    """
    wanted: dict[str, bool] = {}
    for word in free:
        for name in DEFAULT if word == "default" else (word,):
            wanted |= dict.fromkeys(named(name, everything), True)
    held: dict[str, float] = {}
    for word, value in (fixed or {}).items():
        for name in named(word, everything):
            held[name] = value
            wanted.pop(name, None)
    if not inertia and (useless := [name for name in wanted if name.endswith("line_density")]):
        raise IdentificationError(
            f"{useless[0]} cannot be free: the scene's plant leaves the rods' mass out; give it [plant] inertia = "
            '"condensed"'
        )
    for name, value in held.items():
        one = next(one for one in everything if one.name == name)
        if not math.isfinite(value) or (one.positive and value <= 0.0):
            raise IdentificationError(f"{name} cannot be held at {value:g} {one.unit}: expected a positive number")
    if not wanted:
        raise IdentificationError("nothing is free: every parameter is held; free some with --free")
    covariance, found = _prior([one for one in everything if one.name in wanted], uncertainty)
    rest = {one.name: held.get(one.name, one.value) for one in everything if one.name not in wanted}
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    return Parameters(robot_with(robot, held), tuple(found), rest, root)


def named(word: str, everything: Sequence[Parameter]) -> list[str]:
    """Names that a word stands for.

    Raises
    ------
    IdentificationError
        It stands for none.
    """
    word = word.strip()
    same = [
        one.name
        for one in everything
        if word in (one.name, one.last, re.sub(r"_[xy]$", "", one.last), re.sub(r"_[xy]$", "", one.name))
    ]
    if not same:
        words = sorted({re.sub(r"_[xy]$", "", one.last) for one in everything} | {one.name for one in everything})
        near = difflib.get_close_matches(word, words, n=1, cutoff=0.5)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        known = ", ".join(sorted({re.sub(r"_[xy]$", "", one.last) for one in everything}))
        raise IdentificationError(f"{word!r} is no parameter{hint} (known: {known}, each or by rod as rods[0].length)")
    return same


def _prior(free: list[Parameter], known: Uncertainty | None) -> tuple[np.ndarray, list[Parameter]]:
    """Correlation of the free parameters as believed, and these with the standard deviations that are known."""
    if known is None:
        return np.eye(len(free)), free
    places = {name: i for i, name in enumerate(known.names)}
    sds = [
        replace(one, sd=float(known.sd[places[one.name]]) / (one.value if one.positive else 1.0))
        if one.name in places
        else one
        for one in free
    ]
    matrix = np.eye(len(free))
    rows = [(i, places[one.name]) for i, one in enumerate(free) if one.name in places]
    for i, a in rows:
        for j, b in rows:
            if i != j:
                matrix[i, j] = known.correlation[a, b]
    # Written with few digits it may have lost its definiteness by that much.
    values, vectors = np.linalg.eigh(matrix)
    return vectors @ np.diag(np.maximum(values, 1e-9)) @ vectors.T, sds
