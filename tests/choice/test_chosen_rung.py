"""The chosen rung in scene files: written, known again, recorded by a run; what the shipped scenes carry."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ModelError, load_scene
from pcr_mpc.cli import main
from pcr_mpc.loop.run.finding import digest, verified
from pcr_mpc.study.choice.choice import choose
from pcr_mpc.study.choice.file import write_rung
from pcr_mpc.study.choice.rungs import ladders, levels
from tests.conftest import CONTROLLERS, MODELS

SCENES = MODELS / "scenes"
CHOSEN = {
    "hold_slow": {"inertia": "none"},
    "release": {"inertia": "condensed"},
    "heavy_rods": {"inertia": "condensed", "weight": "condensed"},
    "vertical": {"inertia": "none", "weight": "condensed"},
    "curved_rods": {"inertia": "none", "rods": "as_built"},
    "near_straight": {"inertia": "none", "weight": "exact", "rods": "as_built"},
    "payload": {"inertia": "constant", "payload": "carried"},
}


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """The release, cut short, with a need that is not a matter of this machine's speed."""
    folder = tmp_path_factory.mktemp("original")
    shutil.copytree(MODELS, folder / "models")
    shutil.copytree(CONTROLLERS, folder / "controllers")
    path = folder / "models/scenes/release.toml"
    text = path.read_text()
    for old, new in (("duration = 1.0", "duration = 0.2"), ("plant_step = 1000.0", "plant_step = 1e6")):
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def choice(original):
    return choose(load_scene(original))


@pytest.fixture
def file(original):
    """To be written into; afterwards it is as it was."""
    text = original.read_text()
    yield original
    original.write_text(text)


def test_the_chosen_rung_is_written_and_known_again(file, choice, capsys, monkeypatch):
    monkeypatch.setattr("pcr_mpc.cli.study.choose", lambda scene, *, progress: choice)
    assert not verified(load_scene(file))
    assert main(["choose", str(file), "--write"]) == 0
    assert "chosen: inertia condensed" in capsys.readouterr().out
    text, scene = file.read_text(), load_scene(file)
    assert replace(scene.plant, weight="none") == choice.chosen.rung
    assert scene.finding.tip_error == pytest.approx(choice.tip_error, rel=1e-2)
    assert verified(scene)
    assert text.count("[plant]") == text.count("[chosen]") == 1
    write_rung(choice, file)
    assert file.read_text() == text
    assert "# motors fixed" in text  # comments of other tables stay
    # What it rests on has changed:
    for changed in (replace(scene, duration=0.5), replace(scene, plant=replace(scene.plant, dt=2e-3)),
                    replace(scene, robot=replace(scene.robot, tip_mass=0.3)),
                    replace(scene, need=replace(scene.need, tip_accuracy=1e-9))):  # fmt: skip
        assert not verified(changed)
    assert digest(replace(scene, name="other")) == digest(scene)


def test_track_records_rung_and_need(file, choice, tmp_path, capsys):
    write_rung(choice, file)
    arguments = ["track", str(file), "--out", str(tmp_path / "out"), "--no-pictures"]
    assert main([*arguments, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["rung"]["inertia"] == "condensed"
    assert summary["need"]["verified"]
    assert summary["need"]["tip_error_mm"] <= summary["need"]["tip_accuracy_mm"] == 0.002
    assert summary["need"]["plant_step_met"]
    with np.load(tmp_path / "out/run.npz") as stored:
        assert json.loads(str(stored["rung"])) == summary["rung"]
        assert json.loads(str(stored["need"])) == summary["need"]
    assert main([*arguments, "--method", "multiple_shooting"]) == 0
    text = capsys.readouterr().out
    assert "rung        inertia condensed" in text
    assert "tip to 0.002 mm: not verified; see pcr-mpc choose" in text


def test_a_scene_file_without_plant_is_refused(tmp_path, choice):
    path = tmp_path / "scene.toml"
    path.write_text('name = "nothing"\n')
    with pytest.raises(ModelError, match=r"has no \[plant\] table"):
        write_rung(choice, path)
    assert path.read_text() == 'name = "nothing"\n'


def test_the_seven_scenes_carry_verified_rungs_of_their_own():
    rungs = {}
    for path in sorted(SCENES.glob("*.toml")):
        scene = load_scene(path)
        if scene.need is not None:
            assert verified(scene), f"{scene.name}: run pcr-mpc choose {path} --write"
            rungs[scene.name] = {
                name: level for name, level in levels(scene.plant).items() if len(ladders(scene)[name]) > 1
            }
    assert rungs == CHOSEN
    assert len({tuple(rung.items()) for rung in rungs.values()}) == 7


@pytest.mark.slow
@pytest.mark.longest
@pytest.mark.parametrize("name", CHOSEN)
def test_the_scenes_need_the_rungs_that_they_carry(name, monkeypatch):
    monkeypatch.setattr(
        "pcr_mpc.study.choice.choice.numbers_cost", lambda *_: None
    )  # tested elsewhere, and takes minutes if rods are shot
    scene = load_scene(SCENES / f"{name}.toml")
    found = choose(replace(scene, need=replace(scene.need, plant_step=1.0, control_step=10.0)))
    assert found.chosen.rung == replace(scene.plant, weight=scene.plant.weight or "none")
    assert found.tip_error == pytest.approx(scene.finding.tip_error, rel=0.05)
