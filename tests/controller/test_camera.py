"""Tips that are measured late, rarely, and sometimes not at all."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import LinearModel, ModelError, load_scene, load_tuning, make_controller, simulate
from pcr_mpc.loop.hardware.camera import Camera
from pcr_mpc.loop.hardware.past import PastEstimates
from pcr_mpc.loop.parts.controllers import Replay
from pcr_mpc.loop.run.record import from_text, to_text
from tests.conftest import CONTROLLERS, MODELS

from .test_gate import Spoilt, apart_mm, at

LATE = 0.02


@pytest.fixture(scope="module")
def scene():
    scene = replace(load_scene(MODELS / "scenes" / "lemniscate.toml"), duration=1.2)
    tuning = load_tuning(CONTROLLERS / "default.toml")
    scene = scene.tuned(replace(tuning, horizon=6, input_weight=0.1))
    return replace(scene, plant=replace(scene.plant, integrator="velocity_verlet"))


def tracked(scene, camera, latency=0.0, spoil=lambda k, x: None, seed=0):
    tuning = replace(scene.tuning, observer=replace(scene.tuning.observer, latency=latency))
    scene = replace(scene.tuned(tuning), camera=camera)
    return simulate(scene, scene.make_plant(), Spoilt(make_controller(scene), spoil), seed)


def worst_mm(run):
    return 1e3 * float(run.error.max())


@pytest.mark.parametrize("latency", [0.02, 0.0135])
def test_a_picture_shows_the_past_and_comes_when_it_is_due(scene, latency):
    scene = replace(scene, duration=0.3, camera=Camera(latency, every=3))
    run = simulate(scene, scene.make_plant(), Replay(np.full((30, 2), [1.0, -0.5])))
    seen = np.isfinite(run.measured[:, 0])
    assert np.flatnonzero(seen).tolist() == list(range(0, 30, 3))
    times = np.maximum(0.01 * np.arange(0, 30, 3) - latency, 0.0)
    for i in range(2):
        assert run.measured[seen, i] == pytest.approx(np.interp(times, run.t, run.x[:, i]), abs=1e-12)
    assert run.measured[:, 4:] == pytest.approx(run.x[:-1:10, 4:])


def test_a_share_of_pictures_is_lost_and_which_the_seed_says(scene):
    scene = replace(scene, camera=Camera(lost=0.25))
    lost = [np.isnan(simulate(scene, scene.make_plant(), Replay(np.zeros((120, 2))), seed).measured[:, 0])
            for seed in (1, 1, 2)]  # fmt: skip
    assert lost[0].tolist() == lost[1].tolist() != lost[2].tolist()
    assert 0.1 < lost[0].mean() < 0.4


def test_corrections_of_the_past_are_those_of_a_filter_that_begins_again():
    """Against a filter that goes back and repeats all its steps with what has arrived since."""
    rng, age, count = np.random.default_rng(0), 3, 12
    models = [LinearModel(np.eye(6) + 0.1 * rng.normal(size=(6, 6)), rng.normal(size=(6, 2)), rng.normal(size=6),
                          0.1 * rng.normal(size=(6, 2)), 0.01, np.zeros(2)) for _ in range(count)]  # fmt: skip
    gain, tips = rng.normal(scale=0.1, size=(6, 2)), rng.normal(size=(count, 2))
    inputs, angles = rng.normal(size=(count, 2)), np.zeros(2)

    def moved(k, z):
        x = models[k](np.concatenate([z[:4], angles]), inputs[k]) + models[k].E @ z[4:]
        return np.concatenate([x[:4], z[4:]])

    past, z = PastEstimates(age, 0.01), np.zeros(6)
    for k in range(count):
        if k >= age and k % 2 == 0:
            z = z + past.correct(gain @ (tips[k - age] - past.tip(z)))
        again = np.zeros(6)  # all that has arrived by now, each where it belongs
        for j in range(k):
            if j + age <= k and (j + age) % 2 == 0:
                again = again + gain @ (tips[j] - again[:2])
            again = moved(j, again)
        assert z == pytest.approx(again, abs=1e-9)
        past.remember(np.concatenate([z[:4], angles, z[4:]]), models[k])
        z = moved(k, z)


def test_a_latency_that_is_known_costs_next_to_nothing(scene):
    untold, told = (tracked(scene, Camera(LATE), latency) for latency in (0.0, LATE))
    assert worst_mm(told) < 0.02
    assert worst_mm(untold) > 1.0
    assert worst_mm(tracked(scene, Camera(0.0135), 0.0135)) < 0.02


def test_rare_and_lost_pictures_are_bridged(scene):
    """Every third period; that there is none in between is no news, one that is lost is."""
    run = tracked(replace(scene, force=(0.2, -0.2)), Camera(LATE, every=3), LATE)
    assert worst_mm(run) < 6.0
    assert 1e3 * run.error[-200:].max() < 0.5
    assert not run.events
    run = tracked(scene, Camera(LATE, every=3, lost=0.3), LATE)
    lost = np.isnan(run.measured[::3, 0]).sum()
    assert lost > 5
    assert worst_mm(run) < 0.05
    assert {event["kind"] for event in run.events} == {"measurement"}
    assert len(run.events) >= lost


@pytest.mark.parametrize(("latency", "every"), [(0.0, 1), (LATE, 2)])
def test_outliers_are_bridged(scene, latency, every):
    """1 m and 10 cm, in one sample each."""
    camera, spoils = Camera(latency, every), at({40: (0, 1.0), 60: (1, 0.1)})
    good, bad = (tracked(scene, camera, latency, spoil) for spoil in (at({}), spoils))
    assert apart_mm(good, bad) < 0.1
    assert [round(event["t"] / 0.01) for event in bad.events if event["kind"] == "measurement"] == [40, 60]


def test_a_camera_that_insists_is_believed_again(scene):
    """It was knocked: everything is 12 mm to the right from then on."""

    def knocked(k, x):
        x[0] += 0.012 * (k >= 20)

    run = tracked(scene, Camera(LATE, every=2), LATE, knocked)
    told = [event for event in run.events if event["kind"] == "reinitialised"]
    assert len(told) == 1
    assert "30 times in a row" in told[0]["message"]
    assert told[0]["t"] == pytest.approx(0.2 + 0.02 * 29)
    assert run.summary()["failures"] == 0


def test_a_scene_has_a_camera_and_refuses_wrong_ones(tmp_path):
    scene = load_scene(MODELS / "scenes" / "servo.toml")
    assert scene.camera == Camera(0.02, 2)
    assert from_text(to_text(scene)) == scene
    for wrong, key in (({"latency": -1.0}, "latency"), ({"every": 0}, "every"), ({"lost": 1.0}, "lost")):
        with pytest.raises(ModelError, match=key):
            Camera(**wrong)
    text = (MODELS / "scenes" / "servo.toml").read_text().replace("../planar", str(MODELS / "planar"))
    path = tmp_path / "scene.toml"
    path.write_text(text.replace("../../controllers", str(CONTROLLERS)).replace("every = 2", "every = 0"))
    with pytest.raises(ModelError, match="every"):
        load_scene(path)


@pytest.mark.slow
def test_lag_and_latency_that_are_known_cost_little():
    """All of it at once, and an unknown load; the noise of a picture is 0.05 mm."""
    scene = load_scene(MODELS / "scenes" / "servo.toml")
    summary = simulate(scene, scene.make_plant(), make_controller(scene)).summary()
    assert summary["rms_after_1s_mm"] < 0.15
    assert (summary["verdict"], summary["failures"], summary["limit_violations"]) == ("", 0, 0)
