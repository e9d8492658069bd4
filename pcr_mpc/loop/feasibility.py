"""What a scene asks for and cannot have."""

from __future__ import annotations

import numpy as np

from .feed_forward import InverseDynamics, feed_forward
from .scene import Scene

# Beyond a limit by less than this, relative to it, is rounding.
_ROUNDING = 1e-6


def check_scene(scene: Scene) -> list[str]:
    """Go through the start and the reference of a scene, and say what the robot cannot do.

    Returns
    -------
    list of str
        Where and by how much the reference asks for more than the limits on rate, change of rate, torque, tip region,
        margins and strain: there a controller must leave it. Empty if all can be had.

    Raises
    ------
    ModelError
        The start cannot be held (see `Scene.start`).
    PCRError
        No motor angles hold the tip somewhere on the reference; the message says when.
    """
    pose = scene.start()
    return [] if scene.trajectory is None else reference_excess(scene, feed_forward(scene, scene.robot, pose, 0))


def reference_excess(scene: Scene, reference: InverseDynamics) -> list[str]:
    """Where inverse dynamics of the reference ask for more than a scene's limits, one line for each kind of limit."""
    count, period, robot, poses = scene.n_periods, scene.period, scene.robot, scene.pose_limits
    rates = reference.inputs[:count]
    change = np.diff(rates, axis=0, prepend=np.zeros((1, robot.n_rods))) / period
    torques = (reference.torques + reference.torques_per_force @ np.array(scene.force))[: count + 1]
    found = [
        _beyond("motor {i} to turn at {value:.4g} rad/s", rates, robot.rate_limit, period),
        _beyond("motor {i} to change its rate by {value:.4g} rad/s^2", change, robot.acceleration_limit, period),
        _beyond("{value:.4g} N m of motor {i}", torques, scene.torque_limit, period),
    ]
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
    return [line for line in found if line]


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
