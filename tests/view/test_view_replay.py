"""A recorded run as a page: what it shows against the run, and what else it needs, which is nothing."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pcr_mpc import Plant, load_scene, make_controller, shipped, simulate
from pcr_mpc.cli import main
from pcr_mpc.view.live.session import Session
from pcr_mpc.view.page import page
from pcr_mpc.view.replay import replay_data, write_replay


@pytest.fixture(scope="module")
def run():
    scene = replace(load_scene(shipped("lemniscate")), duration=0.3)
    return simulate(scene, scene.make_plant(), make_controller(scene))


def test_frames_show_the_run(run):
    data = replay_data(run)
    frames = data["frames"]
    assert frames[0]["t"] == 0.0
    assert frames[-1]["t"] == pytest.approx(0.3)
    plant = Plant(run.scene.robot)
    plant.reset(run.x[0], run.pose)
    for frame in frames:
        k = round(frame["t"] / run.dt)
        assert frame["p"] == pytest.approx(run.x[k, :2], abs=1e-8)
        assert frame["target"] == pytest.approx(run.reference[k], abs=1e-8)
        assert frame["rung"] == "solved"
        eq = plant.equilibrium(run.x[k])
        assert frame["torque"] == pytest.approx(eq.motor_torque, abs=1e-4)
        # Centrelines, in tenths of millimetres, by another sampler's points.
        line = np.array(frame["rods"]).reshape(2, -1, 2)
        assert np.abs(line / 1e4 - eq.shape(33)).max() < 6e-5
        # Curvature: the moment over EI, m0 = -tau at the clamp.
        assert np.array(frame["bend"])[:, 0] / 100 == pytest.approx(
            -eq.motor_torque / run.scene.robot.stiffnesses, abs=0.5
        )


def test_the_page_needs_nothing_else_and_holds_the_data(run, tmp_path):
    path = tmp_path / "page.html"
    write_replay(run, path)
    text = path.read_text(encoding="utf-8")
    assert not re.findall(r"(?:src|href)=(?!\"data:)", text)
    assert "http" not in text.replace("http-equiv", "").replace("https:", "")
    held = re.search(r'<script type="application/json"[^>]*>(.*?)</script>', text, re.DOTALL)[1]
    assert json.loads(held) == json.loads(json.dumps(replay_data(run)))
    assert "written by pcr-mpc" in text.splitlines()[-1]


def test_text_in_the_data_ends_no_script():
    text = page({"about": "</script><script>alert(1)</script>"})
    assert "</script><script>alert" not in text


def test_snaps_are_shown_where_they_were():
    """Rods that were pulled inside out in a session: the record tells of snaps in words, the page draws them."""
    session = Session(load_scene(shipped("lemniscate")))
    session.choose("off")
    session.switch_mode("RL")
    session.record(True)
    session.drag(0.0, -0.2)
    session.advance(0.4)
    session.record(False)
    told = [event for event in session.events if event["kind"] == "snap"]
    shown = [event for event in replay_data(session.finished.run)["events"] if event["kind"] == "snap"]
    assert len(shown) == len(told) == 2
    for there, here in zip(shown, told, strict=True):
        assert there["t"] == pytest.approx(here["t"], abs=1e-3)
        assert there["energy"] == pytest.approx(here["energy"], rel=1e-3)
        assert there["p"] == pytest.approx(here["p"], abs=1e-4)


def test_the_command_writes_the_page_and_overwrites_nobody_elses(run, tmp_path, capsys):
    run.save(tmp_path / "run")
    assert main(["replay", str(tmp_path / "run"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert Path(said["file"]).read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert said["run_hash"] == run.hash()
    assert main(["replay", str(tmp_path / "run")]) == 0  # over its own
    mine = tmp_path / "mine.html"
    mine.write_text("<p>mine</p>", encoding="utf-8")
    assert main(["replay", str(tmp_path / "run"), "--out", str(mine)]) == 1
    assert mine.read_text(encoding="utf-8") == "<p>mine</p>"
    assert main(["replay", str(tmp_path / "nothing")]) == 1
    assert "Traceback" not in capsys.readouterr().err
