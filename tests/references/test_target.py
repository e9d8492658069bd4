"""Where the motors must end up so that the rods carry an unknown force."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ConvergenceError, inverse_statics, load_scene
from pcr_mpc.loop.demand.feed_forward import feed_forward
from pcr_mpc.loop.parts.target import MotorTarget
from tests.conftest import MODELS

SCENES = MODELS / "scenes"


@pytest.fixture(scope="module")
def lemniscate():
    return replace(load_scene(SCENES / "lemniscate.toml"), duration=0.5)


@pytest.fixture(scope="module")
def reference(lemniscate):
    return feed_forward(lemniscate, lemniscate.robot, lemniscate.start(), 10)


@pytest.mark.parametrize("k", [0, 35])
def test_shift_carries_the_force(lemniscate, reference, k):
    """By Newton's method and by the reference's levers: against inverse statics, which knows neither."""
    robot, state, force = lemniscate.robot, reference.states[k], np.array([4e-4, -3e-4])
    target = MotorTarget(robot)
    target.start(inverse_statics(robot, state[:2], reference.forces[k], mode="LR"))
    wanted = inverse_statics(robot, state[:2], reference.forces[k] + force, mode="LR").q - state[4:]
    small = reference.angles_per_force[k] @ force
    assert np.abs(wanted).max() > 2e-5
    assert small == pytest.approx(wanted, abs=np.abs(wanted).max() ** 2)
    for _ in range(3):
        newton = target.shift(state[:2], state[4:], reference.forces[k] + force)
    assert newton == pytest.approx(wanted, abs=1e-12)


def test_inverse_dynamics_that_do_not_settle_are_refused(lemniscate, monkeypatch):
    monkeypatch.setattr("pcr_mpc.loop.demand.feed_forward._MOST_SWEEPS", 1)
    with pytest.raises(ConvergenceError, match=r"did not settle.*slower reference") as caught:
        feed_forward(lemniscate, lemniscate.robot, lemniscate.start(), 10, "condensed")
    assert 1e-5 < caught.value.residual < 1e-1
