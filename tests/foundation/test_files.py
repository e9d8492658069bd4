"""What is written: whole or not at all, over nobody's work, and never lost once it is computed."""

import contextlib
import errno
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from pcr_mpc import HoldMotors, load_scene, load_tuning, simulate
from pcr_mpc.cli import main
from pcr_mpc.errors import OutputError
from pcr_mpc.files import leaving_no_empty_folders, ours, replacing, require_free, results, stamped, write_text
from pcr_mpc.methods import METHODS
from pcr_mpc.plant.statics import held_tip as statics
from pcr_mpc.study.choice.file import _renewed
from pcr_mpc.study.tuning.file import write_tuning
from tests.conftest import CONTROLLERS, MODELS

PAIR = str(MODELS / "planar_pair.toml")
RELEASE = MODELS / "scenes" / "release.toml"


@pytest.fixture(scope="module")
def run():
    scene = replace(load_scene(RELEASE), duration=0.03)
    return simulate(scene, scene.make_plant(), HoldMotors(2))


@pytest.fixture
def quick(monkeypatch, run):
    """The command line's run takes no time; says how often it was asked for."""
    calls = []

    def known(*arguments, **keywords):
        calls.append(arguments)
        return run

    monkeypatch.setattr("pcr_mpc.cli.track.simulate", known)
    for name in ("plot_run", "animate_run"):
        monkeypatch.setattr(f"pcr_mpc.cli.track.{name}", lambda run, path, **_: path.write_bytes(b"picture"))
    return calls


def full_disk(*arguments, **keywords):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_stamped_file_is_ours_until_it_is_changed(tmp_path):
    path = tmp_path / "a.toml"
    for text in ("x = 1\n", "", "# ä\nx = 1\n"):
        write_text(path, stamped(text))
        assert ours(path)
        require_free(path)
        path.write_text(path.read_text().replace("x = 1", "x = 2") + ("# mine\n" if "x" not in text else ""))
        assert not ours(path)
        with pytest.raises(OutputError, match=r"a\.toml is not as pcr-mpc wrote it, .* --force"):
            require_free(path)
        require_free(path, force=True)


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    path, link = tmp_path / "a.txt", tmp_path / "link.txt"
    path.write_text("old")
    path.chmod(0o640)
    link.symlink_to(path)
    with contextlib.suppress(KeyError), replacing(path) as draft:
        draft.write_text("half")
        raise KeyError
    assert path.read_text() == "old"
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.txt", "link.txt"]
    write_text(link, "new")
    assert path.read_text() == "new"
    assert link.is_symlink()
    assert path.stat().st_mode & 0o777 == 0o640


def test_a_folder_holds_what_was_written_last_and_what_is_not_ours(tmp_path):
    def put(names):
        with results(tmp_path) as staged:
            for name in names:
                (staged / name).write_text(name)

    put(["a", "b", "c"])
    (tmp_path / "mine").write_text("by hand")
    (tmp_path / "b").write_text("changed by hand")
    put(["c", "d"])
    assert {path.name for path in tmp_path.iterdir() if path.name[0] != "."} == {"b", "c", "d", "mine"}
    with contextlib.suppress(KeyError), results(tmp_path) as staged:
        (staged / "c").write_text("half")
        raise KeyError
    assert (tmp_path / "c").read_text() == "c"
    assert (tmp_path / "b").read_text() == "changed by hand"
    assert not any(path.is_dir() for path in tmp_path.iterdir())


def test_a_folder_holds_one_run(quick, tmp_path, capsys):
    arguments = ["track", str(RELEASE), "--out", str(tmp_path)]
    assert main(arguments) == 0
    assert (tmp_path / "track.gif").exists()
    assert main([*arguments, "--no-pictures"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"run.npz", "run.csv", "summary.json", ".pcr-mpc.json"}
    assert set(json.loads((tmp_path / "summary.json").read_text())["files"]) == {"run.npz", "run.csv", "summary.json"}


@pytest.mark.parametrize("name", ["run.csv", "summary.json", "run.npz", "track.png"])
def test_track_leaves_the_work_of_others_alone(quick, tmp_path, capsys, name):
    (tmp_path / name).write_text("by hand")
    (tmp_path / "notes.txt").write_text("mine")
    arguments = ["track", str(RELEASE), "--out", str(tmp_path)]
    assert main(arguments) == 1
    assert f"{name} is not as pcr-mpc wrote it" in capsys.readouterr().err
    assert quick == []  # rather before the run than after
    assert (tmp_path / name).read_text() == "by hand"
    assert main([*arguments, "--force"]) == 0
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_record_that_was_changed_by_hand_is_not_overwritten(run, tmp_path):
    run.save(tmp_path)
    run.save(tmp_path)
    (tmp_path / "run.csv").write_text("t_s\n")
    with pytest.raises(OutputError, match=r"run\.csv"):
        run.save(tmp_path)
    assert (tmp_path / "run.csv").read_text() == "t_s\n"
    run.save(tmp_path, force=True)


@pytest.mark.parametrize("out", ["file", "file/below"])
def test_a_folder_that_cannot_be_is_said_before_the_run(quick, tmp_path, capsys, out):
    (tmp_path / "file").write_text("mine")
    assert main(["track", str(RELEASE), "--out", str(tmp_path / out)]) == 1
    error = capsys.readouterr().err
    assert "a file is where a folder is wanted" in error
    assert str(tmp_path / "file") in error
    assert quick == []
    assert (tmp_path / "file").read_text() == "mine"


def test_a_folder_that_cannot_be_written_to_is_said_before_the_run(quick, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pcr_mpc.files.tempfile.TemporaryFile", full_disk)
    assert main(["track", str(RELEASE), "--out", str(tmp_path / "out")]) == 1
    assert "cannot be written to: No space left on device" in capsys.readouterr().err
    assert quick == []


def test_a_run_is_not_lost_with_the_disk(quick, tmp_path, capsys, monkeypatch):
    """Which fills up after the run was begun: it is where there is room, and the message says where."""
    written, move = [], os.replace

    def full_here(source, target):
        if str(target).startswith(str(tmp_path / "out")):
            full_disk()
        written.append(target)
        move(source, target)

    monkeypatch.setattr("pcr_mpc.files.os.replace", full_here)
    assert main(["track", str(RELEASE), "--out", str(tmp_path / "out"), "--no-pictures", "--json"]) == 1
    captured = capsys.readouterr()
    elsewhere = Path(re.search(r"what was computed is in (\S+)$", captured.err.strip())[1])
    try:
        assert "No space left on device" in captured.err
        assert {path.name for path in elsewhere.iterdir()} >= {"run.npz", "run.csv", "summary.json"}
        assert json.loads(captured.out)["files"]["run.npz"] == str(elsewhere / "run.npz")
    finally:
        shutil.rmtree(elsewhere)


def test_a_run_that_cannot_be_drawn_keeps_its_figures(quick, tmp_path, capsys, monkeypatch):
    def lost(*_):
        raise OutputError("no rods there")

    monkeypatch.setattr("pcr_mpc.cli.track.plot_run", lost)
    assert main(["track", str(RELEASE), "--out", str(tmp_path), "--json"]) == 0
    captured = capsys.readouterr()
    assert "no pictures: no rods there" in captured.err
    assert set(json.loads(captured.out)["files"]) == {"run.npz", "run.csv", "summary.json"}


def test_tune_leaves_a_tuning_by_hand_alone(tmp_path, capsys, monkeypatch):
    shutil.copytree(MODELS, tmp_path / "models")
    shutil.copytree(CONTROLLERS, tmp_path / "controllers")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pcr_mpc.cli.study.tune", lambda *_: pytest.fail("before it is known where to write"))
    scene, mine = tmp_path / "models/scenes/lemniscate.toml", tmp_path / "controllers/mine.toml"
    scene.write_text(scene.read_text().replace('name = "lemniscate"', 'name = "mine"'))
    text = "# worked out by hand\n" + (CONTROLLERS / "default.toml").read_text().replace('"default"', '"mine"')
    mine.write_text(text)
    for extra in (["--start", str(mine)], ["--out", str(mine), "--start", str(CONTROLLERS / "default.toml")]):
        assert main(["tune", str(scene), *extra]) == 1
        assert "mine.toml is not as pcr-mpc wrote it" in capsys.readouterr().err
    assert mine.read_text() == text
    tuning = load_tuning(mine)
    with pytest.raises(OutputError, match="is left alone"):
        write_tuning(tuning, mine, [])
    write_tuning(tuning, mine, [], force=True)
    write_tuning(tuning, mine, ["again"])
    assert load_tuning(mine) == tuning


def test_export_and_pictures_leave_the_work_of_others_alone(tmp_path, capsys):
    pose = ["--p", "0", "0.25", "--mode", "LR"]
    model, picture = tmp_path / "new" / "pair.xml", tmp_path / "new" / "pair.png"
    for arguments, path, flag in (
        (["export", PAIR, *pose, "--links", "8", "--out", str(model)], model, "--force"),
        (["statics", PAIR, *pose, "--picture", str(picture)], picture, "--overwrite"),
    ):
        assert main(arguments) == main(arguments) == 0  # over its own
        path.write_text("by hand")
        assert main(arguments) == 1
        assert f"{path.name} is not as pcr-mpc wrote it" in capsys.readouterr().err
        assert path.read_text() == "by hand"
        assert main([*arguments, flag]) == 0
        assert ours(path)
    assert model.read_text().endswith("without --force -->\n")


@pytest.mark.parametrize("suffix", [".svg", ".pdf", ".png"])
def test_pictures_are_known_again_in_every_format(tmp_path, centre, suffix):
    from pcr_mpc.report.plots import plot_equilibrium

    path = tmp_path / f"pose{suffix}"
    plot_equilibrium(centre, path)
    assert ours(path)


HAND = """\
name = "x"

[plant]  # measured on the bench
# The rods stretch, so:
method = "multiple_shooting"  # as Till has it
segments = 4
on_snap = "jump"    # it may
dt = 0.001 # s
integrator = "rk4" # fourth order

# What follows was agreed with the lab.
[control]
period = 0.01
"""


def test_comments_by_hand_outlive_a_new_rung():
    new = ["[plant]   # the lowest rung that meets the need, by pcr-mpc choose --write", 'inertia = "none"',
           'method = "closed_form"', 'integrator = "velocity_verlet"', "dt = 0.0005               # s"]  # fmt: skip
    text = _renewed(HAND, "plant", new, keep=("on_snap",))
    for comment in re.findall("#.*", HAND):
        assert comment in text
    assert "segments" not in text
    for line in ("# The rods stretch, so:\n", '\non_snap = "jump"    # it may\n', "\ndt = 0.0005               # s\n",
                 '\ninertia = "none"\n', "lab.\n[control]"):  # fmt: skip
        assert line in text
    assert _renewed(text, "plant", new, keep=("on_snap",)) == text
    gone = _renewed(HAND, "plant", ["[plant]", 'integrator = "rk4"', "dt = 0.1"])
    assert "# as Till has it\n" in gone
    assert "# it may\n" in gone
    with_finding = _renewed(text, "chosen", ["[chosen]", "tip_error = 1.0"])
    assert with_finding.index("[plant]") < with_finding.index("[chosen]") < with_finding.index("[control]")
    assert with_finding.replace("[chosen]\ntip_error = 1.0\n", "").split() == text.split()


def test_the_command_line_knows_the_methods():
    """Which it names itself, so that its help is there before two seconds of loading."""
    assert METHODS == statics.METHODS


def test_what_fails_leaves_no_empty_folder(tmp_path):
    """But what is in a folder, or was there before, stays."""
    (tmp_path / "mine").mkdir()

    @leaving_no_empty_folders()
    def fails():
        for path in ("mine/a.csv", "new/deep/a.csv", "kept/a.csv"):
            require_free(tmp_path / path)
        (tmp_path / "kept" / "a.csv").write_text("1")
        raise OutputError("no", path="no")

    with pytest.raises(OutputError):
        fails()
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == ["kept", "kept/a.csv", "mine"]
