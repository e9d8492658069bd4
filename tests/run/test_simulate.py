import json
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    HoldMotors,
    ModelError,
    Plant,
    SimulationError,
    UnreachableError,
    load_scene,
    load_tuning,
    make_controller,
    simulate,
)
from pcr_mpc.loop.parts.controllers import Replay
from pcr_mpc.loop.references.trajectory import Hold
from tests.conftest import CONTROLLERS, MODELS

SCENES = MODELS / "scenes"


@pytest.fixture(scope="module")
def lemniscate():
    return load_scene(SCENES / "lemniscate.toml")


@pytest.fixture(scope="module")
def run(lemniscate):
    scene = replace(lemniscate, duration=2.0)
    return simulate(scene, scene.make_plant(), make_controller(scene))


def test_lemniscate_is_tracked(run):
    summary = run.summary()
    assert summary["rms_after_1s_mm"] < 0.0022  # 0.0019 in the README
    assert (summary["failures"], summary["limit_violations"], summary["fallbacks"]) == (0, 0, 0)


def test_same_seed_same_run_bit_for_bit(lemniscate):
    scene = replace(lemniscate, duration=0.3, tip_noise=1e-4)
    plant, controller = scene.make_plant(), make_controller(scene)
    first = simulate(scene, plant, controller, seed=1)
    again = simulate(scene, plant, controller, seed=1)
    fresh = simulate(scene, scene.make_plant(), make_controller(scene), seed=1)
    other = simulate(scene, plant, controller, seed=2)
    assert first.hash() == again.hash() == fresh.hash()
    assert first.hash() != other.hash()


def test_the_rate_limit_is_reached_and_held():
    scene = replace(load_scene(SCENES / "limited.toml"), duration=2.0)
    run = simulate(scene, scene.make_plant(), make_controller(scene))
    assert np.abs(run.u).max() == 2.5
    assert run.limit_violations() == 0
    assert run.summary()["failures"] == 0


def test_violations_are_counted(run):
    assert replace(run, u=run.u + 7.0).limit_violations() == len(run.u)
    # A command that leads beyond the stop counts, although the motor stays at it.
    x = run.x.copy()
    x[1000, 4] = run.scene.robot.angle_limits[0, 1]
    u = run.u.copy()
    u[100, 0] = 0.5
    assert replace(run, x=x, u=u).limit_violations() == 1


def test_peak_torque_is_that_of_the_statics(run, pair):
    # The centre pose takes 0.76 N m; the figure of eight takes more, within the limit.
    assert 0.76 < run.peak_torque < pair.torque_limit


def test_controllers_plan_and_plant_are_separate_objects(lemniscate):
    """A controller that believes in softer rods tracks worse: it does not peek at the plant."""
    scene = replace(lemniscate, duration=1.2)
    soft = replace(
        scene.robot, rods=tuple(replace(rod, bending_stiffness=0.8 * rod.bending_stiffness) for rod in scene.robot.rods)
    )
    good = simulate(scene, scene.make_plant(), make_controller(scene)).summary()["rms_after_1s_mm"]
    bad = simulate(scene, scene.make_plant(), make_controller(scene, robot=soft)).summary()["rms_after_1s_mm"]
    assert bad > 10 * good


def test_a_robot_with_multiple_shooting_in_the_plant(lemniscate):
    scene = replace(lemniscate, duration=1.2, plant=replace(lemniscate.plant, method="multiple_shooting"))
    run = simulate(scene, scene.make_plant(), make_controller(scene))
    assert run.summary()["rms_after_1s_mm"] < 0.0022


def test_three_rods_are_tracked():
    scene = replace(load_scene(SCENES / "three_rods.toml"), duration=1.2)
    run = simulate(scene, scene.make_plant(), make_controller(scene))
    assert run.summary()["rms_after_1s_mm"] < 6e-4
    assert run.u.shape == (120, 3)


def test_release_swings_about_the_balance():
    scene = load_scene(SCENES / "release.toml")
    controller = make_controller(scene)
    assert isinstance(controller, HoldMotors)
    run = simulate(scene, scene.make_plant(), controller)
    assert (run.x[:, 4:] == run.x[0, 4:]).all()
    assert 0.005 < np.abs(run.x[:, 0]).max() < 0.05
    assert run.summary()["rms_mm"] is None


def test_pick_and_place_arrives():
    scene = load_scene(SCENES / "pick_and_place.toml")
    run = simulate(scene, scene.make_plant(), make_controller(scene))
    assert run.x[-1, :2] == pytest.approx([0.06, 0.22], abs=1e-5)
    assert run.summary()["limit_violations"] == 0


def test_a_failing_run_keeps_what_it_had(lemniscate, tmp_path):
    scene = replace(lemniscate, duration=0.5)

    class Kicked:
        """A plant that throws the tip out of reach at the 100th step."""

        def __init__(self, plant):
            self.plant, self.count = plant, 0
            self.dt, self.method, self.integrator = plant.dt, plant.method, plant.integrator
            self.snaps, self.rungs = plant.snaps, plant.rungs

        def reset(self, *arguments):
            self.plant.reset(*arguments)

        def step(self, x, u, f_ext):
            self.count += 1
            if self.count > 100:
                x = x + [0, 0, 0, 1e3, 0, 0]
            return self.plant.step(x, u, f_ext)

    with pytest.raises(SimulationError, match=r"stopped at t = 0\.10\d0 s of 0\.5 s") as caught:
        simulate(scene, Kicked(scene.make_plant()), HoldMotors(2))
    run = caught.value.run
    assert isinstance(caught.value.__cause__, UnreachableError)
    assert len(run.t) > 100
    assert run.summary()["failures"] == 1
    files = run.save(tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text())["events"][0]["kind"] == "failure"
    assert len(np.load(files["run.npz"])["t"]) == len(run.t)


def test_a_nan_command_keeps_the_run_so_far(lemniscate):
    class Broken(HoldMotors):
        def step(self, k, x):
            decision = super().step(k, x)
            return replace(decision, u=np.full(2, np.nan)) if k == 20 else decision

    with pytest.raises(SimulationError, match="u is not finite") as caught:
        simulate(lemniscate, lemniscate.make_plant(), Broken(2))
    assert len(caught.value.run.t) == 201


def test_a_finer_plant_than_the_scenes(lemniscate, tmp_path):
    scene = replace(lemniscate, duration=0.3)
    run = simulate(scene, Plant(scene.robot, integrator="velocity_verlet", dt=5e-4), make_controller(scene))
    assert run.summary()["plant_budget_us"] == pytest.approx(500.0)
    rows = np.genfromtxt(run.save(tmp_path)["run.csv"], delimiter=",", names=True)
    assert rows["u0_rad_s"][400] == pytest.approx(run.u[20, 0], rel=1e-6)


def test_motors_that_start_elsewhere_than_the_reference(lemniscate, centre):
    scene = replace(lemniscate, start_tip=None, start_mode=None, start_motors=tuple(centre.q))
    with pytest.raises(ModelError, match="free tip rests at"):
        scene.start()


def test_an_interrupted_run_keeps_what_it_had(lemniscate):
    class Interrupted(HoldMotors):
        def step(self, k, x):
            if k == 7:
                raise KeyboardInterrupt
            return super().step(k, x)

    with pytest.raises(SimulationError, match="interrupted") as caught:
        simulate(lemniscate, lemniscate.make_plant(), Interrupted(2))
    assert len(caught.value.run.u) == 7


def test_a_reference_out_of_reach_says_when(lemniscate):
    scene = replace(lemniscate, trajectory=Hold((0.0, 0.45)), duration=0.1)
    with pytest.raises(UnreachableError, match=r"reference at t = 0\.000 s"):
        simulate(scene, scene.make_plant(), make_controller(scene))


def test_fallbacks_are_counted(lemniscate):
    """One OSQP iteration never solves: after the first plan every step falls back, and says so."""
    scene = replace(lemniscate, duration=0.1)
    tuning = replace(load_tuning(CONTROLLERS / "default.toml"), fallback="ladder")
    controller = make_controller(scene, tuning)
    controller.start(scene.start())

    class Starved:
        name = "starved"

        def start(self, pose):
            controller.start(pose)

        def step(self, k, x):
            if k == 1:
                workspace = controller._work.law._workspace
                workspace._without_limits = lambda *_: None  # an answer that takes no iteration
                for solver in (workspace._rates_only, *(one._solver for one in workspace._limited.values())):
                    solver._most = 1
            return controller.step(k, x)

    run = simulate(scene, scene.make_plant(), Starved())
    assert run.summary()["fallbacks"] == 9
    assert run.events[0]["rung"] == "shifted_plan"


def test_saved_runs_read_back(run, tmp_path):
    files = run.save(tmp_path)
    stored = np.load(files["run.npz"])
    assert (stored["x"] == run.x).all()
    rows = np.genfromtxt(files["run.csv"], delimiter=",", names=True)
    assert rows["p_x_m"] == pytest.approx(run.x[:, 0], rel=1e-8, abs=1e-12)
    summary = json.loads((tmp_path / "summary.json").read_text())
    for key in ("scene", "controller", "plant", "rms_mm", "rms_after_1s_mm", "max_mm", "final_error_mm",
                "plant_step_us", "control_step_us", "qp_iterations", "limit_violations", "fallbacks", "failures",
                "run_hash", "files"):  # fmt: skip
        assert key in summary
    assert set(summary["control_step_us"]) == {"p50", "p95", "p99", "max"}
    error = np.hypot(*(run.x[:, :2] - run.reference).T)
    assert summary["max_mm"] == pytest.approx(1e3 * error.max())
    assert summary["rms_mm"] == pytest.approx(1e3 * np.sqrt(np.mean(error**2)))


def test_plant_step_must_divide_the_period(lemniscate):
    plant = replace(lemniscate.plant, dt=3e-3).make(lemniscate.robot)
    with pytest.raises(ValueError, match="does not divide"):
        simulate(lemniscate, plant, HoldMotors(2))


def test_a_late_decision_is_late_when_it_arrives():
    """With a delay of two periods, the second decision late by 4 ms: what was due meanwhile is in time."""
    scene = replace(load_scene(MODELS / "scenes" / "hold_with_load.toml"), duration=0.06, delay=2, deadline=1e-3)
    scene = replace(scene, plant=replace(scene.plant, dt=1e-3))
    run = simulate(
        scene,
        scene.make_plant(),
        Replay(0.1 * np.arange(1, 7)[:, None] * np.ones(2)),
        spent=lambda k, _: 4e-3 if k == 1 else 0.0,
    )
    rates = np.diff(run.x[:, 4]) / run.dt
    wanted = np.repeat([0.0, 0.0, 0.1, 0.2, 0.3, 0.4], 10)
    wanted[30:34] = 0.1
    assert rates == pytest.approx(wanted, abs=1e-9)


def test_limits_on_angles_count_where_a_command_arrives():
    """Two commands of 2 mrad each: by itself each is within the stop at 2.5 mrad, but the second comes on top."""
    scene = replace(load_scene(MODELS / "scenes" / "hold_with_load.toml"), duration=0.05, delay=2)
    rods = [replace(rod, angle_limits=(float(q) - 1.0, float(q) + 2.5e-3))
            for rod, q in zip(scene.robot.rods, scene.start().q, strict=True)]  # fmt: skip
    robot = replace(scene.robot, rods=tuple(rods))
    run = simulate(
        replace(scene, robot=robot),
        Plant(robot, dt=1e-3),
        Replay(np.array([[0.2, 0.2], [0.2, 0.2], *np.zeros((3, 2))])),
    )
    assert run.limit_violations() == 1


def test_torque_is_known_up_to_where_the_rods_were_lost(run):
    x = run.x.copy()
    x[100:, :2] = 9.0  # m, out of reach
    lost = replace(run, x=x)
    assert lost.peak_torque == pytest.approx(replace(run, x=run.x[:100]).peak_torque, rel=1e-12)
    assert 0.0 < lost.peak_torque <= run.peak_torque


@pytest.mark.parametrize(
    "other", [{"segments": 1}, {"weight": "none"}, {"robot": "heavier"}], ids=["segments", "weight", "robot"]
)
def test_a_plant_is_the_scenes_only_with_all_its_settings(other):
    scene = load_scene(SCENES / "vertical.toml")
    robot = scene.robot if "robot" not in other else replace(scene.robot, tip_mass=0.3)
    settings = {name: value for name, value in other.items() if name != "robot"}
    assert scene.plant.describes(scene.make_plant(), scene.robot)
    assert not scene.plant.describes(replace(scene.plant, **settings).make(robot), scene.robot)
