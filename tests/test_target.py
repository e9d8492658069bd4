"""Where the motors must end up so that the rods carry an unknown force."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ConvergenceError, inverse_statics, load_scene, load_tuning, make_controller, simulate
from pcr_mpc.loop.feed_forward import feed_forward
from pcr_mpc.loop.target import MotorTarget

from .conftest import CONTROLLERS, MODELS

SCENES = MODELS / "scenes"


@pytest.fixture(scope="module")
def lemniscate():
    return replace(load_scene(SCENES / "lemniscate.toml"), duration=0.5)


@pytest.fixture(scope="module")
def reference(lemniscate):
    return feed_forward(lemniscate, lemniscate.robot, lemniscate.start(), 10)


@pytest.mark.parametrize("k", [0, 35])
def test_shift_carries_the_force(lemniscate, reference, k):
    """By Newton's method and, where it is small, to first order: against inverse statics, which knows neither."""
    robot, state, force = lemniscate.robot, reference.states[k], np.array([4e-4, -3e-4])
    target = MotorTarget(robot)
    target.start(inverse_statics(robot, state[:2], reference.forces[k], mode="LR"))
    wanted = inverse_statics(robot, state[:2], reference.forces[k] + force, mode="LR").q - state[4:]
    small = target.small_shift(state[:2], state[4:], reference.angles_per_force[k], force)
    assert np.abs(wanted).max() > 2e-5
    assert small == pytest.approx(wanted, abs=np.abs(wanted).max() ** 2)
    for _ in range(3):
        newton = target.shift(state[:2], state[4:], reference.forces[k] + force)
    assert newton == pytest.approx(wanted, abs=1e-12)


def test_large_shift_is_not_taken_to_first_order(lemniscate, reference):
    target, x = MotorTarget(lemniscate.robot), reference.states[0]
    for force in ([0.4, 0.0], [np.nan, 0.0]):
        assert target.small_shift(x[:2], x[4:], reference.angles_per_force[0], np.array(force)) is None


def test_statics_are_solved_for_the_target_only_where_the_shift_is_large(lemniscate, monkeypatch):
    """A controller whose model is right needs none; one under load does, or keeps an offset (see test_observer)."""
    calls = []
    newton = MotorTarget.shift

    def counting(self, *arguments):
        calls.append(1)
        return newton(self, *arguments)

    monkeypatch.setattr(MotorTarget, "shift", counting)
    tuning = load_tuning(CONTROLLERS / "default.toml")
    counts = []
    for force in ((0.0, 0.0), (0.5, -1.0)):
        calls.clear()
        scene = replace(lemniscate, force=force)
        simulate(scene, scene.make_plant(), make_controller(scene, tuning))
        counts.append(len(calls))
    assert counts[0] == 0
    assert counts[1] > 40


def test_inverse_dynamics_that_do_not_settle_are_refused(lemniscate, monkeypatch):
    monkeypatch.setattr("pcr_mpc.loop.feed_forward._MOST_SWEEPS", 1)
    with pytest.raises(ConvergenceError, match=r"did not settle.*slower reference") as caught:
        feed_forward(lemniscate, lemniscate.robot, lemniscate.start(), 10, "condensed")
    assert 1e-5 < caught.value.residual < 1e-1


def test_rods_are_brought_along_while_the_shift_is_small(lemniscate, reference):
    """Else a force that comes late would have to be carried from the start pose, far away, in one step."""
    target = MotorTarget(lemniscate.robot)
    target.start(lemniscate.start())
    before = target._plant.rungs["warm"]
    for k in range(50):
        x = reference.states[k]
        target.small_shift(x[:2], x[4:], reference.angles_per_force[k], np.zeros(2))
    assert target._plant.rungs["warm"] - before == 5
