"""Robots that differ in one number, by its name in `Kind`."""

from dataclasses import replace

import numpy as np


def number_of(robot, name):
    """The number that goes by that name, looked up in the robot itself."""
    if not name.startswith("rods["):
        return robot.gravity["xy".index(name[-1])] if name.startswith("gravity") else getattr(robot, name)
    rod, key = _of_rod(robot, name)
    if key.startswith("base_"):
        return rod.base["xy".index(key[-1])]
    if key.startswith("angle_"):
        return rod.angle_limits[key == "angle_upper"]
    if key == "axial_compliance":
        return 1.0 / rod.axial_stiffness
    if "[" in key:
        attribute, knot = key[:-1].split("[")
        values = np.atleast_1d(getattr(rod, attribute))
        return values[int(knot)] if len(values) > 1 else values[0]
    return getattr(rod, key)


def with_number(robot, name, value):
    """The robot with another value of that number; lists along rods must have as many values as there are knots."""
    value = float(value)
    if name.startswith("gravity"):
        return replace(robot, gravity=_put(robot.gravity, "xy".index(name[-1]), value))
    if not name.startswith("rods["):
        return replace(robot, **{name: value})
    rod, key = _of_rod(robot, name)
    if key.startswith("base_"):
        change = {"base": _put(rod.base, "xy".index(key[-1]), value)}
    elif key.startswith("angle_"):
        change = {"angle_limits": _put(rod.angle_limits, int(key == "angle_upper"), value)}
    elif key == "axial_compliance":
        change = {"axial_stiffness": 1.0 / value}
    elif "[" in key:
        attribute, knot = key[:-1].split("[")
        change = {attribute: _put(np.atleast_1d(getattr(rod, attribute)), int(knot), value)}
    else:
        change = {key: value}
    return replace(robot, rods=_put(robot.rods, robot.rods.index(rod), replace(rod, **change)))


def _of_rod(robot, name):
    place, key = name.removeprefix("rods[").split("].", 1)
    return robot.rods[int(place)], key


def _put(values, index, value):
    return tuple(value if i == index else old for i, old in enumerate(values))
