"""A real loop, the plant as the robot: sensors fail, come late and stop; the reference changes on the fly."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pcr_mpc import (
    PCRError,
    Plant,
    Sensors,
    UnreachableError,
    inverse_statics,
    load_robot,
    load_scene,
    load_tuning,
    make_controller,
    simulate,
)
from pcr_mpc.loop.references.trajectory import Hold
from pcr_mpc.plant.statics.solver import RodSolver
from tests.conftest import CONTROLLERS, MODELS

PERIOD = 0.01
SCENE = MODELS / "scenes" / "lemniscate.toml"


@pytest.fixture(scope="module")
def scene():
    return load_scene(SCENE)


@pytest.fixture(scope="module")
def tuning():
    return load_tuning(CONTROLLERS / "lemniscate.toml")


@pytest.fixture(scope="module")
def live(scene):
    return make_controller(scene)


class Loop:
    """Plant and user: calls the controller when it is told to, holds the last rates, and checks every one of them."""

    def __init__(self, controller, centre, force=(0.0, 0.0), start=True):
        self.robot, self.controller, self.force = controller.robot, controller, force
        eq = inverse_statics(self.robot, centre.p, force, guess=centre)
        self.plant = Plant(self.robot, integrator="velocity_verlet", dt=1e-3)
        self.x = np.concatenate([eq.p, np.zeros(2), eq.q])
        self.plant.reset(self.x, eq)
        self.t, self.u, self.events, self.tips, self.targets = 0.0, np.zeros(self.robot.n_rods), [], [], []
        if start:
            controller.start(eq.p, eq.q)

    def call(self, tip="measured", angles="measured", time="now", **told):
        p = self.x[:2] if isinstance(tip, str) else tip
        q = self.x[4:] if isinstance(angles, str) else angles
        decision = self.controller.step(tip=p, angles=q, time=self.t if isinstance(time, str) else time, **told)
        self.check(decision.u)
        self.events += [event["kind"] for event in decision.events]
        return decision

    def check(self, u):
        lower, upper = self.robot.angle_limits.T
        assert np.isfinite(u).all()
        assert (np.abs(u) <= self.robot.rate_limit).all()
        assert (np.abs(u - self.u) <= self.robot.acceleration_limit * PERIOD + 1e-9).all()
        ahead = self.x[4:] + PERIOD * u
        assert (ahead >= np.minimum(lower, self.x[4:]) - 1e-9).all()
        assert (ahead <= np.maximum(upper, self.x[4:]) + 1e-9).all()
        self.u = u.copy()

    def wait(self, steps=10):
        for _ in range(steps):
            self.x = self.plant.step(self.x, self.u, self.force)
            self.t = round(self.t + 1e-3, 9)
            self.tips.append(self.x[:2])

    def run(self, periods, **told):
        for _ in range(periods):
            self.call(**told)
            self.targets.append(self.controller.target)
            self.wait()
        return self

    def error(self, path, last, shift=0.0):
        """Largest distance from a path in the last so many steps [mm]."""
        t = self.t + 1e-3 * (np.arange(-last, 0) + 1) - shift
        return 1e3 * np.hypot(*(np.array(self.tips[-last:]) - path(t)[:, 0]).T).max()

    def smooth(self):
        """Largest change of the target's velocity and acceleration from one period to the next."""
        targets = np.array(self.targets)
        return [np.abs(np.diff(targets[:, i], axis=0)).max() for i in (1, 2)]


def test_it_tracks_as_a_simulation_does(live, centre, scene):
    """Velocity estimated, inverse dynamics found on the way, p and q measured: 0.003 mm either way."""
    loop = Loop(live, centre).run(110)
    assert loop.events == []
    assert loop.error(scene.trajectory, 300) < 0.006
    known = make_controller(replace(scene, duration=1.1))
    known.start(centre)
    window = known.reference.states[:, 4:]
    assert np.allclose(live._work.track.window(109, 0)[0, 4:6], window[110], atol=1e-8)


def test_a_load_at_the_start_is_no_surprise(live, centre):
    loop = Loop(live, centre, force=(0.5, -1.0))
    decision = loop.call()
    assert np.allclose(decision.force, (0.5, -1.0), atol=1e-6)
    loop.wait()
    loop.run(15)
    # The loop begins with the load carried: 3 mm and more otherwise.
    assert loop.error(live._scene.trajectory, 150) < 0.1


def test_jitter_and_late_calls(live, centre, scene):
    loop, rng = Loop(live, centre), np.random.default_rng(1)
    for k in range(100):
        if k not in (50, 51, 70):
            loop.call()
        loop.wait(10 * (k + 1) + int(rng.integers(-2, 3)) - round(1e3 * loop.t))
    assert loop.error(scene.trajectory, 100) < 0.1
    assert loop.events == ["late", "late"]


def test_a_late_call_where_the_tip_is_expected_out_of_reach(live, centre):
    """What is expected is an estimate: it may lie where no rods can be, and a late call goes on from there linearly."""
    loop = Loop(live, centre).run(5)
    live.work.foresight.expected[:2] = -0.27, 0.2
    loop.wait(30)
    loop.call()
    assert set(loop.events) == {"late", "measurement"}
    # The motors keep their limits until the tip has said the same for long enough, and is believed.
    assert loop.run(35).events[-1] in ("resumed", "reinitialised")


def test_calls_that_do_not_go_on_repeat_the_rates(live, centre):
    loop = Loop(live, centre).run(60)
    u = loop.call().u
    assert (loop.call().u == u).all()  # the same time again
    loop.wait(1)
    assert (loop.call().u == u).all()
    assert (loop.call(time=loop.t - 0.5).u == u).all()
    assert loop.events == ["clock", "early", "clock"]


def test_short_silence_is_bridged(live, centre, scene):
    loop = Loop(live, centre).run(60).run(20, tip=None, angles=[None, np.nan])
    assert loop.error(scene.trajectory, 100) < 0.02
    assert loop.events == ["measurement"] * 2  # of each sensor once


def test_long_silence_ends_at_rest_and_is_taken_up_again(live, centre, scene):
    loop = Loop(live, centre).run(60)
    loop.run(50, tip=None)
    assert loop.events.count("rest") == 1
    assert (loop.u == 0.0).all()
    loop.run(100)
    assert loop.events.count("resumed") == 1
    assert loop.error(scene.trajectory, 200) < 0.1


def test_one_encoder_that_is_silent_is_said_and_ends_at_rest(live, centre):
    loop = Loop(live, centre).run(20)
    for bridged in range(1, 31):
        loop.run(1, angles=[loop.x[4], None])
        assert loop.events == ["measurement"], bridged
    loop.run(20, angles=[loop.x[4], None])
    assert loop.events.count("rest") == 1
    assert (loop.u == 0.0).all()
    loop.run(20)
    assert loop.events.count("resumed") == 1


def test_after_a_pause_the_estimates_begin_anew(live, centre, scene):
    loop = Loop(live, centre).run(60)
    loop.wait(150)
    loop.run(100)
    assert [kind for kind in loop.events if kind != "measurement"] == ["pause", "resumed"]
    assert loop.error(scene.trajectory, 200) < 0.1


def test_at_a_short_period_ten_of_them_are_no_pause(pair, tuning, centre):
    """Who is held up for 30 ms is late at 1 kHz, as at 100 Hz, and goes on."""
    loop = Loop(make_controller(pair, lambda t: (0.02 * np.sin(2 * t) ** 2, 0.25), tuning, period=1e-3), centre)
    for call in range(120):
        loop.call()
        loop.wait(30 if call == 60 else 1)
    assert loop.events == ["late"]
    target = loop.controller.target[0]
    assert 1e3 * np.hypot(*(loop.x[:2] - target)) < 0.1


READING = st.sampled_from(["good"] * 6 + ["none", "nan", "mm", "degrees", "far", "swapped", "wrapped", "inf", "huge"])
TIME = st.sampled_from(["on time"] * 8 + ["jitter", "late", "pause", "again", "back", "nan", "far", "none"])
ACT = st.sampled_from(["nothing"] * 12 + ["follow", "stop", "hold", "jog", "target", "bad target", "bad follow"])


@settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(READING, TIME, ACT), min_size=15, max_size=40), st.integers(0, 1000))
def test_whatever_comes_the_motors_keep_their_limits(live, centre, calls, seed):
    """No exception but those of a path that cannot be had, and limits kept, in every call."""
    loop, rng = Loop(live, centre), np.random.default_rng(seed)
    offset = 0.0
    for kind, when, act in calls:
        p, q = loop.x[:2].copy(), loop.x[4:].copy()
        tip, angles = {
            "good": (p, q), "none": (None, None), "nan": (np.full(2, np.nan), q), "mm": (1e3 * p, q),
            "degrees": (p, np.degrees(q)), "far": (p + rng.uniform(-1, 1, 2), q), "swapped": (p[::-1], q[::-1]),
            "wrapped": (p, q + 2 * np.pi), "inf": (p, np.full(2, np.inf)), "huge": (np.full(2, 1e300), q * 1e300),
        }[kind]  # fmt: skip
        wait = {"jitter": int(rng.integers(7, 14)), "late": 40, "pause": 200, "again": 0}.get(when, 10)
        offset += {"back": -5.0, "far": 1e6}.get(when, 0.0)
        time = {"nan": np.nan, "none": None}.get(when, loop.t + offset)
        told = {"target": {"target": (0.04, 0.24)}, "bad target": {"target": (9.0, np.nan)}}.get(act, {})
        if act == "follow":
            live.follow(Hold((-0.03, 0.23)))
        elif act in ("stop", "hold"):
            getattr(live, act)()
        elif act == "jog":
            live.jog((0.1, 0.05))
        elif act == "bad follow":
            with pytest.raises(UnreachableError):
                live.follow(Hold((0.5, 0.5)))
        loop.call(tip, angles, time, **told)
        try:
            loop.wait(wait)
        except PCRError:  # a plant that was driven blind for long may lose its rods: that is no fault of the loop
            return


def test_another_path_is_joined_smoothly(live, centre):
    def circle(t):
        return 0.03 * np.sin(4 * t), 0.22 + 0.03 * np.cos(4 * t)

    loop = Loop(live, centre).run(60)
    live.follow(circle)
    begun = loop.t
    loop.run(100)
    tips, t = np.array(loop.tips[-400:]), loop.t + 1e-3 * (np.arange(-400, 0) + 1) - begun
    assert 1e3 * np.hypot(*(tips - np.stack(circle(t), 1)).T).max() < 0.02
    assert loop.smooth()[0] < 0.05  # of 0.4 m/s
    assert loop.smooth()[1] < 1.5  # of 4 m/s^2
    assert loop.events == []


def test_stop_hold_and_jog(live, centre):
    loop = Loop(live, centre).run(80)
    live.stop()
    loop.run(40)
    where = loop.controller.target
    assert (where[1:] == 0).all()
    assert np.hypot(*loop.x[2:4]) < 1e-3
    live.jog((0.1, 0.0))
    loop.run(40)
    assert np.allclose(loop.controller.target[1], (0.1, 0.0), atol=1e-4)
    assert np.allclose(loop.x[:2], loop.controller.target[0] + (0.1 * PERIOD, 0.0), rtol=0, atol=1e-4)
    live.hold()
    held = loop.controller.target[0]
    loop.run(60)
    assert np.allclose(loop.x[:2], held, atol=1e-4)
    assert np.abs(loop.smooth()[0]) < 0.08
    assert loop.events == []


def test_a_target_that_moves_is_followed(live, centre):
    loop = Loop(live, centre)
    for k in range(120):
        at = (0.03 * np.sin(0.03 * k), 0.25 + 0.01 * np.sin(0.06 * k))
        loop.call(target=at)
        if k > 60:
            assert 1e3 * np.hypot(*(loop.x[:2] - at)) < 2.0  # it moves 0.9 mm a period
        loop.wait()
    loop.run(100, target=(0.05, 0.2))
    assert np.allclose(loop.x[:2], (0.05, 0.2), atol=1e-4)
    assert loop.events == []


def test_what_cannot_be_had_is_refused_while_the_old_goes_on(live, centre, scene):
    loop = Loop(live, centre).run(40)
    with pytest.raises(UnreachableError, match=r"the path at t = 0.000 s: tip \(0.5, 0.3\) m is 0.6708"):
        live.follow(Hold((0.5, 0.3)))
    with pytest.raises(PCRError, match="the path cannot be joined from"):
        live.follow(Hold((0.0, -0.3)))
    loop.run(20)
    loop.run(3, target=(0.5, 0.3))
    loop.run(20)
    assert loop.events == ["refused"]
    assert loop.error(scene.trajectory, 100) < 0.02


def test_a_joystick_that_is_held_against_an_edge(live, centre):
    """Told in every period; it brakes before the reach of the rods, says so once, and comes back when it is told to."""
    loop = Loop(live, centre)
    for _ in range(140):
        live.jog((0.0, 0.15))
        loop.run(1)
    assert loop.events == ["refused"]
    assert 0.35 < loop.x[1] < 0.387
    assert np.abs(loop.x[2:4]).max() < 0.01  # it is told again and again to come nearer
    live.jog((0.0, -0.1))
    loop.run(30)
    assert loop.x[3] == pytest.approx(-0.1, abs=2e-3)
    live.hold()
    assert loop.run(40).events == ["refused"]


def test_jogging_into_a_stop_ends_before_it(live, centre):
    loop = Loop(live, centre).run(1)
    live.jog((0.25, 0.1))
    loop.run(120)
    assert loop.events == ["refused"]
    assert np.allclose(loop.controller.target[1:], 0.0, atol=1e-9)
    assert np.hypot(*(loop.x[:2] - loop.controller.target[0])) < 1e-4


def test_a_robot_and_a_function_are_enough(pair, tuning, centre):
    controller = make_controller(pair, lambda t: (0.02 * np.sin(2 * t) ** 2, 0.25), tuning, period=PERIOD)
    loop = Loop(controller, centre).run(80)
    t = loop.t + 1e-3 * (np.arange(-300, 0) + 1)
    assert 1e3 * np.abs(np.array(loop.tips[-300:])[:, 0] - 0.02 * np.sin(2 * t) ** 2).max() < 0.02


def test_noise_steps_wrapping_and_delay_are_told(pair, tuning, centre):
    sensors = Sensors(tip_noise=5e-5, angle_step=2 * np.pi / 4096, wrapped=True, delay=1)
    controller = make_controller(pair, lambda t: (0.02 * np.sin(2 * t) ** 2, 0.25), tuning, sensors=sensors)
    loop, rng = Loop(controller, centre, start=False), np.random.default_rng(0)

    def measured():
        q = sensors.angle_step * np.round(loop.x[4:] / sensors.angle_step)
        return loop.x[:2] + rng.normal(0, 5e-5, 2), q - 2 * np.pi * np.ceil(q / (2 * np.pi) - 0.5)

    controller.start(*measured())
    waiting = np.zeros(2)
    for _ in range(100):
        tip, angles = measured()
        u = controller.step(tip=tip, angles=angles, time=loop.t).u
        loop.u, waiting = waiting, u
        loop.wait()
    t = loop.t + 1e-3 * (np.arange(-300, 0) + 1)
    assert 1e3 * np.abs(np.array(loop.tips[-300:])[:, 0] - 0.02 * np.sin(2 * t) ** 2).max() < 0.3


def test_a_tuning_without_an_observer_gets_one(pair, tuning, centre):
    controller = make_controller(pair, None, replace(tuning, observer=None))
    loop = Loop(controller, centre).run(5)
    assert controller.tuning.observer is not None
    assert loop.events == ["observer"]
    assert np.allclose(loop.x[:2], centre.p, atol=1e-6)


def test_a_loop_that_counts_its_periods_may_change_the_reference_too(scene, live, centre):
    """In `simulate`, by a controller that wraps one of the toolkit's."""

    class Switching:
        def start(self, pose):
            live.start(pose)

        def step(self, k, x):
            if k == 30:
                live.follow(Hold((0.03, 0.24)))
            return live.step(k, x)

    short = replace(scene, duration=0.9)
    run = simulate(short, short.make_plant(), Switching())
    assert np.allclose(run.x[-1, :2], (0.03, 0.24), atol=1e-5)
    assert run.limit_violations() == 0
    # And plain again from the next start on.
    plain = simulate(short, short.make_plant(), live)
    assert plain.summary()["max_mm"] < 0.006


def test_live_calls_after_a_start_in_a_pose(scene, live, centre):
    live.start(centre)
    loop = Loop(live, centre, start=False)
    loop.run(60)
    assert loop.error(scene.trajectory, 200) < 0.02


def test_retuning_on_the_fly(pair, tuning, centre):
    controller = make_controller(pair, lambda t: (0.02 * np.sin(2 * t) ** 2, 0.25), tuning)
    loop = Loop(controller, centre).run(30)
    controller.retune(replace(tuning, horizon=9))
    loop.run(50)
    t = loop.t + 1e-3 * (np.arange(-200, 0) + 1)
    assert 1e3 * np.abs(np.array(loop.tips[-200:])[:, 0] - 0.02 * np.sin(2 * t) ** 2).max() < 0.02


def test_what_is_asked_too_early_is_said(pair, tuning, scene):
    controller = make_controller(pair, None, tuning)
    for call in (controller.stop, controller.hold, lambda: controller.step(tip=(0, 0.25)), lambda: controller.target):
        with pytest.raises(PCRError, match=r"was not started: call start\(pose\) or start\(p, q\) first"):
            call()
    with pytest.raises(ValueError, match="give an Equilibrium, or the measured tip and motor angles"):
        controller.start((0.0, 0.25))
    with pytest.raises(ValueError, match="tuning is None, expected a Tuning"):
        make_controller(pair, None)
    with pytest.raises(ValueError, match="a scene has a path, a period and a robot"):
        make_controller(scene, path=Hold((0, 0.25)))
    with pytest.raises(ValueError, match=r"sensors is 0\.001, expected Sensors"):
        make_controller(pair, None, tuning, sensors=0.001)


@pytest.mark.parametrize("blend", [0.0, -1.0, float("nan"), float("inf"), "soon", True])
def test_a_blend_takes_time(live, centre, blend):
    Loop(live, centre).run(2)
    with pytest.raises(ValueError, match="blend"):
        live.follow(Hold((0.0, 0.26)), blend=blend)


def test_one_coordinate_that_is_not_measured(live, centre):
    loop = Loop(live, centre).run(20)
    loop.call(tip=[None, 0.25], angles=loop.x[4:].tolist())
    loop.wait()
    loop.call(tip=None, angles=None)
    assert set(loop.events) == {"measurement"}


def test_where_nothing_is_to_be_tracked_the_motors_are_held():
    held = make_controller(load_scene(MODELS / "scenes" / "release.toml"))
    held.start((0.0, 0.25), (3.3, -0.2))
    assert (held.step(tip=(0.0, 0.25), angles=None, time=1.0).u == 0.0).all()


def test_no_rods_are_started_anew_while_it_runs(pair, tuning, centre, monkeypatch):
    """Where the rods have inertia too; a start from nodes takes periods."""
    model = replace(tuning.model, inertia="condensed")
    controller = make_controller(pair, lambda t: (0.02 * np.sin(2 * t) ** 2, 0.25), replace(tuning, model=model))
    loop = Loop(controller, centre).run(1)
    monkeypatch.setattr(RodSolver, "start", lambda *_: pytest.fail("the rods were started anew"))
    loop.run(60)
    t = loop.t + 1e-3 * (np.arange(-100, 0) + 1)
    assert 1e3 * np.abs(np.array(loop.tips[-100:])[:, 0] - 0.02 * np.sin(2 * t) ** 2).max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["three_rods", "heavy_pair", "curved_pair"])
def test_other_robots(name, tuning):
    robot = load_robot(MODELS / f"{name}.toml")
    pose = inverse_statics(robot, (0.0, 0.25))
    model = replace(tuning.model, method="closed_form" if robot.needs_shooting is None else "multiple_shooting")
    controller = make_controller(robot, lambda t: (0.02 * np.sin(2 * t) ** 2, 0.25), replace(tuning, model=model))
    loop = Loop(controller, pose).run(80)
    t = loop.t + 1e-3 * (np.arange(-300, 0) + 1)
    assert 1e3 * np.abs(np.array(loop.tips[-300:])[:, 0] - 0.02 * np.sin(2 * t) ** 2).max() < 0.1
