"""Plans for rods that have mass: planned without it to lower limits, until with it the given ones are kept."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from ...errors import ConvergenceError, PCRError
from ...loop.demand.feasibility import reference_demand, reference_of
from ...loop.scene.scene import Scene
from .limits import MOST_MARGIN, PlanLimits
from .timed_path import RodsMass, TimedPath

_MOTORS = "rate_rad_s", "rate_change_rad_s2", "torque_Nm"
_NAMES = {"rate": "motor rate", "acceleration": "change of rate", "strains": "strain", "rod_margin": "rod margin"}
_ROUNDS = 8
_SPARE = 5e-4  # by which a limit is lowered more than it must be
_REST = 5  # periods


def with_rods(
    scene: Scene, limits: PlanLimits, carried: float, planned_for: Callable[[PlanLimits], TimedPath]
) -> TimedPath:
    """Plan to limits that are lowered until the plan keeps the given ones with the inertia that the controller knows.

    Motor angles with inertia are those of `feed_forward`, from period to period, as `check_scene` has them. Without a
    tuning, or with ``inertia = "none"`` in its model, it is one plan for rods without mass.

    Parameters
    ----------
    scene : Scene
    limits : PlanLimits
    carried : float
        By the tip, besides its own mass [kg].
    planned_for : callable
        Plans for rods without mass.

    Raises
    ------
    ConvergenceError
        The limits are not kept after some plans, or the inverse dynamics did not settle.
    """
    inertia = scene.tuning.model.inertia if scene.tuning is not None else "none"
    lowered = limits
    for rounds in range(1, _ROUNDS + 1):
        planned = planned_for(lowered)
        if inertia == "none":
            return planned
        asked = asked_with_rods(scene, planned, limits, carried)
        shares = asked.shares
        if max(shares.values()) <= 1.0:  # what is beyond by however little, `check_scene` refuses
            return replace(planned, rods=replace(asked, rounds=rounds))
        # What is left of an excess shows that the rods' part of it does not fall with the limit: then by as much again.
        power = 1.0 if rounds == 1 else 2.0
        factors = {kind: (1.0 - _SPARE) / share**power for kind, share in shares.items() if share > 1.0}
        lowered = _lowered(lowered, factors)
    kind, share = max(shares.items(), key=lambda item: item[1])
    raise ConvergenceError(
        f"with the inertia of its rods ({inertia}) the plan of {scene.name} still asks for {share:.4g} times the "
        f"limit on {_NAMES.get(kind, kind)} after {_ROUNDS} plans; lower the scene's limits",
        residual=share - 1.0,
        iterations=_ROUNDS,
        last=share,
    )


def _lowered(limits: PlanLimits, factors: dict[str, float]) -> PlanLimits:
    """Limits of which so much is left; of margins, so much of what they allow."""
    changed: dict[str, Any] = {}
    for kind, factor in factors.items():
        value = getattr(limits, kind)
        if kind == "strains":
            changed[kind] = tuple(factor * one for one in value)
        elif kind == "rod_margin":
            changed[kind] = min(MOST_MARGIN, 1.0 - factor * (1.0 - value))
        else:
            changed[kind] = value / factor if kind == "stiffness" else factor * value
    return replace(limits, **changed)


def asked_with_rods(scene: Scene, planned: TimedPath, limits: PlanLimits, carried: float) -> RodsMass:
    """What a plan asks for, beside those limits, with the inertia that the scene's controller knows."""
    assert scene.tuning is not None
    robot = scene.robot
    count = math.ceil(planned.duration / scene.period) + _REST
    loaded = replace(
        scene,
        trajectory=planned,
        duration=scene.period * count,
        payload=None,
        robot=replace(robot, tip_mass=robot.tip_mass + carried) if carried else robot,
    )
    try:
        reference = reference_of(loaded, scene.start())
    except PCRError as error:
        raise type(error)(
            f"with the inertia of its rods, which limits are lowered for only after a first plan: {error}; "
            "or give the plan lower limits",
            **error.details,
        ) from None
    demand = reference_demand(loaded, reference)
    rate, acceleration, torque = (float(demand[name]["asked"]) for name in _MOTORS)
    return RodsMass(
        scene.tuning.model.inertia,
        limits,
        rate,
        acceleration,
        torque,
        strains=tuple(reference.strains.max(axis=0).tolist()),
        rod_margin=float(reference.rod_margin.min()),
        stiffness=float(reference.stiffness.min()),
    )
