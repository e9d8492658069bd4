"""A robot as identified, written as TOML: its numbers, where they come from, and how well they are known."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import ModelError, StudyError
from ...files import replacing, require_free, stamped
from ...plant.materials import Section
from ...plant.robot import Robot, load_robot
from ...plant.rod import Rod
from ...plant.uncertainty import Uncertainty
from ...toml_table import read_toml
from .result import Identification

_SECTION = ("diameter", "inner_diameter", "width", "thickness")


def robot_path(scene_file: Path) -> Path:
    """Return the file of a scene's robot."""
    return scene_file.parent / str(read_toml(scene_file).text("robot"))


def write_robot(
    found: Identification, base_file: Path, path: Path, comments: Sequence[str], *, force: bool = False
) -> None:
    """Write a robot with the estimates, under some lines of comment.

    Parameters
    ----------
    base_file : Path
        Of the robot that was believed: what is not a number of `identify`, such as sections, is as it is there.

    Raises
    ------
    StudyError
        It does not read back as it is; nothing is written.
    OutputError
        There is a file that was not written here, or was changed since, and ``force`` is not given.
    """
    require_free(path, force=force)
    base = load_robot(base_file)
    sections = [{key: rod[key] for key in _SECTION if key in rod} for rod in tomllib.loads(_text(base_file))["rods"]]
    rods = tuple(
        replace(rod, base=new.base, length=new.length, bending_stiffness=new.bending_stiffness,
                line_density=new.line_density)
        for rod, new in zip(base.rods, found.robot.rods, strict=True)
    )  # fmt: skip
    robot = replace(base, name=path.stem, rods=rods, tip_mass=found.robot.tip_mass, drag=found.robot.drag)
    with replacing(path) as draft:
        draft.write_text(stamped(_toml(robot, sections, found.uncertainty, comments)), encoding="utf-8")
        try:
            read = load_robot(draft)
        except ModelError as error:
            raise StudyError(f"{path}: the robot cannot be written: {error}", path=str(path)) from error
        if not _alike(read, robot):
            raise StudyError(f"{path}: robot {robot.name} does not read back as it is", path=str(path))


def _alike(one: Robot, other: Robot) -> bool:
    """Whether two robots are the same but for rounding."""

    def numbers(robot: Robot) -> list[float]:
        found: list[float] = [robot.tip_mass, robot.drag, robot.rate_limit, robot.acceleration_limit]
        found += [robot.torque_limit, *robot.gravity]
        for rod in robot.rods:
            found += [*rod.base, rod.length, rod.bending_stiffness, rod.line_density, *rod.angle_limits]
            found += [*rod.curvatures, *rod.stiffness_factors, min(rod.axial_stiffness, 1e30)]
            found += [rod.half_thickness or 0.0, min(rod.strain_limit, 1e30)]
        return found

    return len(numbers(one)) == len(numbers(other)) and np.allclose(numbers(one), numbers(other), rtol=1e-9, atol=1e-30)


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8-sig")


def _toml(
    robot: Robot, sections: Sequence[dict[str, float]], uncertainty: Uncertainty | None, comments: Sequence[str]
) -> str:
    lines = [*(f"# {comment}".rstrip() for comment in comments), f'name = "{robot.name}"']
    for rod, section in zip(robot.rods, sections, strict=True):
        lines += ["", "[[rods]]", *_rod(rod, section)]
    lines += [
        "",
        "[tip]",
        _line("mass", robot.tip_mass, "kg"),
        _line("drag", robot.drag, "N s/m"),
        "",
        "[motors]",
        _line("rate_limit", robot.rate_limit, "rad/s"),
        _line("acceleration_limit", robot.acceleration_limit, "rad/s^2"),
        _line("torque_limit", robot.torque_limit, "N m"),
    ]
    if any(robot.gravity):
        lines += ["", "[world]", _line("gravity", list(robot.gravity), "m/s^2")]
    if uncertainty is not None:
        names = ", ".join(f'"{name}"' for name in uncertainty.names)
        rows = (", ".join(f"{value:.12f}" for value in row) for row in uncertainty.correlation)
        lines += [
            "",
            "[uncertainty]             # how well these numbers are known; pcr-mpc identify starts from it",
            f"names = [{names}]",
            f"sd = [{', '.join(f'{value:.6g}' for value in uncertainty.sd)}]   # standard deviations, SI",
            "correlation = [",
            *(f"  [{row}]," for row in rows),
            "]",
        ]
    return "\n".join(lines) + "\n"


def _rod(rod: Rod, sizes: dict[str, float]) -> list[str]:
    lines = [
        _line("base", list(rod.base), "m"),
        _line("length", rod.length, "m"),
        _line("bending_stiffness", rod.bending_stiffness, "N m^2"),
        _line("line_density", rod.line_density, "kg/m"),
        _line("angle_limits", list(rod.angle_limits), "rad"),
    ]
    if any(rod.curvatures):
        lines.append(_line("curvature", _plain(rod.curvature), "1/m"))
    if rod.stiffness_factors != (1.0,):
        lines.append(_line("stiffness_factors", list(rod.stiffness_factors), "EI(s)/EI"))
    if rod.stretches:
        lines.append(_line("axial_stiffness", rod.axial_stiffness, "N"))
    if sizes:
        # The section is as it was; modulus and density are what these numbers make of them.
        section = Section.strip(**sizes) if "width" in sizes else Section.round(**sizes)
        lines += [_line(key, float(value), "m") for key, value in sizes.items()]
        lines += [
            _line("youngs_modulus", rod.bending_stiffness / section.second_moment, "Pa"),
            _line("density", rod.line_density / section.area, "kg/m^3"),
        ]
        if math.isfinite(rod.strain_limit):
            lines.append(_line("strain_limit", rod.strain_limit, "of the material"))
    return lines


def _plain(value: float | tuple[float, ...]) -> float | list[float]:
    return list(value) if isinstance(value, tuple) else value


def _line(key: str, value: object, comment: str) -> str:
    return f"{f'{key} = {value!r}':38}  # {comment}"
