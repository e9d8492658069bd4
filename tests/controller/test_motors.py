"""Motors that lag, have play, stall, or take angles, whatever moves the robot."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pcr_mpc import ModelError, load_scene, make_controller, simulate
from pcr_mpc.loop.hardware.motors import Motors
from pcr_mpc.loop.parts.controllers import Replay
from pcr_mpc.loop.run.finding import digest
from pcr_mpc.loop.run.record import from_text, to_text
from tests.conftest import MODELS

SCENES = MODELS / "scenes"
LATE = 0.03  # s, time constant


@pytest.fixture(scope="module")
def lemniscate():
    return replace(load_scene(SCENES / "lemniscate.toml"), duration=0.4)


def replayed(scene, rates, **motors):
    scene = replace(scene, motors=Motors(**motors))
    return simulate(scene, scene.make_plant(), Replay(np.asarray(rates, dtype=float)))


def turned(run):
    return run.x[:, 4:] - run.x[0, 4:]


def test_a_rate_lags_as_its_differential_equation_says(lemniscate):
    """Rates that change every period, against an integrator with a tolerance; the motors end at the right angles."""
    rates = np.random.default_rng(3).uniform(-2.0, 2.0, (40, 2))
    run = replayed(lemniscate, rates, time_constant=LATE)
    period, angles, state = lemniscate.period, [np.zeros(2)], np.zeros(4)
    for u in rates:
        found = solve_ivp(
            lambda _, y, u=u: np.concatenate([y[2:], (u - y[2:]) / LATE]), (0, period), state, rtol=1e-10, atol=1e-12
        )
        state = found.y[:, -1]
        angles.append(state[:2])
    assert turned(run)[:: run.steps_per_period] == pytest.approx(np.array(angles), abs=1e-9)
    # A rate in the step response has come to 1 - 1/e after one time constant, to a millisecond.
    run = replayed(lemniscate, np.full((40, 2), [0.5, -0.5]), time_constant=LATE)
    assert run.applied[29] == pytest.approx([0.5 * 0.624, -0.5 * 0.624], rel=0.01)


def test_motors_without_effects_change_no_bit(lemniscate):
    scene = replace(lemniscate, duration=0.1)
    plain, motors = (simulate(one, one.make_plant(), make_controller(one)).hash()
                     for one in (scene, replace(scene, motors=Motors())))  # fmt: skip
    assert plain == motors
    assert digest(scene) != digest(replace(scene, motors=Motors(0.02)))


def test_a_rate_limit_comes_before_the_lag(lemniscate):
    run = replayed(lemniscate, np.full((40, 2), [0.0, 3.0]), time_constant=LATE)
    slower = replace(lemniscate, robot=replace(lemniscate.robot, rate_limit=0.5))
    limited, gentle = replayed(slower, np.full((40, 2), [0.0, 3.0]), time_constant=LATE), replayed(
        lemniscate, np.full((40, 2), [0.0, 0.5]), time_constant=LATE
    )  # fmt: skip
    assert turned(limited) == pytest.approx(turned(gentle), abs=1e-12)
    assert turned(run)[-1, 1] > 2 * turned(limited)[-1, 1]


def test_play_is_crossed_before_the_clamp_turns_back(lemniscate):
    """To and fro: the clamp stops for as long as the motor crosses the play; encoders see the motor."""
    play, rates = 0.02, np.repeat([[0.0, 1.0], [0.0, -1.0]], 20, axis=0)
    run = replayed(lemniscate, rates, backlash=play)
    clamp, motor = turned(run)[::10, 1], run.measured[:, 5] - run.x[0, 5]
    assert motor[[10, 20, 30]] == pytest.approx([0.1, 0.2, 0.1], abs=1e-9)
    assert clamp[[1, 10, 20]] == pytest.approx([0.0, 0.1 - play / 2, 0.2 - play / 2], abs=1e-9)
    assert clamp[22] == pytest.approx(clamp[20], abs=1e-9)
    assert clamp[30] == pytest.approx(0.1 + play / 2, abs=1e-9)
    assert not turned(run)[:, 0].any()


@pytest.fixture(scope="module")
def weak(lemniscate):
    """Motors that have a little more torque than holding the start takes."""
    pose = lemniscate.start()
    limit = 1.03 * float(np.abs(pose.motor_torque).max())
    return replace(lemniscate, robot=replace(lemniscate.robot, torque_limit=limit)), np.sign(pose.motor_torque)


def test_a_motor_has_no_more_than_its_torque(weak):
    """The rods' torques are those of the exact rods at the poses of the run."""
    scene, side = weak
    rates = np.concatenate([np.outer(np.full(15, 3.0), side), np.outer(-np.ones(25), side)])
    strong, run = simulate(scene, scene.make_plant(), Replay(rates)), replayed(scene, rates, saturated=True)
    limit = scene.robot.torque_limit
    assert np.abs(strong.torques).max() > 1.1 * limit
    assert np.abs(run.torques).max() < 1.001 * limit
    assert np.abs(run.torques)[2:15].min() > 0.999 * limit
    # Held back, never turned back; away from the torque it turns at once, as fast as it is told.
    way = side * turned(run)
    assert (np.diff(way[:151], axis=0) >= 0.0).all()
    assert 0.05 < way[150].min() < way[150].max() < 0.3 * (side * turned(strong))[150].min()
    assert run.applied[150:] == pytest.approx(np.outer(np.full(250, -1.0), side), abs=1e-9)
    assert [event["kind"] for event in run.events] == ["stall", "stall"]
    assert "motor 0 is at its torque limit" in run.events[0]["message"]


def test_a_stalled_motor_holds(weak):
    """A load takes the torque beyond what the motors have: they stand, and are not turned back by it."""
    scene, side = weak
    scene, rates = replace(scene, force=(0.0, 4.0)), np.outer(np.ones(40), side)
    run = replayed(scene, rates, saturated=True)
    over = np.abs(run.torques[:-1]) > 1.01 * scene.robot.torque_limit
    assert over.all(axis=1).sum() > 5
    assert not run.applied[::10][over].any()
    assert ((side * run.applied) >= 0.0).all()


def test_a_servo_makes_up_for_what_a_stall_has_cost(weak):
    """Both are told to go where the torque does not suffice, and back again to where they began."""
    scene, side = weak
    rates = np.concatenate([np.outer(np.ones(20), side), np.outer(-np.ones(20), side)])
    rate, angle = (replayed(scene, rates, saturated=True, command=command) for command in ("rate", "angle"))
    assert np.abs(turned(angle)[-1]).max() < 1e-9
    assert (side * turned(rate)[-1]).max() < -0.05
    free = [replayed(scene, 0.2 * rates, time_constant=LATE, command=command) for command in ("rate", "angle")]
    assert turned(free[0]) == pytest.approx(turned(free[1]), abs=1e-9)


def test_another_engine_has_the_same_motors(lemniscate):
    pytest.importorskip("mujoco")
    from pcr_mpc.plant.mujoco.plant import MuJoCoPlant

    scene = replace(lemniscate, duration=0.1, motors=Motors(LATE))
    rates = np.full((10, 2), [1.0, -1.0])
    own, other = (simulate(scene, plant, Replay(rates)) for plant in (scene.make_plant(), MuJoCoPlant(scene.robot)))
    assert other.x[-1, 4:] == pytest.approx(own.x[-1, 4:], abs=1e-6)
    assert other.x[-1, :2] == pytest.approx(own.x[-1, :2], abs=2e-4)


def test_a_scene_has_motors_and_refuses_wrong_ones(tmp_path):
    text = (SCENES / "lemniscate.toml").read_text().replace("../planar_pair", str(MODELS / "planar_pair"))
    text = text.replace("../../controllers", str(MODELS.parent / "controllers"))
    path = tmp_path / "scene.toml"

    def read(*lines):
        path.write_text("\n".join([text, "[motors]", *lines]))
        return load_scene(path)

    scene = read("time_constant = 0.02", "backlash = 0.005", "saturated = true", 'command = "angle"')
    assert scene.motors == Motors(0.02, 0.005, True, "angle")
    assert from_text(to_text(scene)).motors == scene.motors
    for line, key in (("time_constant = -1", "time_constant"), ('command = "torque"', "command"), ("lag = 1", "lag")):
        with pytest.raises(ModelError, match=key):
            read(line)
    with pytest.raises(ModelError, match="backlash"):
        Motors(backlash=np.nan)
    with pytest.raises(ModelError, match="rate, angle"):
        Motors(command="torque")
