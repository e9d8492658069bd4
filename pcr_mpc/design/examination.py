"""All that can be said of a robot or a scene without running it."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .. import interrupt
from ..errors import ModelError, PCRError
from ..loop.scene.scene import Scene
from ..plant.robot import Robot
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.free_tip import inverse_statics
from ..plant.statics.stability import assess_stability
from .demands import demands
from .moving_mass import moving_mass
from .reach import Reach, explore, tips_within
from .rehearsal import rehearse
from .remarks import Remark, about_rods, about_start, about_steps, unidentifiable

_CLAMPED_PINNED = 3.9266023  # first root of tan x = tanh x: a rod clamped at its motor, pinned at the tip
_USUAL_STRETCH = 0.67  # distance of tip and motor over the rod's length, where the shipped robots work
_TRIES = 12  # of tips at which a robot may be held, before it is given up
_TIPS = 80  # of the lattice from which these are taken


@dataclass(eq=False)
class Examination:
    """What was found; it grows while one looks.

    Attributes
    ----------
    name : str
    robot : Robot
    scene : Scene or None
    pose : Equilibrium or None
        At the start of the scene; of a robot, one that it can hold. None if there is none.
    reach : Reach or None
        From that pose.
    path : ndarray, shape (K, 2), or None
        Of the reference [m].
    figures : dict
        Numbers, ready for JSON.
    remarks : list of Remark
    """

    name: str
    robot: Robot
    scene: Scene | None
    pose: Equilibrium | None = None
    reach: Reach | None = None
    path: np.ndarray | None = None
    figures: dict[str, Any] = field(default_factory=dict)
    remarks: list[Remark] = field(default_factory=list)

    def used(self, eq: Equilibrium) -> float:
        """Share of the motors' torque or of the rods' strain that a pose uses, whichever is more."""
        limit = self.robot.torque_limit if self.scene is None else self.scene.torque_limit
        strain = np.nan_to_num(eq.max_strain / eq.robot.strain_limits).max()
        return float(max(np.abs(eq.motor_torque).max() / limit, strain))

    @property
    def errors(self) -> list[Remark]:
        """What keeps it from running as asked."""
        return [one for one in self.remarks if one.level == "error"]


def examine(what: Robot | Scene, *, modes: bool = True, upright: float | None = None) -> Examination:
    """Examine a robot or a scene; what is wrong with it is a remark, and no exception.

    Parameters
    ----------
    what : Robot or Scene
    modes : bool
        Whether to look which working modes there are: 2^n searches for n rods.
    upright : float, optional
        How many times stiffer the rods are out of the plane than in it, which a robot does not say: 1 if they are
        round, the square of width over thickness if they are strips.
    """
    scene = what if isinstance(what, Scene) else None
    robot = what.robot if isinstance(what, Scene) else what
    found = Examination(what.name, robot, scene)
    found.figures["rods"] = [_rod_figures(robot, i) for i in range(robot.n_rods)]
    try:
        found.pose = pose = scene.start() if scene is not None else _usual_pose(robot)
    except PCRError as error:
        about = "start of the reference" if error.details.get("key") == "reference" else "start"
        found.remarks += [Remark("error", about, str(error)), *unidentifiable(robot)]
        return found
    mass, share = moving_mass(pose)
    found.figures["start"] = _pose_figures(pose, mass, share)
    found.remarks += about_start(pose, robot.torque_limit if scene is None else scene.torque_limit)
    if modes:
        found.figures["modes"] = _modes(pose)
    found.reach = explore(pose)
    found.figures["workspace"] = _workspace(found, found.reach)
    if scene is not None:
        found.path, reference, remarks = demands(scene, pose)
        found.figures["reference"] = reference
        found.remarks += remarks
        found.remarks += rehearse(scene, pose, start=reference is None or "peaks" in reference)
        steps, remarks = about_steps(scene, mass, found.figures)
        found.figures["steps"] = steps
        found.remarks += remarks
    found.remarks += about_rods(robot, scene, found.figures, upright)
    found.remarks += unidentifiable(robot)
    found.remarks.sort(key=lambda one: ("error", "warning", "note").index(one.level))
    return found


def _usual_pose(robot: Robot) -> Equilibrium:
    """The stiffest pose of a robot where its rods are about as bent as those of the shipped robots, if there is one.

    Raises
    ------
    ModelError
        None was found.
    """
    tips = sorted(tips_within(robot, _TIPS).values(), key=lambda p: _unusual(robot, p))[:_TRIES]
    beyond: list[Equilibrium] = []
    for p in tips:
        interrupt.check()
        try:
            held = [inverse_statics(robot, p)]
        except PCRError:
            continue
        # By multiple shooting a search in every mode takes long.
        if robot.needs_shooting is None:
            held = [eq for eq in _in_every_mode(robot, p).values() if eq is not None]
        good = [eq for eq in held if np.abs(eq.motor_torque).max() <= robot.torque_limit and not eq.overstrained]
        if good:
            return max(good, key=_least_stiffness)
        beyond += held
    if beyond:
        return max(beyond, key=_least_stiffness)
    raise ModelError(
        f"{robot.name}: at none of {len(tips)} tips within reach was a stable pose found with the motors "
        "between their stops; look at angle_limits, and at base and length of the rods",
        key="angle_limits",
    )


def _unusual(robot: Robot, p: np.ndarray) -> tuple[float, float]:
    """How far a tip is from where all rods are stretched as usual; of tips alike, y up comes first."""
    stretches = 1.0 - np.array(robot.slacks(p))
    return round(float(np.abs(stretches - _USUAL_STRETCH).max()), 3), -float(p[1])


def _least_stiffness(eq: Equilibrium) -> float:
    return float(eq.stiffness_eigenvalues[0])


def _in_every_mode(robot: Robot, p: np.ndarray) -> dict[str, Equilibrium | None]:
    """Pose in each working mode that holds a tip, each by a search of its own; None where there is none."""
    found: dict[str, Equilibrium | None] = {}
    for letters in itertools.product("LR", repeat=robot.n_rods):
        interrupt.check()
        mode = "".join(letters)
        try:
            found[mode] = inverse_statics(robot, p, mode=mode)
        except PCRError:
            found[mode] = None
    return found


def _rod_figures(robot: Robot, i: int) -> dict[str, Any]:
    rod = robot.rods[i]
    hertz = None
    if rod.line_density:
        rate = (_CLAMPED_PINNED / rod.length) ** 2 * math.sqrt(rod.bending_stiffness / rod.line_density)
        hertz = rate / (2 * math.pi)
    return {
        "length_m": rod.length,
        "bending_stiffness_Nm2": rod.bending_stiffness,
        "line_density_kg_m": rod.line_density,
        "mass_kg": rod.line_density * rod.length,
        "own_frequency_Hz": hertz,
        "strain_limit": rod.strain_limit if math.isfinite(rod.strain_limit) else None,
    }


def _pose_figures(eq: Equilibrium, mass: np.ndarray, share: float) -> dict[str, Any]:
    inverse = np.linalg.inv(np.linalg.cholesky(mass))
    rates = np.sqrt(np.maximum(np.linalg.eigvalsh(inverse @ eq.dforce_dp @ inverse.T), 0.0))
    stability = assess_stability(eq)
    return {
        "p_m": eq.p.tolist(),
        "q_rad": eq.q.tolist(),
        "mode": eq.mode,
        "torque_Nm": np.abs(eq.motor_torque).tolist(),
        "torque_limit_Nm": eq.robot.torque_limit,
        "strain": [None if math.isnan(one) else one for one in eq.max_strain.tolist()],
        "stiffness_N_m": stability.stiffness_eigenvalues.tolist(),
        "rod_margins": [None if math.isnan(one) else one for one in stability.rod_margins.tolist()],
        "motor_authority_N_rad": stability.motor_authority,
        "natural_frequencies_Hz": (rates / (2 * math.pi)).tolist(),
        "moving_mass_kg": np.linalg.eigvalsh(mass).tolist(),
        "share_of_rods": share,
    }


def _modes(pose: Equilibrium) -> list[dict[str, Any]]:
    """Which working modes hold the tip of a pose."""
    rows = []
    for mode, eq in {**_in_every_mode(pose.robot, pose.p), pose.mode: pose}.items():
        if eq is None:
            rows.append({"mode": mode, "possible": False})
            continue
        strain = float(np.nanmax(eq.max_strain)) if np.isfinite(eq.max_strain).any() else None
        rows.append(
            {
                "mode": mode,
                "possible": True,
                "torque_Nm": float(np.abs(eq.motor_torque).max()),
                "strain": strain,
                "least_stiffness_N_m": _least_stiffness(eq),
                "energy_J": eq.energy,
            }
        )
    return rows


def _workspace(found: Examination, reach: Reach) -> dict[str, Any]:
    cell = reach.spacing**2
    held = [eq for eq in reach.poses if found.used(eq) <= 1.0]
    tips = np.array([eq.p for eq in held]).reshape(-1, 2)
    return {
        "area_m2": cell * len(tips),
        "overloaded_m2": cell * (len(reach.poses) - len(held)),
        "within_rods_reach_m2": cell * reach.within,
        "x_m": [float(tips[:, 0].min()), float(tips[:, 0].max())] if len(tips) else None,
        "y_m": [float(tips[:, 1].min()), float(tips[:, 1].max())] if len(tips) else None,
        "spacing_m": reach.spacing,
        "ends": reach.ends,
    }
