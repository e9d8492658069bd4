"""A run that is no good says so: in its summary, on top of its table, and by the exit status."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import HoldMotors, load_scene, make_controller, simulate
from pcr_mpc.cli import main
from pcr_mpc.loop.parts.controllers import Decision, Replay
from pcr_mpc.report.tables import summary_table
from tests.conftest import CONTROLLERS, MODELS

SCENES = MODELS / "scenes"


@pytest.fixture(scope="module")
def run():
    scene = replace(load_scene(SCENES / "lemniscate.toml"), duration=0.1)
    return simulate(scene, scene.make_plant(), make_controller(scene))


def fallback(k):
    return {"t": 0.01 * k, "kind": "fallback", "rung": "lqr", "message": "lqr: no model"}


@pytest.mark.parametrize(("count", "lost"), [(0, False), (5, False), (6, True), (10, True)])
def test_most_decisions_are_to_be_solved(run, count, lost):
    one = replace(run, events=[fallback(k) for k in range(count)])
    summary = one.summary()
    assert summary["failures"] == int(lost)
    assert summary["verdict"] == (f"only {10 - count} of 10 decisions were solved" if lost else "")


@pytest.mark.parametrize(("away", "allowed", "lost"), [(0.039, None, False), (0.041, None, True), (0.041, 0.05, False)])
def test_the_tip_is_to_stay_near_the_reference(run, away, allowed, lost):
    """At any time; a tenth of the rods of 0.4 m unless the scene says something else."""
    x = run.x.copy()
    x[50, :2] = run.reference[50] + [0.0, away]
    one = replace(run, x=x, scene=replace(run.scene, tracking_error=allowed))
    assert one.summary()["failures"] == int(lost)
    assert one.verdict() == (
        "tip lost: 41.0 mm from the reference at t = 0.050 s, allowed are 40 mm" if lost else ""
    )  # fmt: skip


def test_a_tip_that_is_nowhere_is_lost(run):
    x = run.x.copy()
    x[-1, 0] = np.nan
    assert "tip lost: nan mm" in replace(run, x=x).verdict()


def test_commands_beyond_the_motors_limits_are_no_result(run):
    """A motor that exists would have done something else."""
    u = run.u.copy()
    u[4, 0] += 2.0 * run.scene.robot.acceleration_limit * run.scene.period
    broken = replace(run, u=u)
    assert broken.verdict() == "commands broke the motors' limits on rate or its change in 2 of 10 periods"
    assert broken.summary()["failures"] == 1


def test_a_run_that_ended_early_is_one_failure(run):
    broken = replace(run, events=[fallback(k) for k in range(9)] + [{"t": 0.1, "kind": "failure", "message": "Boom"}])
    assert broken.summary()["failures"] == 1
    assert broken.verdict().startswith("failed at t = 0.1 s: Boom; only 1 of 10")


def test_the_table_begins_with_the_verdict(run):
    bad = replace(run, events=[fallback(k) for k in range(9)]).summary()
    assert summary_table(bad).splitlines()[0] == "FAILED      only 1 of 10 decisions were solved"
    assert summary_table(run.summary()).startswith("scene ")


def test_without_a_reference_nothing_is_lost():
    scene = replace(load_scene(SCENES / "release.toml"), duration=0.05)
    assert simulate(scene, scene.make_plant(), HoldMotors(2)).verdict() == ""


def test_track_exits_non_zero_for_a_lost_robot(tmp_path, capsys):
    shutil.copytree(MODELS, tmp_path / "models")
    shutil.copytree(CONTROLLERS, tmp_path / "controllers")
    path = tmp_path / "models/scenes/hold_with_load.toml"
    path.write_text(re.sub(r"duration = 3\.0", "duration = 0.2", path.read_text()))
    arguments = ["track", str(path), "--no-pictures", "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    assert "FAILED" not in capsys.readouterr().out
    path.write_text(path.read_text() + "\n[limits]\ntracking_error = 1.0e-3\n")
    assert main(arguments) == 1
    captured = capsys.readouterr()
    assert captured.out.strip().splitlines()[0].startswith("FAILED      tip lost:")
    assert captured.err.splitlines()[-1].startswith("pcr-mpc: hold_with_load: tip lost:")
    assert json.loads((tmp_path / "out/summary.json").read_text())["failures"] == 1


def test_events_of_a_controller_are_told_with_their_time():
    class Told(HoldMotors):
        def step(self, k, x):
            events = ({"kind": "own", "message": "hello"},) if k == 3 else ()
            return Decision(super().step(k, x).u, events=events)

    scene = replace(load_scene(SCENES / "release.toml"), duration=0.05)
    run = simulate(scene, scene.make_plant(), Told(2))
    assert run.events == [{"t": pytest.approx(0.03), "kind": "own", "message": "hello"}]


def test_coming_back_from_beyond_a_stop_breaks_no_limit():
    """A replay from 0.1 rad beyond: back at 1 rad/s is kept, standing there and going on is not."""
    scene = replace(load_scene(SCENES / "hold_with_load.toml"), duration=0.04)
    q = scene.start().q
    scene = replace(scene, trajectory=None, tuning=None)
    run = simulate(scene, scene.make_plant(), Replay(np.zeros((4, 2))))
    rods = tuple(
        replace(rod, angle_limits=(-9.0, float(at) - 0.1)) for rod, at in zip(scene.robot.rods, q, strict=True)
    )
    beyond = replace(run, scene=replace(scene, robot=replace(scene.robot, rods=rods)))
    assert replace(beyond, u=np.full((4, 2), -1.0)).limit_violations() == 0
    for u in (0.0, 1.0):
        assert replace(beyond, u=np.full((4, 2), u)).limit_violations() == 4
