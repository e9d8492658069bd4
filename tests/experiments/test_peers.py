"""Controllers of others agree with this project's on the same problem."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import InfeasibleError, Plant, load_scene
from pcr_mpc.loop.controller.tracking import TrackingController
from pcr_mpc.loop.parts.assembled import motor_limits
from tests.conftest import MODELS

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # do-mpc says which of its optional features are not installed
    pytest.importorskip("do_mpc")

from experiments.peers.do_mpc_controller import DoMPC


@pytest.fixture(scope="module")
def scene():
    scene = load_scene(MODELS / "scenes" / "limited.toml")
    return replace(
        scene, tuning=replace(scene.tuning, horizon=8, observer=None, law="nonlinear_mpc", input_weight=1e-3)
    )


def test_do_mpc_decides_as_the_nonlinear_mpc(scene):
    """From the start into the rate limit, from states off the reference: two transcriptions, the same inputs."""
    pose = scene.start()
    theirs, ours = DoMPC(scene, scene.tuning), TrackingController(scene, scene.tuning)
    theirs.start(pose)
    ours.start(pose)
    plant = Plant(scene.robot, integrator="rk4", dt=1e-3)
    x = np.concatenate([pose.p + [0.003, -0.002], [0.1, 0.0], pose.q])
    plant.reset(x, pose)
    limits = motor_limits(scene.robot, scene.period)
    fastest, largest_change, last = 0.0, 0.0, np.zeros(2)
    for k in range(12):
        u = theirs.step(k, x).u
        assert ours.step(k, x).u == pytest.approx(u, abs=2e-5)
        fastest, largest_change = max(fastest, np.abs(u).max()), max(largest_change, np.abs(u - last).max())
        for _ in range(10):
            x = plant.step(x, u)
        last = u
    assert fastest == pytest.approx(limits.rate, abs=1e-6)
    assert largest_change == pytest.approx(limits.rate_change, abs=1e-6)
    assert len(theirs.iterations) == len(theirs.solve_times) == 12


def test_do_mpc_failing_is_an_error(scene):
    controller = DoMPC(scene, scene.tuning)
    controller.start(scene.start())
    x = np.array([0.0, 0.25, 0.0, 0.0, 9.0, 9.0])  # far beyond the stops
    with pytest.raises(InfeasibleError, match="was not solved in period 3"):
        controller.step(3, x)


def test_crocoddyl_decides_as_the_nonlinear_mpc(scene):
    """Without limits that it does not know: DDP on the plant itself, the same inputs."""
    pytest.importorskip("crocoddyl")
    from experiments.peers.crocoddyl_controller import Crocoddyl

    pose = scene.start()
    theirs, ours = Crocoddyl(scene, scene.tuning), TrackingController(scene, scene.tuning)
    theirs.start(pose)
    ours.start(pose)
    plant = Plant(scene.robot, integrator="rk4", dt=1e-3)
    x = np.concatenate([pose.p + [2e-4, -1e-4], [0.0, 0.0], pose.q])
    plant.reset(x, pose)
    fastest = 0.0
    for k in range(12):
        u = theirs.step(k, x).u
        assert ours.step(k, x).u == pytest.approx(u, abs=2e-3)
        fastest = max(fastest, np.abs(u).max())
        for _ in range(10):
            x = plant.step(x, u)
    assert fastest > 0.1
    assert len(theirs.iterations) == 12
