"""A session of the view without a network: hands, targets, time, settings, records."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pcr_mpc import Plant, load_scene
from pcr_mpc.errors import PCRError, UnstableError
from pcr_mpc.loop.controller.own_controller import OwnController
from pcr_mpc.loop.run.run import load_run
from pcr_mpc.plant.statics.free_tip import forward_statics
from pcr_mpc.study.identification.logs.log import read_log
from pcr_mpc.view.live.session import Session
from tests.view.view_check import spring_balance


@pytest.fixture(scope="module")
def scene():
    return load_scene(Path("models/scenes/lemniscate.toml"))


@pytest.fixture(scope="module")
def played(scene):
    """One session for all that leaves it as it was: its controller is built once."""
    return Session(scene)


@pytest.fixture
def session(played):
    if played.chosen != "lemniscate":
        played.choose("lemniscate")
    played.pause(False)
    played.release()
    if played.mode != "LR":
        played.switch_mode("LR")
    played.reset()
    played.events.clear()
    return played


def kinds(session):
    return [event["kind"] for event in session.events]


def test_a_tip_that_is_dragged_rests_where_the_statics_say(session):
    session.choose("off")
    end = np.array([0.05, 0.2])
    session.drag(*end)
    session.advance(3.0)
    wanted = spring_balance(session.scene.robot, session.start_pose, session.rig.stiffness, end)
    assert np.hypot(*(wanted - session.start_pose.p)) > 0.02  # it is pulled far
    assert session.rig.x[:2] == pytest.approx(wanted, abs=1e-6)
    assert np.abs(session.rig.x[2:4]).max() < 1e-6
    session.release()
    session.advance(0.01)
    assert not session.rig.force.any()


def test_the_path_is_followed_as_a_run_of_the_scene_does(session):
    session.advance(1.5)
    errors = []
    for _ in range(40):
        session.advance(0.01)
        errors.append(np.hypot(*(session.rig.x[:2] - session.target())))
    assert max(errors) < 1e-5  # docs/records: 0.0019 mm RMS
    assert "fallback" not in kinds(session)


def test_a_target_that_is_moved_is_reached_under_a_pull_that_nobody_told(session):
    session.move_target(0.04, 0.22)
    session.drag(*(session.rig.x[:2] + [0.0, -0.01]))
    session.advance(1.5)
    assert np.hypot(*session.rig.force) > 1.0
    assert session.rig.x[:2] == pytest.approx([0.04, 0.22], abs=1e-4)
    session.release()


def test_a_target_out_of_reach_is_refused_and_harms_nothing(session):
    with pytest.raises(ValueError, match="target"):
        session.move_target(np.nan, 0.2)
    session.move_target(5.0, 5.0)
    session.advance(0.3)
    assert "refused" in kinds(session)
    session.move_target(0.0, 0.25)
    session.advance(1.0)
    assert session.rig.x[:2] == pytest.approx([0.0, 0.25], abs=1e-5)


def test_a_motor_in_the_hand_turns_and_the_controller_goes_on_from_there(session):
    q = session.rig.x[4] + 0.3
    session.drag_motor(0, q)
    session.advance(1.0)
    assert session.rig.x[4] == pytest.approx(q, abs=1e-6)
    assert session.decision.plan is None  # nobody decides meanwhile
    tip = session.rig.x[:2].copy()
    session.release()
    session.advance(1.0)
    assert session.decision.plan is not None
    assert session.rig.x[:2] == pytest.approx(tip, abs=1e-3)
    with pytest.raises(ValueError, match="motor"):
        session.drag_motor(2, 0.0)


def test_a_motor_in_the_hand_keeps_its_limits(session):
    session.drag_motor(1, 100.0)
    x = session.rig.x
    for _ in range(30):
        session.advance(0.01)
        assert np.abs(session.rig.applied).max() <= session.scene.robot.rate_limit * (1 + 1e-12)
    assert session.rig.x[5] <= session.scene.robot.angle_limits[1, 1]
    assert session.rig.x[5] > x[5] + 1.0


def test_time_goes_by_whole_steps_and_reset_repeats_it_to_the_last_bit(session):
    session.advance(0.25)
    first = session.rig.x.copy()
    assert session.t == pytest.approx(0.25)
    session.step_once()
    assert session.t == pytest.approx(0.26)
    session.reset()
    assert session.t == 0.0
    session.advance(0.25)
    assert (session.rig.x == first).all()


def test_rods_that_are_pulled_beyond_all_bounds_do_not_end_it(session):
    session.choose("off")
    for far in ((3.0, 3.0), (-5.0, 0.1), (0.0, -4.0)):
        session.drag(*far)
        session.advance(0.8)
        assert np.isfinite(session.rig.x).all()
    robot = session.scene.robot
    assert (np.linalg.norm(session.rig.x[:2] - robot.bases, axis=1) < robot.lengths).all()


def test_what_the_rods_cannot_follow_is_said_and_the_robot_is_put_back(session, monkeypatch):
    session.choose("off")
    session.advance(0.5)

    def fails():
        raise PCRError("torn")

    with monkeypatch.context() as torn:
        torn.setattr(session.rig, "step", fails)
        session.advance(0.001)
    assert kinds(session)[-2:] == ["failure", "recovered"]
    assert np.isfinite(session.rig.x).all()
    assert not session.rig.x[2:4].any()
    session.advance(0.1)


def test_a_snap_is_told_with_the_energy_that_it_lost(session):
    """Against the rods' energy just before and just after, which motion changes little in a millisecond."""
    session.choose("off")
    session.switch_mode("LL")
    session.drag_motor(1, 1.04)
    session.advance(0.75)
    energy, snaps = session.rig.equilibrium().energy, []
    while not snaps and session.t < 1.0:
        before = energy
        session.advance(0.001)
        energy = session.rig.equilibrium().energy
        snaps = [event for event in session.events if event["kind"] == "snap" and event["t"] == round(session.t, 4)]
    assert snaps[0]["rod"] == 1
    assert snaps[0]["energy"] > 0.5  # J
    assert before - energy == pytest.approx(snaps[0]["energy"], abs=0.01)
    assert snaps[0]["p"] == pytest.approx(session.rig.x[:2], abs=5e-3)
    session.switch_mode("LR")


def test_a_tip_that_snaps_where_its_pose_ends_is_told_with_what_it_loses(session):
    """Each rod keeps its shape; the free tip's own stiffness passes zero. Energies against the statics."""
    session.choose("off")
    session.switch_mode("LL")
    angle, snaps, rest, fold = session.rig.x[5], [], session.start_pose, None
    while not snaps and angle < 1.0:
        angle += 0.012
        session.drag_motor(1, angle)
        session.advance(0.02)
        snaps = [event for event in session.events if event["kind"] == "snap"]
        if fold is None:
            try:
                rest = forward_statics(session.scene.robot, session.rig.x[4:], guess=rest)
            except UnstableError:
                fold = session.rig.x[5]  # where the branch of the free tip ends
    assert 0.0 <= session.rig.x[5] - fold < 0.15  # rad: it takes the tip a moment to fall
    assert "fold" in snaps[0]["message"]
    session.drag(*landing(snaps[0]))  # a hand catches it, and lets it down there
    session.advance(2.0)
    after = forward_statics(session.scene.robot, session.rig.x[4:], guess=session.rig.equilibrium())
    # While the tip begins to fall the motor turns on, and works.
    torque = max(abs(rest.motor_torque[1]), abs(after.motor_torque[1]))
    worked = torque * (session.rig.x[5] - rest.q[1])
    assert snaps[0]["energy"] == pytest.approx(rest.energy - after.energy, abs=worked)
    assert worked < 0.4 * snaps[0]["energy"]
    assert snaps[0]["energy"] > 0.05  # J
    session.release()
    session.switch_mode("LR")


def landing(snap):
    """Where a snap leads [m], as it says."""
    x, y = re.search(r"at \((-?\d+), (-?\d+)\) mm", snap["message"]).groups()
    return float(x) / 1e3, float(y) / 1e3


def test_a_swing_is_no_snap(session):
    session.choose("off")
    session.drag(0.08, 0.18)
    session.advance(0.6)
    session.release()
    session.advance(2.0)
    assert "snap" not in kinds(session)


def test_settings_change_the_robot_and_leave_it_where_it_is(session):
    session.advance(0.2)
    before = session.rig.x.copy()
    session.set("rate", 3.0)
    assert session.rig.x == pytest.approx(before)
    session.set("noise", 1e-4)
    session.set("delay", 0.004)
    session.set("lag", 0.01)
    session.set("load", 0.1)
    session.advance(0.3)
    assert session.rig.plant.payload == pytest.approx(0.1)
    assert session.scene.untold_delay == 0.004
    assert session.pilot.scene.untold_delay == 0.0  # which is told to nobody
    assert session.pilot.scene.tip_noise == 1e-4
    assert np.abs(session.rig.applied).max() <= 3.0
    for name, value in (("load", -1.0), ("nonsense", 1.0), ("noise", np.inf)):
        with pytest.raises(ValueError, match=name):
            session.set(name, value)
    for name, value in (("rate", 6.0), ("noise", 0.0), ("delay", 0.0), ("lag", 0.0), ("load", 0.0)):
        session.set(name, value)


def test_a_load_is_that_of_a_heavier_tip(session):
    """The same swing, by a plant whose tip has that mass."""
    session.choose("off")
    session.set("load", 0.1)
    session.drag(*(session.start_pose.p + [0.01, 0.0]))
    session.advance(0.05)
    robot = replace(session.scene.robot, tip_mass=session.scene.robot.tip_mass + 0.1)
    plant = Plant(robot, integrator="rk4", dt=1e-3)
    x = np.concatenate([session.start_pose.p, np.zeros(2), session.start_pose.q])
    plant.reset(x, session.start_pose)
    end = session.start_pose.p + [0.01, 0.0]
    for _ in range(50):
        x = plant.step(x, np.zeros(2), session.rig.stiffness * (end - x[:2]) - session.rig.dashpot * x[2:4])
    assert session.rig.x == pytest.approx(x, abs=1e-9)
    session.set("load", 0.0)
    session.release()


def test_a_recording_is_a_run_that_others_read(session, tmp_path):
    session.advance(0.5)
    session.record(True)
    began = session.rig.x.copy()
    session.advance(0.4)
    ended = session.rig.x.copy()
    session.record(False)
    run = session.finished.run
    run.save(tmp_path)
    again = load_run(tmp_path)
    assert again.hash() == run.hash()
    assert again.x[0] == pytest.approx(began)
    assert again.x[-1] == pytest.approx(ended)
    assert len(again.u) == 40
    assert again.limit_violations() == 0
    assert again.summary()["max_mm"] < 0.02
    for name in ("run.csv", "run.npz"):
        (log,) = read_log(tmp_path / name, 2)
        assert log.t[-1] >= 0.39
    # The plant's own steps lead along the record.
    plant = run.scene.make_plant()
    plant.reset(run.x[0], run.pose)
    x = run.x[0]
    for u in run.applied:
        x = plant.step(x, u)
    assert x == pytest.approx(run.x[-1], abs=1e-9)


def test_what_cannot_be_chosen_leaves_all_as_it_is(session):
    for wrong in (lambda: session.choose("nobody"), lambda: session.switch_mode("LRL")):
        with pytest.raises(ValueError, match=r"nobody|LRL"):
            wrong()
    session.advance(0.1)
    assert session.chosen == "lemniscate"
    assert session.decision.plan is not None


def test_a_controller_takes_up_a_robot_in_motion(session):
    """With the tip's velocity it is told, what the rods carry is no load; without, it is taken for one."""
    session.advance(1.6)
    x, pose = session.rig.x.copy(), session.rig.equilibrium()
    assert np.hypot(*x[2:4]) > 0.1  # m/s
    controller = session.pilot.controller
    controller.start(pose, velocity=x[2:4])
    knowing = controller.step(tip=x[:2], angles=x[4:])
    controller.start(x[:2], x[4:], mode="LR")
    guessing = controller.step(tip=x[:2], angles=x[4:])
    assert knowing.estimate[2:4] == pytest.approx(x[2:4])
    assert np.hypot(*knowing.force) < 1e-9
    assert guessing.force == pytest.approx(pose.force, rel=1e-3)
    assert not guessing.estimate[2:4].any()
    session.choose("lqr")
    session.advance(0.4)
    assert "failure" not in kinds(session)
    assert np.hypot(*(session.rig.x[:2] - session.target())) < 2e-3


OWN = """
import numpy as np

class Mine:
    name = "mine"
    def start(self, pose):
        self.n = len(pose.q)
    def step(self, k, x):
        if k == 20:
            raise RuntimeError("lost my way")
        return 0.1 * np.ones(self.n)
"""


def test_a_controller_of_ones_own_steers_and_its_failure_leaves_the_robot(scene, tmp_path):
    (tmp_path / "mine_for_view.py").write_text(OWN)
    session = Session(scene, OwnController("mine_for_view:Mine", str(tmp_path)))
    assert session.choice.names[0] == "Mine"
    q = session.rig.x[4:].copy()
    session.advance(0.1)
    assert session.rig.x[4:] == pytest.approx(q + 0.01, abs=1e-9)
    with pytest.raises(PCRError, match="target"):
        session.move_target(0.0, 0.2)
    session.advance(0.2)
    assert session.chosen == "off"
    assert any("lost my way" in event["message"] for event in session.events)
    assert np.isfinite(session.rig.x).all()
