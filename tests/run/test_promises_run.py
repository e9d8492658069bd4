"""What a run promises to count and to write, on figures that are made up."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import HoldMotors, SimulationError, simulate
from pcr_mpc.loop.scene.settings import Finding, Need

from .test_promises_simulate import PER, PERIODS, resting

scene = pytest.fixture(scope="module")(resting)


@pytest.fixture(scope="module")
def run(scene):
    """Motors at rest, tip at rest, reference at the tip: every figure that is not zero is one that a test put there."""
    return simulate(scene, scene.make_plant(), HoldMotors(2))


def commanded(run, u, delay=0, at=None):
    """The run with other commands, motors in the middle of their range, or at given angles."""
    x = run.x.copy()
    x[:, 4:] = run.scene.robot.angle_limits.mean(axis=1) if at is None else at
    return replace(run, u=np.array(u, dtype=float), x=x, scene=replace(run.scene, delay=delay))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("motor", [0, 1])
def test_each_limit_is_one_of_both_signs_and_of_each_motor(run, sign, motor):
    robot = run.scene.robot
    one = np.zeros((PERIODS, 2))
    # A change of 3 rad/s a period is allowed, and 6 rad/s.
    one[1:5, motor] = sign * np.array([3.0, 6.0, 6.0, 3.0])
    assert commanded(run, one).limit_violations() == 0
    over = one.copy()
    over[2:4, motor] = sign * 6.00001
    assert commanded(run, over).limit_violations() == 3  # too fast twice, then braked too hard
    change = np.zeros((PERIODS, 2))
    change[2:, motor] = sign * 3.00001
    assert commanded(run, change).limit_violations() == 1
    first = np.zeros((PERIODS, 2))
    first[:, motor] = sign * 3.00001  # from rest
    assert commanded(run, first).limit_violations() == 1
    stop = robot.angle_limits[motor, 0 if sign < 0 else 1]
    near, away = robot.angle_limits.mean(axis=1), np.zeros((PERIODS, 2))
    near[motor] = stop - sign * 0.01  # 10 mrad away, and 20 mrad of motion asked for
    away[3:5, motor] = sign * 2.0
    assert commanded(run, away, at=near).limit_violations() == 2
    away[3:5, motor] = sign * 0.9999
    assert commanded(run, away, at=near).limit_violations() == 0
    assert commanded(run, -away * 2, at=near).limit_violations() == 0


def test_limits_of_a_slow_motor_are_as_sharp(run):
    """A turn in a month: rounding is of the limit, not of a rad/s."""
    rate = 2e-6
    slow = replace(run.scene.robot, rate_limit=rate, acceleration_limit=50.0 * rate)  # half of it in a period
    run = replace(run, scene=replace(run.scene, robot=slow))
    ramp = np.outer([0.0, 0.5, 1.0, 1.0, 0.5, 0.0], [rate, 0.0])
    assert commanded(run, ramp).limit_violations() == 0
    assert commanded(run, (1 + 1e-12) * ramp).limit_violations() == 0
    assert (
        commanded(run, 1.00001 * ramp).limit_violations() == 5
    )  # four changes, of them one to full rate, and full rate
    ramp[2:4] *= 1.00001
    assert commanded(run, ramp).limit_violations() == 3


def test_a_delayed_command_counts_from_where_it_arrives(run):
    """At its stop from period 2 on: the command of period 1 arrives there with a delay of one, and not without."""
    x, u = run.x.copy(), np.zeros((PERIODS, 2))
    x[:, 4:] = run.scene.robot.angle_limits.mean(axis=1)
    x[2 * PER :, 4] = run.scene.robot.angle_limits[0, 0]
    u[1, 0] = -1.0
    assert [commanded(run, u, delay, at=x[:, 4:]).limit_violations() for delay in (0, 1)] == [0, 1]


def test_times_are_in_microseconds_and_of_the_part_that_they_name(run):
    parts = np.array([40.0, 10.0, 4.0, 20.0, 8.0, 30.0]) * 1e-6  # total, linearise, update, solve, solver, CPU
    timed = replace(run, control_time=np.tile(parts, (PERIODS, 1)), plant_time=np.arange(1.0, 61.0) * 1e-6)
    summary = timed.summary()
    assert summary["control_step_us"] == pytest.approx(dict.fromkeys(("p50", "p95", "p99", "max"), 40.0))
    assert summary["control_cpu_us"]["p50"] == pytest.approx(30.0)
    found = {name: figures["max"] for name, figures in summary["control_parts_us"].items()}
    assert found == pytest.approx({"linearise": 10.0, "update": 4.0, "solve": 20.0, "solver": 8.0})
    assert summary["solver_share"] == pytest.approx(0.2)
    assert summary["plant_step_us"] == pytest.approx({"p50": 30.5, "p95": 57.05, "p99": 59.41, "max": 60.0})
    assert summary["plant_budget_us"] == pytest.approx(1000.0)
    assert summary["control_budget_us"] == pytest.approx(10_000.0)


def test_errors_are_in_millimetres_and_those_after_one_second_from_it_on(run):
    """3-4-5 mm off until 1 s, half of that from then on, nothing at the end."""
    t = run.t * 20  # up to 1.2 s
    off = np.where((t < 1.0)[:, None], [3e-3, -4e-3], [1.5e-3, -2e-3])
    off[-1] = 0.0
    moved = replace(run, t=t, reference=run.x[:, :2] + off)
    summary, late = moved.summary(), int((t >= 1.0).sum())
    assert late == 11
    assert summary["max_mm"] == pytest.approx(5.0)
    assert summary["final_error_mm"] == pytest.approx(0.0, abs=1e-9)
    assert summary["rms_after_1s_mm"] == pytest.approx(2.5 * math.sqrt((late - 1) / late))
    squares = 25.0 * (len(t) - late) + 6.25 * (late - 1)
    assert summary["rms_mm"] == pytest.approx(math.sqrt(squares / len(t)))
    assert summary["final_tip_m"] == run.x[-1, :2].tolist()
    assert summary["duration_s"] == pytest.approx(1.2)


def test_the_hash_is_of_states_inputs_and_times_and_of_nothing_else(run):
    assert replace(run, plant_time=run.plant_time + 1.0, seed=5).hash() == run.hash()
    for name in ("t", "x", "u"):
        array = getattr(run, name).copy()
        array.flat[-1] = np.nextafter(array.flat[-1], np.inf)
        assert replace(run, **{name: array}).hash() != run.hash(), name


def test_the_need_is_held_against_medians_and_against_what_was_found(run, monkeypatch):
    need = Need(tip_accuracy=2e-4, plant_step=30e-6, control_step=50e-6)
    times = {"plant_time": np.full(PERIODS * PER, 30e-6), "control_time": np.full((PERIODS, 6), 50e-6)}
    asked = replace(run, scene=replace(run.scene, need=need, finding=Finding(1e-4, 0.0, "abc")), **times)
    monkeypatch.setattr("pcr_mpc.loop.run.summary.verified", lambda scene: True)
    found = asked.summary()["need"]
    assert found == {
        "tip_accuracy_mm": pytest.approx(0.2), "tip_error_mm": pytest.approx(0.1), "verified": True,
        "plant_step_us": pytest.approx(30.0), "plant_step_met": True,
        "control_step_us": pytest.approx(50.0), "control_step_met": True,
    }  # fmt: skip
    for name, value in times.items():
        slow = value.copy()
        slow.flat[: value.size // 2 + 6] *= 1.01  # the median, not the mean
        late = replace(asked, **{name: slow}).summary()["need"]
        assert [late["plant_step_met"], late["control_step_met"]] == [name != "plant_time", name != "control_time"]
    outlier = np.full(PERIODS * PER, 1e-6)
    outlier[:5] = 1.0
    assert replace(asked, plant_time=outlier).summary()["need"]["plant_step_met"]
    # Another engine's plant is not the rung that was found.
    other = replace(asked, rung=None).summary()["need"]
    assert (other["verified"], other["tip_error_mm"]) == (False, None)
    assert run.summary()["need"] is None


def test_rows_of_the_csv_file_have_the_rates_of_their_period(run, tmp_path):
    u = np.arange(2.0 * PERIODS).reshape(PERIODS, 2)
    files = commanded(run, u).save(tmp_path)
    rows = np.genfromtxt(files["run.csv"], delimiter=",", names=True)
    assert len(rows) == PERIODS * PER + 1
    for k in (0, PER - 1, PER, 3 * PER + 4, PERIODS * PER - 1):
        assert (rows["u0_rad_s"][k], rows["u1_rad_s"][k]) == tuple(u[k // PER])
    assert rows["u1_rad_s"][-1] == u[-1, 1]  # there is no period after the last
    assert rows["t_s"] == pytest.approx(run.t)
    assert rows["ref_y_m"] == pytest.approx(run.reference[:, 1])
    stored = np.load(files["run.npz"])
    assert stored["u"].tolist() == u.tolist()
    assert stored["reference"].tolist() == run.reference.tolist()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert set(summary["files"]) >= {"run.npz", "run.csv", "summary.json"}
    assert all((tmp_path / name).exists() for name in summary["files"])


def test_a_run_that_failed_in_its_first_decision_is_written_too(scene, tmp_path):
    class Refusing(HoldMotors):
        def step(self, k, x):
            raise ArithmeticError("no")

    with pytest.raises(SimulationError, match=r"stopped at t = 0\.0000 s") as info:
        simulate(scene, scene.make_plant(), Refusing(2))
    run = info.value.run
    assert (run.t.tolist(), run.u.shape, run.plant_time.shape) == ([0.0], (0, 2), (0,))
    files = run.save(tmp_path)
    with open(files["run.csv"], newline="", encoding="utf-8") as handle:
        header, row = csv.reader(handle)
    assert dict(zip(header, row, strict=True))["u0_rad_s"] == "nan"
    summary = run.summary()
    assert summary["control_step_us"]["p50"] is None
    assert summary["solver_share"] is None
    assert summary["qp_iterations"] == {"p50": None, "max": 0}
    assert summary["rms_after_1s_mm"] is None
