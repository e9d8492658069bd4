"""Episodes under mismatch: repeatable, judged, and unknown to the controller."""

import json
import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ModelError, Uncertainty, load_scene, make_controller, simulate
from pcr_mpc.loop.demand.feed_forward import feed_forward
from pcr_mpc.loop.parts.controllers import HoldMotors
from pcr_mpc.loop.references.trajectory import Hold
from pcr_mpc.study.episodes import episodes
from pcr_mpc.study.episodes.episodes import ALLOWED_ERROR, EXACT, Spread, run_episode, simulate_episode
from tests.conftest import MODELS


@pytest.fixture(scope="module")
def scene():
    scene = load_scene(MODELS / "scenes" / "lemniscate.toml")
    return replace(scene, duration=0.3, plant=replace(scene.plant, integrator="velocity_verlet"))


def repeatable(row):
    return {name: value for name, value in row.items() if name != "timing"}


def test_same_seed_same_row_bit_for_bit(scene):
    rows = [run_episode(scene, scene.tuning, seed) for seed in (3, 4, 3)]
    assert repeatable(rows[0]) == repeatable(rows[2])
    for name in ("stiffness0", "stiffness1", "mass", "drag", "base0_x_m", "base1_y_m", "tip_noise_m", "angle_step_rad",
                 "force_x_N", "rms_mm", "run_hash"):  # fmt: skip
        assert rows[0][name] != rows[1][name], name
    assert json.loads(json.dumps(rows[0])) == rows[0]


def test_samples_fill_their_ranges_and_nothing_else():
    spread = Spread()
    samples = [spread.sample(2, seed) for seed in range(2000)]
    columns = {
        "stiffness": (np.array([m.stiffness for m in samples]), 0.9, 1.1),
        "mass": (np.array([m.mass for m in samples]), 0.8, 1.2),
        "log drag": (np.log([m.drag for m in samples]), -math.log(2), math.log(2)),
        "base": (np.array([m.base_offset for m in samples]), -1e-3, 1e-3),
        "delay": (np.array([m.delay for m in samples]), 0, 1),
        "tip noise": (np.array([m.tip_noise for m in samples]), 0.0, 1e-4),
        "angle step": (np.array([m.angle_step for m in samples]), 0.0, 2 * math.pi / 4096),
        "force": (np.hypot(*np.array([m.force for m in samples]).T), 0.0, 1.0),
    }
    for name, (values, low, high) in columns.items():
        assert values.min() >= low, name
        assert values.max() <= high, name
        assert values.min() < low + 0.01 * (high - low), name
        assert values.max() > high - 0.01 * (high - low), name
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.03 * (high - low)), name
    # Independent of each other, to five standard errors.
    drawn = np.column_stack([values.reshape(len(samples), -1) for values, _, _ in columns.values()])
    assert np.abs(np.corrcoef(drawn.T) - np.eye(drawn.shape[1])).max() < 5 / math.sqrt(len(samples))


NAMES = ("rods[0].bending_stiffness", "rods[1].bending_stiffness", "tip_mass", "rods[1].base_y", "rods[0].length")


@pytest.fixture(scope="module")
def known(scene):
    """Both stiffnesses and the mass nearly share one scale; the fourth and fifth go together the other way."""
    matrix = np.eye(5)
    matrix[:3, :3] = 0.98 + 0.02 * np.eye(3)
    matrix[3, 4] = matrix[4, 3] = -0.6
    return Uncertainty(NAMES, np.array([0.0025, 0.0025, 0.0125, 3e-4, 1e-3]), matrix)


def test_what_is_known_is_drawn_with_all_its_correlations(scene, known):
    spread = Spread(known=known, believed=scene.robot)
    assumed = Spread()
    samples = [spread.sample(2, seed) for seed in range(3000)]
    robots = [one.applied_to(scene).robot for one in samples]
    rods = [robot.rods for robot in robots]
    drawn = np.array(
        [[np.log(a.bending_stiffness), np.log(b.bending_stiffness), np.log(robot.tip_mass), b.base[1], np.log(a.length)]
         for (a, b), robot in zip(rods, robots, strict=True)]
    )  # fmt: skip
    believed = scene.robot
    values = np.array([believed.rods[0].bending_stiffness, believed.rods[1].bending_stiffness, believed.tip_mass, 1.0,
                       believed.rods[0].length])  # fmt: skip
    wanted = known.sd / values
    assert drawn.std(axis=0) == pytest.approx(wanted, rel=5 / math.sqrt(2 * len(samples)))
    middle = np.log(values[[0, 1, 2, 4]])
    assert np.abs(drawn.mean(axis=0)[[0, 1, 2, 4]] - middle).max() < 5 * wanted.max() / math.sqrt(len(samples))
    found = np.corrcoef(drawn.T)
    slack = 5 * (1 - known.correlation**2) / math.sqrt(len(samples))
    assert (np.abs(found - known.correlation) <= slack + 1e-12).all()
    for one, seed in zip(samples[:50], range(50), strict=False):
        other = assumed.sample(2, seed)
        assert (one.drag, one.delay, one.tip_noise, one.force) == (
            other.drag,
            other.delay,
            other.tip_noise,
            other.force,
        )
        assert one.base_offset[0] == other.base_offset[0]
        assert one.base_offset[1][0] == other.base_offset[1][0]
        assert one.length[1] == 1.0
    assert json.loads(json.dumps(samples[0].row()))["length0"] == samples[0].length[0]
    assert "length0" not in assumed.sample(2, 0).row()


def test_what_cannot_be_known_is_named(scene, known):
    with pytest.raises(ValueError, match="known and believed go together"):
        Spread(known=known)
    for name, words in (("rods[2].length", "which planar_pair with 2 rods has not"), ("delay", "tip_mass, drag")):
        other = replace(known, names=(*NAMES[:4], name))
        with pytest.raises(ModelError, match=words):
            Spread(known=other, believed=scene.robot)
    still = replace(scene.robot, drag=0.0)
    with pytest.raises(ModelError, match="'drag', which planar_pair has at 0"):
        Spread(known=replace(known, names=(*NAMES[:4], "drag")), believed=still)
    with pytest.raises(ValueError, match="2 rods, the scene's has 3"):
        Spread(known=known, believed=scene.robot).sample(3, 0)


@pytest.mark.parametrize("wrong", [{"stiffness": -0.1}, {"mass": 1.0}, {"drag": 0.5}, {"force": math.nan}])
def test_a_spread_out_of_range_is_named(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Spread(**wrong)


def test_the_robot_is_another_and_the_controller_does_not_know(scene, monkeypatch):
    """The sampled robot moves; the controller is given the scene's, but for its encoders' data sheet."""
    given = {}

    def spy(believed, robot, reference):
        given.update(scene=believed, robot=robot, reference=reference)
        return HoldMotors(robot.n_rods)

    monkeypatch.setattr(episodes, "make_controller", spy)
    scene = replace(scene, delay=1, force=(0.1, 0.0), tip_noise=3e-5)
    mismatch = replace(Spread().sample(2, 5), delay=1)
    monkeypatch.setattr(Spread, "sample", lambda *_: mismatch)
    run = simulate_episode(scene, scene.tuning, 5)
    true = run.scene
    assert given["robot"] == given["scene"].robot == scene.robot
    assert given["scene"] == replace(scene, angle_step=true.angle_step)
    # So does what it feeds forward: the inverse dynamics are those of the scene's robot, not of the sampled one.
    assert given["reference"].states[0, 4:] == pytest.approx(scene.start().q, abs=1e-9)
    for rod, nominal, factor, offset in zip(
        true.robot.rods, scene.robot.rods, mismatch.stiffness, mismatch.base_offset, strict=True
    ):
        assert rod.bending_stiffness == factor * nominal.bending_stiffness != nominal.bending_stiffness
        assert np.subtract(rod.base, nominal.base) == pytest.approx(offset)
    assert true.robot.tip_mass == mismatch.mass * scene.robot.tip_mass != scene.robot.tip_mass
    assert true.robot.drag == mismatch.drag * scene.robot.drag != scene.robot.drag
    assert true.robot.angle_limits == pytest.approx(scene.robot.angle_limits)
    assert (true.delay, given["scene"].delay) == (2, 1)
    assert true.tip_noise == math.hypot(3e-5, mismatch.tip_noise)
    assert true.force == (0.1 + mismatch.force[0], mismatch.force[1])
    # The run starts in balance at the reference, which the believed robot would not with these motors.
    assert run.x[0, :2] == pytest.approx([0.0, 0.25], abs=1e-9)
    assert np.abs(run.x[0, 4:] - scene.start().q).max() > 1e-3


@pytest.mark.parametrize(("period", "delay"), [(None, 1), (0.005, 2), (0.02, 1)])
def test_a_shorter_period_does_not_make_the_bus_faster(scene, period, delay):
    """One period of 10 ms more than told, whatever the tuning's own period is."""
    seed = next(seed for seed in range(20) if Spread().sample(2, seed).delay == 1)
    run = simulate_episode(replace(scene, duration=0.04), replace(scene.tuning, period=period), seed)
    assert run.scene.delay == delay
    assert run.scene.period == (period or scene.period)


def test_the_reference_is_solved_once_and_is_the_same(scene, monkeypatch):
    """For all episodes of a scene, whatever else is tuned; a run that solves it by itself is equal bit for bit."""
    solved = []

    def counting(believed, robot, pose, horizon, inertia):
        solved.append(horizon)
        return feed_forward(believed, robot, pose, horizon, inertia)

    monkeypatch.setattr(episodes, "feed_forward", counting)
    scene = replace(scene, duration=0.11, delay=1)  # of no other test
    first, _, third = (simulate_episode(scene, scene.tuning, seed, spread) for seed, spread in
                       ((0, EXACT), (1, Spread()), (0, EXACT)))  # fmt: skip
    simulate_episode(scene, replace(scene.tuning, input_weight=0.3, observer=None), 0)
    assert solved == [scene.tuning.horizon + 1]
    by_itself = simulate(scene, scene.make_plant(), make_controller(scene))
    assert first.hash() == third.hash() == by_itself.hash()
    simulate_episode(scene, replace(scene.tuning, period=0.005), 0)
    simulate_episode(replace(scene, trajectory=Hold((0.0, 0.25))), scene.tuning, 0)
    simulate_episode(scene, replace(scene.tuning, model=replace(scene.tuning.model, inertia="constant")), 0)
    assert len(solved) == 4


def test_a_reference_that_is_too_short_is_refused(scene):
    short = feed_forward(scene, scene.robot, scene.start(), scene.tuning.horizon - 1)
    needed = scene.n_periods + scene.tuning.horizon
    with pytest.raises(ValueError, match=f"reference has {needed - 1} periods; scene and horizon need {needed}"):
        make_controller(scene, reference=short)


def test_only_rk4_is_replaced(scene):
    """The paper's Euler is there for its own sake, and distributed rods move by an integrator of their own."""
    for integrator, lighter in (("rk4", "velocity_verlet"), ("semi_implicit_euler",) * 2, ("gauss",) * 2):
        given = replace(scene, plant=replace(scene.plant, integrator=integrator))
        assert episodes.lighter(given) == replace(given, plant=replace(given.plant, integrator=lighter))


def test_threads_take_turns(scene, monkeypatch):
    """The rods' graphs of a process share their memory."""
    inside, most = [], []

    def busy(*_):
        inside.append(1)
        most.append(len(inside))
        time.sleep(0.02)
        inside.pop()
        raise ValueError("enough")

    monkeypatch.setattr(episodes, "simulate_episode", busy)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda seed: run_episode(scene, scene.tuning, seed), range(8)))
    assert most == [1] * 8


def test_without_mismatch_it_is_the_scene(scene):
    plain = simulate(scene, scene.make_plant(), make_controller(scene), seed=9)
    row = run_episode(scene, scene.tuning, 9, EXACT)
    assert row["run_hash"] == plain.hash()
    assert row["rms_mm"] == pytest.approx(plain.summary()["rms_mm"])
    assert row["max_mm"] == plain.summary()["max_mm"]
    change = np.diff(np.vstack([np.zeros(2), plain.u]), axis=0) / 0.01
    assert row["effort_rad_s2"] == pytest.approx(math.sqrt((change**2).mean()))
    assert (row["failure"], row["limit_violations"], row["fallbacks"], row["rungs"]) == ("", 0, 0, "")
    assert row["timing"]["control_cpu_us"] > 0
    # Made up, for what was measured is a matter of the machine: 3 of 30 steps take longer than their 10 ms.
    times = plain.control_time.copy()
    times[:, 5] = np.where(np.arange(30) % 10 == 0, 0.0101, 2e-4)
    assert episodes._timing(replace(plain, control_time=times)) == {"control_cpu_us": pytest.approx(200.0), "late": 0.1}


def test_a_failing_episode_is_a_row(scene):
    """Stopped on its way by a load that no rod bears; and not even begun, for the reference is out of reach."""
    stopped = run_episode(replace(scene, force=(0.0, 500.0)), scene.tuning, 0, EXACT)
    assert "stopped at t =" in stopped["failure"]
    assert stopped["rms_mm"] > 0
    unreachable = run_episode(replace(scene, trajectory=Hold((0.0, 0.45))), scene.tuning, 0, EXACT)
    assert "UnreachableError: reference at t = 0.000 s" in unreachable["failure"]
    assert unreachable["rms_mm"] is None
    assert unreachable["timing"]["control_cpu_us"] is None
    assert set(stopped) == set(unreachable)


def test_straying_is_a_failure_after_the_start_up(scene, monkeypatch):
    monkeypatch.setattr(episodes, "make_controller", lambda *_, **__: HoldMotors(2))
    far = replace(scene, duration=1.3)
    row = run_episode(far, scene.tuning, 0, EXACT)
    assert row["failure"].startswith("strayed ")
    assert "at t = 1." in row["failure"]
    assert row["max_mm"] > 1e3 * ALLOWED_ERROR
    # Within the first second the tip may be anywhere, but not at the end.
    brief = run_episode(replace(scene, duration=0.9), scene.tuning, 0, EXACT)
    assert brief["final_error_mm"] > 1e3 * ALLOWED_ERROR
    assert f"strayed {brief['final_error_mm']:.1f} mm" in brief["failure"]
    near = run_episode(replace(scene, duration=0.2), scene.tuning, 0, EXACT)
    assert near["failure"] == ""


def test_broken_limits_are_a_failure(scene, monkeypatch):
    class Racing(HoldMotors):
        def step(self, k, x):
            return replace(super().step(k, x), u=np.array([7.0, 0.0]) if k == 3 else np.zeros(2))

    monkeypatch.setattr(episodes, "make_controller", lambda *_, **__: Racing(2))
    row = run_episode(scene, scene.tuning, 0, EXACT)
    assert row["failure"] == "limits violated in 2 of 30 periods"  # up and down again
    assert row["limit_violations"] == 2


def test_an_interrupt_is_no_failing_episode(scene, monkeypatch):
    class Interrupted(HoldMotors):
        def step(self, k, x):
            raise KeyboardInterrupt

    monkeypatch.setattr(episodes, "make_controller", lambda *_, **__: Interrupted(2))
    with pytest.raises(KeyboardInterrupt):
        run_episode(scene, scene.tuning, 0)


def test_a_deadline_does_not_make_an_episode_depend_on_the_machine(scene):
    late = run_episode(replace(scene, deadline=0.0, duration=0.1), scene.tuning, 2)
    in_time = run_episode(replace(scene, duration=0.1), scene.tuning, 2)
    assert repeatable(late) == repeatable(in_time)


def test_motors_that_lag_leave_all_else_of_a_seed_as_it_was():
    """The lag is drawn beside the rest, within its range, and reaches the motors that move, not the controller's."""
    plain, lagging = Spread(), Spread(motor_lag=0.02)
    drawn = [lagging.sample(2, seed) for seed in range(40)]
    assert [replace(one, motor_lag=0.0) for one in drawn] == [plain.sample(2, seed) for seed in range(40)]
    lags = [one.motor_lag for one in drawn]
    assert 0.0 <= min(lags) < 0.005 < 0.015 < max(lags) <= 0.02
    scene = load_scene(MODELS / "scenes" / "servo.toml")
    assert drawn[0].applied_to(scene).motors.time_constant == pytest.approx(0.02 + lags[0])
    assert "motor_lag_s" in drawn[0].row()
    assert "motor_lag_s" not in plain.sample(2, 0).row()
    assert plain.sample(2, 0).applied_to(scene).motors == scene.motors
