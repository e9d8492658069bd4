"""Paths with corners, in which the tip rests: planned leg by leg."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import Blended, Spline, Waypoints, plan_timing
from tests.study.planning.by_statics import motors

POINTS = ((-0.06, 0.22), (0.0, 0.27), (0.05, 0.22))


@pytest.fixture(scope="module")
def scene(points_scene):
    return replace(points_scene, trajectory=Blended(Waypoints(POINTS, speed=0.1)))


@pytest.fixture(scope="module")
def planned(scene):
    return plan_timing(scene, cells=30)


def test_the_tip_rests_in_a_corner_and_goes_straight_between(planned):
    _, corner, end = planned.move.starts
    assert end == pytest.approx(planned.duration)
    assert planned(np.array([corner]))[0] == pytest.approx(np.array([POINTS[1], (0, 0), (0, 0)]), abs=1e-9)
    for first, last, begin, until in ((0, 1, 0.0, corner), (1, 2, corner, end)):
        way = np.subtract(POINTS[last], POINTS[first])
        off = planned(np.linspace(begin, until, 200))[:, 0] - POINTS[first]
        assert np.abs(off @ np.array([-way[1], way[0]])).max() < 1e-6 * np.hypot(*way)
    step = 1e-6
    before, after = planned(np.array([corner - step, corner + step]))[:, 2]
    assert np.abs([before, after]).max() < 1e-2  # m/s^2: no jump


def test_a_plan_of_legs_takes_as_long_as_those_of_each_leg(scene, planned):
    alone = [
        plan_timing(replace(scene, trajectory=Blended(Waypoints(leg, speed=0.1))), cells=30).duration
        for leg in (POINTS[:2], POINTS[1:])
    ]
    assert planned.duration == pytest.approx(sum(alone), rel=1e-4)


def test_limits_are_kept_on_all_legs(scene, planned):
    """Angles found one by one; rates and their change by differences of these."""
    t = np.linspace(0.0, planned.duration, 3001)
    q = np.stack([eq.q for eq in motors(scene.robot, planned, t, scene.start())])
    rates = np.diff(q, axis=0) / t[1]
    changes = np.diff(rates, axis=0, prepend=0.0, append=0.0) / t[1]
    assert 0.99 <= np.abs(rates).max() / scene.robot.rate_limit <= 1.001
    assert 0.99 <= np.abs(changes).max() / scene.robot.acceleration_limit <= 1.001
    assert np.diff(planned.t).min() >= 0.0
    assert np.diff(planned.s).min() >= -1e-12


@pytest.mark.slow
def test_a_free_path_has_no_corner(scene, planned):
    """It is that of the smooth path through the same points, and its distance is from the one that was given."""
    free = plan_timing(scene, cells=30, free=True)
    smooth = plan_timing(replace(scene, trajectory=Blended(Spline(POINTS, speed=0.1))), cells=30, free=True)
    assert free.duration == pytest.approx(smooth.duration, rel=1e-3)
    assert free.duration < 0.8 * planned.duration
    corner = np.linalg.norm(free.motion[:, 0] - POINTS[1], axis=1).min()
    assert corner < 1e-6
    ways = [np.array(leg) for leg in (POINTS[:2], POINTS[1:])]
    away = max(min(_from_way(p, *way) for way in ways) for p in free.motion[:, 0])
    assert free.deviation == pytest.approx(away, rel=1e-2)


@pytest.mark.slow
def test_a_sharp_bend_is_rounded_within_the_tolerance(scene):
    """A cubic spline through points that all but turn back bends with a radius of a tenth of a millimetre."""
    points = ((-0.06, 0.22), (0.0, 0.26), (-0.02, 0.247), (0.05, 0.24))
    sharp = replace(scene, trajectory=Blended(Spline(points, speed=0.1)))
    t = np.linspace(0.0, sharp.trajectory.duration, 200001)
    way, rate, change = np.moveaxis(sharp.trajectory(t), 1, 0)
    bend = np.abs(rate[:, 0] * change[:, 1] - rate[:, 1] * change[:, 0])[1:-1]
    radius = (np.linalg.norm(rate, axis=1)[1:-1] ** 3 / np.maximum(bend, 1e-300)).min()
    assert radius < 1e-3
    planned = plan_timing(sharp, cells=60)
    away = [np.linalg.norm(way - p, axis=1).min() for p in planned(np.linspace(0.0, planned.duration, 200))[:, 0]]
    assert max(away) < planned.deviation + 1e-6
    assert planned.deviation <= 5e-5
    assert planned.excess <= 1e-3
    assert np.linalg.norm(planned.motion[10:-10, 1], axis=1).min() < 0.2 * np.linalg.norm(planned.motion[:, 1]).max()


def _from_way(p, first, last):
    along = np.clip((p - first) @ (last - first) / ((last - first) @ (last - first)), 0.0, 1.0)
    return np.linalg.norm(p - first - along * (last - first))
