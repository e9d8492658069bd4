"""Every file under models/ and controllers/ loads; a wrong one says what is wrong."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ModelError, load_robot, load_scene, load_tuning
from pcr_mpc.loop.references.trajectory import Hold, Lemniscate, PickAndPlace
from tests.conftest import CONTROLLERS, MODELS

ROBOTS = sorted(MODELS.glob("*.toml"))
SCENES = sorted((MODELS / "scenes").glob("*.toml"))
TUNINGS = sorted(CONTROLLERS.glob("*.toml"))


@pytest.mark.parametrize("path", ROBOTS, ids=lambda p: p.stem)
def test_robots_load(path):
    assert load_robot(path).name == path.stem


@pytest.mark.parametrize("path", SCENES, ids=lambda p: p.stem)
def test_scenes_load_and_start_in_balance(path):
    scene = load_scene(path)
    assert scene.name == path.stem
    pose = scene.start()
    assert pose.stable
    assert np.abs(pose.force - scene.robot.tip_weight).max() < 1e-7
    lower, upper = scene.robot.angle_limits.T
    assert (pose.q > lower).all()
    assert (pose.q < upper).all()


@pytest.mark.parametrize("path", TUNINGS, ids=lambda p: p.stem)
def test_tunings_load(path):
    assert load_tuning(path).name == path.stem


@pytest.mark.parametrize("path", ROBOTS, ids=lambda p: p.stem)
def test_every_number_of_a_robot_has_a_source(path):
    """A comment beside it, unless an earlier rod's same key has one."""
    explained = set()
    for line in path.read_text().splitlines():
        match = re.match(r"(\w+) = [\d\[-]", line)
        if match and "#" in line:
            explained.add(match[1])
        elif match:
            assert match[1] in explained, f"{path.name}: {line}"


@pytest.fixture
def files(tmp_path):
    shutil.copytree(MODELS, tmp_path / "models")
    shutil.copytree(CONTROLLERS, tmp_path / "controllers")
    return tmp_path


@pytest.mark.parametrize(
    ("file", "old", "new", "key", "message"),
    [
        ("models/planar_pair.toml", "drag =", "darg =", "darg", "did you mean 'drag'"),
        ("models/planar_pair.toml", "length = 0.4  ", "length = -1.0 ", "length", "is -1"),
        ("models/planar_pair.toml", "mass = 0.25", 'mass = "heavy"', "mass", "expected a number"),
        ("models/planar_pair.toml", "mass = 0.25", "mass = nan", "mass", "expected a number"),
        ("models/planar_pair.toml", "base = [-0.1, 0.0]", "base = [-0.1]", "base", "2 finite numbers"),
        (
            "models/planar_pair.toml",
            "angle_limits = [1.04, 5.24]",
            "angle_limits = [5.24, 1.04]",
            "angle_limits",
            "below",
        ),
        ("models/planar_pair.toml", 'name = "planar_pair"', "", "name", "missing"),
        ("models/scenes/lemniscate.toml", "period = 2.0", "priod = 2.0", "priod", "did you mean 'period'"),
        ("models/scenes/lemniscate.toml", "period = 0.01", "period = 0.0105", "period", "not a multiple"),
        ("models/scenes/lemniscate.toml", 'kind = "lemniscate"', 'kind = "ellipse"', "kind", "one of"),
        ("models/scenes/lemniscate.toml", "tip = [0.0, 0.25]", "tip = [0.0, 0.2]", "start.tip", "not where"),
        ("models/scenes/lemniscate.toml", "duration = 6.0 ", "duration = 6.0\nspeed = 1", "speed", "unknown key"),
        ("controllers/lemniscate.toml", "horizon = 6", "horizon = 0", "horizon", "integer >= 1"),
        ("controllers/lemniscate.toml", "input = 0.1", "inputs = 0.1", "inputs", "did you mean 'input'"),
    ],
)
def test_a_wrong_file_is_named_with_its_key(files, file, old, new, key, message):
    path = files / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ModelError, match=message) as caught:
        load_scene(files / "models/scenes/lemniscate.toml")
    assert caught.value.key == key
    assert str(path) in str(caught.value)


def test_a_tuning_without_a_period_has_the_scenes(files):
    """Not that of the tuning before."""
    path = files / "controllers/frozen.toml"
    path.write_text(path.read_text().replace('name = "frozen"', 'name = "frozen"\nperiod = 0.005'))
    scene = files / "models/scenes/lemniscate.toml"
    scene.write_text(re.sub(r"controllers/\w+\.toml", "controllers/frozen.toml", scene.read_text()))
    scene = load_scene(scene)
    default = load_tuning(files / "controllers/default.toml")
    assert scene.period == scene.tuned(replace(default, period=0.005)).period == 0.005
    assert scene.tuned(default).period == 0.01
    assert scene.tuned(default).tuned(scene.tuning) == scene


def test_broken_and_missing_files(tmp_path):
    (tmp_path / "path.csv").write_text("t_s,x_m,y_m\n0,0.1,0.2\n")
    with pytest.raises(ModelError, match=r"path\.csv: is a table, not a scene"):
        load_scene(tmp_path / "path.csv")
    with pytest.raises(ModelError, match="no such file"):
        load_robot(tmp_path / "none.toml")
    (tmp_path / "broken.toml").write_text("name = ")
    with pytest.raises(ModelError, match="Invalid value"):
        load_robot(tmp_path / "broken.toml")


def test_two_rods_on_one_motor_are_refused(files):
    path = files / "models/planar_pair.toml"
    path.write_text(path.read_text().replace("base = [0.1, 0.0]", "base = [-0.1, 0.0]"))
    with pytest.raises(ModelError, match="different bases"):
        load_robot(path)


@pytest.mark.parametrize(
    "trajectory",
    [
        Hold((0.1, 0.2)),
        Lemniscate((0.0, 0.25), (0.12, 0.06), 2.0, 1.0),
        PickAndPlace((-0.06, 0.22), (0.06, 0.22), 0.05, 0.2, 0.6),
    ],
)
def test_velocity_and_acceleration_are_derivatives(trajectory):
    t, h = np.linspace(0.0, 3.0, 301) + 1e-3, 1e-5
    samples, ahead, back = trajectory(t), trajectory(t + h), trajectory(t - h)
    assert (ahead[:, 0] - back[:, 0]) / (2 * h) == pytest.approx(samples[:, 1], abs=1e-6)
    # The jerk jumps where a quintic begins and ends; away from there the difference is exact.
    assert (ahead[:, 1] - back[:, 1]) / (2 * h) == pytest.approx(samples[:, 2], abs=5e-3)


def test_lemniscate_has_its_size_and_period():
    figure = load_scene(MODELS / "scenes/lemniscate.toml").trajectory
    p = figure(np.linspace(2.0, 4.0, 4001))[:, 0]
    assert np.ptp(p, axis=0) == pytest.approx([0.12, 0.06], rel=1e-5)
    assert p[0] == pytest.approx(p[-1])
    assert figure(np.zeros(1))[0, 1:] == pytest.approx(np.zeros((2, 2)))


def test_pick_and_place_rests_at_both_ends_and_peaks_as_stated():
    scene = load_scene(MODELS / "scenes/pick_and_place.toml")
    samples = scene.trajectory(np.linspace(0, scene.duration, 20001))
    assert samples[0, 0] == pytest.approx([-0.06, 0.22])
    assert samples[-1, 0] == pytest.approx([0.06, 0.22])
    assert samples[[0, -1], 1:] == pytest.approx(np.zeros((2, 2, 2)))
    assert samples[:, 0, 1].max() == pytest.approx(0.27)
    peak = np.hypot(*samples[:, 2].T).max()
    stated = re.search(r"peak acceleration .*?([\d.]+) m/s\^2", (MODELS / "README.md").read_text())
    assert peak == pytest.approx(float(stated[1]), abs=0.05)


def test_tunings_know_the_plants_methods():
    """The controller may not import the plant, so it spells the names out once more."""
    from pcr_mpc.control import tuning
    from pcr_mpc.plant.rods import equations as rod

    assert tuple(rod.SCHEMES) == tuning.SCHEMES
