"""A reference that is changed while the robot moves: followed, stopped, held, jogged, refused."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    PCRError,
    UnreachableError,
    simulate,
)
from pcr_mpc.loop.references.trajectory import Hold
from tests.live.plant_loop import PERIOD, Loop


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


@pytest.mark.parametrize("blend", [0.0, -1.0, float("nan"), float("inf"), "soon", True])
def test_a_blend_takes_time(live, centre, blend):
    Loop(live, centre).run(2)
    with pytest.raises(ValueError, match="blend"):
        live.follow(Hold((0.0, 0.26)), blend=blend)


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
