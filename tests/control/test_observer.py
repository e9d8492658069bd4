"""What the controller does not measure: each compensation, and what happens without it."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import Plant, linearise, load_scene, load_tuning, make_controller, simulate
from pcr_mpc.control.observer import DisturbanceObserver, ObserverTuning
from tests.conftest import CONTROLLERS, MODELS

SCENES = MODELS / "scenes"


@pytest.fixture(scope="module")
def tuning():
    return load_tuning(CONTROLLERS / "measured.toml")


@pytest.fixture(scope="module")
def lemniscate():
    return replace(load_scene(SCENES / "lemniscate.toml"), duration=1.4)


@pytest.fixture(scope="module")
def exact(lemniscate, tuning):
    """Of the lemniscate with sensors and motors as they should be."""
    return rms_mm(lemniscate, tuning)


def rms_mm(scene, tuning):
    run = simulate(scene, scene.make_plant(), make_controller(scene, tuning))
    assert run.summary()["failures"] == 0
    return run.summary()["rms_after_1s_mm"]


def test_observer_finds_velocity_and_force(pair, centre):
    """On the swinging nonlinear plant, from tip and angles alone."""
    force = np.array([0.5, -1.0])
    plant, model = Plant(pair, integrator="rk4", dt=1e-3), Plant(pair)
    x = np.concatenate([centre.p, [0.0, 0.0], centre.q])
    plant.reset(x, centre)
    model.reset(x, centre)
    observer = DisturbanceObserver(ObserverTuning(force_walk=0.1), 0.0, 0.0, linearise(model, x, [0, 0], 0.01))
    observer.start(x)
    for _ in range(100):
        observer.correct(x[:2], x[4:])
        here = linearise(model, observer.x, [0.3, -0.2], 0.01, observer.force)
        observer.predict(here, np.array([0.3, -0.2]))
        for _ in range(10):
            x = plant.step(x, [0.3, -0.2], force)
    assert np.linalg.norm(x[2:4]) > 0.01
    assert observer.x == pytest.approx(x, abs=2e-5)
    assert observer.force == pytest.approx(force, abs=0.01)


def test_gain_against_the_riccati_recursion(pair, centre):
    """The steady gain is where the covariance recursion of the filter settles."""
    plant = Plant(pair)
    x = np.concatenate([centre.p, [0.0, 0.0], centre.q])
    plant.reset(x, centre)
    model = linearise(plant, x, [0, 0], 0.01)
    tuning = ObserverTuning(2e-4, 0.03, 0.01)
    a = np.block([[model.A[:4, :4], model.E[:4]], [np.zeros((2, 4)), np.eye(2)]])
    b = np.block([[model.E[:4], np.zeros((4, 2))], [np.zeros((2, 2)), np.eye(2)]])
    noise = b @ np.diag([0.03**2] * 2 + [0.01**2] * 2) @ b.T
    covariance = 1e-3 * np.eye(6)
    for _ in range(3000):
        gain = covariance[:, :2] @ np.linalg.inv(covariance[:2, :2] + 4e-8 * np.eye(2))
        covariance = a @ (covariance - gain @ covariance[:2]) @ a.T + noise
    assert DisturbanceObserver(tuning, 0.0, 0.0, model).gain == pytest.approx(gain, rel=1e-6, abs=1e-6 * gain.max())


def test_no_offset_under_an_unknown_load(tuning):
    scene = replace(load_scene(SCENES / "hold_with_load.toml"), duration=1.5)
    blind = replace(tuning, observer=None)
    ends = []
    for one in (tuning, blind):
        run = simulate(scene, scene.make_plant(), make_controller(scene, one))
        ends.append(run.summary()["final_error_mm"])
    assert ends[0] < 1e-4
    assert ends[1] > 1.0


def test_unknown_load_on_the_lemniscate(lemniscate, tuning):
    scene = replace(lemniscate, force=(0.5, -1.0))
    assert rms_mm(scene, tuning) < 0.03
    assert rms_mm(scene, replace(tuning, observer=None)) > 3.0


@pytest.mark.parametrize("delay", [1, 3])
def test_delay_is_predicted(lemniscate, tuning, delay):
    scene = replace(lemniscate, delay=delay)
    assert rms_mm(scene, tuning) < 0.01


def test_delay_not_predicted(lemniscate, tuning):
    scene = replace(lemniscate, delay=1)
    frozen = load_tuning(CONTROLLERS / "frozen.toml")
    assert rms_mm(scene, replace(frozen, model=replace(frozen.model, predict_delay=False))) > 1.0


def test_encoder_steps_are_bridged_by_the_commands(lemniscate, tuning, exact):
    scene = replace(lemniscate, angle_step=2 * np.pi / 4096)
    assert rms_mm(scene, tuning) < 1.1 * exact
    assert rms_mm(scene, replace(tuning, observer=None)) > 2 * exact


def test_noise_is_filtered(lemniscate, tuning):
    """A filter that believes in perfect sensors lets the motors tremble."""
    scene = replace(lemniscate, tip_noise=1e-4)
    trembles = []
    for believed in (1e-4, 1e-7):
        controller = make_controller(
            replace(scene, tip_noise=believed), replace(tuning, observer=ObserverTuning(tip_noise=1e-7))
        )
        run = simulate(scene, scene.make_plant(), controller)
        trembles.append(np.diff(run.u[100:], axis=0).std())
    assert trembles[0] < 0.5 * trembles[1]


def test_all_at_once():
    scene = replace(load_scene(SCENES / "sensors.toml"), duration=1.5)
    assert rms_mm(scene, scene.tuning) < 0.2


@pytest.mark.parametrize("cost", [0.004, 0.008])
def test_late_decisions(lemniscate, tuning, exact, cost):
    """Every decision is 8 ms late, or within its deadline of 5 ms."""
    errors = []
    for late in ("hold", "shifted_plan"):
        scene = replace(lemniscate, deadline=0.005, late=late)
        run = simulate(scene, scene.make_plant(), make_controller(scene, tuning), spent=lambda k, _: cost)
        summary = run.summary()
        assert summary["deadline_misses"] == (scene.n_periods if cost > 0.005 else 0)
        errors.append(summary["rms_after_1s_mm"])
    if cost < 0.005:
        assert errors == [exact, exact]
    else:
        assert exact < errors[1] < 0.5 * errors[0]
