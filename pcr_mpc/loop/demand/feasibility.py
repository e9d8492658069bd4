"""What a scene asks for and cannot have."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...plant.robot import Robot
from ...plant.statics.equilibrium import Equilibrium
from ..references.blended import Blended
from ..references.smoothness import contradictions, jumps
from ..references.tabulated import Tabulated
from ..references.trajectory import sampled
from ..scene.scene import Scene
from .feed_forward import InverseDynamics, feed_forward
from .slowing import Slowed, advice

# Beyond a limit by less than this, relative to it, is rounding.
_ROUNDING = 1e-6


def check_scene(scene: Scene) -> list[str]:
    """Go through the start and the reference of a scene, and say what the robot cannot do.

    Returns
    -------
    list of str
        Where and by how much the reference asks for more than the limits on rate, change of rate, torque, tip region,
        margins and strain: there a controller must leave it; and by how much slower it would not. Also where it jumps.
        Empty if all can be had.

    Raises
    ------
    ModelError
        The start cannot be held (see `Scene.start`).
    PCRError
        No motor angles hold the tip somewhere on the reference; the message says when, and by how much slower they
        would, if slower is what it takes.
    """
    pose = scene.start()
    if scene.trajectory is None:
        return []
    return reference_excess(scene, reference_of(scene, pose), pose)


def reference_of(scene: Scene, pose: Equilibrium) -> InverseDynamics:
    """Inverse dynamics of the reference with the rods' inertia that the scene's controller knows."""
    if scene.tuning is None or scene.tuning.model.inertia == "none":
        return feed_forward(scene, scene.robot, pose, 0)
    # What the rods' mass takes at the end depends on what comes then, which the controller looks at, too.
    return feed_forward(scene, scene.robot, pose, scene.tuning.horizon, scene.tuning.model.inertia)


def reference_excess(
    scene: Scene, reference: InverseDynamics, pose: Equilibrium | None = None, robot: Robot | None = None
) -> list[str]:
    """Where inverse dynamics of the reference ask for more than a scene's limits, one line for each kind of limit.

    Parameters
    ----------
    scene : Scene
    reference : InverseDynamics
    pose : Equilibrium, optional
        In which it starts: by how much it is to be slower is solved for, which takes as long as the inverse dynamics
        do. None, and where the rods have inertia: to first order.
    robot : Robot, optional
        For which the inverse dynamics are; by default the scene's.
    """
    count, period, poses = scene.n_periods, scene.period, scene.pose_limits
    robot = robot or scene.robot
    pose = pose if reference.inertia == "none" else None  # slower ones are solved for without
    slowed = Slowed.of(scene, robot, reference)
    rates, changes, torques = slowed.motors(1.0)
    found = []
    for kind, (what, values, limit) in enumerate((
        ("motor {i} to turn at {value:.4g} rad/s", rates, robot.rate_limit),
        ("motor {i} to change its rate by {value:.4g} rad/s^2", changes, robot.acceleration_limit),
        ("{value:.4g} N m of motor {i}", torques, scene.torque_limit),
    )):  # fmt: skip
        if line := _beyond(what, values, limit, period):
            found.append(f"{line}; {advice(slowed, kind, limit, robot, pose)}")
    if poses.tip_lower is not None and poses.tip_upper is not None:
        middle = (np.array(poses.tip_lower) + poses.tip_upper) / 2
        away = reference.states[: count + 1, :2] - middle
        found += [
            _beyond(f"the tip {{value:.4g}} m from the middle of its region in {axis}", away[:, i : i + 1],
                    poses.tip_upper[i] - middle[i], period)
            for i, axis in enumerate("xy")
        ]  # fmt: skip
    for name, values, least in (
        ("a rod margin", reference.rod_margin, poses.rod_margin),
        ("a stiffness", reference.stiffness, poses.stiffness),
    ):
        short = np.zeros(1) if least is None else values[: count + 1] < (1.0 - _ROUNDING) * least
        if short.any():
            k = int(np.nanargmin(values[: count + 1]))
            found.append(
                f"the reference leads to {name} of {values[k]:.4g} at t = {k * period:.3f} s, where {least:.4g} is to "
                f"be kept; {_share(short)}"
            )
    found.append(_overstrained(reference.strains[: count + 1], scene.strain_limits, period))
    return [line for line in found if line] + _roughness(scene, reference)


def reference_demand(scene: Scene, reference: InverseDynamics) -> dict[str, Any]:
    """What the reference asks of motors and tip at most, ready for JSON.

    Returns
    -------
    dict
        ``rate_rad_s``, ``rate_change_rad_s2``, ``torque_Nm``: each with ``asked``, ``limit``, ``motor`` and ``t_s``;
        ``speed_m_s``, ``acceleration_m_s2``: ``asked`` and ``t_s``; ``rod_margin``, ``stiffness_N_m``: the least, with
        what is to be kept as ``limit`` (or None) and ``t_s``.
    """
    count, period = scene.n_periods, scene.period
    said: dict[str, Any] = {}
    motors = Slowed.of(scene, scene.robot, reference).motors(1.0)
    limits = (scene.robot.rate_limit, scene.robot.acceleration_limit, scene.torque_limit)
    names = ("rate_rad_s", "rate_change_rad_s2", "torque_Nm")
    for name, values, limit in zip(names, motors, limits, strict=True):
        k, i = np.unravel_index(int(np.abs(values).argmax()), values.shape)
        said[name] = {
            "asked": abs(float(values[k, i])),
            "limit": limit,
            "motor": int(i),
            "t_s": _moment(int(k), period),
        }
    assert scene.trajectory is not None
    motion = np.linalg.norm(sampled(scene.trajectory, period * np.arange(count + 1))[:, 1:], axis=2)
    for j, name in enumerate(("speed_m_s", "acceleration_m_s2")):
        at = int(motion[:, j].argmax())
        said[name] = {"asked": float(motion[at, j]), "t_s": _moment(at, period)}
    for name, values, least in (
        ("rod_margin", reference.rod_margin, scene.pose_limits.rod_margin),
        ("stiffness_N_m", reference.stiffness, scene.pose_limits.stiffness),
    ):
        values = values[: count + 1]
        if np.isfinite(values).any():
            at = int(np.nanargmin(values))
            said[name] = {"asked": float(values[at]), "limit": least, "t_s": _moment(at, period)}
    return said


def _moment(k: int, period: float) -> float:
    return round(k * period, 9)


def demand_line(demand: dict[str, Any]) -> str:
    """What is asked of the motors, in one line."""
    return ", ".join(
        f"{demand[name]['asked']:.3g} of {demand[name]['limit']:g} {unit} (t = {demand[name]['t_s']:.2f} s)"
        for name, unit in (("rate_rad_s", "rad/s"), ("rate_change_rad_s2", "rad/s^2"), ("torque_Nm", "N m"))
    )


def _roughness(scene: Scene, reference: InverseDynamics) -> list[str]:
    """Jumps of the reference, and what it says of itself wrongly."""
    assert scene.trajectory is not None
    t = scene.period * np.arange(scene.n_periods + 1)
    lines = []
    for jump in jumps(scene.trajectory, t, scene.start_velocity):
        times = "" if jump.count == 1 else f", and {jump.count - 1} more times by less"
        k = min(int(jump.t / scene.period), len(t) - 1)
        force = (scene.robot.tip_mass + float(scene.carried(t[k]))) * np.array(jump.change)
        turns = np.abs(reference.angles_per_force[k] @ force)
        if jump.of == "acceleration":
            lines.append(
                f"the reference's acceleration jumps by {jump.size:.3g} m/s^2 at t = {jump.t:.3f} s{times}; motor "
                f"{turns.argmax()} would have to turn by {turns.max():.3g} rad at once; blend it (start, end), round "
                "or smooth it"
            )
        else:
            lines.append(
                f"the reference's velocity jumps by {jump.size:.3g} m/s at t = {jump.t:.3f} s{times}, which nothing "
                "can follow; blend it (start, end), round or smooth it"
            )
    rows = scene.trajectory.path if isinstance(scene.trajectory, Blended) else scene.trajectory
    if isinstance(rows, Tabulated) and rows.scatter:
        lines.append(
            f"the rows of the reference scatter by about {1e3 * rows.scatter:.2g} mm, which becomes acceleration; if "
            f"that is noise, say so: smoothing = {rows.scatter:.2g}"
        )
    return lines + contradictions(scene.trajectory, t)


def _overstrained(strains: np.ndarray, limits: np.ndarray, period: float) -> str:
    share = np.nan_to_num(strains / limits)
    excess = share > 1.0 + _ROUNDING
    if not excess.any():
        return ""
    k, i = np.unravel_index(int(share.argmax()), share.shape)
    return (
        f"the reference strains rod {i} by {100 * strains[k, i]:.3g} % at t = {k * period:.3f} s, where its material "
        f"bears {100 * limits[i]:.3g} %; {_share(excess.any(axis=1))}"
    )


def _beyond(what: str, values: np.ndarray, limit: float, period: float) -> str:
    excess = np.abs(values) > (1.0 + _ROUNDING) * limit
    if not excess.any():
        return ""
    k, i = np.unravel_index(int(np.abs(values).argmax()), values.shape)
    asked = what.format(i=i, value=values[k, i])
    return (
        f"the reference asks for {asked} at t = {k * period:.3f} s, where {limit:.4g} is allowed; "
        f"{_share(excess.any(axis=1))}"
    )


def _share(where: np.ndarray) -> str:
    return f"beyond the limit in {int(where.sum())} of {len(where)} periods"
