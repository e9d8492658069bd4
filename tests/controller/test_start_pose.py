"""The pose in which a robot stands is found from its sensors, or it is said why not."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import AmbiguousPoseError, MeasurementError, PCRError, Sensors, inverse_statics, load_robot, solve_statics
from pcr_mpc.loop.parts.start_pose import find_start
from tests.conftest import MODELS


@pytest.mark.parametrize("name", ["planar_pair", "three_rods", "heavy_pair", "curved_pair", "stretching_pair"])
def test_the_branch_is_found_under_any_load(name):
    """Poses made by `inverse_statics`, which knows nothing of the search; the load is what it was given."""
    robot, rng = load_robot(MODELS / f"{name}.toml"), np.random.default_rng(1)
    found = 0
    for _ in range(6):
        p = robot.bases.mean(axis=0) + np.array([rng.uniform(-0.1, 0.1), rng.uniform(0.16, 0.3)])
        force = rng.uniform(-0.3, 0.3, 2)
        try:
            eq = inverse_statics(robot, p, force)
        except PCRError:
            continue
        start = find_start(robot, eq.p, eq.q)
        assert np.allclose(start.pose.rod_forces, eq.rod_forces, rtol=1e-4, atol=1e-6)
        assert np.allclose(start.force, force, atol=1e-6)
        found += 1
    assert found > 0


def test_noise_is_no_load(pair, centre):
    """Within the tolerance of the sensors there is a pose without load, and the nearest one is taken."""
    sensors, rng = Sensors(tip_noise=1e-4, angle_step=2 * np.pi / 1024), np.random.default_rng(0)
    p = centre.p + rng.normal(0, 1e-4, 2)
    q = sensors.angle_step * np.round(centre.q / sensors.angle_step)
    blind, told = find_start(pair, p, q), find_start(pair, p, q, sensors=sensors)
    assert np.hypot(*blind.force) > 0.01
    assert np.hypot(*told.force) < 1e-9
    assert np.abs(told.pose.p - p).max() < 5e-4
    assert np.abs(told.pose.q - q).max() < sensors.angle_step


def test_whole_turns_do_not_matter_to_encoders_that_wrap(pair, centre):
    wrapped = (centre.q + np.pi) % (2 * np.pi) - np.pi
    with pytest.raises(MeasurementError, match=r"whole turns off: encoders that wrap\? set Sensors\(wrapped=True\)"):
        find_start(pair, centre.p, wrapped)
    assert np.allclose(find_start(pair, centre.p, wrapped, sensors=Sensors(wrapped=True)).pose.q, centre.q)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p, q: (p, np.degrees(q)), "are the angles degrees"),
        (lambda p, q: (1e3 * p, q), "is the tip in millimetres"),
        (lambda p, q: (1e3 * p, np.degrees(q)), "millimetres and degrees"),
        (lambda p, q: (p, q[::-1]), "are the motors swapped"),
        (lambda p, q: (p + (0.0, 0.5), q), r"the tip is 0.7566 m from the base of rod 0, whose length is 0.4 m"),
        (lambda p, q: (p, q + (2.5, 0.0)), r"motor 0 is at 5.867 rad, beyond its stops \[1.04, 5.24\] rad"),
        (lambda p, q: (p, q + (0.0, 0.5)), r"takes a load of \(.*\) N on the tip .*, and no more than 2.45 N"),
    ],
)  # fmt: skip
def test_what_fits_no_pose_is_said_with_numbers(pair, centre, change, message):
    with pytest.raises(MeasurementError, match=message):
        find_start(pair, *change(centre.p, centre.q))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p, q: (1e3 * p, q), "is the tip in millimetres"),
        (lambda p, q: (p, np.degrees(q)), "are the angles degrees"),
        (lambda p, q: (p, q + (2 * np.pi, 0.0)), "whole turns off"),
    ],
)
def test_what_cannot_be_is_explained_though_the_tip_is_pushed(pair, centre, change, message):
    """A rough pose, such as a hand would write: it takes half of the largest load to stay there."""
    p, q = centre.p, centre.q + (0.12, 0.12)
    eq = solve_statics(pair, p, q, guess=centre)
    assert 0.3 < np.linalg.norm(eq.force) / max(9.81 * pair.tip_mass, pair.force_scale) < 1.0
    find_start(pair, p, q)
    with pytest.raises(MeasurementError, match=message):
        find_start(pair, *change(p, q))


def test_two_poses_that_fit_are_said_and_a_mode_settles_it():
    """Rods bowed inward that are pulled by 0.8 N, or outward by 1.3 N: at the same angles, and the load is unknown."""
    robot = load_robot(MODELS / "rfrfr.toml")
    eq = inverse_statics(robot, (0.0, 0.25), (0.0, -0.8), guess=inverse_statics(robot, (0.0, 0.25), mode="RL"))
    with pytest.raises(AmbiguousPoseError, match=r"may be in any of these poses: .*; give start") as caught:
        find_start(robot, eq.p, eq.q, load=2.0)
    error = pickle.loads(pickle.dumps(caught.value))
    assert dict(error.candidates).keys() == {"LR", "RL"}
    assert dict(error.candidates)["RL"] == pytest.approx(0.8)
    for mode in ("LR", "RL"):
        assert find_start(robot, eq.p, eq.q, mode=mode, load=2.0).pose.mode == mode
    found = find_start(robot, eq.p, eq.q)  # where no load can be more than the tip's weight there is one pose only
    assert np.allclose(found.pose.rod_forces, eq.rod_forces, atol=1e-6)


def test_arguments_are_looked_at(pair, centre):
    with pytest.raises(ValueError, match="mode is 'L', expected 2 letters L or R"):
        find_start(pair, centre.p, centre.q, mode="L")
    with pytest.raises(ValueError, match="p is not finite"):
        find_start(pair, (np.nan, 0.2), centre.q)
    with pytest.raises(MeasurementError, match=r"is stable|takes a load of"):
        find_start(pair, centre.p, centre.q, mode="RL")
    limited = replace(pair, tip_mass=1e-3)
    with pytest.raises(MeasurementError, match=r"load=\) a greater load"):
        find_start(limited, centre.p + (0.02, 0.0), centre.q)
    assert find_start(limited, centre.p + (0.02, 0.0), centre.q, load=10.0).pose.mode == centre.mode
