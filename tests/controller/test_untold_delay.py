"""Commands that come later than anybody was told, by a time that is no whole number of anything."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ModelError, Plant, load_run, load_scene, simulate
from pcr_mpc.loop.parts.controllers import Replay
from tests.conftest import MODELS

RATES = 0.1 * np.array([[1.0, -2.0], [3.0, 1.0], [-2.0, 0.5], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])


@pytest.fixture(scope="module")
def scene():
    return replace(load_scene(MODELS / "scenes" / "hold_with_load.toml"), duration=0.06)


def moved(scene, delay, untold):
    true = replace(scene, delay=delay, untold_delay=untold)
    return simulate(true, Plant(scene.robot, integrator="rk4", dt=1e-3), Replay(RATES))


@pytest.mark.parametrize("untold", [0.0, 0.003, 0.01, 0.0137, 0.0204])
def test_every_motor_turns_as_a_delayed_hold_of_the_commands(scene, untold):
    """At the ends of the steps the angles are the integral of the commands, held for a period and moved by the time."""
    run = moved(scene, 1, untold)
    edges = 0.01 * np.arange(len(RATES) + 1) + 0.01 + untold
    turned = np.vstack([np.zeros(2), 0.01 * np.cumsum(RATES, axis=0)])
    wanted = np.stack([np.interp(run.t, edges, angles) for angles in turned.T], axis=1)
    assert run.x[:, 4:] - run.x[0, 4:] == pytest.approx(wanted, abs=1e-12)


def test_a_whole_period_is_a_period_of_delay(scene):
    told, untold = moved(scene, 2, 0.0), moved(scene, 1, 0.01)
    assert told.hash() == untold.hash()


def test_the_tip_moves_on_without_steps_in_time(scene):
    """A thousandth of a step more moves the tip by a thousandth of what a step does, to first order."""
    one, more, step = (moved(scene, 0, untold).x[:, :2] for untold in (0.0134, 0.013401, 0.0135))
    assert more - one == pytest.approx(0.01 * (step - one), abs=2e-3 * np.abs(step - one).max())


def test_limits_on_angles_count_where_a_command_arrives(scene):
    """Two commands of 2 mrad each: by itself each is within the stop at 2.5 mrad, but the second comes on top."""
    rods = [replace(rod, angle_limits=(float(q) - 1.0, float(q) + 2.5e-3))
            for rod, q in zip(scene.robot.rods, scene.start().q, strict=True)]  # fmt: skip
    robot = replace(scene.robot, rods=tuple(rods))
    run = simulate(
        replace(scene, robot=robot, untold_delay=0.0136),
        Plant(robot, dt=1e-3),
        Replay(np.array([[0.2, 0.2], [0.2, 0.2], *np.zeros((4, 2))])),
    )
    assert run.limit_violations() == 1


def test_a_record_has_it(scene, tmp_path):
    run = moved(scene, 1, 0.0137)
    run.save(tmp_path)
    again = load_run(tmp_path)
    assert again.scene.untold_delay == 0.0137
    assert again.hash() == run.hash()


@pytest.mark.parametrize("time", [-1e-3, float("nan"), float("inf")])
def test_no_time_is_refused(scene, time):
    with pytest.raises(ModelError, match="untold_delay"):
        replace(scene, untold_delay=time)


def test_a_scene_file_says_it(tmp_path):
    text = (MODELS / "scenes" / "hold_with_load.toml").read_text(encoding="utf-8")
    text = text.replace('"../', f'"{(MODELS / "scenes").as_posix()}/../')
    path = tmp_path / "late.toml"
    path.write_text(text.replace("[control]", "[control]\nuntold_delay = 0.0125"), encoding="utf-8")
    assert load_scene(path).untold_delay == 0.0125
