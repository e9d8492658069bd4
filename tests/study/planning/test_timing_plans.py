"""Plans are as fast as closed forms and toppra say, keep their limits between their points too, and can be tracked."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    Blended,
    Line,
    PlanLimits,
    Spline,
    inverse_statics,
    load_path,
    make_controller,
    plan_timing,
    simulate,
)
from pcr_mpc.loop.references.trajectory import smooth_step
from pcr_mpc.plant.statics.stability import least_rod_margin
from pcr_mpc.study.planning.along_path import refining
from pcr_mpc.study.planning.along_path.course import paced
from pcr_mpc.study.planning.along_path.meshing import points
from pcr_mpc.study.planning.along_path.pace import constant_pace, spline_of
from pcr_mpc.study.planning.along_path.path import paths_of
from pcr_mpc.study.planning.along_path.timing import Problem, evaluated
from pcr_mpc.study.planning.freely.collocation import _narrowed
from pcr_mpc.study.planning.motion import Carrier
from tests.study.planning.by_statics import motors

NO_MOTORS = {"rate": 1e6, "acceleration": 1e12, "torque": 1e3}


def test_limits_are_kept_at_ten_times_the_grid(points_scene, planned):
    """Angles found one by one, rates and their change by differences of the angles alone."""
    assert planned.excess <= 1e-3
    scene, robot = points_scene, points_scene.robot
    t = np.linspace(0.0, planned.duration, 10 * planned.grid + 1)
    step = t[1]
    poses = motors(robot, planned, t, scene.start())
    q = np.stack([eq.q for eq in poses])
    rates = np.diff(q, axis=0) / step
    changes = np.diff(rates, axis=0, prepend=0.0, append=0.0) / step
    assert np.abs(rates).max() == pytest.approx(robot.rate_limit, rel=1e-3)
    assert np.abs(rates).max() <= 1.001 * robot.rate_limit
    assert np.abs(changes).max() <= 1.001 * robot.acceleration_limit
    assert np.abs(changes).max() >= 0.99 * robot.acceleration_limit
    assert max(np.abs(eq.motor_torque).max() for eq in poses) <= scene.torque_limit
    assert all(eq.stable for eq in poses)


def test_the_motion_is_one_and_rests_at_both_ends(planned):
    step = planned.duration / 20000
    t = np.arange(-3, 20004) * step
    samples = planned(t)
    velocity = (samples[2:, 0] - samples[:-2, 0]) / (2 * step)
    acceleration = (samples[2:, 1] - samples[:-2, 1]) / (2 * step)
    assert np.abs(velocity - samples[1:-1, 1]).max() < 1e-6
    assert np.abs(acceleration - samples[1:-1, 2]).max() < 1e-4
    assert np.abs(np.diff(samples[:, 2], axis=0)).max() < 0.05  # 200 m/s^3 at most: no jump
    assert np.abs(planned(np.array([0.0, planned.duration]))[:, 1:]).max() < 1e-9
    assert planned(np.array([0.0]))[0, 0] == pytest.approx([-0.06, 0.22], abs=1e-12)
    assert planned(np.array([planned.duration]))[0, 0] == pytest.approx([-0.05, 0.24], abs=1e-12)


def test_the_path_is_the_scenes(points_scene, planned):
    given = points_scene.trajectory(np.linspace(0.0, points_scene.trajectory.duration, 20001))[:, 0]
    away = [np.linalg.norm(given - p, axis=1).min() for p in planned(np.linspace(0.0, planned.duration, 50))[:, 0]]
    assert max(away) < planned.deviation + 1e-5
    assert planned.deviation <= 5e-5


def test_the_mpc_tracks_it_from_its_file(points_scene, planned, tmp_path):
    scene = points_scene
    path = tmp_path / "path.csv"
    path.write_text(planned.csv())
    trajectory = load_path(path)
    assert trajectory.duration == pytest.approx(planned.duration)
    t = np.linspace(0.0, planned.duration, 3001)
    assert np.abs(trajectory(t) - planned(t)).max(axis=(0, 2)) == pytest.approx([0.0, 0.0, 0.0], abs=1e-4)
    duration = scene.period * math.ceil((planned.duration + 0.2) / scene.period)
    run = simulate(tracked := replace(scene, trajectory=trajectory, duration=duration), tracked.make_plant(),
                   make_controller(tracked))  # fmt: skip
    summary = run.summary()
    assert summary["max_mm"] < 0.05
    assert not summary["limit_violations"]


class Quintic:
    """A path by the quintic timing of `PickAndPlace`."""

    def __init__(self, path, move):
        self.path, self.move = path, move

    def __call__(self, t):
        value, slope, curvature = smooth_step(t / self.move)
        rate, change = self.path.length * slope / self.move, self.path.length * curvature / self.move**2
        p, p1, p2 = self.path.derivatives(self.path.length * value)[:3]
        return np.stack([p, p1 * rate[:, None], p2 * rate[:, None] ** 2 + p1 * change[:, None]], axis=1)


def test_it_is_faster_than_a_quintic_within_the_same_limits(points_scene, planned):
    """Which is slowed down until it keeps them."""
    robot, pose = points_scene.robot, points_scene.start()

    def share(move):
        trajectory = Quintic(planned.move.course.path, move)
        t = np.linspace(0.0, move, 301)
        q = np.stack([eq.q for eq in motors(robot, trajectory, t, pose)])
        rates = np.diff(q, axis=0) / t[1]
        changes = np.diff(rates, axis=0, prepend=0.0, append=0.0) / t[1]
        return max(np.abs(rates).max() / robot.rate_limit, np.abs(changes).max() / robot.acceleration_limit)

    fast, slow = 1.0, 3.0
    while slow - fast > 0.02:
        middle = (fast + slow) / 2
        fast, slow = (middle, slow) if share(middle) > 1.0 else (fast, middle)
    assert fast > 1.5 * planned.duration


@pytest.mark.parametrize(("speed", "acceleration"), [(math.inf, 2.0), (0.3, 2.0)])
def test_a_straight_line_takes_the_time_of_bang_bang(light, speed, acceleration):
    length = 0.12
    scene = replace(light, trajectory=Line(points=((-0.06, 0.22), (0.06, 0.22)), speed=0.1))
    limits = PlanLimits(**NO_MOTORS, tip_speed=speed, tip_acceleration=acceleration)
    planned = plan_timing(scene, limits=limits, cells=160)
    top = min(speed, math.sqrt(length * acceleration))
    best = length / top + top / acceleration
    assert best <= planned.duration * 1.001
    assert planned.duration <= 1.02 * best
    assert np.linalg.norm(planned(np.linspace(0, planned.duration, 5000))[:, 2], axis=1).max() <= 1.001 * acceleration


def test_jerk_is_limited_by_option(light):
    """By the closed form: a quarter of the time each of +J, -J, -J, +J."""
    scene = replace(light, trajectory=Line(points=((-0.06, 0.22), (0.06, 0.22)), speed=0.1))
    planned = plan_timing(scene, limits=PlanLimits(**NO_MOTORS, tip_jerk=50.0))
    best = (32 * 0.12 / 50.0) ** (1 / 3)
    assert best <= planned.duration * 1.001
    assert planned.duration <= 1.02 * best


@pytest.mark.slow
def test_it_is_as_fast_as_toppra_where_only_rates_and_accelerations_count(light):
    toppra = pytest.importorskip("toppra")
    toppra.setup_logging("ERROR")
    scene = light
    robot, limits = scene.robot, PlanLimits(rate=6.0, acceleration=60.0, torque=1e3)
    planned = plan_timing(scene, limits=limits, cells=160)
    # Their path: angles at rest, by inverse statics along ours.
    pose, q = scene.start(), []
    s = np.linspace(0.0, planned.move.course.path.length, 301)
    for p in planned.move.course.path.derivatives(s)[0]:
        pose = inverse_statics(robot, p, guess=pose)
        q.append(pose.q)
    path = toppra.SplineInterpolator(s, np.array(q))
    both = np.array([[-1.0, 1.0]] * 2)
    constraints = [
        toppra.constraint.JointVelocityConstraint(limits.rate * both),
        toppra.constraint.JointAccelerationConstraint(
            limits.acceleration * both, discretization_scheme=toppra.constraint.DiscretizationType.Interpolation
        ),
    ]
    grid = np.linspace(0.0, s[-1], 1001)
    theirs = toppra.algorithm.TOPPRA(constraints, path, gridpoints=grid, parametrizer="ParametrizeConstAccel")
    duration = theirs.compute_trajectory().duration
    assert planned.duration <= 1.02 * duration
    assert planned.duration >= 0.99 * duration
    assert planned.excess <= 1e-3


def test_slopes_are_those_of_differences(scene, pair):
    """Of every limit's share, by the coefficients of the pace."""
    rng = np.random.default_rng(0)
    (path,) = paths_of(scene.trajectory, 0.8, 5e-5)
    limits = replace(PlanLimits.of_scene(scene), tip_speed=1.0, tip_acceleration=5.0, tip_jerk=200.0)
    limits = replace(limits, stiffness=50.0, rod_margin=0.7)  # so near that their slopes are computed
    problem = Problem(paced(path), scene.start(), Carrier(pair.tip_mass, pair.drag, np.zeros(2)), limits)
    x, c = points(20, 6), constant_pace(20, 0.6).c
    c = c * (1.0 + 0.2 * np.sin(np.arange(len(c))))
    q = np.stack([inverse_statics(pair, p, guess=problem.pose).q for p in problem.course(x)[0]])
    start = evaluated(problem, spline_of(c), x, q, tolerance=1e-9).with_slopes()
    change = 1e-5 * c * rng.standard_normal(len(c))
    ends = [evaluated(problem, spline_of(c + sign * change), x, start.turned.q.value, start.turned.poses, 1e-9)
            for sign in (1.0, -1.0)]  # fmt: skip
    unknowns = np.stack([spline_of(change)(x, nu=order) for order in range(4)])
    for here, ahead, behind in zip(start.uses, *(end.uses for end in ends), strict=True):
        predicted = np.einsum("mkd,dm->mk", here.share.slope, unknowns)
        found = (ahead.share.value - behind.share.value) / 2
        allowed = {"change of rate": 5e-2, "motor rate": 5e-3}.get(here.limit, 1e-3)
        assert np.abs(predicted - found).max() < allowed * np.abs(found).max(), here.limit
    assert {use.limit for use in start.uses} >= {"stiffness", "rod margin", "tip jerk", "motor torque"}


def test_what_is_left_of_a_limit_is_left_on_both_sides():
    low, high = _narrowed(np.array([-1.0, -np.inf, 0.0]), np.array([3.0, 2.0, np.inf]), 0.005)
    assert low.tolist() == [-0.98, -np.inf, 0.0]
    assert high.tolist() == [2.98, 2.0, np.inf]


def test_a_margin_that_the_fastest_motion_does_not_leave_is_kept(points_scene):
    """By rods that are found one by one; it takes time, and is no nearer than it must be.

    Of a heavy tip on quick motors: elsewhere the shipped robot comes nearest to a snap where it rests.
    """
    line = Blended(Spline(((-0.1, 0.3), (0.1, 0.3)), speed=0.2))
    robot = replace(points_scene.robot, tip_mass=1.0, acceleration_limit=2e3)
    scene = replace(points_scene, robot=robot, trajectory=line, start_tip=(-0.1, 0.3))
    limits = replace(PlanLimits.of_scene(scene), torque=5.0, strains=(), rod_margin=0.05)

    def least(planned):
        t = np.linspace(0.0, planned.duration, 401)
        return min(least_rod_margin(eq) for eq in motors(robot, planned, t, scene.start()))

    fast = plan_timing(scene, limits=limits, cells=40)
    # Far from its limit it is good to 1 %.
    said = 0.95 * fast.shares[fast.kinds.index("rod margin")].max()
    assert said == pytest.approx(1.0 - least(fast), rel=0.01)
    kept = plan_timing(scene, limits=replace(limits, rod_margin=least(fast) + 0.03), cells=40)
    assert least(fast) + 0.0295 < least(kept) < least(fast) + 0.031
    assert kept.duration > 1.005 * fast.duration


@pytest.mark.slow
def test_a_strain_that_the_material_does_not_bear_is_kept_off(scene):
    """The largest strain of poses that are found one by one; and it takes time."""
    limits = PlanLimits.of_scene(scene)
    assert limits.strains == pytest.approx(scene.robot.strain_limits)
    fast = plan_timing(scene, limits=replace(limits, strains=()), cells=40)
    assert "strain" not in fast.kinds

    def strains(planned):
        t = np.linspace(0.0, planned.duration, 401)
        return np.stack([eq.max_strain for eq in motors(scene.robot, planned, t, scene.start())]).max(axis=0)

    least = 0.97 * strains(fast).max()
    kept = plan_timing(scene, limits=replace(limits, strains=(least, least)), cells=40)
    assert 0.995 * least < strains(kept).max() <= 1.001 * least
    assert kept.duration > fast.duration
    assert kept.excess <= 1e-3


@pytest.mark.slow
def test_a_torque_that_is_hardly_more_than_rest_takes_is_kept(points_scene):
    """It takes much more time to ask for less of it than for less of a rate: programs must charge more for its excess.

    Made slower all along until it kept its limits, as it once was, it took 1.60 s; 1.16 s with all the torque.
    """
    points = ((-0.05, 0.2), (-0.045, 0.26), (-0.01, 0.23), (0.015, 0.275), (0.05, 0.265), (0.03, 0.225), (0.055, 0.195),
              (0.0, 0.185))  # fmt: skip
    scene = replace(points_scene, trajectory=Blended(Spline(points, speed=0.1)))
    planned = plan_timing(scene, limits=replace(PlanLimits.of_scene(scene), torque=0.93))
    assert planned.duration < 1.3
    assert planned.excess <= 1e-3
    t = np.linspace(0.0, planned.duration, 3001)
    poses = motors(scene.robot, planned, t, scene.start())
    rates = np.diff([eq.q for eq in poses], axis=0) / t[1]
    changes = np.diff(rates, axis=0, prepend=0.0, append=0.0) / t[1]
    assert 0.99 < max(np.abs(eq.motor_torque).max() for eq in poses) / 0.93 <= 1.001
    assert np.abs(rates).max() <= 1.001 * scene.robot.rate_limit
    assert np.abs(changes).max() <= 1.001 * scene.robot.acceleration_limit


def test_what_is_said_of_a_plan_is_said_of_its_last_pace(scene, monkeypatch):
    """Also where rounds run out, and what is left of an excess is accepted: what was checked is what is written."""
    monkeypatch.setattr(refining, "_ROUNDS", 1)
    monkeypatch.setattr(refining, "_LARGEST_EXCESS", 1.0)
    planned = plan_timing(scene, cells=30)
    assert planned.t[-1] == pytest.approx(planned.duration, rel=1e-12)
    assert planned(planned.t)[:, 0] == pytest.approx(planned.motion[:, 0], abs=1e-9)
    assert len(planned.t) > 30 * refining.FINE  # the fine grid, not the one that finds most
