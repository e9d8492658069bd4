"""What is said of a robot or a scene without running it, against motion, differences and closed forms."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib import image

from pcr_mpc import HoldMotors, Plant, load_robot, load_scene, make_controller, shipped, simulate
from pcr_mpc.cli import main
from pcr_mpc.design.examination import Examination, examine
from pcr_mpc.design.reach import tips_within
from pcr_mpc.design.remarks import Remark, about_steps, unidentifiable
from pcr_mpc.loop.references.trajectory import Hold
from pcr_mpc.report.designs.check_picture import plot_check
from pcr_mpc.report.designs.check_tables import check_table


@pytest.fixture(scope="module")
def scene():
    return load_scene(shipped("lemniscate"))


@pytest.fixture(scope="module")
def found(scene):
    return examine(scene)


def about(found, name):
    return [(one.level, one.text) for one in found.remarks if one.about == name]


def test_natural_frequencies_are_those_of_the_released_tip(found):
    """The tip is let go a little beside its rest, with the motors held and the rods' inertia, and swings through it."""
    pose = found.pose
    k, vectors = np.linalg.eigh(pose.dforce_dp)
    for axis in (0, 1):
        plant = Plant(pose.robot, inertia="condensed", integrator="rk4", dt=1e-3)
        x = np.concatenate([pose.p + 1e-4 * vectors[:, axis], np.zeros(2), pose.q])
        plant.reset(x, pose)
        away = []
        for _ in range(900):
            x = plant.step(x, np.zeros(2))
            away.append(float((x[:2] - pose.p) @ vectors[:, axis]))
        through = np.flatnonzero(np.diff(np.sign(away)))
        hertz = (len(through) - 1) / (2 * 1e-3 * (through[-1] - through[0]))
        assert found.figures["start"]["natural_frequencies_Hz"][axis] == pytest.approx(hertz, rel=5e-3)
    assert k[0] > 0


def test_the_rods_own_frequency_is_that_of_a_clamped_and_pinned_beam(found):
    """15.418 sqrt(EI / (mu L^4)) rad/s, as in every table of beams."""
    rod = found.robot.rods[0]
    rate = 15.418 * np.sqrt(rod.bending_stiffness / rod.line_density) / rod.length**2
    assert found.figures["rods"][0]["own_frequency_Hz"] == pytest.approx(rate / (2 * np.pi), rel=1e-4)


def test_the_workspace_of_a_symmetric_robot_is_symmetric_and_held(found):
    tips = found.reach.tips
    assert len(tips) > 60
    mirrored = {(round(-x, 9), round(y, 9)) for x, y in tips.tolist()}
    assert mirrored == {(round(x, 9), round(y, 9)) for x, y in tips.tolist()}
    lower, upper = found.robot.angle_limits.T
    for eq in found.reach.poses[::7]:
        assert np.abs(eq.force).max() < 1e-7
        assert eq.stable
        assert ((eq.q >= lower) & (eq.q <= upper)).all()


def test_the_lattice_covers_what_all_rods_reach(found):
    """Two circles of radius L at a distance d overlap in a lens of known area."""
    robot = found.robot
    length, d = 0.995 * robot.lengths[0], np.hypot(*(robot.bases[1] - robot.bases[0]))
    lens = 2 * length**2 * np.arccos(d / (2 * length)) - d / 2 * np.sqrt(4 * length**2 - d**2)
    assert found.figures["workspace"]["within_rods_reach_m2"] == pytest.approx(lens, rel=0.05)
    assert 150 < len(tips_within(robot, 260)) < 400


def test_every_mode_is_looked_for(found):
    modes = {row["mode"]: row for row in found.figures["modes"]}
    assert set(modes) == {"LL", "LR", "RL", "RR"}
    assert modes["LR"]["torque_Nm"] == pytest.approx(max(found.figures["start"]["torque_Nm"]))
    assert modes["LL"]["torque_Nm"] == pytest.approx(modes["RR"]["torque_Nm"])  # mirror images


def test_what_the_reference_asks_is_what_differences_say(scene, found):
    speeds = np.diff(scene.trajectory(np.linspace(0, 6, 60_001))[:, 0], axis=0) / 1e-4
    assert found.figures["reference"]["speed_m_s"] == pytest.approx(np.hypot(*speeds.T).max(), rel=1e-3)
    peaks = found.figures["reference"]["peaks"]
    assert peaks["motor rate"]["limit"] == scene.robot.rate_limit
    assert peaks["torque"]["used"] == pytest.approx(peaks["torque"]["value"] / scene.torque_limit)
    assert found.errors == []


def test_rods_that_the_controller_knows_to_be_heavy_are_heavy_here_too(scene):
    """What is asked of the motors is what a run says; without the rods' inertia it is something else."""
    robot = replace(scene.robot, rods=tuple(replace(rod, line_density=0.3) for rod in scene.robot.rods))
    asked = {}
    for inertia in ("none", "condensed"):
        tuning = replace(scene.tuning, model=replace(scene.tuning.model, inertia=inertia))
        case = replace(scene, robot=robot, tuning=tuning, duration=1.0)
        asked[inertia] = examine(case, modes=False).figures["reference"]["peaks"]["motor rate"]["value"]
    # A controller of one's own knows no inverse dynamics: what it is told is the same.
    for controller in (make_controller(case), HoldMotors(2)):
        run = simulate(case, case.make_plant(), controller, progress=True)
        said = run.asked["rate_rad_s"]["asked"]
        assert said == pytest.approx(asked["condensed"], rel=1e-3)  # ours ends a horizon later
    assert abs(asked["condensed"] - asked["none"]) > 0.02 * asked["none"]


def test_what_motion_does_not_tell_is_said(found):
    (note,) = about(found, "identification")
    assert re.search("motion alone does not tell the scale of EI, masses, drag and force", note[1])


def test_a_scene_that_cannot_run_as_asked_fails(capsys):
    """Of `limited` the motors are slower than its reference; the sentence is on stderr, the rest on stdout."""
    assert main(["check", "limited", "--json"]) == 1
    captured = capsys.readouterr()
    record = json.loads(captured.out)
    assert not record["can_run"]
    assert record["remarks"][0]["level"] == "error"
    assert "limited cannot run as asked: the reference asks for motor" in captured.err
    assert record["reference"]["peaks"]["motor rate"]["used"] > 1


def test_what_the_table_has_said_at_length_is_not_said_twice(monkeypatch, capsys):
    found = Examination("limited", None, load_scene(shipped("limited")), remarks=[Remark("error", "reference", "why")])
    monkeypatch.setattr("pcr_mpc.cli.new.examine", lambda _, upright: found)
    monkeypatch.setattr("pcr_mpc.cli.new.check_table", lambda one: one.remarks[0].text)
    assert main(["check", "limited"]) == 1
    captured = capsys.readouterr()
    assert captured.out == "why\n"
    assert captured.err == "pcr-mpc: limited cannot run as asked: reference (ERROR in the table)\n"


def still(scene, **other):
    """The scene with its tip at rest, which costs little."""
    return replace(scene, trajectory=Hold(scene.start_tip), duration=0.4, **other)


def test_a_plant_step_beyond_the_integrators_limit_is_an_error(scene, found):
    """RK4 is stable up to 2.785 / omega."""
    figures = {**found.figures, "reference": None}
    # The plant without the rods' inertia moves the tip's mass alone.
    longest = float(2.785 / np.sqrt(found.pose.stiffness_eigenvalues[1] / scene.robot.tip_mass))
    for share, level in ((1.2, "error"), (0.8, "warning"), (0.3, None)):
        dt = share * longest
        other = replace(scene, plant=replace(scene.plant, dt=dt), period=dt, duration=20 * dt)
        steps, remarks = about_steps(other, np.eye(2), figures)
        assert steps["longest_stable_step_s"] == pytest.approx(longest)
        assert [one.level for one in remarks if one.about == "plant step"] == ([level] if level else [])
        # A swing takes 2 pi / 2.785 = 2.3 of the longest steps.
        assert [one.level for one in remarks if one.about == "control period"] == ["warning"]
    assert about_steps(scene, np.eye(2), figures)[1] == []


def test_rods_that_count_and_are_left_out_are_a_warning(scene, found):
    assert about(found, "rods' mass") == []
    heavy = replace(scene.robot, rods=tuple(replace(rod, line_density=0.3) for rod in scene.robot.rods))
    found = examine(still(scene, robot=heavy), modes=False)
    ((level, text),) = about(found, "rods' mass")
    assert level == "warning"
    assert "is left out of the plant (inertia = 'none') and of the controller's model" in text
    assert about(found, "rods' swings")


def test_a_wire_beyond_its_strain_is_an_error(scene):
    thick = tuple(replace(rod, thickness_ratio=0.00075 / rod.length, strain_limit=0.007) for rod in scene.robot.rods)
    found = examine(still(scene, robot=replace(scene.robot, rods=thick)), modes=False)
    assert {level for level, _ in about(found, "strain")} == {"error"}
    # 1.5 mm at 15 /m, which models/README.md reckons: 1.1 %.
    assert found.figures["start"]["strain"] == pytest.approx([0.0114, 0.0114], rel=0.02)


def test_a_start_that_no_motor_holds_is_an_error(scene, found):
    torque = max(found.figures["start"]["torque_Nm"])
    weak = replace(scene.robot, torque_limit=torque / 2)
    without = examine(still(scene, robot=weak, pose_limits=replace(scene.pose_limits, torque=None)))
    assert [one.level for one in without.errors] == ["error"]
    said = re.search(r"takes -?(\S+) N m of motor \d, which has (\S+) N m", without.errors[0].text)
    assert [float(number) for number in said.groups()] == pytest.approx([torque, torque / 2], rel=1e-3)


def test_a_robot_is_checked_in_a_pose_of_its_own(tmp_path, capsys):
    picture = tmp_path / "new/robot.png"
    assert main(["check", "planar_pair", "--picture", str(picture), "--json"]) == 0
    captured = capsys.readouterr()
    record = json.loads(captured.out)
    assert record["of"] == "robot"
    assert record["can_run"]
    # In front of its motors, in the mode that all shipped scenes of it take, which is the stiffest.
    assert record["start"]["mode"] == "LR"
    assert abs(record["start"]["p_m"][0]) < 0.04
    assert max(record["start"]["torque_Nm"]) < load_robot(shipped("planar_pair", "robot")).torque_limit
    assert image.imread(picture).std() > 0.05
    assert f"drawn in {picture}" in captured.err


def test_a_scene_as_a_table_and_a_picture(found, tmp_path):
    text = check_table(found)
    for words in (
        "scene lemniscate: 2 rods, mode LR",
        "modes that hold this tip",
        "not found: RL",
        "workspace of this mode",
        "the reference asks for",
        "rk4 is stable up to",
        "note: motion alone",
    ):
        assert words in text
    plot_check(found, tmp_path / "scene.png")
    assert image.imread(tmp_path / "scene.png").std() > 0.05


def test_the_mode_of_the_robot_comes_first(found):
    """Though six of many modes are shown, and others have less energy."""
    rows = [
        {
            "mode": f"{i:03b}",
            "possible": True,
            "torque_Nm": 1.0,
            "strain": None,
            "least_stiffness_N_m": 1.0,
            "energy_J": i,
        }
        for i in range(8)
    ]
    figures = {**found.figures, "modes": rows, "start": {**found.figures["start"], "mode": "111"}}
    lines = check_table(replace(found, figures=figures)).splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("modes that hold"))
    assert lines[first + 2].startswith("111 (this one)")
    assert "and 2 more" in lines[first + 8]


def test_tips_that_overload_motors_are_no_workspace(scene):
    """All are when the motors have no torque to speak of, none when they have much."""
    areas = {}
    for limit in (0.8, 1e3):
        case = replace(scene, robot=replace(scene.robot, torque_limit=limit))
        space = examine(case, modes=False).figures["workspace"]
        areas[limit] = space["area_m2"], space["overloaded_m2"]
    assert areas[1e3][1] == 0.0
    assert sum(areas[0.8]) == pytest.approx(areas[1e3][0])
    assert 0.0 < areas[0.8][0] < areas[1e3][0]


def test_a_picture_of_somebody_is_left_alone(tmp_path, capsys):
    (tmp_path / "mine.png").write_bytes(b"mine")
    assert main(["check", "lemniscate", "--picture", str(tmp_path / "mine.png")]) == 1
    assert "is not as pcr-mpc wrote it" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "near"), [("lemniscat", "lemniscate"), ("planar_pear", "planar_pair")])
def test_neither_robot_nor_scene(name, near, capsys):
    assert main(["check", name]) == 1
    assert f"did you mean '{near}'?" in capsys.readouterr().err


def test_three_rods_have_a_motor_more_than_the_tip_needs(scene):
    one, other = unidentifiable(load_robot(shipped("three_rods", "robot")))
    assert "1 motor more than the tip has coordinates" in other.text
    assert unidentifiable(scene.robot) == [one]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["heavy_rods", "vertical", "payload", "release"])
def test_shipped_scenes_of_all_kinds_can_run(name):
    assert examine(load_scene(shipped(name))).errors == []
