"""Plans that reckon with what rods are: their mass and weight."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    Blended,
    PlanLimits,
    Spline,
    check_scene,
    load_scene,
    make_controller,
    plan_timing,
    simulate,
)
from pcr_mpc.report.designs.plan_table import plan_table
from pcr_mpc.study.planning import rods_mass
from pcr_mpc.study.planning.plan import rods_left_out
from pcr_mpc.study.planning.timed_path import RodsMass
from tests.conftest import MODELS
from tests.study.planning.by_statics import motors


def test_limits_are_lowered_until_with_the_rods_mass_none_is_exceeded_by_anything(scene, planned, monkeypatch):
    """A motor that is asked for half a thousandth too much is one that `check_scene` refuses."""
    model = replace(scene.tuning.model, inertia="condensed")
    heavy, limits = replace(scene, tuning=replace(scene.tuning, model=model)), PlanLimits.of_scene(scene)
    kept = []

    def asked(*_):
        share = 1.0005 * kept[-1].acceleration / limits.acceleration
        return RodsMass("condensed", limits, 1.0, share * limits.acceleration, 0.1, (math.nan, math.nan), 0.5, 20.0)

    monkeypatch.setattr(rods_mass, "asked_with_rods", asked)
    found = rods_mass.with_rods(heavy, limits, 0.0, lambda lowered: kept.append(lowered) or planned)
    assert len(kept) == found.rods.rounds == 2
    assert found.rods.acceleration <= limits.acceleration


def test_limits_are_lowered_more_where_what_the_rods_take_does_not_fall_with_them(scene, planned, monkeypatch):
    """Half of it does not: in proportion to what is left the limit would be met only after dozens of plans."""
    model = replace(scene.tuning.model, inertia="condensed")
    heavy, limits = replace(scene, tuning=replace(scene.tuning, model=model)), PlanLimits.of_scene(scene)
    kept = []

    def asked(*_):
        change = 0.6 * limits.acceleration + 0.45 * kept[-1].acceleration
        return RodsMass("condensed", limits, 1.0, change, 0.1, (math.nan, math.nan), 0.5, 20.0)

    monkeypatch.setattr(rods_mass, "asked_with_rods", asked)
    found = rods_mass.with_rods(heavy, limits, 0.0, lambda lowered: kept.append(lowered) or planned)
    assert found.rods.rounds <= 5
    assert 0.87 < kept[-1].acceleration / limits.acceleration < 0.4 / 0.45


@pytest.mark.slow
def test_a_plan_reckons_with_the_rods_inertia_that_the_controller_knows(scene):
    """Of rods three times as heavy: where a plan without it asks for too much, one with it does not, and is slower."""
    rods = tuple(replace(rod, line_density=3.0 * rod.line_density) for rod in scene.robot.rods)
    model = replace(scene.tuning.model, inertia="condensed")
    heavy = replace(scene, robot=replace(scene.robot, rods=rods), tuning=replace(scene.tuning, model=model))

    def tracked(planned):
        duration = heavy.period * (math.ceil(planned.duration / heavy.period) + 20)
        return replace(heavy, trajectory=planned, duration=duration)

    light = plan_timing(replace(heavy, tuning=scene.tuning), cells=40)
    assert light.rods is None
    (line,) = (line for line in check_scene(tracked(light)) if "change its rate by" in line)
    left_out = rods_left_out(replace(heavy, tuning=scene.tuning), light)
    assert f"change its rate by {left_out.acceleration:.4g} rad" in line.replace("by -", "by ")
    planned = plan_timing(heavy, cells=40)
    assert check_scene(tracked(planned)) == []
    assert light.duration < planned.duration < 1.3 * light.duration
    assert planned.rods.acceleration == pytest.approx(heavy.robot.acceleration_limit, rel=2e-2)
    assert planned.limits.acceleration < heavy.robot.acceleration_limit
    assert "lowered for that" in plan_table(planned.summary() | {"share_of_rods": 0.1})
    # A plant whose rods have that mass, led by a controller that knows it.
    there = replace(tracked(planned), plant=replace(heavy.plant, inertia="condensed"))
    run = simulate(there, there.make_plant(), make_controller(there))
    assert not run.summary()["limit_violations"]
    assert run.summary()["max_mm"] < 0.5


@pytest.mark.slow
def test_rods_with_weight_are_planned_for_by_shooting(scene):
    vertical = load_scene(MODELS / "scenes" / "vertical.toml")
    heavy = replace(scene, robot=vertical.robot)
    planned = plan_timing(heavy, cells=40)
    assert planned.excess <= 1e-3
    t = np.linspace(0.0, planned.duration, 801)
    q = np.stack([eq.q for eq in motors(heavy.robot, planned, t, heavy.start())])
    assert np.abs(np.diff(q, axis=0)).max() / t[1] <= 1.001 * heavy.robot.rate_limit
    assert np.abs(np.diff(q, 2, axis=0)).max() / t[1] ** 2 <= 1.001 * heavy.robot.acceleration_limit
    assert np.abs(q - scene.start().q).max() > 0.1


def test_more_motors_than_two_turn_at_the_rates_that_the_plan_says():
    """Of many angles those of least motion, found in small steps: their rates and changes keep the limits, too."""
    scene = load_scene(MODELS / "scenes" / "three_rods.toml")
    ways = ((0.0, 0.0), (0.04, 0.04), (0.08, 0.0), (0.04, -0.04), (0.0, 0.01), (-0.05, 0.03))
    points = tuple(map(tuple, scene.start().p + np.array(ways)))
    scene = replace(scene, tuning=None, trajectory=Blended(Spline(points, speed=0.1)))
    planned = plan_timing(scene, cells=40)
    t = np.linspace(0.0, planned.duration, 2001)
    rates = np.diff([eq.q for eq in motors(scene.robot, planned, t, scene.start())], axis=0) / t[1]
    assert 0.99 < np.abs(planned.rates).max() / scene.robot.rate_limit <= 1.001
    assert np.abs(rates).max() <= 1.002 * scene.robot.rate_limit
    assert np.abs(np.diff(rates, axis=0)).max() / t[1] <= 1.004 * scene.robot.acceleration_limit
