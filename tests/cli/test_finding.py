"""What a command is given in the place of what it takes is named, with what may be meant."""

from pathlib import Path

import pytest

from pcr_mpc import shipped
from pcr_mpc.cli import main
from pcr_mpc.cli.track import _say_replaced


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Within a folder that has another one, as `new` makes it."""
    monkeypatch.chdir(tmp_path)
    assert main(["copy", "lemniscate", "mine"]) == 0
    return tmp_path / "mine"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["track", "mine"], "mine: is a folder, and track takes a scene; did you mean mine/scene.toml?"),
        (["check", "./mine"], "./mine: is a folder, and check takes a scene or a robot; did you mean mine/scene.toml?"),
        (["statics", "mine", "--q", "1", "2"],
         "mine: is a folder, and statics takes a robot; did you mean mine/robot.toml?"),
        (["track", "."], ".: is a folder, and track takes a scene"),
        (["track", "mine/robot.toml"],
         "mine/robot.toml: is a robot, and track takes a scene; did you mean mine/scene.toml?"),
        (["track", "mine/tuning.toml"],
         "mine/tuning.toml: is a tuning, and track takes a scene; did you mean mine/scene.toml?"),
        (["statics", "mine/scene.toml", "--q", "1", "2"],
         "mine/scene.toml: is a scene, and statics takes a robot; did you mean mine/robot.toml?"),
        (["track", "mine/scene.toml", "--controller", "mine/robot.toml"],
         "mine/robot.toml: is a robot, and track takes a tuning; did you mean mine/tuning.toml?"),
        (["track", "planar_pair"], "planar_pair is a robot, and track takes a scene; pcr-mpc models lists them"),
        (["replay", "nowhere"], "nowhere: no such file or folder"),
        (["replay", "nowhere/run.npz"], "nowhere/run.npz: no such file or folder"),
        (["new", ""], "an argument of new is empty; give a name"),
        (["new", "  "], "an argument of new is empty; give a name"),
        (["track", "lemniscate", "--out", ""], "--out is empty; give a name"),
        (["track", "lemniscate", "--out="], "--out is empty; give a name"),
    ],
)  # fmt: skip
def test_what_may_be_meant_is_named(mine, capsys, arguments, said):
    before = sorted(mine.parent.rglob("*"))
    capsys.readouterr()
    assert main(arguments) == 1
    assert capsys.readouterr().err == f"pcr-mpc: {said}\n"
    assert sorted(mine.parent.rglob("*")) == before


def test_a_name_is_that_of_the_package_though_a_folder_is_called_so(mine, tmp_path):
    from pcr_mpc.cli.finding import found

    (tmp_path / "limited").mkdir()
    assert found("limited", ("scene",), "track") == (shipped("limited"), True)


def test_a_run_of_another_scene_of_the_same_name_is_not_replaced_without_a_word(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "summary.json").write_text('{"scene_file": "a/scene.toml"}')
    for scene, said in (("b/scene.toml", True), ("a/scene.toml", False), (str(tmp_path / "a/scene.toml"), False)):
        _say_replaced(tmp_path, Path(scene))
        assert ("the run of a/scene.toml" in capsys.readouterr().err) == said
