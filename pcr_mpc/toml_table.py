"""Strict reading of TOML: every key is typed, and an unknown key is an error naming the nearest one."""

from __future__ import annotations

import difflib
import math
import os
import tomllib
from pathlib import Path
from typing import Any

from .catalogue import kinds_of
from .errors import ModelError, described, number_problem

_REQUIRED: Any = object()
# Likeness of two words from which one may be meant for the other.
_NEAR = 0.75
_TABLES = ".csv", ".tsv", ".txt", ".npz", ".json"
_WORD = 4  # letters of what may be meant as a part of a longer name
# What people look for in a robot or scene and the toolkit does not describe, by how its name begins.
_UNDESCRIBED = {
    ("motor", "actuator", "gear", "servo"): "motors are described by [motors] rate_limit, acceleration_limit and "
    "torque_limit of the robot and angle_limits of each rod, one to a rod and no dynamics besides",
    ("platform", "end_effector", "effector", "plate"): "there is no platform with an orientation: the rods meet in one "
    "passive joint, whose mass is [tip] mass",
    ("tendon", "cable", "wire", "string"): "tendons are not described: rods are driven by turning their bases",
    (
        "joint",
        "hinge",
        "clamp",
    ): "joints are not described: each rod is clamped to a motor and all end in one passive joint",
    (
        "friction",
        "damping",
        "viscosity",
        "backlash",
        "hysteresis",
    ): "no friction or damping but [tip] drag is described",
    ("contact", "obstacle", "collision", "ground", "wall"): "contact with anything is not described",
    ("torsion", "twist", "shear", "poisson", "z"): "the robot is planar: there is no torsion, shear or third axis",
    ("plastic", "fatigue", "temperature"): "the rods are elastic and nothing else is described",
    ("young", "elastic", "radius"): "rods are described by "
    "bending_stiffness [N m^2] and line_density [kg/m], or by material (or youngs_modulus and density) and diameter",
}


class Table:
    """One TOML table whose keys are taken one by one; what is left over is an error.

    Use as a context manager: leaving it checks that no unknown key remains, and a `ModelError` about a value, raised
    within, is given the name of the file.
    """

    def __init__(self, path: Path, name: str, data: dict[str, Any]) -> None:
        self.path = path
        self.name = name
        self._data = dict(data)
        self._known: list[str] = []

    def __enter__(self) -> Table:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if isinstance(error, ModelError) and "file" not in error.details:
            raise ModelError(f"{self.path}: {self.name}{error}", file=str(self.path), **error.details) from None
        if kind is None and self._data:
            self._unknown(next(iter(self._data)))

    def fail(self, key: str, problem: str, **details: Any) -> ModelError:
        """Build the error that says what is wrong with ``key``."""
        return ModelError(f"{self.path}: {self.name}{key}: {problem}", file=str(self.path), key=key, **details)

    def refuse_misspelt(self, *keys: str) -> None:
        """Raise if a key that is left may be meant for one of these, which are missing: before that is said of them."""
        for other in self._data:
            if other not in keys and (near := difflib.get_close_matches(other, keys, n=1, cutoff=_NEAR)):
                raise self.fail(other, f"unknown key; did you mean {near[0]!r}?", nearest=near[0])

    def _unknown(self, key: str) -> None:
        parts = [known for known in self._known if len(key) >= _WORD and key in known]
        nearest = next(iter([*difflib.get_close_matches(key, self._known, n=1, cutoff=_NEAR), *parts]), None)
        undescribed = next((words for stems, words in _UNDESCRIBED.items() if key.lower().startswith(stems)), None)
        hint = f"; did you mean {nearest!r}?" if nearest else f"; {undescribed}" if undescribed else ""
        known = f"known here: {', '.join(dict.fromkeys(self._known))}" if self._known else "no key is known here"
        raise self.fail(key, f"unknown key{hint} ({known})", nearest=nearest)

    def _take(self, key: str, default: Any) -> Any:
        self._known.append(key)
        if key in self._data:
            return self._data.pop(key)
        if default is _REQUIRED:
            # A misspelt required key is both missing and unknown: name the misspelling.
            self.refuse_misspelt(key)
            raise self.fail(key, "missing")
        return default

    def number(
        self,
        key: str,
        default: float = _REQUIRED,
        *,
        above: float = -math.inf,
        minimum: float = -math.inf,
        maximum: float = math.inf,
    ) -> float:
        """Take a finite number, greater than ``above`` and from ``minimum`` to ``maximum``."""
        value = self._take(key, default)
        if value is default:
            return float(default)
        problem = number_problem(value, above=above, minimum=minimum, maximum=maximum)
        if problem:
            raise self.fail(key, problem)
        return float(value)

    def integer(self, key: str, default: int = _REQUIRED, *, minimum: int = 1) -> int:
        """Take an integer of at least ``minimum``."""
        value = self._take(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or value < minimum:
            raise self.fail(key, f"expected an integer >= {minimum}, found {value!r}")
        return value

    def count(self, key: str) -> float:
        """Take an integer of at least 1, or "for ever", which is infinity."""
        value = self._take(key, _REQUIRED)
        if value == "for ever":
            return math.inf
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise self.fail(key, f'expected an integer >= 1, or "for ever", found {value!r}')
        return float(value)

    def boolean(self, key: str, default: bool = _REQUIRED) -> bool:
        """Take true or false."""
        value = self._take(key, default)
        if not isinstance(value, bool):
            raise self.fail(key, f"expected true or false, found {value!r}")
        return value

    def vector(self, key: str, size: int | None, default: Any = _REQUIRED) -> Any:
        """Take a list of ``size`` finite numbers (any size if None)."""
        value = self._take(key, default)
        if value is default:
            return default
        if (
            not isinstance(value, list)
            or (size is not None and len(value) != size)
            or any(number_problem(v) for v in value)
        ):
            count = "" if size is None else f"{size} "
            raise self.fail(key, f"expected a list of {count}finite numbers, found {value!r}")
        return tuple(float(v) for v in value)

    def points(self, key: str) -> tuple[tuple[float, float], ...]:
        """Take a list of pairs of finite numbers."""
        value = self._take(key, _REQUIRED)
        if not isinstance(value, list):
            raise self.fail(key, f"expected a list of points [x, y], found {value!r}")
        for i, point in enumerate(value):
            if not isinstance(point, list) or len(point) != 2 or any(number_problem(v) for v in point):
                raise self.fail(f"{key}[{i}]", f"expected two finite numbers, found {point!r}")
        return tuple((float(x), float(y)) for x, y in value)

    def profile(self, key: str, default: Any = _REQUIRED) -> Any:
        """Take a finite number, or a list of them."""
        if isinstance(self._data.get(key), list):
            return self.vector(key, None)
        return self.number(key, default) if key in self._data else self._take(key, default)

    def text(self, key: str, default: Any = _REQUIRED, *, choices: tuple[str, ...] = ()) -> Any:
        """Take a string, one of ``choices`` if given."""
        value = self._take(key, default)
        if value is default:
            return default
        if not isinstance(value, str) or (choices and value not in choices):
            expected = f"one of {', '.join(choices)}" if choices else "a string"
            raise self.fail(key, f"expected {expected}, found {value!r}")
        return value

    def file(self, key: str, default: Any = _REQUIRED) -> Any:
        """Take the path of another file, which is relative to the folder of this one; it must be there."""
        value = self.text(key, default)
        if value is default:
            return default
        path = self.path.parent / value
        if not path.exists():
            raise self.fail(key, f"{path}: no such file or folder{self._elsewhere(value)}")
        return path

    def _elsewhere(self, value: str) -> str:
        """From where a path is relative, and how the file is called from there that somebody may have meant."""
        if Path(value).is_absolute():
            return ""
        said = f"; a path in this file is relative to its folder, {self.path.parent.resolve()}"
        return f'{said}: write "{seen_from(Path(value), self.path.parent)}"' if Path(value).exists() else said

    def peek(self, key: str) -> Any:
        """Look at a value without taking it; None if it is not there."""
        return self._data.get(key)

    def texts(self, key: str) -> tuple[str, ...]:
        """Take a list of strings that is not empty."""
        value = self._take(key, _REQUIRED)
        if not isinstance(value, list) or not value or not all(isinstance(one, str) for one in value):
            raise self.fail(key, f"expected a list of strings, found {value!r}")
        return tuple(value)

    def matrix(self, key: str, size: int, default: Any = _REQUIRED) -> Any:
        """Take a list of ``size`` rows of ``size`` finite numbers."""
        value = self._take(key, default)
        if value is default:
            return default
        if (
            not isinstance(value, list)
            or len(value) != size
            or any(not isinstance(row, list) or len(row) != size or any(map(number_problem, row)) for row in value)
        ):
            raise self.fail(key, f"expected {size} rows of {size} finite numbers, found {value!r}")
        return tuple(tuple(map(float, row)) for row in value)

    def has(self, key: str) -> bool:
        """Whether the key is there and not taken yet."""
        self._known.append(key)
        return key in self._data

    def table(self, key: str, default: Any = _REQUIRED) -> Table:
        """Take a sub-table (pass ``default={}`` if it may be left out)."""
        value = self._take(key, default)
        if not isinstance(value, dict):
            raise self.fail(key, f"expected a table, found {value!r}")
        return Table(self.path, f"{self.name}{key}.", value)

    def tables(self, key: str) -> list[Table]:
        """Take a non-empty array of tables."""
        value = self._take(key, _REQUIRED)
        if not isinstance(value, list) or not value or not all(isinstance(v, dict) for v in value):
            raise self.fail(key, f"expected [[{key}]] tables, found {value!r}")
        return [Table(self.path, f"{self.name}{key}[{i}].", v) for i, v in enumerate(value)]


def seen_from(path: Path, folder: Path) -> str:
    """Name of a file for use in a TOML file in ``folder``: relative to it, absolute where there is no such way."""
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:  # on another drive
        return path.resolve().as_posix()


def read_toml(path: str | Path) -> Table:
    """Open a TOML file as the root table.

    Raises
    ------
    ModelError
        If the file is missing or is not TOML.
    """
    path = Path(os.path.normpath(path))
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise ModelError(f"{path}: no such file{_at_hand(path)}", file=str(path)) from None
    except OSError as error:
        raise ModelError(described(error) if error.filename else f"{path}: {error}", file=str(path)) from error
    # ValueError: not TOML, or an integer of thousands of digits; RecursionError: thousands of brackets.
    except UnicodeDecodeError as error:
        raise ModelError(f"{path}: is not UTF-8 text ({error}); save it as UTF-8", file=str(path)) from error
    except (ValueError, RecursionError) as error:
        if path.suffix.lower() in _TABLES:
            raise ModelError(
                f"{path}: is a table, not a scene, robot or tuning; a path goes into [reference] of a scene: "
                'kind = "file", file = its name',
                file=str(path),
            ) from None
        raise ModelError(f"{path}: {error}", file=str(path)) from error
    return Table(path, "", data)


def near_file(path: Path) -> Path | None:
    """File that somebody may have meant by a path where there is none: its name or its folder is misspelt."""
    folder = path.parent
    if folder.is_dir():
        names = [one.name for one in folder.glob("*.toml")]
        near = difflib.get_close_matches(path.name if path.suffix else f"{path.name}.toml", names, n=1)
        return folder / near[0] if near else None
    if not folder.parent.is_dir():
        return None
    folders = [one.name for one in folder.parent.iterdir() if (one / path.name).is_file()]
    near = difflib.get_close_matches(folder.name, folders, n=1)
    return folder.parent / near[0] / path.name if near else None


def _at_hand(path: Path) -> str:
    """Advice to whom a file is missing that is misspelt, or comes with the package."""
    if near := near_file(path):
        return f"; did you mean {near}?"
    if not (kinds := kinds_of(path.stem)):
        return ""
    kind = kinds[0] if len(kinds) == 1 else " and a ".join(kinds)
    come = "comes" if len(kinds) == 1 else "come"
    return (
        f"; a {kind} of that name {come} with the package: on the command line give {path.stem}, without folder and "
        f'".toml", in Python shipped("{path.stem}", "{kinds[0]}")'
    )
