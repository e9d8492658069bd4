"""What a run leaves behind: everything that it was, to the last bit, and what each number is."""

import json
import time
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from pcr_mpc import (
    Equilibrium,
    HoldMotors,
    ModelError,
    Run,
    load_run,
    load_scene,
    make_controller,
    simulate,
    solve_statics,
)
from pcr_mpc.loop.parts.controllers import Replay
from pcr_mpc.loop.run.record import from_text, to_text
from tests.conftest import MODELS

SCENES = MODELS / "scenes"


@pytest.fixture(scope="module")
def run():
    """Noise, encoders, a delay of two periods and an unknown load."""
    scene = replace(load_scene(SCENES / "sensors.toml"), duration=0.4)
    return simulate(scene, scene.make_plant(), make_controller(scene), seed=3)


@pytest.fixture(scope="module")
def files(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("record")
    run.save(folder)
    return folder


def assert_same(a, b):
    """To the bit, and of the same types."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    elif isinstance(a, Equilibrium | Run):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    else:
        assert a == b
        assert repr(a) == repr(b)  # -0.0 is no 0.0


def test_a_run_comes_back_to_the_bit(run, files):
    back = load_run(files)
    assert_same(run, back)
    assert back.hash() == run.hash()
    assert back.summary() == run.summary()
    assert not back.x.flags.writeable


def test_what_came_back_runs_again(run, files):
    back = load_run(files)
    scene = back.scene
    again = simulate(scene, scene.make_plant(), make_controller(scene, back.tuning, back.believed), back.seed)
    assert again.hash() == run.hash()
    assert (again.measured == run.measured).all()


@pytest.mark.parametrize("name", sorted(path.stem for path in SCENES.glob("*.toml")))
def test_every_scene_comes_back(name):
    """Of all that is in it: payloads, curved and stretching rods, needs, findings, regions, own tunings."""
    scene = replace(load_scene(SCENES / f"{name}.toml"), deadline=0.004, start_velocity=(-0.0, 1 / 3))
    assert_same(from_text(to_text(scene)), scene)


def test_applied_rates_are_those_that_moved_the_motors(run):
    per = run.steps_per_period
    turned = np.diff(run.x[:, 4:], axis=0) / run.dt
    assert np.abs(run.u).max() > 0.1
    assert turned == pytest.approx(run.applied, abs=1e-9)
    assert (run.applied[: 2 * per] == 0).all()  # two periods on the way
    assert (run.applied[2 * per :] == np.repeat(run.u[:-2], per, axis=0)).all()


def test_measured_is_what_the_sensors_gave_and_the_estimate_is_nearer(run):
    truth = run.x[:: run.steps_per_period][:-1]
    wrong = run.measured - truth
    assert 0.7 < wrong[:, :2].std() / 5e-5 < 1.4
    assert run.measured[:, 4:] / 1.534e-3 == pytest.approx(np.round(truth[:, 4:] / 1.534e-3), abs=1e-9)
    filtered = run.estimate - truth
    late = slice(20, None)
    assert filtered[late, :2].std() < 0.8 * wrong[late, :2].std()
    assert np.abs(filtered[late, 4:]).max() < 1.534e-3
    assert run.estimated_force[-10:].mean(axis=0) == pytest.approx(run.scene.force, abs=0.2)


def test_torques_are_those_of_the_rods(run):
    assert run.torques.shape == (len(run.u) + 1, 2)
    guess = run.pose
    for k in (0, 13, len(run.u)):
        x = run.x[k * run.steps_per_period]
        other = solve_statics(run.scene.robot, x[:2], x[4:], method="multiple_shooting", guess=guess)
        assert run.torques[k] == pytest.approx(other.motor_torque, rel=1e-6)
    assert run.peak_torque == np.abs(run.torques).max()


def test_the_record_says_what_each_array_is(run, files):
    with np.load(files / "run.npz") as stored:
        about = json.loads(str(stored["about"]))
        arrays = {name: stored[name] for name in stored.files if stored[name].ndim}
        text = json.loads(str(stored["record"]))
    assert set(arrays) == set(about)
    assert all(
        "[" in about[name] for name in arrays if name not in ("measured", "estimate", "iterations", "control_time")
    )
    assert "decided" in about["u"]
    assert "delay" in about["u"]
    assert "got" in about["applied"]
    assert len(arrays["applied"]) == len(run.t) - 1
    said = dict(text["dict"])
    assert dict(said["versions"]["dict"])["numpy"] == np.__version__
    assert said["tuning"]["name"] == "sensors"


def test_the_table_has_what_was_given_believed_decided_and_done(run, files):
    rows = np.genfromtxt(files / "run.csv", delimiter=",", names=True)
    k, per = 235, run.steps_per_period
    period = k // per
    row = rows[k]
    assert row["u1_rad_s"] == pytest.approx(run.u[period, 1], rel=1e-8)
    assert row["u1_applied_rad_s"] == pytest.approx(run.u[period - 2, 1], rel=1e-8)
    assert row["measured_q0_rad"] == pytest.approx(run.measured[period, 4], rel=1e-8)
    assert row["estimated_v_y_m_s"] == pytest.approx(run.estimate[period, 3], rel=1e-8)
    assert row["estimated_force_x_N"] == pytest.approx(run.estimated_force[period, 0], rel=1e-8)
    assert row["torque0_Nm"] == pytest.approx(run.torques[period, 0], rel=1e-8)
    assert np.isfinite(np.array(rows.tolist())).all()


@dataclass(frozen=True)
class Circle:
    """A trajectory of one's own."""

    radius: float

    def __call__(self, t):
        out = np.zeros((len(t), 3, 2))
        out[:, 0] = np.stack([self.radius * np.sin(t), 0.25 + self.radius * (1 - np.cos(t))], axis=1)
        out[:, 1] = np.stack([self.radius * np.cos(t), self.radius * np.sin(t)], axis=1)
        out[:, 2] = np.stack([-self.radius * np.sin(t), self.radius * np.cos(t)], axis=1)
        return out


def test_a_trajectory_of_ones_own_comes_back_as_samples(tmp_path):
    scene = replace(load_scene(SCENES / "lemniscate.toml"), trajectory=Circle(0.01), duration=0.1)
    run = simulate(scene, scene.make_plant(), make_controller(scene))
    run.save(tmp_path)
    back = load_run(tmp_path)
    assert back.summary() == run.summary()
    assert (back.scene.trajectory(run.t)[:, 0] == run.reference).all()
    between = np.array([0.0123, 0.1234])
    assert back.scene.trajectory(between) == pytest.approx(scene.trajectory(between), abs=1e-8)
    again = simulate(back.scene, back.scene.make_plant(), make_controller(back.scene))
    assert again.x == pytest.approx(run.x, abs=1e-9)


def test_runs_without_a_model_come_back(tmp_path):
    scene = replace(load_scene(SCENES / "release.toml"), duration=0.05)
    run = simulate(scene, scene.make_plant(), HoldMotors(2))
    run.save(tmp_path)
    assert_same(load_run(tmp_path), run)
    assert np.isnan(run.estimate).all()
    assert run.tuning is None


def test_what_is_no_record_is_refused_by_name(files, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"run\.npz"):
        load_run(tmp_path)
    (tmp_path / "run.npz").write_bytes(b"nothing")
    with pytest.raises(ModelError, match=r"run\.npz: no complete record"):
        load_run(tmp_path)
    (tmp_path / "run.npz").write_bytes((files / "run.npz").read_bytes()[:3000])
    with pytest.raises(ModelError, match=r"run\.npz: no complete record"):
        load_run(tmp_path)
    with np.load(files / "run.npz") as stored:
        parts = dict(stored)
    np.savez(tmp_path / "run.npz", **{k: v for k, v in parts.items() if k != "format"})
    with pytest.raises(ModelError, match="format of the record is none"):
        load_run(tmp_path)
    np.savez(tmp_path / "run.npz", **{k: v for k, v in parts.items() if k != "x"})
    with pytest.raises(ModelError, match=r"no complete record.*x"):
        load_run(tmp_path)
    parts["record"] = np.array(str(parts["record"]).replace('"class": "Lemniscate"', '"class": "os"'))
    np.savez(tmp_path / "run.npz", **parts)
    with pytest.raises(ModelError, match="no class of pcr_mpc"):
        load_run(tmp_path)


def test_misses_count_against_the_period_without_a_deadline():
    class Slow(HoldMotors):
        def step(self, k, x):
            time.sleep(0.012)
            return super().step(k, x)

    scene = replace(load_scene(SCENES / "hold_with_load.toml"), duration=0.03)
    assert scene.deadline == np.inf
    run = simulate(scene, scene.make_plant(), Slow(2))
    assert run.summary()["deadline_misses"] == 3


@pytest.mark.parametrize(
    ("deadline", "cost", "misses"),
    [(np.inf, 0.0099, 0), (np.inf, 0.011, 6), (0.01, 0.011, 6), (0.002, 0.003, 6), (0.002, 0.001, 0)],
)
def test_misses_count_against_deadline_and_period(deadline, cost, misses):
    scene = replace(load_scene(SCENES / "hold_with_load.toml"), duration=0.06, deadline=deadline)
    rates = 0.1 * np.ones((6, 2))
    run = simulate(scene, scene.make_plant(), Replay(rates), spent=lambda *_: cost)
    assert run.deadline_misses() == misses
    assert run.summary()["deadline_misses"] == misses
    assert (run.decision_time == cost).all()
    # Lateness is simulated where the decision is later than the deadline only.
    assert (run.applied[0] == (0.0 if cost > deadline else 0.1)).all()
