"""What the tests of loops on the fly share."""

import pytest

from pcr_mpc import load_scene, load_tuning, make_controller
from tests.conftest import CONTROLLERS
from tests.live.plant_loop import SCENE


@pytest.fixture(scope="module")
def scene():
    return load_scene(SCENE)


@pytest.fixture(scope="module")
def tuning():
    return load_tuning(CONTROLLERS / "lemniscate.toml")


@pytest.fixture(scope="module")
def live(scene):
    return make_controller(scene)
