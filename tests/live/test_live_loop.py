"""A real loop, the plant as the robot: sensors fail, come late and stop."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pcr_mpc import (
    PCRError,
    UnreachableError,
    make_controller,
)
from pcr_mpc.loop.references.trajectory import Hold
from tests.live.plant_loop import Loop


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
    # Then rods and plan begin where the robot is, too: neither leads anywhere from where it was not.
    said = len(loop.events)
    assert loop.run(100).events[said:] == []
    assert loop.error(live._scene.trajectory, 100) < 0.1


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


def test_one_coordinate_that_is_not_measured(live, centre):
    loop = Loop(live, centre).run(20)
    loop.call(tip=[None, 0.25], angles=loop.x[4:].tolist())
    loop.wait()
    loop.call(tip=None, angles=None)
    assert set(loop.events) == {"measurement"}
