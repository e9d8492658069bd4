"""Planning from commanded angles: motors that are late, by nobody knows how much, are not told to turn twice."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ModelError, SimulationError, load_scene, load_tuning, make_controller, simulate
from pcr_mpc.loop.hardware.motors import Motors
from pcr_mpc.study.tuning.file import write_tuning
from tests.conftest import CONTROLLERS, MODELS

LAG = 0.02


@pytest.fixture(scope="module")
def scene():
    scene = replace(load_scene(MODELS / "scenes" / "lemniscate.toml"), duration=1.5)
    return replace(scene, plant=replace(scene.plant, integrator="velocity_verlet"))


@pytest.fixture(scope="module")
def measured():
    tuning = load_tuning(CONTROLLERS / "default.toml")
    return replace(tuning, input_weight=0.07, model=replace(tuning.model, angles="measured"))


def commanded(tuning, lag=0.0):
    return replace(tuning, model=replace(tuning.model, angles="commanded", motor_lag=lag))


def error_mm(scene, tuning, lag=0.0, delay=0.0, since=1.0):
    """RMS [mm] and the controller."""
    believed = scene.tuned(tuning)
    true, controller = replace(believed, motors=Motors(lag), untold_delay=delay), make_controller(believed)
    try:
        run = simulate(true, true.make_plant(), controller)
    except SimulationError:
        return np.inf, controller
    return 1e3 * float(np.sqrt(np.mean(run.error[run.t >= since] ** 2))), controller


def fitted(controller):
    """Lag that a controller has found [s]."""
    given = controller.work.foresight.inputs
    (above, below), (prior_above, prior_below) = given["lags"], given["prior"]
    return (prior_above + above) / (prior_below + below)


def test_untold_lag_and_latency_are_borne(scene, measured):
    """The same weights: from measured angles the loop is lost, from commanded ones it tracks; and it knows the time."""
    assert error_mm(scene, measured, LAG, 0.02)[0] > 8.0
    found, controller = error_mm(scene, commanded(measured), LAG, 0.02)
    assert found < 1.5
    assert fitted(controller) == pytest.approx(0.04, rel=0.1)


def test_motors_that_follow_at_once_cost_little(scene, measured):
    found, controller = error_mm(scene, commanded(measured))
    assert found < 0.004
    assert abs(fitted(controller)) < 1e-3


def test_a_lag_that_is_known_is_compensated_from_the_start(scene, measured):
    """Told, it need not be learnt: the first second is better, too."""
    short = replace(scene, duration=1.0)
    untold, told = (error_mm(short, commanded(measured, lag), LAG, since=0.0)[0] for lag in (0.0, LAG))
    assert told < 0.5 * untold
    assert told < 0.1


def test_what_never_comes_is_given_up(scene, measured):
    """A motor that falls short, at a stop nobody told of: the tip is found again, if slowly."""
    believed = scene.tuned(commanded(measured))
    controller = make_controller(believed)
    rods = tuple(replace(rod, angle_limits=(rod.angle_limits[0], 3.39)) if i == 0 else rod
                 for i, rod in enumerate(believed.robot.rods))  # fmt: skip
    true = replace(believed, robot=replace(believed.robot, rods=rods))
    run = simulate(true, true.make_plant(), controller)
    assert run.x[:, 4].max() == pytest.approx(3.39, abs=1e-9)
    assert run.summary()["failures"] == 0
    assert run.error.max() < 0.04


def test_a_tuning_says_so_and_keeps_it(measured, tmp_path):
    tuning = commanded(measured, LAG)
    path = tmp_path / "tuning.toml"
    write_tuning(tuning, path, [])
    assert load_tuning(path).model == tuning.model
    with pytest.raises(ModelError, match="angles = 'commanded'"):
        replace(measured.model, motor_lag=LAG)
    with pytest.raises(ValueError, match="measured, commanded"):
        replace(measured.model, angles="guessed")
