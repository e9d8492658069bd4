"""A design as the three files from which it runs: robot, scene and tuning, with the source of each number."""

from __future__ import annotations

import shlex

from .sizing import Design

# Of the tuning of the lemniscate, which bears a robot that is not quite as believed; its units of length and time.
_POSITION, _VELOCITY, _INPUT, _HORIZON, _NOISE, _WALK = 1.0e4, 1.0, 0.1, 6, 0.03, 0.016
_LENGTH, _SWING, _PERIOD = 0.4, 0.39, 0.01
_RODS_COUNT = 0.02  # share of the mass that moves from which the controller's model has the rods'
_COLUMN = 38


def files(design: Design) -> dict[str, str]:
    """Name -> text."""
    return {"robot.toml": robot_text(design), "scene.toml": scene_text(design), "tuning.toml": tuning_text(design)}


def command(design: Design) -> str:
    """The command that makes it."""
    wish = design.wish
    section = {"diameter": wish.diameter} if wish.width is None else {"width": wish.width, "thickness": wish.thickness}
    given = {"rods": wish.rods, "material": wish.material, **section, "length": wish.length, "spacing": wish.spacing,
             "tip-mass": wish.tip_mass, "motor": wish.motor}  # fmt: skip
    options = [(f"--{key}", f"{value:g}" if isinstance(value, float) else str(value))
               for key, value in given.items() if value is not None]  # fmt: skip
    return shlex.join(["pcr-mpc", "new", wish.name, *(word for option in options for word in option)])


def robot_text(design: Design) -> str:
    """The robot's file."""
    wish, motor, material, section = design.wish, design.motor, design.wish.stuff, design.wish.section
    stiffness, density = material.youngs_modulus * section.second_moment, material.density * section.area
    modulus, rho = f"{material.youngs_modulus:.4g} Pa", f"{material.density:.4g} kg/m^3"
    if wish.width is None:
        d = f"({wish.diameter:g} m)"
        bending, mass = f"E pi d^4 / 64 = {modulus} * pi {d}^4 / 64", f"rho pi d^2 / 4 = {rho} * pi {d}^2 / 4"
        sizes = {"diameter": (wish.diameter, "m")}
    else:
        w, t = f"{wish.width:g} m", f"{wish.thickness:g} m"
        bending, mass = f"E w t^3 / 12 = {modulus} * {w} * ({t})^3 / 12", f"rho w t = {rho} * {w} * {t}"
        sizes = {"width": (wish.width, "m; upright, out of the plane"), "thickness": (wish.thick, "m; in the plane")}
    lines = [
        f"# {wish.rods} rods of {wish.material}, a first draft by:",
        f"#   {command(design)}",
        "# Put your own numbers in, then: pcr-mpc check scene.toml. SI units.",
        f"# EI = {bending} = {stiffness:.4g} N m^2",
        f"# line density = {mass} = {density:.4g} kg/m",
        *_wrapped(f"{wish.material}: {material.source}"),
        f'name = "{wish.name}"',
    ]
    for i, (base, stops) in enumerate(zip(design.layout.bases, design.layout.angle_limits, strict=True)):
        first = i == 0
        lines += [
            "",
            "[[rods]]",
            _line("base", base, "m; motor axis" if first else ""),
            _line("length", wish.length, "m; from clamp to pin" if first else ""),
            _line("material", wish.material, "E, density and strain limit; see the head of this file" if first else ""),
            *(_line(key, size, unit if first else "") for key, (size, unit) in sizes.items()),
            _line("angle_limits", stops, "rad; stops of the motor, of the clamp or the cable" if first else ""),
        ]
    chosen = "given" if wish.tip_mass else "chosen: the tip swings slowly enough, and outweighs its rods"
    speed, stall = f"{motor.no_load_speed:g} rev/min", f"{motor.stall_torque:g} N m"
    lines += [
        "",
        "[tip]",
        _line("mass", design.tip_mass, f"kg; pin and payload; {chosen}"),
        _line("drag", design.drag, "N s/m; assumed, 2.5 % of critical: measure it"),
        "",
        f"[motors]                              # {motor.name} at {motor.voltage:g} V, {motor.source}",
        _line("rate_limit", _short(motor.rate_limit), f"rad/s; 75 % of the no-load speed, {speed}"),
        _line("acceleration_limit", _short(motor.acceleration_limit), "rad/s^2; assumed: reached in 20 ms"),
        _line("torque_limit", _short(motor.torque_limit), f"N m; half of the stall torque, {stall}"),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def scene_text(design: Design) -> str:
    """The scene's file."""
    centre = design.layout.centre
    lines = [
        "# A figure of eight, from rest at its centre, as fast as the robot follows with ease.",
        "# Other paths: kind file, waypoints, circle and more; see the page about paths.",
        f'name = "{design.wish.name}"',
        'robot = "robot.toml"',
        _line("duration", round(design.duration, 6), "s; start-up and two laps"),
        "",
        "[start]",
        _line("tip", centre, "m; where the reference begins"),
        _line("mode", design.layout.mode, "a letter L or R for each rod: the side to which it is bowed"),
        "",
        "[reference]",
        _line("kind", "lemniscate", ""),
        _line("centre", centre, "m"),
        _line("size", design.size, "m; width and height"),
        _line("period", design.lap, f"s, of a lap; the tip's free swing takes {design.swing:.2g} s"),
        _line("ramp", _short(design.lap / 2), "s; smooth start"),
        "",
        "[plant]",
        _line("inertia", "condensed", f"of the rods, {100 * design.rods_share:.2g} % of the mass that moves"),
        _line("integrator", "rk4", ""),
        _line("dt", design.plant_step, "s"),
        "",
        "[control]",
        _line("period", design.control_period, "s"),
        _line("tuning", "tuning.toml", ""),
    ]
    return "\n".join(lines) + "\n"


def tuning_text(design: Design) -> str:
    """The tuning's file: that of the shipped lemniscate in this robot's units of length, mass and time."""
    length, time = design.wish.length / _LENGTH, design.swing / _SWING
    force = design.tip_mass * design.wish.length / design.swing**2
    horizon = min(max(round(_HORIZON * time * _PERIOD / design.control_period), _HORIZON), 20)
    rods = design.rods_share > _RODS_COUNT
    lines = [
        "# The tuning of the shipped scene lemniscate, in this robot's units of length, mass and time.",
        "# pcr-mpc tune scene.toml searches for a better one. Weights act on squared deviations from the reference.",
        f'name = "{design.wish.name}"',
        _line("horizon", horizon, "control periods"),
        "",
        "[weights]",
        _line("position", _short(_POSITION / length**2), "1/m^2"),
        _line("velocity", _short(_VELOCITY * (time / length) ** 2), "1/(m/s)^2"),
        _line("input", _short(_INPUT * time**2), "1/(rad/s)^2, on the deviation from the feed-forward"),
        "",
        "[solver]",
        _line("tolerance", 1e-5, "absolute and relative"),
        _line("max_iterations", 500, "in all; then the last plan, LQR or rest answers"),
        "",
        "[model]                               # what is linearised",
        _line("inertia", "condensed" if rods else "none", f"of the rods: they {'count' if rods else 'are light'}"),
        _line("linearise", "along_plan", "for every period of the last plan"),
        "",
        "[observer]",
        "on = true                             # tip velocity and an unknown force from the measured tip and angles",
        _line("tip_noise", _short(1e-5 * length), "m, at least; a scene's sensor may be worse"),
        _line("force_noise", _short(_NOISE * force / 2.6), "N, forces that come and go"),
        _line("force_walk", _short(_WALK * force / 2.6), "N, change of the unknown force in a period"),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _line(key: str, value: object, comment: str) -> str:
    if isinstance(value, str):
        text = f'"{value}"'
    elif isinstance(value, tuple):
        text = f"[{', '.join(repr(round(float(v), 6)) for v in value)}]"
    else:
        text = repr(value)
    line = f"{key} = {text}"
    return f"{line.ljust(_COLUMN)}# {comment}" if comment else line


def _short(value: float) -> float:
    return float(f"{value:.3g}")


def _wrapped(text: str, width: int = 116) -> list[str]:
    lines, line = [], ""
    for word in text.split():
        if line and len(line) + len(word) >= width:
            lines.append(line)
            line = ""
        line = f"{line} {word}".strip()
    return [f"# {one}" for one in [*lines, line]]
