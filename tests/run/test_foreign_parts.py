"""Plants and controllers of one's own: refused before the start, or the run until then is kept."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import SimulationError, load_scene, simulate
from pcr_mpc.loop.parts.controllers import Decision
from tests.conftest import MODELS


@pytest.fixture(scope="module")
def scene():
    return replace(load_scene(MODELS / "scenes" / "release.toml"), duration=0.05)


class Mine:
    name = "mine"

    def start(self, pose):
        pass

    def step(self, k, x):
        return Decision(np.zeros(2))


def changed(**attributes):
    kind = type("Mine", (Mine,), attributes)
    return kind()


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        (changed(start=None), "controller Mine has no method 'start'; see pcr_mpc.loop.parts.controllers.Controller"),
        (changed(name=3), "controller Mine has name = 3, expected a str"),
        (changed(step=lambda self, x: None), r"controller Mine: step\(x\) is called with 2 arguments"),
        (changed(start=lambda self: None), r"controller Mine: start\(\) is called with 1 arguments"),
        (changed(step=None), "controller Mine has no method 'step'"),
        (Mine, "controller is the class Mine, expected an object"),
        (None, "controller NoneType has no method 'start'"),
    ],
)
def test_a_controller_that_does_not_fit_is_named_before_the_start(scene, controller, message):
    plant = scene.make_plant()
    plant.step = plant.reset = lambda *_: pytest.fail("it was begun")
    with pytest.raises(ValueError, match=message):
        simulate(scene, plant, controller)


def test_a_plant_that_does_not_fit_is_named_before_the_start(scene):
    with pytest.raises(ValueError, match=r"plant Mine has no 'method'; see .*SimulatedPlant"):
        simulate(scene, Mine(), Mine())


class Failing(Mine):
    def __init__(self, how):
        self.how = how

    def step(self, k, x):
        return self.how(k) if k == 3 else super().step(k, x)


def throw(error):
    def how(k):
        raise error

    return how


@pytest.mark.parametrize(
    ("how", "message"),
    [
        (throw(AttributeError("no such thing")), "AttributeError: no such thing"),
        (throw(ValueError("bad")), "ValueError: bad"),
        (throw(MemoryError()), "MemoryError"),
        (throw(AssertionError()), "AssertionError"),
        (lambda k: sys.exit(3), "SystemExit: 3"),
        (throw(KeyboardInterrupt()), "interrupted"),
        (lambda k: None, "TypeError: the controller's step returned None, expected 2 motor rates or a Decision"),
        (lambda k: np.zeros(3), r"the controller's u has shape \(3,\), expected \(2,\)"),
        (lambda k: 0.0, r"the controller's u has shape \(\), expected \(2,\)"),
        (lambda k: "stop", "the controller's u is 'stop', expected numbers"),
        (lambda k: Decision(np.zeros(1)), r"the controller's u has shape \(1,\), expected \(2,\)"),
        (lambda k: Decision(np.full(2, np.nan)), "the controller's u is not finite"),
    ],
)
def test_whatever_a_controller_does_the_run_until_then_is_kept(scene, how, message):
    with pytest.raises(SimulationError, match=message) as caught:
        simulate(scene, scene.make_plant(), Failing(how))
    run = caught.value.run
    assert run.controller == "mine"
    assert len(run.u) == 3
    assert len(run.t) == 3 * run.steps_per_period + 1
    assert [event["kind"] for event in run.events] == ["failure"]
    assert run.summary()["failures"] == 1


def test_a_trajectory_of_ones_own_is_looked_at_before_the_start(scene):
    wrong = replace(scene, trajectory=lambda t: np.zeros((len(t), 2)))
    with pytest.raises(ValueError, match=r"what the scene's trajectory returns has shape \(\d+, 2\), expected"):
        simulate(wrong, scene.make_plant(), Mine())
