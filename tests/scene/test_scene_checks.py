"""A scene from Python must keep what one from TOML must; names that become files must be names of files."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ModelError, load_robot, load_scene, load_tuning
from pcr_mpc.files import name_problem
from pcr_mpc.loop.references.trajectory import Hold, Lemniscate, PickAndPlace
from pcr_mpc.loop.scene.settings import Need, Payload
from pcr_mpc.study.episodes.spread import Spread
from pcr_mpc.study.tuning.space import Search, space
from tests.conftest import CONTROLLERS, MODELS

LEMNISCATE = MODELS / "scenes" / "lemniscate.toml"
NO_FILES = ["", " ", ".", "..", "../../evil", "a/b", "a\\b", "nul\0l", "a\nb", "x" * 300, "CON", "com1.txt", ".hidden",
            "end.", " padded", 'quo"te', "col:on", 7, None]  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    return load_scene(LEMNISCATE)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"duration": -1.0}, "duration: is -1, expected a finite number > 0"),
        ({"duration": math.nan}, "duration: expected a number, found nan"),
        ({"duration": math.inf}, "duration: is inf"),
        ({"duration": "6"}, "duration: expected a number"),
        ({"period": 0.0}, "period: is 0, expected a finite number > 0"),
        ({"period": -0.01}, "period: is -0.01"),
        ({"period": 0.0105}, "period is 0.0105 s, not a multiple of the plant's step 0.001 s"),
        ({"period": 5e-4}, "period is 0.0005 s, not a multiple"),
        ({"duration": 0.005}, "longer than the duration 0.005 s"),
        ({"duration": 2.0049}, "duration is 2.0049 s, which is no whole number .* of 0.01 s; take 2 or"),
        ({"tip_noise": -1e-3}, "tip_noise: is -0.001"),
        ({"angle_step": math.nan}, "angle_step: expected a number"),
        ({"angle_step": -1e-9}, "angle_step: is -1e-09, expected a finite number >= 0"),
        ({"delay": -1}, "delay is -1, expected a whole number"),
        ({"delay": 1.5}, "delay is 1.5"),
        ({"deadline": -1.0}, "deadline: is -1"),
        ({"deadline": 0.02}, r"deadline is 0\.02 s, longer than the control period 0\.01 s"),
        ({"deadline": math.nextafter(0.01, 1.0)}, r"deadline is 0\.010+2 s, longer"),
        ({"late": "never"}, "late is 'never', expected one of hold, shifted_plan"),
        ({"force": (1.0,)}, r"force has shape \(1,\), expected \(2,\)"),
        ({"start_velocity": (math.nan, 0.0)}, "start_velocity is not finite"),
        ({"start_motors": (1.0, 2.0)}, "give either start_tip and start_mode, or start_motors"),
        ({"start_tip": None}, "give either start_tip"),
        ({"start_mode": None}, "give either start_tip"),
        ({"start_tip": None, "start_mode": None, "start_motors": (1.0,)}, r"start_motors has shape \(1,\)"),
    ],
)  # fmt: skip
def test_a_scene_from_python_is_checked_by_name(scene, changed, message):
    with pytest.raises(ModelError, match=message):
        replace(scene, **changed)


def test_a_deadline_is_at_most_the_period_whatever_that_is(scene):
    late = replace(scene, deadline=0.01)
    assert (late.deadline, replace(scene, deadline=math.inf).deadline) == (0.01, math.inf)
    quick = replace(scene.tuning, period=0.005)
    assert scene.tuned(quick).period == 0.005
    with pytest.raises(ModelError, match=r"deadline is 0\.01 s, longer than the control period 0\.005 s") as caught:
        late.tuned(quick)
    assert caught.value.key == "deadline"
    slow = replace(scene.tuning, period=0.02)
    assert replace(scene.tuned(slow), deadline=0.02).deadline == 0.02


def test_what_means_the_same_is_taken(scene):
    same = replace(scene, duration=np.float64(6), start_tip=np.array([0.0, 0.25]), start_velocity=[0, 0], period=0.01)
    assert same == scene
    assert replace(scene, duration=3 * 0.1).n_periods == 30


@pytest.mark.parametrize(
    "make",
    [
        lambda: Payload(-0.1, 0.0, 1.0),
        lambda: Payload(0.1, 1.0, 1.0),
        lambda: Need(0.0, 1.0, 1.0),
        lambda: Hold((0.0, math.nan)),
        lambda: Lemniscate((0.0, 0.25), (0.1, 0.1), 0.0, 1.0),
        lambda: Lemniscate((0.0, 0.25), (0.1, 0.1), 1.0, -1.0),
        lambda: PickAndPlace((0.0, 0.25), (0.0, 0.2), 0.0, 0.0, 0.0),
        lambda: PickAndPlace((0.0, 0.25), (0.0, 0.2, 1.0), 0.0, 0.0, 1.0),
    ],
)
def test_parts_of_a_scene_are_checked_too(make):
    with pytest.raises(ModelError):
        make()


def test_a_duration_that_is_cut_is_said_with_the_file(tmp_path):
    path = tmp_path / "scene.toml"
    text = LEMNISCATE.read_text().replace('"../', f'"{MODELS}/').replace("duration = 6.0 ", "duration = 2.0049 ")
    path.write_text(text.replace(f'"{MODELS}/../', f'"{MODELS.parent}/'))
    with pytest.raises(ModelError, match=r"scene\.toml: duration is 2\.0049 s") as caught:
        load_scene(path)
    assert caught.value.key == "duration"
    with pytest.raises(ModelError, match=r"period 0\.02 s does not fit .* duration 0\.05 s a multiple of it"):
        replace(load_scene(LEMNISCATE), duration=0.05).tuned(
            replace(load_tuning(CONTROLLERS / "default.toml"), period=0.02)
        )


def test_a_search_leaves_out_periods_that_do_not_divide_the_duration(scene):
    tuned = scene.tuned(load_tuning(CONTROLLERS / "default.toml"))
    for duration, periods in ((0.1, (0.005, 0.01, 0.02)), (0.05, (0.005, 0.01))):
        search = Search(replace(tuned, duration=duration), Spread(), 1, 0, "sqlite://")
        assert tuple(space(search)["period"].choices) == periods


@pytest.mark.parametrize("name", NO_FILES)
def test_names_that_are_no_names_of_files_are_refused(scene, name):
    assert name_problem(name)
    for one in (scene, scene.robot, scene.tuning):
        with pytest.raises(ModelError, match="name: ") as caught:
            replace(one, name=name)
        assert caught.value.key == "name"


@pytest.mark.parametrize("name", ["lemniscate", "lemniscate in 1 s", "größer", "v1.2", "a-b_c", "été 2"])
def test_names_of_files_are_taken(scene, name):
    assert name_problem(name) is None
    assert replace(scene, name=name).name == name


@pytest.mark.parametrize(
    ("load", "source"),
    [
        (load_scene, LEMNISCATE),
        (load_robot, MODELS / "planar_pair.toml"),
        (load_tuning, CONTROLLERS / "default.toml"),
    ],
)
@pytest.mark.parametrize("name", ["../../evil", ""])
def test_such_a_name_is_refused_with_its_file(tmp_path, load, source, name):
    path = tmp_path / "one.toml"
    text = source.read_text().replace('"../../', f'"{MODELS.parent}/').replace('"../', f'"{MODELS}/')
    path.write_text(text.replace(f'name = "{source.stem}"', f'name = "{name}"'))
    with pytest.raises(ModelError, match=r"one\.toml: name: ") as caught:
        load(path)
    assert caught.value.key == "name"
