import json
import math
import re
import shutil

import numpy as np
import pytest
from matplotlib import image

from pcr_mpc.cli import main
from pcr_mpc.report.timing import timing_tables
from tests.conftest import CONTROLLERS, MODELS


@pytest.fixture
def scene(tmp_path):
    """The lemniscate, cut to half a second."""
    shutil.copytree(MODELS, tmp_path / "models")
    shutil.copytree(CONTROLLERS, tmp_path / "controllers")
    path = tmp_path / "models/scenes/lemniscate.toml"
    path.write_text(re.sub(r"duration = 6\.0", "duration = 0.5", path.read_text()))
    return path


def test_track_writes_record_and_pictures(scene, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["track", str(scene), "--out", str(out), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["failures"] == 0
    assert summary["scene_file"] == str(scene)
    assert set(summary["files"]) == {"run.npz", "run.csv", "summary.json", "track.png", "track.gif", "replay.html"}
    assert json.loads((out / "summary.json").read_text()) == summary
    picture = image.imread(out / "track.png")
    assert picture.std() > 0.05  # not blank
    assert (out / "track.gif").stat().st_size > 10_000


def test_track_prints_a_table(scene, tmp_path, capsys):
    arguments = ["track", str(scene), "--out", str(tmp_path), "--no-pictures", "--method", "multiple_shooting"]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    for words in ("RMS after 1 s", "plant step", "control step", "p99", "limit violations  0", "multiple_shooting"):
        assert words in text


def test_a_failed_run_is_written_and_exits_non_zero(scene, tmp_path, capsys):
    scene.write_text(scene.read_text() + "\n[load]\nforce = [0.0, 500.0]\n")
    assert main(["track", str(scene), "--out", str(tmp_path / "out"), "--no-pictures", "--json"]) == 1
    captured = capsys.readouterr()
    assert "stopped at t =" in captured.err.splitlines()[-1]
    assert "Traceback" not in captured.err
    assert json.loads(captured.out)["failures"] == 1
    assert (tmp_path / "out/run.npz").exists()


def test_statics_three_ways(capsys, tmp_path):
    pair = str(MODELS / "planar_pair.toml")
    assert main(["statics", pair, "--p", "0", "0.25", "--mode", "LR", "--json"]) == 0
    inverse = json.loads(capsys.readouterr().out)
    assert inverse["stable"]
    assert np.abs(inverse["force"]).max() < 1e-8
    q = [str(angle) for angle in inverse["q"]]
    assert main(["statics", pair, "--p", "0", "0.25", "--q", *q, "--json", "--picture", str(tmp_path / "a.png")]) == 0
    held = json.loads(capsys.readouterr().out)
    assert held["energy"] == pytest.approx(inverse["energy"])
    assert (tmp_path / "a.png").exists()
    assert main(["statics", str(MODELS / "rfrfr.toml"), "--q", "120", "60", "--degrees"]) == 0
    assert "0.927501" in capsys.readouterr().out


@pytest.mark.slow
def test_timing(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pcr_mpc.study.timing.stopwatch._INTERRUPTED", math.inf)  # however busy the machine is
    assert main(["timing", str(scene), "--steps", "60", "--json", "--out", str(tmp_path / "t")]) == 0
    result = json.loads(capsys.readouterr().out)
    names = {(c["name"], c["method"]) for c in result["components"]}
    assert {("plant step", m) for m in ("closed_form", "multiple_shooting", "single_shooting")} <= names
    for name in ("control step", "look ahead", "QP update", "inside OSQP"):
        assert (name, "closed_form") in names
    for component in result["components"]:
        ordered = [component[key] for key in ("p50", "p95", "p99", "p99.9", "max")]
        assert 0 < ordered[0]
        assert ordered == sorted(ordered)
        assert component["n"] > 0
    step = next(c for c in result["components"] if c["name"] == "control step")
    assert set(step["misses"]) == {"100 Hz", "200 Hz", "500 Hz"}
    assert step["n"] == 40
    assert len(step["first"]) == 20
    assert sum(sum(counts) for counts in result["histogram"]["control step"].values()) == 40
    assert step["interrupted"] == 0
    assert sum(row["n"] for row in result["iterations"]) == 40
    assert sum(result["control_parts"].values()) == pytest.approx(step["mean"])
    solvers = {row["solver"]: row for row in result["solvers"]}
    assert list(solvers) == ["OSQP", "DAQP"]
    assert solvers["OSQP"]["n"] == 40
    for row in solvers.values():
        assert 0 < row["inside"]["p50"] < row["step"]["p50"] <= row["step"]["p99"] <= row["step"]["max"]
    # No limit acts on this path: neither is asked.
    assert solvers["DAQP"]["iterations"]["max"] == solvers["OSQP"]["iterations"]["p50"] == 1
    text = timing_tables(result)
    for component in result["components"]:
        (line, *_) = (
            line for line in text.splitlines() if line.startswith(f"{component['name']} ({component['method']})")
        )
        assert line.split()[-1] == str(component["n"])
        assert (f"{component['p50']:.1f}" if component["p50"] < 100 else f"{component['p50']:.0f}") in line.split()
    assert "deadlines missed" in text
    assert {row["name"] for row in result["overhead"]} == {"graph", "plain call", "Plant.step", "rollout"}
    assert result["versions"]["casadi"]
    assert result["machine"]["cores"] >= 1
    assert json.loads((tmp_path / "t" / "timing.json").read_text()) == result
    assert (tmp_path / "t" / "timing.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["track", "nowhere.toml"], "nowhere.toml: no such file"),
        (["plan", "waypoints", "--tolerance", "-1"], "--tolerance is -1 mm, expected a finite number > 0"),
        (["plan", "waypoints", "--tip-speed", "nan"], "--tip-speed is nan m/s, expected a finite number > 0"),
        (["plan", "waypoints", "--out", "fast.toml"], "--out is fast.toml, expected a name that ends with .csv"),
        (["tune", "waypoints", "--out", "a.csv"], "--out is a.csv, expected a name that ends with .toml"),
        (["statics", str(MODELS / "planar_pair.toml")], "give --p, --q or both"),
        (["statics", str(MODELS / "planar_pair.toml"), "--p", "0.5", "0.5"], "move the tip at least"),
        (["statics", str(MODELS / "planar_pair.toml"), "--p", "0", "0.2", "--q", "1"], r"q has shape (1,)"),
    ],
)
def test_failures_are_one_clear_line(arguments, message, capsys):
    assert main(arguments) == 1
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
    main([*arguments, "--traceback"])
    assert "Traceback" in capsys.readouterr().err


def test_help_teaches(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "pcr-mpc track lemniscate" in capsys.readouterr().out
