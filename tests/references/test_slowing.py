"""A path that asks too much says when, how much, and by how much slower it would not; a rough one says where."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    Blended,
    Circle,
    Line,
    ModelError,
    PCRError,
    Polygon,
    check_scene,
    inverse_statics,
    load_scene,
    make_controller,
    simulate,
)
from pcr_mpc.loop.demand.feasibility import reference_demand, reference_excess
from pcr_mpc.loop.demand.feed_forward import feed_forward
from pcr_mpc.loop.references.smoothness import contradictions, jumps
from pcr_mpc.report.tables import summary_table
from tests.conftest import MODELS

SQUARE = ((-0.03, 0.22), (0.03, 0.22), (0.03, 0.28), (-0.03, 0.28))


@pytest.fixture(scope="module")
def scene():
    return replace(load_scene(MODELS / "scenes/square.toml"), duration=5.2, period=0.02)


def on(scene, path, slower=1.0, **robot):
    """A scene of a path, made slower."""
    path = Blended(path, time_scale=slower)
    duration = scene.period * np.ceil(path.duration / scene.period)
    begin = tuple(path(np.zeros(1))[0, 0].tolist())
    return replace(scene, trajectory=path, start_tip=begin, duration=duration, robot=replace(scene.robot, **robot))


FAST = {
    "circle": Circle((0.0, 0.25), 0.06, 0.8),
    "square": Polygon(SQUARE, 0.005, 0.25),
}


@pytest.mark.parametrize(
    ("path", "limits"),
    [
        pytest.param("circle", {"rate_limit": 3.0}, marks=pytest.mark.slow),
        ("circle", {"acceleration_limit": 20.0}),
        ("square", {"rate_limit": 3.0, "acceleration_limit": 1e4}),
        pytest.param("square", {"rate_limit": 100.0, "acceleration_limit": 60.0}, marks=pytest.mark.slow),
        ("square", {"torque_limit": 0.94, "rate_limit": 100.0, "acceleration_limit": 1e4}),
    ],
)
def test_so_much_slower_it_keeps_the_limit_and_less_does_not(scene, path, limits):
    """Both sides of what it says, by the inverse dynamics of the path that is really made slower."""
    (line,) = check_scene(on(scene, FAST[path], **limits))
    factor = float(re.search(r"made ([\d.]+) times as slow", line)[1])
    assert 1.05 < factor < 4.0
    assert check_scene(on(scene, FAST[path], factor, **limits)) == []
    assert len(check_scene(on(scene, FAST[path], 0.97 * factor, **limits))) == 1


def test_what_no_slowing_mends_is_said(scene):
    path = Line(((0.0, 0.29), (0.0, 0.26)), 0.1)
    at_rest = float(np.abs(inverse_statics(scene.robot, (0.0, 0.26), mode="LR").motor_torque).max())
    start = float(np.abs(inverse_statics(scene.robot, (0.0, 0.29), mode="LR").motor_torque).max())
    limit = (at_rest + start) / 2
    assert limit < 0.99 * at_rest
    (line,) = check_scene(on(scene, path, torque_limit=limit))
    assert "slower does not help: at rest it takes" in line
    assert float(line.split("it takes ")[1].split(" N m")[0]) == pytest.approx(at_rest, rel=1e-3)


def test_to_first_order_it_is_said_to_be_about(scene):
    fast = on(scene, FAST["circle"], rate_limit=3.0)
    dynamics = feed_forward(fast, fast.robot, fast.start(), 0)
    (line,) = reference_excess(fast, dynamics)
    (solved,) = check_scene(fast)
    about, exact = (float(re.search(r"([\d.]+) times as slow", one)[1]) for one in (line, solved))
    assert "made about" in line
    assert about == pytest.approx(exact, rel=0.05)


def test_a_path_too_fast_for_the_rods_is_told_from_one_out_of_bounds(scene):
    with pytest.raises(
        PCRError,
        match=r"acceleration of .*, for which [^;]*\. .* everywhere on it.* factor of at least \S+ \(time_scale\)$",
    ) as e:
        check_scene(on(scene, Circle((0.0, 0.25), 0.06, 0.22)))
    slower = float(str(e.value).split("factor of at least ")[1].split()[0])
    check_scene(on(scene, Circle((0.0, 0.25), 0.06, 0.22), slower))
    # A stop of motor 0 is in the way, however slowly; drag does not make it a matter of speed.
    out = on(scene, Line(((0.0, 0.25), (0.0, 0.02)), 0.1))
    with pytest.raises(PCRError, match=r"reference at t = 2\.\d+ s: p = .* needs motor 0 at 5\.2\d+ rad, outside") as e:
        check_scene(out)
    assert "slower" not in str(e.value)


def test_a_path_out_of_reach_says_how_far_and_when(tmp_path):
    text = (
        (MODELS / "scenes/square.toml")
        .read_text()
        .replace("../../", f"{MODELS.parent}/")
        .replace('"../', f'"{MODELS}/')
    )
    path = tmp_path / "scene.toml"
    path.write_text(text.replace("0.28", "0.45"))
    with pytest.raises(
        ModelError, match=r"reference at t = [\d.]+ s: tip .* from the base of rod 0.*; at t = "
    ) as caught:
        load_scene(path)
    when, rod, short = re.search(r"at t = ([\d.]+) s rod (\d) is ([\d.]+) mm too short", str(caught.value)).groups()
    place = load_scene(MODELS / "scenes/square.toml").trajectory
    place = replace(place, path=replace(place.path, corners=((-0.03, 0.22), (0.03, 0.22), (0.03, 0.45), (-0.03, 0.45))))
    tip = place(np.array([float(when)]))[0, 0]
    base = np.array([[-0.1, 0.0], [0.1, 0.0]][int(rod)])
    assert 1e3 * (np.linalg.norm(tip - base) - 0.4) == pytest.approx(float(short), abs=0.1)
    assert float(short) > 40.0
    thousandfold = (
        text.replace("0.22", "220.0").replace("0.28", "280.0").replace("0.03", "30.0").replace("0.005", "5.0")
    )
    path.write_text(thousandfold.replace("speed = 0.1", "speed = 100.0"))
    with pytest.raises(ModelError, match=r"is it in millimetres\?"):
        load_scene(path)
    path.write_text(text.replace("0.22", "22.0").replace("0.28", "28.0").replace("0.03", "3.0").replace("0.005", "0.5"))
    with pytest.raises(ModelError, match=r"is it in millimetres or centimetres\?"):
        load_scene(path)


def test_rows_out_of_reach_are_to_blame_and_not_the_start_that_is_left_to_them(tmp_path):
    text = (MODELS / "scenes/circle_from_file.toml").read_text().replace("../../", f"{MODELS.parent}/")
    (tmp_path / "scene.toml").write_text(
        text.replace('"../', f'"{MODELS}/').replace("circle_60mm", "rows").replace("repeat = 2", "repeat = 1")
    )
    for first, row in ((0.52, 1), (0.25, 4)):
        rows = "".join(f"0.{i},0.0{i},{first if i < 3 else 0.52}\n" for i in range(7))
        (tmp_path / "rows.csv").write_text(f"t_s,x_m,y_m\n{rows}")
        with pytest.raises(ModelError, match=rf"reference at t = \S+ s \(at row {row} of its file\): tip "):
            load_scene(tmp_path / "scene.toml")


# --- jumps ------------------------------------------------------------------------------------------------------------


class Kinked:
    """At rest until 0.4137 s, then off at once: with a speed [m/s], or an acceleration [m/s^2]."""

    def __init__(self, speed=0.0, acceleration=0.0, said=1.0):
        self.speed, self.acceleration, self.said = speed, acceleration, said

    def __call__(self, t):
        late = np.maximum(np.asarray(t) - 0.4137, 0.0)
        on = late > 0
        samples = np.zeros((len(late), 3, 2))
        samples[:, 0] = [0.0, 0.25]
        samples[:, 0, 0] += self.speed * late + self.acceleration * late**2 / 2
        samples[:, 1, 0] = self.said * (self.speed * on + self.acceleration * late)
        samples[:, 2, 0] = self.acceleration * on
        return samples


T = 0.02 * np.arange(41)


def test_jumps_are_found_where_they_are():
    (jump,) = jumps(Kinked(acceleration=0.3), T, (0.0, 0.0))
    assert (jump.of, jump.count) == ("acceleration", 1)
    assert jump.t == pytest.approx(0.4137, abs=1e-6)
    assert jump.change == pytest.approx((0.3, 0.0))
    (jump,) = jumps(Kinked(speed=0.05), T, (0.0, 0.0))
    assert jump.of == "velocity"
    assert jump.size == pytest.approx(0.05)
    # A circle that is not blended: at its beginning and at its end.
    speed, acceleration = 2 * np.pi * 0.03 / 0.5, 0.03 * (2 * np.pi / 0.5) ** 2
    found = jumps(Circle((0.0, 0.25), 0.03, 0.5), T, (0.0, 0.0))
    assert [jump.of for jump in found] == ["velocity", "acceleration"]
    assert [jump.count for jump in found] == [2, 2]
    assert [jump.size for jump in found] == pytest.approx([speed, acceleration], rel=1e-6)
    assert jumps(Circle((0.0, 0.25), 0.03, 5.0), T, (2 * np.pi * 0.03 / 5.0, 0.0))[0].of == "acceleration"


def test_what_is_smooth_does_not_jump():
    smooth = Blended(Circle((0.0, 0.25), 0.03, 0.5), start=0.1)
    assert jumps(smooth, T, (0.0, 0.0)) == []
    assert jumps(lambda t: smooth(t), T, (0.0, 0.0)) == []  # not known to be the toolkit's
    assert contradictions(lambda t: smooth(t), T) == []


def test_jumps_are_warned_of_with_what_they_ask(scene):
    still = replace(scene, start_tip=(0.0, 0.25), duration=0.8)
    (line,) = check_scene(replace(still, trajectory=Kinked(acceleration=0.3)))
    assert "the reference's acceleration jumps by 0.3 m/s^2 at t = 0.414 s; motor" in line
    pose = still.start()
    turned = inverse_statics(still.robot, (0.0, 0.25), (-0.3 * still.robot.tip_mass, 0.0), guess=pose)
    step = float(np.abs(turned.q - pose.q).max())
    assert float(re.search(r"turn by ([\d.]+) rad at once", line)[1]) == pytest.approx(step, rel=0.02)
    lines = check_scene(replace(still, trajectory=Kinked(speed=0.05)))
    assert any("velocity jumps by 0.05 m/s at t = 0.414 s" in line for line in lines)


def test_a_velocity_that_is_none_is_warned_of(scene):
    wrong = Kinked(acceleration=0.3, said=2.0)
    (line,) = [line for line in contradictions(wrong, T) if "velocity is not" in line]
    assert "is not the derivative of its position" in line
    assert contradictions(Kinked(acceleration=0.3), T) == []
    assert contradictions(Kinked(speed=0.3), T) == []


# --- what is asked ----------------------------------------------------------------------------------------------------


def test_a_run_says_what_its_reference_asked(scene, capsys):
    short = replace(scene, duration=0.4)
    run = simulate(short, short.make_plant(), make_controller(short), progress=True)
    t = short.period * np.arange(short.n_periods + 1)
    p, v, a = np.moveaxis(short.trajectory(t), 1, 0)
    pose, angles, torques = short.start(), [], []
    for k in range(len(t)):
        pose = inverse_statics(short.robot, p[k], -short.robot.tip_mass * a[k] - short.robot.drag * v[k], guess=pose)
        angles.append(pose.q)
        torques.append(pose.motor_torque)
    rates = np.diff(angles, axis=0) / short.period
    changes = np.diff(rates, axis=0, prepend=np.zeros((1, 2))) / short.period
    asked = run.summary()["asked"]
    for name, values in (("rate_rad_s", rates), ("rate_change_rad_s2", changes), ("torque_Nm", np.array(torques))):
        assert asked[name]["asked"] == pytest.approx(np.abs(values).max(), rel=1e-6)
        k = np.abs(values).max(axis=1).argmax()
        assert asked[name]["t_s"] == pytest.approx(k * short.period)
    assert asked["rate_rad_s"]["limit"] == 6.0
    assert asked["speed_m_s"]["asked"] == pytest.approx(np.linalg.norm(v, axis=1).max())
    assert asked["acceleration_m_s2"]["asked"] == pytest.approx(np.linalg.norm(a, axis=1).max())
    assert 0.05 < asked["rod_margin"]["asked"] < 1.0
    line = f"{asked['rate_rad_s']['asked']:.3g} of 6 rad/s"
    assert f"square: the reference asks for at most {line}" in capsys.readouterr().err
    assert f"asked for         {line}" in summary_table(run.summary())
    assert reference_demand(short, make_started(short).reference) == asked


class Still:
    """A controller of one's own that knows nothing."""

    def start(self, pose):
        pass

    def step(self, k, x):
        return np.zeros(2)


def test_with_a_controller_of_ones_own_who_looks_on_is_told_too(scene, capsys):
    fast = replace(on(scene, FAST["circle"], rate_limit=3.0), duration=0.4, tracking_error=1.0)
    run = simulate(fast, fast.make_plant(), Still(), progress=True)
    assert [event["message"] for event in run.events if event["kind"] == "warning"] == check_scene(fast)
    assert "3 is allowed" in capsys.readouterr().err
    assert run.asked["rate_rad_s"]["asked"] > 3.0
    out = on(scene, Line(((0.0, 0.25), (0.0, 0.02)), 0.1))
    run = simulate(replace(out, tracking_error=1.0), out.make_plant(), Still(), progress=True)
    assert run.events[0]["message"].startswith("reference at t = 2.0")
    assert run.asked is None
    quiet = simulate(replace(fast, duration=0.1), fast.make_plant(), Still())
    assert quiet.events == []


def make_started(scene):
    controller = make_controller(scene)
    controller.start(scene.start())
    return controller
