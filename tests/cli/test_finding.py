"""What a command is given in the place of what it takes is named, with what may be meant."""

import os
from argparse import Namespace
from pathlib import Path

import pytest

from pcr_mpc import shipped
from pcr_mpc.cli import main
from pcr_mpc.cli.places import own_place, remember
from pcr_mpc.errors import ModelError


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
    for scene, said in (
        ("a/scene.toml", False), ("b/scene.toml", True), ("b/scene.toml", False),
        (str(tmp_path / "b/scene.toml"), False), ("a/scene.toml", True),
    ):  # fmt: skip
        options = Namespace(scene=Path(scene))
        where = own_place(options, "plan/mine.csv")
        assert ("will be replaced" in capsys.readouterr().err) == said
        where.parent.mkdir(parents=True, exist_ok=True)
        where.write_text(scene)
        remember(options)
    # A command that failed has replaced nothing.
    os.utime(where, (0, 0))
    options = Namespace(scene=Path("c/scene.toml"))
    own_place(options, "plan/mine.csv")
    assert "the results of a/scene.toml" in capsys.readouterr().err
    remember(options)
    own_place(Namespace(scene=Path("a/scene.toml")), "plan/mine.csv")
    assert not capsys.readouterr().err
    # It is for this warning alone: a command is none the worse where it cannot be noted.
    os.utime(where)
    (tmp_path / "results" / ".scenes.json").unlink()
    (tmp_path / "results" / ".scenes.json").mkdir()
    options = Namespace(scene=Path("c/scene.toml"))
    own_place(options, "plan/mine.csv")
    os.utime(where)
    remember(options)


def test_commands_say_whose_results_they_replace(mine, tmp_path, monkeypatch, capsys):
    """Every command that has a place of its own for a scene's results."""
    monkeypatch.chdir(tmp_path)
    asked = []
    places = {"plan": "plan", "track": "track", "margins": "margins", "study": "timing", "identify": "excite"}
    for module, command in places.items():

        def noted(options, place, other="", command=command):
            asked.append(command)
            raise ModelError("far enough", said=True)

        monkeypatch.setattr(f"pcr_mpc.cli.{module}.own_place", noted)
        more = ["--duration", "2"] if command == "excite" else []
        assert main([command, str(mine / "scene.toml"), *more]) == 1
    assert asked == list(places.values())


@pytest.mark.parametrize("command", ["track", "plan", "check", "margins"])
def test_a_misspelt_file_is_guessed(command, mine, capsys):
    for given in (mine / "scen.toml", mine / "scene", mine.with_name("mines") / "scene.toml"):
        assert main([command, str(given)]) == 1
        assert f"no such file; did you mean {mine / 'scene.toml'}?" in capsys.readouterr().err


def test_a_misspelt_name_may_be_a_file(mine, monkeypatch, capsys):
    monkeypatch.chdir(mine)
    assert main(["track", "scen"]) == 1
    assert "did you mean scene.toml?" in capsys.readouterr().err
