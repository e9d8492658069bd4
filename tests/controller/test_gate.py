"""Measurements that cannot be are not believed, and a controller that is asked wrongly says so."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import PCRError, SimulationError, inverse_statics, load_scene, load_tuning, make_controller, simulate
from pcr_mpc.loop.parts.controllers import Replay
from pcr_mpc.loop.parts.gate import PATIENCE, _Sensor
from tests.conftest import CONTROLLERS, MODELS

SCENES = MODELS / "scenes"


class Spoilt:
    """A controller that is told something else than what is measured."""

    def __init__(self, controller, spoil):
        self.controller, self.spoil = controller, spoil
        self.name, self.start = controller.name, controller.start

    def step(self, k, x):
        x = x.copy()
        self.spoil(k, x)
        return self.controller.step(k, x)


def run_spoilt(scene, spoil, tuning=None):
    if tuning is not None:
        scene = scene.tuned(tuning)
    return simulate(scene, scene.make_plant(), Spoilt(make_controller(scene), spoil))


def added(index, amount):
    def spoil(x):
        x[index] += amount

    return spoil


def scaled(part, factor):
    def spoil(x):
        x[part] *= factor

    return spoil


@pytest.fixture(scope="module")
def lemniscate():
    return replace(load_scene(SCENES / "lemniscate.toml"), duration=0.9)


@pytest.fixture(scope="module")
def tunings():
    names = ("lemniscate", "default", "lqr", "pd", "nonlinear")
    found = {name: load_tuning(CONTROLLERS / f"{name}.toml") for name in names}
    found["nonlinear"] = replace(found["nonlinear"], horizon=4)  # IPOPT takes long to set up
    return found | {f"{name} alone": replace(found[name], observer=None) for name in ("lemniscate", "pd")}


def apart_mm(run, other):
    return 1e3 * float(np.hypot(*(run.x[:, :2] - other.x[:, :2]).T).max())


def at(periods):
    """What is off in which period."""

    def spoil(k, x):
        if k in periods:
            index, amount = periods[k]
            x[index] += amount

    return spoil


@pytest.mark.parametrize("name", ["lemniscate", "default", "lqr", "pd", "lemniscate alone", "pd alone"])
def test_readings_that_cannot_be_are_bridged(lemniscate, tunings, name):
    """Off by 1 m and 10 cm, in x and y, at the start, once and in a row; and a motor angle."""
    periods = {0: (1, -0.1), 20: (0, 1.0), 55: (4, 0.5), 75: (0, 0.1)} | dict.fromkeys(range(30, 40), (1, 0.1))
    runs = [run_spoilt(lemniscate, spoil, tunings[name]) for spoil in (at(periods), at({}))]
    assert apart_mm(*runs) < 0.003
    summary = runs[0].summary()
    assert (summary["failures"], summary["limit_violations"], summary["fallbacks"]) == (0, 0, 0)
    told = [event for event in runs[0].events if event["kind"] == "measurement"]
    assert [round(event["t"] / 0.01) for event in told] == sorted(periods)
    assert summary["refused_measurements"] == len(periods)
    assert not runs[1].events


def test_what_just_passes_does_not_shut_the_gate(lemniscate, tunings):
    """A tip off by 4.5 mm, and an encoder by 0.03 rad, are believed; then so are the sound readings after them."""
    periods = {60: (0, 0.0045), 75: (4, 0.03)}
    runs = [run_spoilt(lemniscate, spoil, tunings["default"]) for spoil in (at(periods), at({}))]
    assert 0.1 < apart_mm(*runs) < 3.0
    assert runs[0].summary()["refused_measurements"] == 0


def test_a_surprise_fades_by_half_in_every_period():
    sensor, seen = _Sensor(), []
    for surprise in (8.0, 0.0, 0.5, 3.0, 0.0):
        sensor.believed(surprise)
        seen.append(sensor.surprise)
    assert not sensor.refused([0.1], 1e-3)
    assert [*seen, sensor.surprise] == [8.0, 4.0, 2.0, 3.0, 1.5, 0.75]


def test_the_nonlinear_mpc_is_behind_the_gate_too(lemniscate, tunings):
    scene = replace(lemniscate, duration=0.3)
    runs = [run_spoilt(scene, at(periods), tunings["nonlinear"]) for periods in ({20: (0, 0.1)}, {})]
    assert apart_mm(*runs) < 0.003
    assert runs[0].summary()["refused_measurements"] == 1


@pytest.fixture(scope="module")
def built(lemniscate):
    scene = replace(lemniscate, duration=0.1)
    return make_controller(scene), scene.start()


@pytest.fixture
def started(built):
    controller, pose = built
    controller.start(pose)
    return controller, np.concatenate([pose.p, np.zeros(2), pose.q])


def test_noise_load_and_delay_hide_no_glitch():
    scene = replace(load_scene(SCENES / "sensors.toml"), duration=0.9)
    clean, spoilt = (run_spoilt(scene, at(periods)) for periods in ({}, {60: (0, 1.0), 65: (1, 0.1), 80: (0, np.nan)}))
    assert clean.summary()["refused_measurements"] == 0
    # A sample that is missing costs what the noise of the others does.
    assert apart_mm(spoilt, clean) < 0.05
    assert spoilt.summary()["refused_measurements"] == 3


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (added(0, 1.0), "out of reach"),
        (added(0, 0.05), "cannot be further than"),
        (added(0, np.nan), "not finite"),
        (scaled(slice(0, 2), 1e3), "millimetres"),
        (scaled(slice(0, 2), 1e2), "out of reach"),  # centimetres
        (lambda x: x.__setitem__(slice(0, 2), 1e3 * x[:2] + 50.0), "out of reach"),
        (scaled(slice(4, 6), 180 / np.pi), "degrees"),
        (added(4, -2 * np.pi), "wrapped = true"),
        (added(5, -np.inf), "not finite"),
        (added(5, 0.2), "motors turn by at most"),
        (added(slice(0, 6), 1e308), "out of reach"),
        (added(slice(0, 6), -1.7e308), "not finite"),
    ],
)
def test_the_event_says_what_is_odd_and_when(started, spoil, words):
    controller, x = started
    expected = controller.step(0, x).u
    wrong = x.copy()
    spoil(wrong)
    decision = controller.step(1, wrong)
    assert {event["kind"] for event in decision.events} == {"measurement"}
    assert all(event["message"].startswith("period 1: ") for event in decision.events)
    assert any(words in event["message"] for event in decision.events)
    assert np.abs(decision.u - expected).max() < 0.01  # rad/s: nothing moves in the first periods


@pytest.mark.parametrize(("side", "force"), [(-1.0, 1.0), (1.0, 4.0)])
def test_what_can_be_is_believed(lemniscate, side, force):
    """Loads that strike at once, on a robot 40 % softer or stiffer than the controller thinks, a period later."""
    rods = tuple(replace(rod, bending_stiffness=(1.0 + 0.4 * side) * rod.bending_stiffness)
                 for rod in lemniscate.robot.rods)  # fmt: skip
    true = replace(lemniscate, robot=replace(lemniscate.robot, rods=rods), force=(0.3 * force, side * force), delay=1)
    controller = make_controller(lemniscate)
    run = simulate(true, true.make_plant(), controller)
    assert run.summary()["refused_measurements"] == 0
    assert run.x[:, :2].std() > 0.01  # it moves


def test_a_robot_that_was_pushed_is_found_again(pair):
    """The tip is elsewhere for good: after a while the controller believes it, and says so."""
    scene = replace(load_scene(SCENES / "hold_with_load.toml"), duration=0.9, force=(0.0, 0.0))
    pose = inverse_statics(pair, (0.03, 0.27), mode="LR")

    class Elsewhere:
        """The robot is in another pose than the one the controller was started in."""

        def __init__(self, controller):
            self.controller, self.name = controller, controller.name

        def start(self, _):
            self.controller.start(scene.start())

        def step(self, k, x):
            return self.controller.step(k, x)

    for tuning in (scene.tuning, replace(scene.tuning, observer=None)):
        there = replace(scene, start_tip=(0.03, 0.27), trajectory=scene.trajectory)
        run = simulate(there, there.make_plant(), Elsewhere(make_controller(scene, tuning)))
        assert run.pose.p == pytest.approx(pose.p)
        kinds = [event["kind"] for event in run.events]
        # Tip and encoders, each refused for as long as it takes.
        assert kinds.count("reinitialised") == 2
        assert kinds.count("measurement") == 2 * (PATIENCE - 1)
        assert run.summary()["fallbacks"] == 0
        assert 1e3 * run.error[-1] < 0.1


@pytest.mark.parametrize("name", ["lemniscate", "lemniscate alone"])
def test_encoders_that_wrap(tunings, name):
    scene = replace(load_scene(SCENES / "hold_with_load.toml").tuned(tunings[name]), duration=0.2)
    assert scene.start().q[0] > np.pi
    wrapped, plain = (
        simulate(one, one.make_plant(), make_controller(one)) for one in (replace(scene, wrapped=True), scene)
    )
    assert apart_mm(wrapped, plain) < 1e-9
    assert wrapped.events == plain.events == []
    one = replace(scene, wrapped=True)
    with pytest.raises(SimulationError, match=r"jump by 2 pi.*\[sensor\] wrapped = true"):
        simulate(one, one.make_plant(), make_controller(scene))


def test_a_scene_file_says_that_encoders_wrap(tmp_path):
    text = (SCENES / "hold_with_load.toml").read_text().replace('"../', f'"{SCENES}/../')
    path = tmp_path / "wraps.toml"
    path.write_text(text + "\n[sensor]\nwrapped = true\n\n[limits]\ntracking_error = 0.005\n")
    scene = load_scene(path)
    assert scene.wrapped
    assert scene.allowed_error == 0.005
    assert load_scene(SCENES / "hold_with_load.toml").allowed_error == pytest.approx(0.04)
    path.write_text(text + "\n[limits]\ntracking_error = 0.0\n")
    with pytest.raises(ValueError, match="tracking_error"):
        load_scene(path)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (scaled(slice(4, 6), 180 / np.pi), "degrees"),
        (scaled(slice(0, 2), 1e3), "millimetres"),
        (scaled(slice(0, 2), 1e2), "centimetres"),
        (lambda x: x.__setitem__(slice(0, 2), 1e3 * x[:2] + 50.0), "millimetres"),
        (added(4, -2 * np.pi), "wrapped = true"),
    ],
)
def test_a_first_measurement_in_other_units_is_refused(started, spoil, words):
    controller, x = started
    wrong = x.copy()
    spoil(wrong)
    with pytest.raises(PCRError, match=words) as caught:
        controller.step(0, wrong)
    assert isinstance(caught.value, ValueError)
    # It is as it was before.
    assert not controller.step(0, x).events


@pytest.mark.parametrize(("place", "wrong"), [(0, -1.0), (1, 1.0), (0, 0.05), (5, 0.2)])
def test_a_first_measurement_that_is_merely_wrong_is_bridged(started, place, wrong):
    controller, x = started
    decision = controller.step(0, x + wrong * (np.arange(6) == place))
    assert [event["kind"] for event in decision.events] == ["measurement"]
    assert np.abs(decision.u).max() < 0.01  # rad/s


def test_what_was_not_measured_is_said_in_words(started):
    controller, x = started
    said = " ".join(event["message"] for event in controller.step(0, np.where(np.arange(6) < 2, np.nan, x)).events)
    assert "no tip was measured" in said
    assert "nan" not in said
    said = " ".join(event["message"] for event in controller.step(1, np.where(np.arange(6) > 3, np.nan, x)).events)
    assert "no motor angles were measured" in said


@pytest.mark.parametrize("wrong", [np.zeros(5), np.zeros(7), np.zeros((2, 3)), 0.25, [[0.0] * 6] * 6, "123456", None])
def test_shapes_are_checked(started, wrong):
    controller, x = started
    with pytest.raises(ValueError, match=r"x (has shape .*expected \(6,\)|is .*expected numbers)"):
        controller.step(0, wrong)
    assert np.isfinite(controller.step(0, x).u).all()


def test_other_forms_of_the_same_state(built):
    controller, pose = built
    x = np.concatenate([pose.p, np.zeros(2), pose.q])
    locked = x.copy()
    locked.flags.writeable = False
    answers = []
    for form in (x, x.tolist(), tuple(x.tolist()), x[:, None], x[None], locked, np.repeat(x, 2)[::2], x.astype("f4")):
        controller.start(pose)
        controller.step(0, form)
        answers.append(controller.step(np.int64(1), form).u)
    assert (np.array(answers[:-1]) == answers[0]).all()
    assert answers[-1] == pytest.approx(answers[0], abs=1e-3)
    assert answers[0].any()


@pytest.mark.parametrize("k", [-1, 1.0, 0.5, "1", None, True, np.int64(-3)])
def test_periods_are_counted_from_zero(started, k):
    controller, x = started
    with pytest.raises(ValueError, match=r"k = .* must be a whole number"):
        controller.step(k, x)
    with pytest.raises(ValueError, match=r"k = .* must be a whole number"):
        Replay(np.zeros((3, 2))).step(k, x)


def test_a_step_before_the_start_says_so(lemniscate):
    with pytest.raises(PCRError, match=r"lemniscate was not started: call start\(pose\)"):
        make_controller(lemniscate).step(0, np.zeros(6))
    with pytest.raises(ValueError, match="beyond the 3 periods"):
        Replay(np.zeros((3, 2))).step(3, np.zeros(6))


@pytest.mark.parametrize("name", ["lemniscate", "lqr"])
def test_beyond_the_end_the_last_point_is_held(tunings, name):
    """A scene that ends in full motion, and a robot that goes on: it settles where the reference was at the end."""
    scene = replace(load_scene(SCENES / "lemniscate.toml").tuned(tunings[name]), duration=0.8, delay=1)
    end = scene.trajectory(np.array([0.8]))[0]
    assert np.hypot(*end[1]) > 0.1  # m/s
    longer = replace(scene, duration=1.6)
    run = simulate(longer, longer.make_plant(), make_controller(scene))
    assert run.summary()["fallbacks"] == 0
    assert run.x[-1, :2] == pytest.approx(end[0], abs=1e-5)
    same = simulate(scene, scene.make_plant(), make_controller(scene))
    assert (run.u[:80] == same.u).all()
