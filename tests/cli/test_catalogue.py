"""What travels with the package is found by name, copied and left as it came."""

import json
import re
import tomllib
from dataclasses import replace

import pytest

from pcr_mpc import ModelError, PCRError, catalogue, load_robot, load_scene, load_tuning, shipped
from pcr_mpc.catalogue import KINDS, description, is_name, names_of
from pcr_mpc.cli import main
from tests.conftest import CONTROLLERS, MODELS, ROOT

FOLDERS = {"scene": MODELS / "scenes", "robot": MODELS, "tuning": CONTROLLERS}
SCENES = sorted(path.stem for path in FOLDERS["scene"].glob("*.toml"))


def test_everything_in_the_folders_has_a_name():
    for kind, folder in FOLDERS.items():
        assert {shipped(name, kind) for name in names_of(kind)} == set(folder.glob("*.toml"))


def test_the_wheel_has_what_the_clone_has():
    """Where the wheel puts the folders is where the package looks first."""
    included = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert included["force-include"] == {name: f"pcr_mpc/data/{name}" for name in ("models", "controllers")}


def test_a_package_with_data_looks_there(tmp_path, monkeypatch):
    (tmp_path / "pcr_mpc/data/models/scenes").mkdir(parents=True)
    (tmp_path / "pcr_mpc/data/models/scenes/own.toml").write_text('name = "own"\n')
    monkeypatch.setattr(catalogue, "__file__", str(tmp_path / "pcr_mpc/catalogue.py"))
    assert names_of("scene") == ["own"]


def test_a_name_that_is_not_there_is_answered_with_the_nearest():
    with pytest.raises(ModelError, match=r"no scene named 'lemniscat' comes with the package; did you mean 'lemnisc"):
        shipped("lemniscat")
    with pytest.raises(ModelError, match="no tuning named 'zzz' comes with the package; there are default, frozen"):
        shipped("zzz", "tuning")
    with pytest.raises(ValueError, match="kind is 'scenes', expected one of scene, robot, tuning"):
        shipped("lemniscate", "scenes")


@pytest.mark.parametrize("text", ["a/b", "./a", "a.toml", "", ".", "..", "a/"])
def test_a_path_is_no_name(text):
    assert not is_name(text)


def test_a_missing_file_that_comes_with_the_package_is_pointed_out():
    with pytest.raises(ModelError, match=r"no such file; a scene and a tuning of that .* shipped\(\"lemniscate\""):
        load_scene("nowhere/lemniscate.toml")
    with pytest.raises(ModelError, match=r"no such file$"):
        load_scene("nowhere/mine.toml")


def test_first_sentences():
    assert description(shipped("release")).endswith(
        "Fig. 3: the tip is let go with a velocity while the motors stand still"
    )
    assert all(len(description(shipped(name, kind))) > 15 for kind in KINDS for name in names_of(kind))


def test_models_lists_all_of_it(capsys):
    assert main(["models"]) == 0
    text = capsys.readouterr().out
    assert re.search(r"^  limited +The lemniscate with motors too slow", text, re.MULTILINE)
    assert main(["models", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert {kind: [row["name"] for row in record[f"{kind}s"]] for kind in KINDS} == {k: names_of(k) for k in KINDS}


@pytest.mark.parametrize("name", SCENES)
def test_a_copied_scene_is_the_same_scene(name, tmp_path, capsys):
    assert main(["copy", name, str(tmp_path / "deep/mine")]) == 0
    captured = capsys.readouterr()
    assert "pcr-mpc check" in captured.err
    copied = load_scene(tmp_path / "deep/mine/scene.toml")
    assert copied == load_scene(shipped(name))
    assert "../" not in (tmp_path / "deep/mine/scene.toml").read_text()


def test_robots_and_tunings_are_copied_too(tmp_path, capsys):
    assert main(["copy", "rfrfr", str(tmp_path), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["files"] == {"robot.toml": str(tmp_path / "robot.toml")}
    assert load_robot(tmp_path / "robot.toml") == load_robot(MODELS / "rfrfr.toml")
    assert main(["copy", "lemniscate", str(tmp_path), "--kind", "tuning"]) == 0
    assert load_tuning(tmp_path / "tuning.toml") == load_tuning(CONTROLLERS / "lemniscate.toml")


def test_a_copy_overwrites_nothing(tmp_path, capsys):
    (tmp_path / "tuning.toml").write_text("mine")
    assert main(["copy", "lemniscate", str(tmp_path)]) == 1
    assert "tuning.toml: is there already; give another folder, or --force" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["tuning.toml"]
    assert main(["copy", "lemniscate", str(tmp_path), "--force"]) == 0
    assert load_tuning(tmp_path / "tuning.toml").name == "lemniscate"
    capsys.readouterr()
    assert main(["copy", "lemniscate", str(tmp_path / "a copy")]) == 0
    scene = str(tmp_path / "a copy" / "scene.toml")
    assert capsys.readouterr().err == f"next: pcr-mpc check '{scene}', pcr-mpc track '{scene}'\n"


def test_commands_take_names(tmp_path, capsys, monkeypatch):
    """Also where a folder of that name stands; and a file of another name, without suffix, is still a file."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "planar_pair").mkdir()
    where = ["--p", "0", "0.25", "--mode", "LR", "--json"]
    assert main(["statics", "planar_pair", *where]) == 0
    named = json.loads(capsys.readouterr().out)
    (tmp_path / "mine").write_bytes((MODELS / "planar_pair.toml").read_bytes())
    assert main(["statics", "mine", *where]) == 0
    assert json.loads(capsys.readouterr().out) == named
    assert main(["statics", "planar_pear", *where]) == 1
    assert "did you mean 'planar_pair'?" in capsys.readouterr().err


def test_track_takes_names_of_scene_and_tuning(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    seen = []

    def simulate(scene, *_, **__):
        seen.append(scene)
        raise PCRError("enough")

    monkeypatch.setattr("pcr_mpc.cli.track.simulate", simulate)
    assert main(["track", "hold_slow", "--controller", "lqr"]) == 1
    assert "enough" in capsys.readouterr().err
    assert seen == [replace(load_scene(MODELS / "scenes/hold_slow.toml"), tuning=load_tuning(CONTROLLERS / "lqr.toml"))]


def test_what_comes_with_the_package_is_left_as_it_came(capsys):
    before = shipped("vertical").read_bytes()
    assert main(["choose", "vertical", "--write"]) == 1
    assert "pcr-mpc copy vertical FOLDER first" in capsys.readouterr().err
    assert shipped("vertical").read_bytes() == before


def test_a_tuning_of_a_named_scene_is_written_here(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    wanted = []
    monkeypatch.setattr("pcr_mpc.cli.study.require_free", lambda path, force: wanted.append(str(path)))

    def refuse(*_, **__):
        raise PCRError("enough")

    monkeypatch.setattr("pcr_mpc.cli.study.require_folder", refuse)
    assert main(["tune", "pick_and_place"]) == 1
    assert main(["tune", str(shipped("pick_and_place"))]) == 1
    assert wanted == ["pick_and_place.toml", str(CONTROLLERS / "pick_and_place.toml")]
