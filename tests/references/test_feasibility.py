"""What a scene asks for and cannot have is said before it runs, with numbers; what was not kept is counted."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    HoldMotors,
    ModelError,
    check_scene,
    inverse_statics,
    load_scene,
    make_controller,
    simulate,
    solve_statics,
)
from pcr_mpc.cli import main
from pcr_mpc.loop.references.trajectory import Hold, PickAndPlace
from tests.conftest import MODELS

SCENES = MODELS / "scenes"


@pytest.fixture(scope="module")
def slow():
    """20 mm to the right in a second: nearly at rest all the way."""
    scene = load_scene(SCENES / "hold_slow.toml")
    path = replace(scene.trajectory, wait=0.25, move=1.0)
    plant = load_scene(SCENES / "limited.toml").plant
    return replace(scene, period=0.05, duration=1.5, trajectory=path, plant=plant)


@pytest.fixture(scope="module")
def path(slow, pair):
    """Poses along the way, in which the rods carry what eq. (7) of the paper asks for."""
    poses = [inverse_statics(pair, (-0.01, 0.25), mode="LR")]
    for p, v, a in slow.trajectory(0.05 * np.arange(1, 31)):
        poses.append(inverse_statics(pair, p, -pair.tip_mass * a - pair.drag * v, guess=poses[-1]))
    return poses


def only(lines):
    assert len(lines) == 1, lines
    numbers = [float(n) for n in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", lines[0])]
    return lines[0], numbers


def edited(tmp_path, name, **limits):
    """A shipped scene with limits of its own."""
    text = (
        (SCENES / f"{name}.toml")
        .read_text()
        .replace("../", f"{MODELS}/")
        .replace(f"{MODELS}/{MODELS}/", f"{MODELS}/../")
    )
    path = tmp_path / "edited.toml"
    path.write_text(text + "\n[limits]\n" + "".join(f"{key} = {value}\n" for key, value in limits.items()))
    return path


@pytest.mark.parametrize("limit", [0.75, 0.1])
def test_a_start_that_the_motors_cannot_hold_is_refused(tmp_path, limit, capsys):
    path = edited(tmp_path, "lemniscate", torque=limit)
    refused = rf"edited\.toml: .*0\.7566 N m of motor [01], which has {limit} N m"
    with pytest.raises(ModelError, match=refused) as caught:
        load_scene(path)
    assert caught.value.limit == limit
    assert main(["track", str(path), "--out", str(tmp_path / "out"), "--no-pictures"]) == 1
    assert re.search(refused, capsys.readouterr().err)


def test_a_start_is_refused_for_the_motors_and_for_the_limit_of_poses(slow):
    for weak in (
        replace(slow, robot=replace(slow.robot, torque_limit=0.5)),
        replace(slow, pose_limits=replace(slow.pose_limits, torque=0.5)),
    ):
        for attempt in (
            weak.start,
            lambda weak=weak: check_scene(weak),
            lambda weak=weak: simulate(weak, weak.make_plant(), make_controller(weak)),
        ):
            with pytest.raises(ModelError, match=r"0\.759 N m of motor [01], which has 0\.5 N m"):
                attempt()


def test_nothing_is_said_of_what_can_be_had(slow):
    assert check_scene(slow) == []
    run = simulate(replace(slow, duration=0.2), slow.make_plant(), make_controller(replace(slow, duration=0.2)))
    assert run.events == []
    assert run.summary()["warnings"] == 0
    assert run.pose_violations() == {"torque": 0, "rod margin": 0, "stiffness": 0, "strain": 0}


def test_rates(slow, path):
    poses = path
    rates = np.diff([eq.q for eq in poses], axis=0) / 0.05
    k, i = np.unravel_index(np.abs(rates).argmax(), rates.shape)
    limit = round(0.9 * float(np.abs(rates).max()), 4)
    line, numbers = only(check_scene(replace(slow, robot=replace(slow.robot, rate_limit=limit))))
    assert f"motor {i} to turn at" in line
    assert numbers[1] == pytest.approx(rates[k, i], rel=1e-3)
    assert numbers[3] == pytest.approx(limit, rel=1e-3)
    assert f"in {(np.abs(rates) > limit).any(axis=1).sum()} of 30 periods" in line


def test_changes_of_rate(slow, path):
    poses = path
    change = np.diff([eq.q for eq in poses], n=2, axis=0) / 0.05**2
    largest = float(np.abs(change).max())
    line, numbers = only(check_scene(replace(slow, robot=replace(slow.robot, acceleration_limit=0.5 * largest))))
    assert "rad/s^2" in line
    assert abs(numbers[1]) == pytest.approx(largest, rel=1e-3)


def test_torques_and_those_of_a_load(slow, path):
    poses = path
    start = float(np.abs(poses[0].motor_torque).max())
    loaded = replace(slow, force=(-0.5, 1.0))
    at_rest = [inverse_statics(slow.robot, eq.p, (-0.5, 1.0), guess=eq) for eq in poses]
    most = max(float(np.abs(eq.motor_torque).max()) for eq in at_rest)
    assert most > 1.01 * start
    limit = 0.5 * (start + most)
    line, numbers = only(check_scene(replace(loaded, robot=replace(slow.robot, torque_limit=limit))))
    assert "N m of motor" in line
    assert abs(numbers[0]) == pytest.approx(most, rel=0.02)
    assert check_scene(replace(loaded, robot=replace(slow.robot, torque_limit=1.05 * most))) == []


def test_region(slow):
    limits = replace(slow.pose_limits, tip_lower=(-0.02, 0.2), tip_upper=(0.004, 0.3))
    line, _ = only(check_scene(replace(slow, pose_limits=limits)))
    assert "0.018 m from the middle of its region in x" in line
    assert "0.012 is allowed" in line


def test_margins(slow, path):
    poses = path
    softest = min(float(eq.stiffness_eigenvalues[0]) for eq in poses)
    line, numbers = only(check_scene(replace(slow, pose_limits=replace(slow.pose_limits, stiffness=1.01 * softest))))
    assert "a stiffness of" in line
    assert numbers[0] == pytest.approx(softest, rel=1e-3)
    line, numbers = only(check_scene(replace(slow, pose_limits=replace(slow.pose_limits, rod_margin=0.89))))
    assert "a rod margin of" in line


def test_warnings_are_events_and_stand_on_stderr(slow, capsys):
    scene = replace(slow, duration=0.8, robot=replace(slow.robot, rate_limit=0.003))
    run = simulate(scene, scene.make_plant(), make_controller(scene), progress=True)
    said = [event for event in run.events if event["kind"] == "warning"]
    assert [event["message"] for event in said] == check_scene(scene)
    assert run.summary()["warnings"] == 1
    assert f"hold_slow: warning: {said[0]['message']}" in capsys.readouterr().err


def test_what_needs_no_statics_is_said_at_once(tmp_path):
    text = (
        (SCENES / "hold_with_load.toml").read_text().replace("../../", f"{MODELS.parent}/").replace("../", f"{MODELS}/")
    )
    path = tmp_path / "far.toml"
    path.write_text(text.replace("[0.0, 0.25]", "[0.0, 0.45]"))
    with pytest.raises(ModelError, match=r"far\.toml: .*reference at t = 0\.000 s: .*0\.460977 m from the base"):
        load_scene(path)
    upwards = 'kind = "pick_and_place"\npick = [0.0, 0.25]\nplace = [0.0, 0.4]\nlift = 0.0\nwait = 0.0\nmove = 1.0'
    path.write_text(re.sub(r"kind = .*\nposition = .*", upwards, text))
    with pytest.raises(ModelError, match=r"far\.toml: .*reference at t = 0\.\d+ s: .*from the base of rod") as caught:
        load_scene(path)
    reach = np.sqrt(0.4**2 - 0.1**2)
    when = caught.value.t
    heights = PickAndPlace((0.0, 0.25), (0.0, 0.4), 0.0, 0.0, 1.0)(np.array([when - 0.01, when]))[:, 0, 1]
    assert heights[0] < reach <= heights[1]
    path.write_text(re.sub(r"tip = .*\nmode = .*", "motors = [3.37, 192.9]", text))
    with pytest.raises(ModelError, match=r"motor 1 is to start at 192\.9 rad, beyond its stops, \[-2\.1, 2\.1\]"):
        load_scene(path)


def test_broken_limits_on_poses_are_counted(pair):
    """A swing of the tip with the motors held, against an independent solution of the rods."""
    scene = replace(load_scene(SCENES / "release.toml"), duration=0.3)
    poses = replace(scene.pose_limits, torque=0.8, tip_lower=(-0.01, 0.2), tip_upper=(0.01, 0.3), stiffness=62.0)
    scene = replace(scene, pose_limits=poses)
    run = simulate(scene, scene.make_plant(), HoldMotors(2))
    count, guess = {"torque": 0, "tip region": 0, "stiffness": 0}, run.pose
    for x in run.x[:: run.steps_per_period]:
        guess = solve_statics(pair, x[:2], x[4:], method="multiple_shooting", guess=guess)
        count["torque"] += np.abs(guess.motor_torque).max() > 0.8
        count["tip region"] += abs(x[0]) > 0.01 or not 0.2 < x[1] < 0.3
        count["stiffness"] += guess.stiffness_eigenvalues[0] < 62.0
    assert all(0 < n < 31 for n in count.values()), count
    found = run.summary()["pose_violations"]
    assert {kind: n for kind, n in found.items() if n} == pytest.approx(count, abs=1)
    assert found["rod margin"] == 0


def test_a_place_that_the_motors_cannot_hold_is_never_a_good_run(slow):
    """The start can be held, the end not: the robot stays away, and the run says why."""
    place = (0.0, 0.28)
    scene = replace(slow, start_tip=(0.0, 0.3), duration=1.0, trajectory=PickAndPlace((0.0, 0.3), place, 0.0, 0.0, 0.8))
    starts, ends = (inverse_statics(slow.robot, p, mode="LR").motor_torque for p in ((0.0, 0.3), place))
    limit = float(np.abs(starts).max() + 0.2 * (np.abs(ends).max() - np.abs(starts).max()))
    weak = replace(scene, robot=replace(slow.robot, torque_limit=limit),
                   pose_limits=replace(slow.pose_limits, torque=limit))  # fmt: skip
    run = simulate(weak, weak.make_plant(), make_controller(weak))
    summary = run.summary()
    assert summary["final_error_mm"] > 3.0
    (warning,) = [event["message"] for event in summary["events"] if event["kind"] == "warning"]
    assert f"where {limit:.4g} is allowed" in warning
    asked = abs(float(re.search(r"asks for (\S+) N m", warning)[1]))
    assert asked == pytest.approx(np.abs(ends).max(), rel=2e-2)
    assert Hold(place)(np.zeros(1))[0, 0] == pytest.approx(run.reference[-1])
