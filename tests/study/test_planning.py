"""Plans are as fast as closed forms and toppra say, keep their limits between their points too, and can be tracked."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    Blended,
    ConvergenceError,
    InfeasibleError,
    Line,
    ModelError,
    PlanLimits,
    Plant,
    Spline,
    UnreachableError,
    UnstableError,
    Waypoints,
    check_scene,
    inverse_statics,
    load_path,
    load_scene,
    make_controller,
    plan_timing,
    simulate,
)
from pcr_mpc.cli import main
from pcr_mpc.linearisation.pose_limits import PoseLimits
from pcr_mpc.loop.demand.feasibility import reference_demand, reference_of
from pcr_mpc.loop.references.tabulated import Tabulated
from pcr_mpc.loop.references.trajectory import PickAndPlace, smooth_step
from pcr_mpc.report.designs.plan_table import plan_table
from pcr_mpc.study.planning import rods_mass
from pcr_mpc.study.planning.collocation import _narrowed
from pcr_mpc.study.planning.course import paced
from pcr_mpc.study.planning.free import way_points
from pcr_mpc.study.planning.meshing import points
from pcr_mpc.study.planning.motion import Carrier
from pcr_mpc.study.planning.pace import constant_pace, spline_of
from pcr_mpc.study.planning.path import path_of
from pcr_mpc.study.planning.plan import rods_left_out
from pcr_mpc.study.planning.timing import Problem, evaluated
from tests.conftest import MODELS
from tests.references.drawn import rows

NO_MOTORS = {"rate": 1e6, "acceleration": 1e12, "torque": 1e3}


@pytest.fixture(scope="module")
def scene():
    return load_scene(MODELS / "scenes" / "pick_and_place.toml")


@pytest.fixture(scope="module")
def points_scene():
    return load_scene(MODELS / "scenes" / "eight_points.toml")


@pytest.fixture(scope="module")
def planned(points_scene):
    return plan_timing(points_scene, cells=80)


@pytest.fixture(scope="module")
def light(scene):
    """The same robot with a tip of no weight: its motors stand as they do at rest, whatever the motion."""
    return replace(scene, robot=replace(scene.robot, tip_mass=1e-9, drag=0.0))


def motors(robot, trajectory, t, pose):
    """Angles at equally spaced times, by inverse statics of the forces that the motion takes."""
    samples = trajectory(t)
    forces = -robot.tip_mass * samples[:, 2] - robot.drag * samples[:, 1]
    found = []
    for p, force in zip(samples[:, 0], forces, strict=True):
        pose = inverse_statics(robot, p, force, guess=pose)
        found.append(pose)
    return found


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
    path = path_of(scene.trajectory, 0.8, 5e-5)
    limits = replace(PlanLimits.of_scene(scene), tip_speed=1.0, tip_acceleration=5.0, tip_jerk=200.0)
    limits = replace(limits, stiffness=50.0, rod_margin=0.38)  # so near that their slopes are computed
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


def test_limits_are_lowered_until_with_the_rods_mass_none_is_exceeded_by_anything(scene, planned, monkeypatch):
    """A motor that is asked for half a thousandth too much is one that `check_scene` refuses."""
    model = replace(scene.tuning.model, inertia="condensed")
    heavy, limits = replace(scene, tuning=replace(scene.tuning, model=model)), PlanLimits.of_scene(scene)
    kept = []

    def asked(*_):
        share = 1.0005 * kept[-1].acceleration / limits.acceleration
        return {"rate": 1.0, "acceleration": share * limits.acceleration, "torque": 0.1}

    monkeypatch.setattr(rods_mass, "asked_of_motors", asked)
    found = rods_mass.with_rods(heavy, limits, 0.0, lambda lowered: kept.append(lowered) or planned)
    assert len(kept) == found.rods.rounds == 2
    assert found.rods.acceleration <= limits.acceleration


@pytest.mark.parametrize(
    ("excess", "words"),
    [(-5e-4, "limits kept, 99.950 %"), (4e-5, "limits kept to 0.1 %, 100.004 %"), (2e-3, "limits exceeded: 100.200 %")],
)
def test_limits_are_said_to_be_kept_or_not_and_never_both(planned, excess, words):
    """Whatever is left or beyond is a share of the limit that is used."""
    assert f"{words} of one at most" in plan_table(planned.summary() | {"largest_excess": excess})


def test_a_rough_path_is_told_from_one_with_a_corner(scene):
    t, points = rows()
    rough = Tabulated(t, points)
    with pytest.raises(ModelError, match=rf"rough.* scatter by about .* smoothing = {rough.scatter:.2g}$"):
        path_of(Blended(rough), t[-1], 5e-5)
    path_of(Blended(replace(rough, smoothing=rough.scatter)), t[-1], 5e-5)
    with pytest.raises(ModelError, match=r"round the corner, or allow more \(--tolerance, tolerance\)$"):
        path_of(Waypoints(((0.0, 0.2), (0.1, 0.2), (0.1, 0.3)), speed=0.1), 4.0, 5e-5)


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


@pytest.mark.slow
def test_margins_and_torque_limit_too(scene):
    """A margin that the fastest motion does not leave is kept, and takes time."""
    limits = PlanLimits.of_scene(scene)
    free = plan_timing(scene, limits=limits, cells=40)
    used = dict(zip(free.kinds, free.shares.max(axis=1), strict=True))
    least = 1.0 - 0.95 * used["rod margin"] * (1.0 - limits.rod_margin)
    kept = plan_timing(
        scene, limits=replace(limits, rod_margin=least, torque=0.97 * used["motor torque"] * 1.5), cells=40
    )
    assert kept.duration > 1.001 * free.duration
    assert kept.excess <= 1e-3
    shares = dict(zip(kept.kinds, kept.shares.max(axis=1), strict=True))
    assert max(shares["rod margin"], shares["motor torque"]) > 0.99


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"trajectory": PickAndPlace((-0.06, 0.22), (0.35, 0.22), 0.0, 0.0, 1.0)}, UnreachableError, "rod 0"),
        ({"pose_limits": PoseLimits(tip_lower=(-0.1, 0.1), tip_upper=(0.1, 0.25))}, InfeasibleError, "20 mm outside"),
        ({"pose_limits": PoseLimits(stiffness=70.0)}, InfeasibleError, "70 N/m"),
        ({"trajectory": None, "tuning": None}, ModelError, "no reference"),
        ({"trajectory": PickAndPlace((-0.06, 0.22), (-0.06, 0.22), 0.0, 0.0, 1.0)}, ModelError, "nothing to plan"),
    ],
)
def test_what_cannot_be_planned_is_said_with_numbers(scene, change, error, message):
    with pytest.raises(error, match=message):
        plan_timing(replace(scene, **change))


def test_a_torque_that_does_not_hold_the_tip_is_said(scene):
    limits = replace(PlanLimits.of_scene(scene), torque=0.7)
    with pytest.raises(InfeasibleError, match=r"to rest there takes .* N m, where 0.7 N m are allowed") as caught:
        plan_timing(scene, limits=limits)
    assert caught.value.limit == "motor torque"
    assert 0.0 <= caught.value.s <= 0.17


def test_a_path_through_a_fold_says_where(scene):
    """Down between the motors the rods' branch ends."""
    trajectory = Line(points=((-0.06, 0.22), (0.1, -0.2)), speed=0.1)
    with pytest.raises((UnstableError, ConvergenceError, UnreachableError), match=r"the path at .* mm from its start"):
        plan_timing(replace(scene, trajectory=trajectory))


def test_the_lines_that_are_to_be_put_into_a_scene_are_found_from_there(planned, tmp_path, monkeypatch, capsys):
    mine = tmp_path / "mine" / "scene.toml"
    mine.parent.mkdir()
    text = (MODELS / "scenes" / "eight_points.toml").read_text()
    mine.write_text(text.replace("../../", f"{MODELS.parent}/").replace('"../', f'"{MODELS}/'))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pcr_mpc.cli.plan.plan_timing", lambda *_, **__: planned)
    for given in ("mine/scene.toml", "eight_points"):
        for out in (["--out", "fast.csv"], []):
            assert main(["plan", given, "--no-pictures", *out]) == 0
            lines = capsys.readouterr().out.partition("[reference]\n")[2]
            kept = re.sub(r"^\[reference\]\n(\w.*\n)*|^duration.*", "", mine.read_text(), flags=re.MULTILINE)
            (mine.parent / "fast.toml").write_text(f"{kept}\n[reference]\n{lines}")
            found = load_scene(mine.parent / "fast.toml")
            assert planned.duration <= found.duration < planned.duration + 10 * found.period


def test_the_command_writes_a_path_and_a_picture(tmp_path, capsys):
    out = tmp_path / "fast.csv"
    command = ["plan", str(MODELS / "scenes" / "pick_and_place.toml"), "--out", str(out), "--cells", "40"]
    assert main([*command, "--json", "--tip-speed", "0.5"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["duration_s"] == pytest.approx(load_path(out).duration)
    assert found["largest_excess"] <= 1e-3
    assert found["top_speed_m_s"] == pytest.approx(0.5, rel=2e-3)
    # Two rods of 5.6 g beside 250 g: less than all of them, for they are clamped at one end.
    assert 0.005 < found["share_of_rods"] < 11.1 / 261.1
    left_out = {"asked": dict.fromkeys(("rate_rad_s", "rate_change_rad_s2", "torque_Nm"), 2.0)}
    left_out["limits"] = dict.fromkeys(left_out["asked"], 1.5)
    told = plan_table(found | {"share_of_rods": 0.38, "rods_left_out": left_out})
    assert "38 % of the mass that moves, left out" in told
    assert "with it the motors are asked for 2 of 1.5 rad/s, " in told
    assert "limits kept by rods without mass" in told
    assert {row["limit"] for row in found["limits"]} >= {"motor rate", "change of rate", "tip speed"}
    assert (tmp_path / "fast.png").stat().st_size > 10_000
    out.write_text("mine")
    assert main(command) == 1
    assert "left alone" in capsys.readouterr().err
    assert out.read_text() == "mine"
