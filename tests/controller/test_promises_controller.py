"""What the controller of a scene promises: which model, which pose and which load belong to which period."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    ConvergenceError,
    LinearMPC,
    Plant,
    inverse_statics,
    load_scene,
    load_tuning,
    make_controller,
    simulate,
    solve_statics,
)
from pcr_mpc.loop.controller.tracking import TrackingController
from pcr_mpc.loop.demand.feed_forward import feed_forward
from pcr_mpc.loop.demand.moving_rods import _momentum
from pcr_mpc.loop.parts.assembled import motor_limits
from pcr_mpc.loop.parts.controllers import HoldMotors
from pcr_mpc.loop.parts.target import MotorTarget
from pcr_mpc.loop.references.trajectory import PickAndPlace
from pcr_mpc.loop.scene.settings import Payload
from pcr_mpc.plant.statics.many_poses.equilibria import together
from tests.conftest import CONTROLLERS, MODELS

PATH = PickAndPlace((-0.06, 0.22), (0.06, 0.22), lift=0.05, wait=0.0, move=0.6)


@pytest.fixture(scope="module")
def scene():
    """Moves from the first period on, and carries nothing."""
    scene = load_scene(MODELS / "scenes" / "payload.toml")
    model = replace(scene.tuning.model, linearise="here")
    tuning = replace(scene.tuning, horizon=5, model=model)
    return replace(scene, payload=None, trajectory=PATH, duration=0.1, need=None, tuning=tuning)


@pytest.fixture
def asked(monkeypatch):
    """What the linear MPC is asked: (x, models, window) of every call."""
    calls, decide = [], LinearMPC.decide

    def spy(self, qp, x, models, reference, *others):
        calls.append((x, models, reference))
        return decide(self, qp, x, models, reference, *others)

    monkeypatch.setattr(LinearMPC, "decide", spy)
    return calls


def at_rest(pose):
    return np.concatenate([pose.p, np.zeros(2), pose.q])


# --- the controller ---------------------------------------------------------------------------------------------------


def test_the_window_carries_the_unknown_force_at_the_end_of_the_horizon(scene, asked):
    """Half a metre per second on: against inverse statics there, which is a second method."""
    pose, horizon, force = scene.start(), 30, np.array([4e-4, -3e-4])
    tuning = replace(scene.tuning, horizon=horizon)
    controller = make_controller(scene, tuning)
    controller.start(pose)
    controller.observer.force[:] = force
    controller.step(0, at_rest(pose))
    window = asked[-1][2]
    plain = feed_forward(scene, scene.robot, pose, horizon)
    assert window.states[:, :4] == pytest.approx(plain.states[1 : horizon + 1, :4], abs=1e-12)
    assert window.inputs == pytest.approx(plain.inputs[:horizon], abs=1e-12)
    shift = window.states[:, 4:] - plain.states[1 : horizon + 1, 4:]
    end = plain.states[horizon]
    near = solve_statics(scene.robot, end[:2], end[4:])
    wanted = inverse_statics(scene.robot, end[:2], plain.forces[horizon] + force, guess=near).q - end[4:]
    assert shift == pytest.approx(np.tile(wanted, (horizon, 1)), abs=2e-8)
    first = solve_statics(scene.robot, pose.p, pose.q, guess=pose)
    here = inverse_statics(scene.robot, pose.p, force, guess=first).q - pose.q
    assert np.abs(here - wanted).max() > 1e-6  # else the test says nothing


@pytest.mark.parametrize("delay", [0, 2])
def test_models_along_the_plan_carry_what_the_tip_carries_then(scene, asked, delay):
    """A force moves the tip by dt/m: the mass doubles from the period of the pick on."""
    pose, pick = scene.start(), 3
    late = replace(scene, delay=delay, payload=Payload(0.25, pick * scene.period, 9.0))
    model = replace(scene.tuning.model, linearise="along_plan")
    controller = make_controller(late, replace(scene.tuning, horizon=8, model=model))
    controller.start(pose)
    for k in range(3):
        asked.clear()
        controller.step(k, at_rest(pose))
        masses = [scene.period / model.E[2, 0] for model in asked[-1][1]]
        carried = [k + delay + j >= pick for j in range(8)]
        assert masses == pytest.approx(np.where(carried, 0.5, 0.25), rel=0.05), k


@pytest.mark.parametrize("delay", [0, 2])
def test_the_window_begins_where_the_command_arrives(scene, asked, delay):
    """First wanted state: that of the end of the period in which the rates act."""
    late = replace(scene, delay=delay)
    controller = make_controller(late)
    controller.start(scene.start())
    controller.step(1, at_rest(scene.start()))
    t = scene.period * (1 + delay + np.arange(1, scene.tuning.horizon + 1))
    assert asked[-1][2].states[:, :2] == pytest.approx(scene.trajectory(t)[:, 0], abs=1e-12)
    blind = replace(scene.tuning, model=replace(scene.tuning.model, predict_delay=False))
    controller = make_controller(late, blind)
    controller.start(scene.start())
    controller.step(1, at_rest(scene.start()))
    assert asked[-1][2].states[0, :2] == pytest.approx(scene.trajectory(scene.period * np.array([2]))[0, 0], abs=1e-12)


def test_the_observer_of_the_nonlinear_mpc_foresees_what_its_plan_foresees(scene):
    """Not what the linearisation does: its error would be taken for a force."""
    tuning = replace(load_tuning(CONTROLLERS / "nonlinear.toml"), horizon=2, observer=scene.tuning.observer)
    controller = make_controller(scene, tuning)
    pose = scene.start()
    controller.start(pose)
    x = at_rest(pose)
    for k in range(2):
        decision = controller.step(k, x)
        assert decision.plan.fallback is None
        assert controller.observer.x == pytest.approx(decision.plan.states[1], abs=1e-10)
        x = decision.plan.states[1].copy()
    assert np.abs(x[4:] - pose.q).max() > 1e-3  # far enough for a linear model to show


@pytest.mark.parametrize("fallback", ["raise", "ladder"])
def test_without_a_model_the_tuning_says_whether_to_raise(scene, fallback, monkeypatch):
    controller = make_controller(scene, replace(scene.tuning, fallback=fallback))
    pose = scene.start()
    controller.start(pose)

    def failing(*_):
        raise ConvergenceError("made up", residual=1.0, iterations=1, last=None)

    monkeypatch.setattr("pcr_mpc.loop.parts.foresight.Foresight.__call__", failing)
    if fallback == "raise":
        with pytest.raises(ConvergenceError, match="made up"):
            controller.step(0, at_rest(pose))
    else:
        plan = controller.step(0, at_rest(pose)).plan
        assert plan.fallback == "lqr"
        assert plan.status == "no linear model: made up"


def test_a_second_start_forgets_the_first(scene):
    """State, force, plan and commands on the way: the same measurements get the same answers."""
    late = replace(scene, delay=2)
    controller, pose = make_controller(late), scene.start()
    answers = []
    for _ in range(2):
        controller.start(pose)
        x = at_rest(pose)
        answers.append([])
        for k in range(4):
            x[0] += 2e-4
            answers[-1].append(controller.step(k, x).u.copy())
        assert np.abs(controller.observer.force).max() > 0
    assert np.array_equal(*answers)


def test_nothing_to_track_is_named(scene):
    still = replace(scene, trajectory=None)
    assert isinstance(make_controller(still), HoldMotors)
    assert make_controller(scene).name == scene.tuning.name
    assert isinstance(make_controller(replace(scene, tuning=None)), HoldMotors)
    with pytest.raises(ValueError, match="scene payload has no reference to track"):
        TrackingController(still, scene.tuning)


def test_limits_of_the_motors_are_those_of_a_period(scene):
    robot = replace(scene.robot, rate_limit=5.0, acceleration_limit=200.0)
    limits = motor_limits(robot, 0.01)
    assert (limits.rate, limits.rate_change) == (5.0, pytest.approx(2.0))
    assert limits.angle_lower.tolist() == [1.04, -2.1]
    assert limits.angle_upper.tolist() == [5.24, 2.1]


def test_the_limits_are_the_robots_and_not_those_that_the_controller_believes_in(scene):
    """Motors stand on the data sheet: a wrong robot does not drive them faster."""
    slow = replace(scene, robot=replace(scene.robot, rate_limit=0.5), duration=0.1)
    run = simulate(slow, slow.make_plant(), make_controller(slow, robot=scene.robot))
    assert np.abs(run.u).max() == 0.5


# --- what it tracks ---------------------------------------------------------------------------------------------------


def test_a_payload_is_a_part_of_the_references_velocity_where_the_rods_have_inertia(scene):
    """Momentum over mass, both with what is carried: M_pp^-1 pi = v + M_pp^-1 M_pq q' of a robot that much heavier."""
    pose = scene.start()
    found = feed_forward(replace(scene, payload=Payload(0.2, 0.0, 9.0)), scene.robot, pose, 2, "condensed").states
    t = scene.period * np.arange(len(found))
    rates = np.gradient(found[:, 4:], t, axis=0, edge_order=2)
    plant = Plant(replace(scene.robot, tip_mass=scene.robot.tip_mass + 0.2), inertia="condensed")
    plant.reset(found[0], pose)
    for x, v, rate in zip(found, scene.trajectory(t)[:, 1], rates, strict=True):
        mass = plant.mass(x[:2], x[4:])[0]
        assert x[2:4] - v == pytest.approx(np.linalg.solve(mass[:2, :2], mass[:2, 2:] @ rate), abs=1e-6)
    assert np.abs(found[:, 2:4] - scene.trajectory(t)[:, 1]).max() > 1e-4  # else the test says nothing


def test_rates_lead_from_each_pose_of_the_reference_to_the_next(scene):
    found = feed_forward(scene, scene.robot, scene.start(), 3)
    assert len(found.states) == scene.n_periods + 4
    assert len(found.inputs) == scene.n_periods + 3
    assert found.states[:-1, 4:] + scene.period * found.inputs == pytest.approx(found.states[1:, 4:], abs=1e-12)


def test_motors_that_have_lost_a_direction_stay_where_they_are(pair):
    """The tip between two rods that are images of each other by half a turn: both motors push it along one line."""
    pose = solve_statics(pair, (0.0, 0.0), (2.5, 2.5 - np.pi))
    assert np.linalg.svd(pose.dforce_dq, compute_uv=False)[1] < 1e-8 * np.abs(pose.dforce_dq).max()
    target = MotorTarget(pair)
    target.start(pose)
    assert target.shift(pose.p, pose.q, pose.force + [0.3, -0.2]).tolist() == [0.0, 0.0]


def test_a_large_shift_is_taken_in_steps_and_one_out_of_reach_not_at_all(pair, centre):
    target = MotorTarget(pair)
    target.start(centre)
    first = target.shift(centre.p, centre.q, centre.force + [0.0, -8.0])
    assert np.abs(first).max() == pytest.approx(0.1)
    held = first.copy()
    assert target.shift(np.array([0.0, 0.9]), centre.q, centre.force).tolist() == held.tolist()
    target.start(centre)
    assert target.shift(centre.p, centre.q, centre.force) == pytest.approx([0.0, 0.0], abs=1e-9)


def test_the_rods_push_the_tip_by_the_slope_of_their_kinetic_energy(pair, centre):
    """dT/dp at given velocities, against differences of T = w' M w / 2; and the momentum is dT/dv."""
    heavy = replace(pair, rods=tuple(replace(rod, line_density=10 * rod.line_density) for rod in pair.rods))
    plant, v, rates = Plant(heavy, inertia="condensed"), np.array([0.3, -0.2]), np.array([2.0, 1.0])
    plant.reset(at_rest(centre), centre)

    def energy(p, v):
        w = np.concatenate([v, rates])
        return w @ plant.mass(p, centre.q)[0] @ w / 2

    poses = together([solve_statics(heavy, centre.p, centre.q, guess=centre)])
    _, momentum, push = _momentum(poses, centre, "condensed", v[None], rates[None])
    by_p, by_v = np.empty(2), np.empty(2)
    for axis, h in enumerate(1e-5 * np.eye(2)):
        by_p[axis] = (energy(centre.p + h, v) - energy(centre.p - h, v)) / 2e-5
        by_v[axis] = (energy(centre.p, v + h) - energy(centre.p, v - h)) / 2e-5
    assert push[0] == pytest.approx(by_p, rel=1e-5)
    assert momentum[0] == pytest.approx(by_v, rel=1e-7)
