"""A robot as identified, written as TOML: its numbers, where they come from, and how well they are known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import ModelError, StudyError
from ...files import replacing, require_free, stamped
from ...plant.robot import Robot, load_robot
from ...plant.rod import Rod
from ...plant.uncertainty import Uncertainty
from ...toml_table import read_toml
from .result import Identification


def robot_path(scene_file: Path) -> Path:
    """Return the file of a scene's robot."""
    return scene_file.parent / str(read_toml(scene_file).text("robot"))


def write_robot(
    found: Identification, base: Robot, path: Path, comments: Sequence[str], *, force: bool = False
) -> None:
    """Write a robot with the estimates, under some lines of comment.

    Parameters
    ----------
    base : Robot
        As its file has it, without a scene's own limits and gravity.

    Raises
    ------
    StudyError
        It does not read back as it is; nothing is written.
    OutputError
        There is a file that was not written here, or was changed since, and ``force`` is not given.
    """
    require_free(path, force=force)
    rods = tuple(
        replace(rod, base=new.base, length=new.length, bending_stiffness=new.bending_stiffness,
                line_density=new.line_density)
        for rod, new in zip(base.rods, found.robot.rods, strict=True)
    )  # fmt: skip
    robot = replace(base, name=path.stem, rods=rods, tip_mass=found.robot.tip_mass, drag=found.robot.drag)
    with replacing(path) as draft:
        draft.write_text(stamped(_toml(robot, found.uncertainty, comments)), encoding="utf-8")
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


def _toml(robot: Robot, uncertainty: Uncertainty | None, comments: Sequence[str]) -> str:
    lines = [*(f"# {comment}".rstrip() for comment in comments), f'name = "{robot.name}"']
    for rod in robot.rods:
        lines += ["", "[[rods]]", *_rod(rod)]
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


def _rod(rod: Rod) -> list[str]:
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
    if rod.half_thickness is not None:
        # A round section of the same thickness stands for whatever section it is.
        diameter = 2.0 * rod.half_thickness
        area, second_moment = math.pi * diameter**2 / 4.0, math.pi * diameter**4 / 64.0
        lines += [
            _line("diameter", diameter, "m; of a round section with this EI and density"),
            _line("youngs_modulus", rod.bending_stiffness / second_moment, "Pa"),
            _line("density", rod.line_density / area, "kg/m^3"),
        ]
        if math.isfinite(rod.strain_limit):
            lines.append(_line("strain_limit", rod.strain_limit, "-"))
    return lines


def _plain(value: float | tuple[float, ...]) -> float | list[float]:
    return list(value) if isinstance(value, tuple) else value


def _line(key: str, value: object, comment: str) -> str:
    return f"{f'{key} = {value!r}':38}  # {comment}"
