"""Scenes with paths of every kind, in closed loop."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import load_scene, make_controller, simulate
from tests.conftest import MODELS

# Largest RMS error after 1 s [mm], which the pages state.
SCENES = {"circle_from_file": 2e-4, "square": 3e-3, "hand_drawn": 2e-4, "waypoints": 2e-4}


def run_of(name, duration=None):
    scene = load_scene(MODELS / "scenes" / f"{name}.toml")
    scene = replace(scene, duration=duration or scene.duration)
    return simulate(scene, scene.make_plant(), make_controller(scene))


@pytest.mark.parametrize("name", ["circle_from_file", "square"])
def test_the_tip_follows_from_rest(name):
    run = run_of(name, 0.5)
    summary = run.summary()
    assert (summary["verdict"], summary["limit_violations"], summary["fallbacks"]) == ("", 0, 0)
    assert 1e3 * np.ptp(run.reference, axis=0).max() > 5.0
    assert summary["max_mm"] < 4 * SCENES[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_the_whole_path_is_followed(name):
    run = run_of(name)
    summary = run.summary()
    assert (summary["verdict"], summary["limit_violations"], summary["fallbacks"]) == ("", 0, 0)
    assert not any(summary["pose_violations"].values())
    assert summary["rms_after_1s_mm"] < SCENES[name]
    assert summary["final_error_mm"] < SCENES[name]
    assert run.scene.trajectory.duration <= run.t[-1]
