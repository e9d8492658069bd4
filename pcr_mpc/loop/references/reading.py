"""The [reference] table of a scene."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ...toml_table import Table
from .blended import Blended
from .on_curves import Circle, Line, OnCurve, Polygon, Spline, Waypoints
from .path_file import load_path
from .tabulated import Tabulated
from .trajectory import Hold, Lemniscate, PickAndPlace, Trajectory

# What a record can hold and a digest can be made of.
KINDS = (Hold, Lemniscate, PickAndPlace, Circle, Line, Polygon, Waypoints, Spline, Tabulated, Blended)
_NAMES = ("none", "hold", "lemniscate", "pick_and_place", "file", "waypoints", "circle", "line", "polygon", "spline")
_OPTIONS = ("repeat", "start", "end", "time_scale")


def built_in(trajectory: Trajectory | None) -> bool:
    """Whether a trajectory is made of the toolkit's own classes alone, and so says itself what it is."""
    return type(trajectory) in KINDS and (not isinstance(trajectory, Blended) or built_in(trajectory.path))


def read_reference(table: Table) -> Trajectory | None:
    """Take the keys of a scene's [reference] table; the file of kind "file" is relative to the scene.

    Raises
    ------
    ModelError
        Names the file and the key.
    """
    kind = table.text("kind", choices=_NAMES)
    if kind == "none":
        return None
    if kind == "hold":
        return Hold(table.vector("position", 2))
    if kind == "lemniscate":
        return _lemniscate(table)
    if kind == "pick_and_place":
        path: Trajectory = PickAndPlace(
            pick=table.vector("pick", 2),
            place=table.vector("place", 2),
            lift=table.number("lift"),
            wait=table.number("wait", minimum=0.0),
            move=table.number("move", above=0.0),
        )
        given = any(table.has(key) for key in _OPTIONS)
        return _blended(table, path) if given else path
    return _blended(table, _READERS[kind](table))


def _lemniscate(table: Table) -> Trajectory:
    """Its ramp is the blend at its start, and it goes on for ever, where nothing else is said."""
    figure: dict[str, Any] = {
        "centre": table.vector("centre", 2),
        "size": table.vector("size", 2),
        "period": table.number("period", above=0.0),
    }
    given = any(table.has(key) for key in _OPTIONS)
    if not given:
        return Lemniscate(**figure, ramp=table.number("ramp", above=0.0))
    if table.has("start") and table.has("ramp"):
        raise table.fail("ramp", "is the blend at the start, which start says too; leave out one of them")
    ramp = table.number("ramp", above=0.0) if table.has("ramp") else None
    return _blended(table, Lemniscate(**figure, ramp=0.0), start=ramp, repeat=math.inf)


def _blended(table: Table, path: Trajectory, start: float | None = None, repeat: float = 1.0) -> Blended:
    if table.has("repeat"):
        repeat = table.count("repeat")
    return Blended(
        path,
        repeat=repeat,
        start=table.number("start", minimum=0.0) if table.has("start") else start,
        end=table.number("end", minimum=0.0) if table.has("end") else None,
        time_scale=table.number("time_scale", 1.0, above=0.0),
    )


def _circle(table: Table) -> Circle:
    centre, radius = table.vector("centre", 2), table.number("radius", above=0.0)
    key = _either(table, "period", "speed")
    value = table.number(key, above=0.0)
    return Circle(
        centre,
        radius,
        value if key == "period" else 2 * math.pi * radius / value,
        table.number("angle", -math.pi / 2),
        table.boolean("clockwise", False),
    )


def _line(table: Table) -> Line:
    points = table.points("points")
    return Line(points, _speed(table, Line(points, 1.0)))


def _polygon(table: Table) -> Polygon:
    corners, radius = table.points("corners"), table.number("radius", above=0.0)
    return Polygon(corners, radius, _speed(table, Polygon(corners, radius, 1.0)))


def _speed(table: Table, unit: OnCurve) -> float:
    """As stated, or such that the whole takes the stated time; ``unit`` is the same at 1 m/s."""
    if _either(table, "speed", "time") == "speed":
        return table.number("speed", above=0.0)
    return unit.curve.length / table.number("time", above=0.0)


def _waypoints(table: Table) -> Waypoints:
    points, radius = table.points("points"), table.number("radius", 0.0, minimum=0.0)
    return Waypoints(points, **_through(table), radius=radius)


def _spline(table: Table) -> Spline:
    return Spline(table.points("points"), **_through(table))


def _through(table: Table) -> dict[str, Any]:
    key = _either(table, "speed", "times")
    return {
        key: table.profile("speed") if key == "speed" else table.vector("times", None),
        "closed": _closed(table),
    }


def _file(table: Table) -> Tabulated:
    file = table.file("file")
    smoothing = table.number("smoothing", minimum=0.0) if table.has("smoothing") else None
    return load_path(file, smoothing=smoothing, closed=_closed(table))


def _closed(table: Table) -> bool:
    """As stated; what is repeated is closed."""
    repeated = table.has("repeat") and table.peek("repeat") != 1
    return table.boolean("closed", repeated)


def _either(table: Table, one: str, other: str) -> str:
    """Which of two keys is given."""
    found = [key for key in (one, other) if table.has(key)]
    if len(found) != 1:
        raise table.fail(one, f"give either {one} or {other}")
    return found[0]


_READERS: dict[str, Callable[[Table], Trajectory]] = {
    "circle": _circle, "line": _line, "polygon": _polygon, "waypoints": _waypoints, "spline": _spline, "file": _file,
}  # fmt: skip
