"""Scenes of plans, and the plan of one."""

from dataclasses import replace

import pytest

from pcr_mpc import (
    load_scene,
    plan_timing,
)
from tests.conftest import MODELS


@pytest.fixture(scope="module")
def scene():
    return load_scene(MODELS / "scenes" / "pick_and_place.toml")


@pytest.fixture(scope="module")
def points_scene():
    return load_scene(MODELS / "scenes" / "eight_points.toml")


@pytest.fixture(scope="module")
def planned(points_scene):
    return plan_timing(points_scene, cells=80)


@pytest.fixture(scope="module")
def light(scene):
    """The same robot with a tip of no weight: its motors stand as they do at rest, whatever the motion."""
    return replace(scene, robot=replace(scene.robot, tip_mass=1e-9, drag=0.0))
