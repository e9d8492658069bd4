"""Scenes whose closed loops no other test runs: kept short, with their own controllers."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import load_scene, make_controller, simulate
from tests.conftest import MODELS


@pytest.mark.parametrize(
    ("name", "duration", "moves_mm", "largest_mm"),
    [("hold_slow", 0.9, 1.0, 1e-3), ("near_straight", 0.4, 0.1, 6e-4), ("curved_rods", 0.4, 5.0, 8e-3)],
)
def test_the_tip_stays_with_its_reference(name, duration, moves_mm, largest_mm):
    scene = replace(load_scene(MODELS / "scenes" / f"{name}.toml"), duration=duration)
    run = simulate(scene, scene.make_plant(), make_controller(scene))
    summary = run.summary()
    assert (summary["failures"], summary["limit_violations"], summary["fallbacks"]) == (0, 0, 0)
    assert summary["control_rungs"] == {"solved": scene.n_periods}
    assert 1e3 * np.ptp(run.reference, axis=0).max() >= moves_mm
    assert summary["max_mm"] < largest_mm, summary["max_mm"]
