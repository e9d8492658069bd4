"""Motions worth recording: their derivatives, their limits, and what they promise."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import load_scene
from pcr_mpc.cli import main
from pcr_mpc.loop.demand.feed_forward import feed_forward
from pcr_mpc.loop.references.path_file import load_path
from pcr_mpc.study.excitation.design import MultiSine, excite, expected
from pcr_mpc.study.identification.problem import Noise
from tests.conftest import MODELS

SCENE = MODELS / "scenes" / "lemniscate.toml"


def test_derivatives_of_a_multi_sine():
    rng = np.random.default_rng(0)
    motion = MultiSine(np.array([0.1, 0.2]), 3.0, 0.5, np.array([3.0, 8.0]), *rng.normal(0.0, 0.02, (2, 2, 2)))
    t, h = np.linspace(0.01, 2.99, 97), 1e-4
    samples, ahead, behind = motion(t), motion(t + h), motion(t - h)
    for order in range(2):
        slope = (ahead[:, order] - behind[:, order]) / (2 * h)
        assert samples[:, order + 1] == pytest.approx(slope, abs=1e-5)
    ends = motion(np.array([0.0, 3.0]))
    assert ends[:, 0] == pytest.approx(np.array([[0.1, 0.2]] * 2), abs=1e-15)
    assert ends[:, 1:] == pytest.approx(np.zeros((2, 2, 2)), abs=1e-12)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("excite")
    assert main(["excite", str(SCENE), "--duration", "1.0", "--trials", "2", "--out", str(folder), "--json"]) == 0
    return folder, json.loads((folder / "excitation.json").read_text())


def test_what_is_written_can_be_tracked_within_the_limits(written):
    folder, record = written
    scene = load_scene(folder / "excited.toml")
    assert scene.duration == 1.0
    path = load_path(folder / "excited.csv")
    reference = feed_forward(scene, scene.robot, scene.start(), 0)
    assert reference.states[::10, :2] == pytest.approx(path(np.arange(0.0, 1.05, 0.1))[:, 0], abs=1e-12)
    rates = np.abs(reference.inputs).max() / scene.robot.rate_limit
    changes = np.abs(np.diff(reference.inputs, axis=0)).max() / scene.period / scene.robot.acceleration_limit
    assert rates == pytest.approx(0.6 * record["limits_used"]["rate"], rel=0.02)
    assert changes <= 0.6 * 1.02
    assert max(rates, changes) > 0.2
    assert max(record["limits_used"].values()) <= 1.0


def test_the_rods_are_not_strained_beyond_their_limit():
    scene = load_scene(SCENE)
    at_rest = scene.start().max_strain.max()
    rods = tuple(replace(rod, strain_limit=1.2 * at_rest) for rod in scene.robot.rods)
    scene = replace(scene, robot=replace(scene.robot, rods=rods))
    found = excite(scene, 1.0, trials=1).best
    asked = replace(scene, duration=1.0, trajectory=found.trajectory)
    most = feed_forward(asked, asked.robot, asked.start(), 0).strains.max()
    assert at_rest < most <= (1 + 0.6 * 0.2) * at_rest
    assert found.use["strain"] <= 1.0


@pytest.mark.slow
def test_it_promises_more_than_the_lemniscate():
    found = excite(load_scene(SCENE), 4.0, trials=6)
    assert found.best.worst <= 0.5 * found.beside.worst


def test_the_worst_is_the_worst(written):
    _, record = written
    for one in record["expected_sd"].values():
        assert 0.0 < one["excited_over_believed"] <= 1.0 + 1e-9
    assert record["worst"] == max(one["excited_over_believed"] for one in record["expected_sd"].values())


def test_twice_the_noise_is_twice_the_deviation():
    scene = replace(load_scene(SCENE), duration=1.2)
    few = [expected(scene, "eight", scene.trajectory, Noise(k * 1e-6, k * 1e-5)) for k in (1.0, 2.0)]
    for name, sd in few[0].sd.items():
        assert few[1].sd[name] == pytest.approx(2.0 * sd, rel=0.01), name


def test_a_duration_that_does_not_fit():
    with pytest.raises(ValueError, match=r"whole number of control periods|duration"):
        excite(load_scene(SCENE), 1.0037, trials=1)
