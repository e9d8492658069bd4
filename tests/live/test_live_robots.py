"""Whatever robot, tuning and sensors a loop on the fly is made for; and what is asked of it in the wrong way."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    PCRError,
    Sensors,
    inverse_statics,
    load_robot,
    load_scene,
    make_controller,
)
from pcr_mpc.loop.references.trajectory import Hold
from pcr_mpc.plant.statics.solver import RodSolver
from tests.conftest import MODELS
from tests.live.plant_loop import PERIOD, Loop


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
