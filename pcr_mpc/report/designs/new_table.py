"""What was chosen for a new robot, as a table and as a record."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from ...design.examination import Examination
from ...design.sizing import Design
from ...design.wish import Wish
from ..tables import digits
from .check_tables import remarks_text


def new_record(chosen: Design, found: Examination, files: dict[str, str]) -> dict[str, Any]:
    """Everything, ready for JSON."""
    rod = found.robot.rods[0]
    return {
        "name": chosen.wish.name,
        "given": {key: value for key, value in asdict(chosen.wish).items() if value is not None},
        "bending_stiffness_Nm2": rod.bending_stiffness,
        "line_density_kg_m": rod.line_density,
        "motor": chosen.motor.name,
        "tip_mass_kg": chosen.tip_mass,
        "path_size_m": list(chosen.size),
        "lap_s": chosen.lap,
        "control_period_s": chosen.control_period,
        "peaks": found.figures["reference"]["peaks"],
        "remarks": [{"level": one.level, "about": one.about, "text": one.text} for one in found.remarks],
        "files": files,
    }


def new_table(chosen: Design, found: Examination) -> str:
    """Figures of the draft, and what is to be said of them."""
    wish, rod, start = chosen.wish, found.robot.rods[0], found.figures["start"]
    peaks, space = found.figures["reference"]["peaks"], found.figures["workspace"]
    torque, strain = peaks["torque"], peaks["strain"]
    bases = ", ".join(f"({x:.3g}, {y:.3g})" for x, y in found.robot.bases.tolist())
    rows = [
        ("rods", f"{wish.rods} of {wish.material}, {_section(wish)}, {wish.length:.3g} m long: EI "
         f"{rod.bending_stiffness:.4g} N m^2, {1e3 * rod.line_density:.3g} g/m"),
        ("motors", f"{chosen.motor.name} at {bases} m"),
        ("tip", f"{digits(1e3 * chosen.tip_mass)} g; it swings on its rods at "
         f"{_list(start['natural_frequencies_Hz'])} Hz"),
        ("path", f"figure of eight, {1e3 * chosen.size[0]:.3g} x {1e3 * chosen.size[1]:.3g} mm in {chosen.lap:.3g} s"),
        ("workspace", f"{digits(1e4 * space['area_m2'])} cm^2 in mode {start['mode']}, with strain and torque within "
         "their limits"),
        ("torque", f"{torque['value']:.3g} N m at most, {100 * torque['used']:.0f} % of what the motor has in motion"),
        ("strain", f"{100 * strain['value']:.2g} % at most, {100 * strain['used']:.0f} % of the material's limit"),
        ("motor rate", f"{peaks['motor rate']['value']:.3g} rad/s at most, {100 * peaks['motor rate']['used']:.0f} %"),
        ("control", f"every {1e3 * chosen.control_period:g} ms"),
    ]  # fmt: skip
    width = max(len(name) for name, _ in rows)
    lines = [f"{name.ljust(width)}  {text}" for name, text in rows]
    return "\n".join([*lines, "", remarks_text(found)])


def _section(wish: Wish) -> str:
    strip = "" if wish.width is None else f"strips {digits(1e3 * wish.width)} mm wide, "
    return f"{strip}{digits(1e3 * wish.thick)} mm thick"


def _list(values: list[float]) -> str:
    return " and ".join(f"{value:.3g}" for value in values)
