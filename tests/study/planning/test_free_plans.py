"""Plans whose path is free between way-points: what is written keeps every limit, and is what the plant does."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    ModelError,
    PlanLimits,
    Plant,
    Spline,
    load_path,
    load_scene,
    make_controller,
    plan_timing,
    simulate,
)
from pcr_mpc.loop.demand.feasibility import reference_demand, reference_of
from pcr_mpc.study.planning.freely.free import way_points
from tests.conftest import MODELS


def test_a_closed_path_is_not_free():
    closed = Spline(((0.0, 0.25), (0.03, 0.26), (0.0, 0.28)), 0.1, closed=True)
    with pytest.raises(ModelError, match=r"a closed Spline has no way-points .* open \(closed = false\)"):
        way_points(closed)


def driven(scene, planned, step=1e-4):
    """Tips of the plant whose motors turn as planned, and their times."""
    count = round(planned.duration / step)
    t = np.linspace(0.0, planned.duration, count + 1)
    plant = Plant(scene.robot, integrator="rk4", dt=t[1])
    x = np.concatenate([planned.motion[0, 0], np.zeros(2), planned.q[0]])
    plant.reset(x, scene.start())
    angles = np.stack([np.interp(t, planned.t, q) for q in planned.q.T], axis=1)
    tips = [x[:2]]
    for rates in np.diff(angles, axis=0) / t[1]:
        x = plant.step(x, rates)
        tips.append(x[:2])
    return np.array(tips), t


def test_a_free_path_is_what_the_plant_does_under_its_motors(scene, tmp_path):
    """Between two points: faster than on the given way, by motors whose rates and their changes are within limits."""
    free = plan_timing(scene, cells=40, free=True)
    tips, t = driven(scene, free)
    assert np.linalg.norm(tips - free(t)[:, 0], axis=1).max() < 2e-5
    assert tips[-1] == pytest.approx(scene.trajectory.place, abs=2e-5)
    assert free.duration < 0.3  # on the given way 0.389 s
    assert free.excess <= 1e-3
    rates = np.diff(free.q, axis=0) / np.diff(free.t)[:, None]
    assert 0.98 * scene.robot.acceleration_limit < np.abs(np.diff(free.rates, axis=0) / np.diff(free.t)[:, None]).max()
    assert np.abs(np.diff(free.rates, axis=0) / np.diff(free.t)[:, None]).max() < scene.robot.acceleration_limit
    assert np.abs(rates).max() < scene.robot.rate_limit
    assert np.abs(free.rates[[0, -1]]).max() < 1e-6
    # Of the file that is written nothing but the tip is read: by inverse statics it asks for no more.
    (tmp_path / "free.csv").write_text(free.csv())
    path = load_path(tmp_path / "free.csv")
    for period in (5e-4, 5e-3):
        duration = period * math.ceil(path.duration / period)
        plant = replace(scene.plant, dt=period)
        case = replace(scene, trajectory=path, duration=duration, period=period, plant=plant)
        asked = reference_demand(case, reference_of(case, case.start()))
        for kind in ("rate_rad_s", "rate_change_rad_s2"):
            assert asked[kind]["asked"] <= asked[kind]["limit"], (period, kind)


@pytest.mark.slow
def test_a_path_between_way_points_may_be_free(points_scene, planned):
    """It is faster, goes through the points, keeps its limits, the tip's region among them, and can be tracked."""
    x = planned.motion[:, 0, 0]
    region = {"tip_lower": (x.min() - 1e-3, 0.15), "tip_upper": (x.max() + 1e-3, 0.3)}
    limits = replace(PlanLimits.of_scene(points_scene), **region)
    free = plan_timing(points_scene, limits=limits, free=True)
    # 0.750 s is what linear programs found whose path was a spline of 40 pieces.
    assert free.duration < 0.8 * planned.duration
    assert free.excess <= 1e-3
    tips, _ = driven(points_scene, free)
    assert tips[:, 0].min() >= region["tip_lower"][0] - 2e-5
    assert tips[:, 0].max() <= region["tip_upper"][0] + 2e-5
    order = []
    for point in points_scene.trajectory.path.points:
        away = np.linalg.norm(tips - point, axis=1)
        order.append(int(away.argmin()))
        assert away.min() < 5e-5
    assert order == sorted(order)
    duration = points_scene.period * math.ceil((free.duration + 0.2) / points_scene.period)
    tracked = replace(points_scene, trajectory=free, duration=duration)
    summary = simulate(tracked, tracked.make_plant(), make_controller(tracked)).summary()
    assert summary["max_mm"] < 0.2  # the change of rate jumps, and is held for 5 ms
    with pytest.raises(ModelError, match="no way-points"):
        plan_timing(load_scene(MODELS / "scenes" / "circle_from_file.toml"), free=True)
    with pytest.raises(ModelError, match="is for uniform"):
        plan_timing(replace(points_scene, robot=load_scene(MODELS / "scenes" / "vertical.toml").robot), free=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limit", "value"), [("torque", 0.97), ("tip_speed", 0.5), ("tip_acceleration", 5.0), ("tip_jerk", 300.0)]
)
def test_a_free_path_keeps_every_limit(scene, limit, value):
    """Which its plan without it exceeds, or does not know."""
    limits = replace(PlanLimits.of_scene(scene), **{limit: value})
    free = plan_timing(scene, limits=limits, cells=60, free=True)
    assert 0.9 < free.shares.max() <= 1.0 + 1e-3
    tips, t = driven(scene, free)
    speed = np.linalg.norm(np.diff(tips, axis=0), axis=1) / t[1]
    if limit == "tip_speed":
        assert speed.max() == pytest.approx(value, rel=2e-3)
    share = dict(zip(free.kinds, free.shares.max(axis=1), strict=True))
    assert share["motor torque" if limit == "torque" else limit.replace("_", " ")] > 0.98
