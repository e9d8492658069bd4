"""The comparison with mujoco.sysid: what it simulates is the robot that was run."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import load_scene
from pcr_mpc.plant.mujoco.plant import MuJoCoPlant
from pcr_mpc.study.episodes.episodes import Spread, lighter

pytest.importorskip("mujoco")
from experiments.control.identification import DEFAULT_SCENE, drive, reality
from experiments.peers import mujoco_sysid


def test_the_simulation_that_is_fitted_is_the_one_that_ran(monkeypatch):
    """With the true numbers it ends where MuJoCo did with a fifth of its step; with others elsewhere."""
    monkeypatch.setattr("experiments.control.identification.LINKS", 12)
    monkeypatch.setattr(mujoco_sysid, "LINKS", 12)
    scene = lighter(replace(load_scene(DEFAULT_SCENE), duration=0.4))
    true = reality(scene, 1, Spread())
    run = drive(scene, true, "mujoco", scene.robot, scene.delay, 1)
    assert run.plant.startswith(MuJoCoPlant(true.robot, links=12).method)
    wanted = run.x[:: run.steps_per_period, :2][: len(run.u)]
    found = mujoco_sysid.tips(run, true.robot, true.force)
    assert np.abs(found - wanted).max() < 5e-5
    assert np.abs(mujoco_sysid.tips(run, scene.robot, true.force) - wanted).max() > 5e-4
