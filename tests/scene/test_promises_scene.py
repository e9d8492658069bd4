"""What a scene file promises: units, what goes together, what is refused, and what is known of its rung."""

import math
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ModelError, load_scene
from pcr_mpc.loop.references.trajectory import Lemniscate
from pcr_mpc.loop.run.finding import digest, verified
from pcr_mpc.loop.scene.settings import Finding, Need, Payload
from tests.conftest import CONTROLLERS, MODELS


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    shutil.copytree(MODELS, folder / "models")
    shutil.copytree(CONTROLLERS, folder / "controllers")
    return folder / "models/scenes"


@pytest.fixture
def edited(folder):
    """Load a scene in which some text is replaced, or to which some is added."""

    def load(name, *changes, add=""):
        text = (folder / f"{name}.toml").read_text()
        for old, new in changes:
            assert re.search(old, text, flags=re.M), old
            text = re.sub(old, new, text, count=1, flags=re.M)
        path = folder / "edited.toml"
        path.write_text(text + add)
        return load_scene(path)

    return load


@pytest.fixture(scope="module")
def lemniscate():
    return load_scene(MODELS / "scenes" / "lemniscate.toml")


@pytest.mark.parametrize(
    "start",
    [
        'tip = [0.0, 0.25]\nmode = "LR"\nmotors = [3.3, -0.2]',
        'motors = [3.3, -0.2]\nmode = "LR"',
        "tip = [0.0, 0.25]",
        'mode = "LR"',
        "velocity = [0.0, 0.0]",
    ],
    ids=["both", "motors and mode", "tip alone", "mode alone", "neither"],
)
def test_a_start_is_a_tip_with_its_mode_or_motors(edited, start):
    with pytest.raises(ModelError, match=r"start\.tip: give either tip and mode, or motors") as caught:
        edited("release", (r"^tip = .*\n^mode = .*$", start), (r"^velocity = \[0\.3.*$", ""))
    assert caught.value.key == "tip"


def test_a_start_at_motors_is_where_they_let_the_tip_rest(edited):
    scene = edited("release", (r"^tip = .*\n^mode = .*$", "motors = [3.3, -0.2]"))
    pose = scene.start()
    assert pose.q.tolist() == [3.3, -0.2]
    assert pose.force == pytest.approx([0.0, 0.0], abs=1e-7)
    assert pose.stable
    assert (scene.start_tip, scene.start_mode, scene.start_velocity) == (None, None, (0.3, -0.2))


def test_a_start_is_searched_for_once(lemniscate):
    """For scenes that differ in other things too; it is a frozen value, and another start is another."""
    pose = lemniscate.start()
    assert replace(lemniscate, duration=2.0, force=(1.0, 0.0)).start() is pose
    assert not pose.q.flags.writeable
    elsewhere = replace(lemniscate, start_tip=(0.0, 0.26)).start()
    assert elsewhere.p.tolist() == [0.0, 0.26]
    heavier = replace(lemniscate, robot=replace(lemniscate.robot, tip_mass=0.3))
    assert heavier.start().robot.tip_mass == 0.3
    resting = replace(lemniscate, trajectory=None, tuning=None, start_tip=None, start_mode=None,
                      start_motors=tuple(pose.q))  # fmt: skip
    assert resting.start() is resting.start() is not pose


@pytest.mark.parametrize(("period", "fits"), [(0.005, True), (0.0015, False), (4e-4, False), (6.0, True), (6.1, False)])
def test_a_tuning_with_a_period_that_does_not_fit_is_refused(lemniscate, period, fits):
    """A multiple of the plant's step of 1 ms, at most the duration of 6 s."""
    tuning = replace(lemniscate.tuning, period=period)
    if fits:
        assert lemniscate.tuned(tuning).period == period
        assert lemniscate.tuned(tuning).n_periods == round(6.0 / period)
    else:
        with pytest.raises(ModelError, match=rf"period {period:g} s does not fit scene lemniscate") as caught:
            lemniscate.tuned(tuning)
        assert caught.value.key == "period"


@pytest.mark.parametrize(
    ("changes", "add", "message"),
    [
        ([(r"^duration = 1\.0", "duration = 0.005")], "", r"period is 0\.01 s, longer than the duration"),
        ([(r"^period = 0\.01", "period = 0.0001")], "", r"period is 0\.0001 s, not a multiple"),
        ([(r"^kind = .*$", 'kind = "hold"\nposition = [0.0, 0.25]')], "", r"a reference needs control\.tuning"),
        ([], "[limits]\ntip_lower = [0.0, 0.0]\n", r"limits\.tip_lower: give both"),
        ([], "[limits]\ntip_upper = [0.0, 0.0]\n", r"limits\.tip_lower: give both"),
        ([], "[limits]\ntip_lower = [0.1, 0.0]\ntip_upper = [0.1, 1.0]\n", r"is not below tip_upper"),
        ([], "[limits]\nrate = 0.0\n", r"limits\.rate: is 0"),
        ([], "[limits]\nrod_margin = 0.95\n", r"limits\.rod_margin: is 0\.95"),
        ([], "[sensor]\ntip_noise = -1.0\n", r"sensor\.tip_noise: is -1"),
        ([], "[sensor]\nangle_step = -1.0\n", r"sensor\.angle_step: is -1"),
        ([(r"^period = 0\.01", "period = 0.01\ndelay = -1")], "", r"control\.delay: expected an integer >= 0"),
        ([(r"^period = 0\.01", "period = 0.01\ndeadline = -1.0")], "", r"control\.deadline: is -1"),
        ([(r"^period = 0\.01", "period = 0.01\ndeadline = 0.011")], "", r"deadline is 0\.011 s, longer than the"),
        ([(r"^period = 0\.01", 'period = 0.01\nlate = "never"')], "", r"control\.late: expected one of hold"),
        ([(r"^tip_accuracy = \S+", "tip_accuracy = 0.0")], "", r"need\.tip_accuracy: is 0"),
        ([(r"^tip_error = \S+", "tip_error = -0.1")], "", r"chosen\.tip_error: is -0\.1"),
        ([(r"^digest = \S+", "digest = 5")], "", r"chosen\.digest: expected a string"),
    ],
)  # fmt: skip
def test_what_a_scene_cannot_have_is_named(edited, changes, add, message):
    with pytest.raises(ModelError, match=message):
        edited("release", *changes, add="\n" + add)


def test_a_tuning_without_a_reference_has_no_use(edited):
    with pytest.raises(ModelError, match="has no use for it"):
        edited("release", (r"^period = 0\.01", 'period = 0.01\ntuning = "../../controllers/default.toml"'))


def test_figures_of_a_scene_are_turned_into_si_units(edited):
    """Millimetres and microseconds in the file, metres and seconds in the scene."""
    scene = edited(
        "release",
        (r"^tip_accuracy = \S+", "tip_accuracy = 0.25"), (r"^plant_step = \S+", "plant_step = 500.0"),
        (r"^control_step = \S+", "control_step = 4000.0"), (r"^tip_error = \S+", "tip_error = 0.136"),
        (r"^estimated = \S+", "estimated = 0.002"),
    )  # fmt: skip
    need = scene.need
    assert [need.tip_accuracy, need.plant_step, need.control_step] == pytest.approx([2.5e-4, 5e-4, 4e-3])
    assert scene.finding.tip_error == pytest.approx(1.36e-4)
    assert scene.finding.estimated == pytest.approx(2e-6)


def test_limits_of_a_scene_replace_those_of_its_robot(edited):
    limits = (
        "\n[limits]\nrate = 2.0\nacceleration = 50.0\ntorque = 0.9\ntip_lower = [-0.1, 0.1]\ntip_upper = [0.1, 0.3]\n"
    )
    scene = edited("release", add=limits)
    assert (scene.robot.rate_limit, scene.robot.acceleration_limit, scene.robot.torque_limit) == (2.0, 50.0, 0.9)
    assert (scene.pose_limits.torque, scene.pose_limits.tip_lower, scene.pose_limits.tip_upper) == (
        0.9, (-0.1, 0.1), (0.1, 0.3))  # fmt: skip
    # Stability margins have defaults: 5 % of a rod's load, one sum of EI/L^3 of stiffness; 0 switches one off.
    assert scene.pose_limits.rod_margin == 0.05
    assert scene.pose_limits.stiffness == pytest.approx(2 * 0.05 / 0.4**3)
    off = edited("release", add="\n[limits]\nrod_margin = 0.0\nstiffness = 0.0\n").pose_limits
    assert (off.rod_margin, off.stiffness) == (None, None)
    assert edited("release", add="\n[world]\ngravity = [0.0, -9.81]\n").robot.gravity == (0.0, -9.81)


def test_sensors_delays_and_loads_are_read(edited):
    scene = edited(
        "release", (r"^period = 0\.01", 'period = 0.01\ndelay = 2\ndeadline = 0.004\nlate = "shifted_plan"'),
        add="\n[sensor]\ntip_noise = 5e-5\nangle_step = 0.0015\n[load]\nforce = [0.5, -1.0]\n",
    )  # fmt: skip
    assert (scene.delay, scene.deadline, scene.late) == (2, 0.004, "shifted_plan")
    assert (scene.tip_noise, scene.angle_step, scene.force) == (5e-5, 0.0015, (0.5, -1.0))
    plain = edited("release")
    assert (plain.delay, plain.deadline, plain.late, plain.tip_noise, plain.angle_step, plain.force) == (
        0, math.inf, "hold", 0.0, 0.0, (0.0, 0.0))  # fmt: skip


def test_a_finding_holds_only_while_it_meets_the_need_and_rests_on_the_same(lemniscate):
    need = Need(1e-4, 1.0, 1.0)
    scene = replace(lemniscate, need=need)
    for error, holds in ((0.5e-4, True), (1e-4, True), (1.01e-4, False), (math.nan, False)):
        found = replace(scene, finding=Finding(error, 0.0, digest(scene)))
        assert verified(found) is holds, error
    good = replace(scene, finding=Finding(0.5e-4, 0.0, digest(scene)))
    assert not verified(replace(good, need=None))
    assert not verified(replace(good, finding=None))
    assert not verified(replace(good, finding=replace(good.finding, digest="0")))


@pytest.mark.parametrize(
    "changed",
    [
        {"duration": 5.0},
        {"period": 0.02},
        {"force": (0.1, 0.0)},
        {"delay": 1},
        {"start_velocity": (0.0, 0.1)},
        {"start_mode": "RL"},
        {"payload": Payload(0.1, 0.0, 1.0)},
        {"trajectory": Lemniscate((0.0, 0.25), (0.12, 0.06), 2.0, 1.1)},
        {"need": Need(2e-4, 1.0, 1.0)},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_a_finding_rests_on_the_motion(lemniscate, changed):
    assert digest(replace(lemniscate, **changed)) != digest(lemniscate)


def test_a_finding_does_not_rest_on_the_tuning_nor_on_names(lemniscate):
    other = replace(lemniscate, name="b", tuning=replace(lemniscate.tuning, horizon=9), finding=Finding(0.0, 0.0, ""))
    assert digest(other) == digest(lemniscate)
    assert digest(replace(lemniscate, robot=replace(lemniscate.robot, drag=0.3))) != digest(lemniscate)


def test_a_payload_is_carried_from_its_pick_up_to_its_place(lemniscate):
    payload = Payload(0.2, 0.3, 0.6)
    times = np.array([[0.0, 0.2999], [0.3 - 1e-12, 0.3], [0.5999, 0.6 - 1e-12], [0.6, 9.0]])
    assert payload.carried(times).tolist() == [[0.0, 0.0], [0.2, 0.2], [0.2, 0.0], [0.0, 0.0]]
    # Multiples of a step that are not the decimal number: 0.1 * 3 > 0.3.
    assert payload.carried(0.1 * np.arange(8)).tolist() == [0.0] * 3 + [0.2] * 3 + [0.0] * 2
    assert lemniscate.carried(times).tolist() == np.zeros((4, 2)).tolist()


def test_smooth_motions_stay_at_their_ends_before_and_after():
    path = load_scene(MODELS / "scenes/payload.toml").trajectory
    samples = path(np.array([-1.0, 0.0, 0.2, 0.8, 0.9, 5.0]))
    assert samples[:, 0] == pytest.approx(np.array([[-0.06, 0.22]] * 3 + [[0.06, 0.22]] * 3), abs=1e-15)
    assert samples[:, 1:] == pytest.approx(np.zeros((6, 2, 2)), abs=1e-12)
