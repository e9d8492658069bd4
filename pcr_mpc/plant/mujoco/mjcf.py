"""The robot as MuJoCo's model file (MJCF): hinge chains, a mass that slides in the plane, pins between them."""

from __future__ import annotations

import numpy as np

from ...errors import ModelError
from ..robot import Robot
from ..rod import Rod
from ..statics.equilibrium import Equilibrium
from .hinge_chain import ChainState, Hinges, hinges, settled_chains

# A pin is a soft constraint: a critically damped spring of this time constant [s] and of MuJoCo's largest impedance,
# stiff enough for a gap of less than a micrometre, and implicit in the integrator, so that no time step is too long.
_PIN_TIME = 2e-4
_PIN_IMPEDANCE = 0.9999
# A link's inertia about its own axis, of that across: a plane motion does not feel it.
_SLENDER = 0.02
_MOST_LINKS = 1000


def checked_links(robot: Robot, links: int) -> int:
    """Return the number of links, or say what keeps the robot from being chains of so many."""
    if isinstance(links, bool) or not isinstance(links, int | np.integer) or not 2 <= links <= _MOST_LINKS:
        raise ValueError(f"links = {links!r} must be a whole number from 2 to {_MOST_LINKS}")
    for i, rod in enumerate(robot.rods):
        if rod.stretches:
            raise ModelError(
                f"{robot.name}: rod {i} stretches, but the links of the model for MuJoCo are rigid; "
                "leave out its axial_stiffness",
                key="axial_stiffness",
            )
        if rod.line_density == 0.0:
            raise ModelError(
                f"{robot.name}: rod {i} has line_density 0 kg/m, but MuJoCo has no bodies without mass; "
                "give it one, such as a thousandth of the tip's mass",
                key="line_density",
            )
    return int(links)


def mjcf(
    robot: Robot, *, pose: Equilibrium | None = None, links: int = 40, timestep: float = 5e-4, visible: bool = True
) -> str:
    """Write the robot as MJCF.

    The plane is MuJoCo's x and y, with the robot's gravity and without contacts. A link is a body with a hinge at its
    base; the first hinge's coordinate is the first link's angle from world x. The motor is a position servo on it,
    whose gain is the stiffness of half a link: ``ctrl`` is the motor angle, exactly, for the clamp has no inertia; to
    it the servo adds the hinge's angle at rest. The tip has the coordinates of two sliders, after those of the hinges.

    Parameters
    ----------
    robot : Robot
        Its rods must have mass and not stretch.
    pose : Equilibrium, optional
        Writes a keyframe "start": the chains in equilibrium there, at rest.
    links : int
        Per rod.
    timestep : float
        [s].
    visible : bool
        With shapes to look at, which have no mass.

    Returns
    -------
    str

    Raises
    ------
    ModelError
        A rod has no mass, or stretches.
    ConvergenceError
        The chains have no equilibrium near the pose.

    Notes
    -----
    The springs need the integrator ``discrete`` (MuJoCo 3.13), which alone is implicit in them: with all others 40
    links of the default robot blow up at steps of 25 us.
    """
    links = checked_links(robot, links)
    chains = hinges(robot, links)
    lines = [
        f'<mujoco model="{_quoted(robot.name)}">',
        '  <compiler angle="radian"/>',
        f'  <option integrator="discrete" timestep="{_numbers(timestep)}" '
        f'gravity="{_numbers(*robot.gravity)} 0" tolerance="1e-14">',
        '    <flag contact="disable" autoreset="disable"/>',
        "  </option>",
        "  <worldbody>",
        *(line for i, rod in enumerate(robot.rods) for line in _chain(i, rod, chains[i], visible)),
        '    <body name="tip">',
        f'      <joint name="x" type="slide" axis="1 0 0" damping="{_numbers(robot.drag)}"/>',
        f'      <joint name="y" type="slide" axis="0 1 0" damping="{_numbers(robot.drag)}"/>',
        # It does not turn: the inertia is only what MuJoCo asks of a body.
        f'      <inertial pos="0 0 0" mass="{_numbers(robot.tip_mass)}" diaginertia="1 1 1"/>',
        '      <site name="pin"/>',
    ]
    if visible:
        lines.append(f'      <geom type="sphere" size="{_numbers(robot.lengths.min() / 40)}" {_GHOST}/>')
    lines += ["    </body>", "  </worldbody>", "  <equality>"]
    for i in range(robot.n_rods):
        lines.append(
            f'    <connect site1="end{i}" site2="pin" solref="{_PIN_TIME} 1" '
            f'solimp="{_PIN_IMPEDANCE} {_PIN_IMPEDANCE} 1"/>'
        )
    lines += ["  </equality>", "  <actuator>"]
    for i, chain in enumerate(chains):
        gain, rest = chain.stiffness[0], chain.rest[0]
        lines.append(
            f'    <general name="motor{i}" joint="rod{i}_0" biastype="affine" gainprm="{_numbers(gain)}" '
            f'biasprm="{_numbers(gain * rest, -gain, 0.0)}"/>'
        )
    lines.append("  </actuator>")
    if pose is not None:
        start, still = settled_chains(pose, np.zeros(2), links), np.zeros(2)
        qpos, qvel = coordinates(start, pose.p, still)
        lines += [
            "  <keyframe>",
            f'    <key name="start" qpos="{_numbers(*qpos)}" qvel="{_numbers(*qvel)}" ctrl="{_numbers(*pose.q)}"/>',
            "  </keyframe>",
        ]
    return "\n".join([*lines, "</mujoco>", ""])


def coordinates(state: ChainState, p: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of the model's joints and their rates: hinges from base to tip, rod by rod, then the tip."""
    hinges, rates = (np.diff(of, axis=1, prepend=0.0).ravel() for of in (state.angles, state.rates))
    return np.concatenate([hinges, p]), np.concatenate([rates, v])


_GHOST = 'mass="0" contype="0" conaffinity="0"'


def _chain(i: int, rod: Rod, chain: Hinges, visible: bool) -> list[str]:
    """The bodies of rod i, one inside the other."""
    links = len(chain.rest)
    length = rod.length / links
    mass = rod.line_density * length
    across = mass * length**2 / 12
    inertial = (
        f'<inertial pos="{_numbers(length / 2)} 0 0" mass="{_numbers(mass)}" '
        f'diaginertia="{_numbers(_SLENDER * across, across, across)}"/>'
    )
    shape = f'<geom type="capsule" fromto="0 0 0 {_numbers(length)} 0 0" size="{_numbers(rod.length / 200)}" {_GHOST}/>'
    lines = []
    for j in range(links):
        # The first spring is the motor's servo.
        at, spring, rest = (rod.base, 0.0, 0.0) if j == 0 else ((length, 0.0), chain.stiffness[j], chain.rest[j])
        lines += [
            f'<body name="rod{i}_{j}" pos="{_numbers(*at)} 0">',
            f'<joint name="rod{i}_{j}" type="hinge" axis="0 0 1" stiffness="{_numbers(spring)}" '
            f'springref="{_numbers(rest)}"/>',
            inertial,
        ]
        if visible:
            lines.append(shape)
    lines.append(f'<site name="end{i}" pos="{_numbers(length)} 0 0"/>')
    return [f"    {line}" for line in [*lines, "</body>" * links]]


def _numbers(*values: float) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def _quoted(text: str) -> str:
    return text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
