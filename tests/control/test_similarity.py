"""Dynamically similar robots give similar answers: whatever has a unit is measured in the robot's own."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    LinearMPC,
    Plant,
    Reference,
    forward_statics,
    inverse_statics,
    linearise,
    load_scene,
    load_tuning,
    simulate,
    solve_statics,
)
from pcr_mpc.control.mpc import riccati
from pcr_mpc.control.nonlinear.nonlinear_mpc import NonlinearMPC
from pcr_mpc.control.observer import DisturbanceObserver
from pcr_mpc.linearisation.pose_limits import LimitWatch, PoseLimits
from pcr_mpc.loop.controller.make_controller import make_controller
from pcr_mpc.loop.parts.assembled import motor_limits
from pcr_mpc.plant.statics.stability import all_equilibria, assess_stability, distance_to_fold
from pcr_mpc.plant.statics.symbolic import rod_unknowns, symbolic_dynamics
from tests.conftest import CONTROLLERS, MODELS

from .similar import Units

# A micro-robot with quick motion, a bridge with slow motion, and each unit by itself: no product of them stays.
UNITS = [
    Units(1e-6, 1e-9, 1e-3),
    Units(1e3, 1e7, 30.0),
    Units(1e-4, 1.0, 1.0),
    Units(1.0, 1e-8, 1.0),
    Units(1.0, 1.0, 1e-4),
]
IDS = ["micro", "bridge", "length", "mass", "time"]


@pytest.fixture(params=UNITS, ids=IDS)
def units(request):
    return request.param


@pytest.fixture(scope="module")
def laden(pair):
    """In the plane of gravity, so that weights count."""
    return replace(pair, gravity=(0.0, -9.81), rods=tuple(replace(rod, line_density=0.0) for rod in pair.rods))


def test_statics(pair, units, poses):
    robot = units.robot(pair)
    for eq in poses:
        p, q = units.length * eq.p, eq.q
        for method in ("closed_form", "multiple_shooting"):
            here = solve_statics(robot, p, q, method=method)
            there = solve_statics(pair, eq.p, q, method=method)
            assert here.mode == there.mode
            assert here.force / units.force == pytest.approx(there.force, rel=1e-7, abs=1e-9)
            assert here.dforce_dp / units.stiffness == pytest.approx(there.dforce_dp, rel=1e-7, abs=1e-7)
            assert here.dforce_dq / units.force == pytest.approx(there.dforce_dq, rel=1e-7, abs=1e-7)
            assert here.motor_torque / units.torque == pytest.approx(there.motor_torque, rel=1e-7, abs=1e-9)
            assert here.energy / units.torque == pytest.approx(there.energy, rel=1e-9)
        one, other = assess_stability(here), assess_stability(there)
        assert one.unstable_directions == other.unstable_directions
        assert one.rod_margins == pytest.approx(other.rod_margins, rel=1e-6)
        assert one.motor_authority / units.force == pytest.approx(other.motor_authority, rel=1e-6)


def test_balance(laden, units):
    robot = units.robot(laden)
    push = np.array([0.3, -0.4])
    there = inverse_statics(laden, (0.02, 0.25), push, mode="LR")
    here = inverse_statics(robot, units.length * there.p, units.force * push, mode="LR")
    assert here.q == pytest.approx(there.q, abs=1e-7)
    there = forward_statics(laden, (3.2, -0.1), push)
    here = forward_statics(robot, there.q, units.force * push)
    assert here.p / units.length == pytest.approx(there.p, abs=1e-7)
    there = forward_statics(laden, (3.5, -0.3), push, guess=there)
    here = forward_statics(robot, there.q, units.force * push, guess=here)
    assert here.p / units.length == pytest.approx(there.p, abs=1e-7)
    fold = (0.25, 0.15), there.q + 0.5
    far = distance_to_fold(there, *fold)
    assert 0.05 < far < 0.95
    assert distance_to_fold(here, units.length * np.array(fold[0]), fold[1]) == pytest.approx(far, abs=3e-6)


@pytest.fixture(scope="module")
def listed(laden):
    """All free poses of a robot whose rods can meet in a small region only, which keeps the search short."""
    rods = (replace(laden.rods[0], base=(-0.34, 0.0)), replace(laden.rods[1], base=(0.34, 0.0)))
    robot, q, push = replace(laden, rods=rods), (1.0, 1.9), (0.1, 0.0)
    return robot, q, push, all_equilibria(robot, q=q, force=push)


def test_list_of_held_equilibria(laden, units):
    q, there = (3.366, -0.224), (0.0, 0.25)
    held = all_equilibria(laden, there, q)
    found = all_equilibria(units.robot(laden), units.length * np.array(there), q)
    assert len(held) > 3
    assert [eq.force / units.force for eq in found] == [pytest.approx(eq.force, abs=1e-6) for eq in held]


@pytest.mark.parametrize("units", [UNITS[0], *(pytest.param(of, marks=pytest.mark.slow) for of in UNITS[1:])], ids=IDS)
def test_list_of_free_equilibria(units, listed):
    robot, q, push, free = listed
    assert len(free) > 1
    found = all_equilibria(units.robot(robot), q=q, force=units.force * np.array(push))
    assert [eq.p / units.length for eq in found] == [pytest.approx(eq.p, abs=1e-6) for eq in free]
    assert [eq.stable for eq in found] == [eq.stable for eq in free]


def test_a_free_tip_carries_its_weight_in_every_pose_listed(listed):
    robot, q, push, free = listed
    for eq in free:
        assert eq.force == pytest.approx(np.array(push) + [0.0, -9.81 * robot.tip_mass], abs=1e-7)
    rests = forward_statics(robot, q, push)
    assert min(np.linalg.norm(eq.p - rests.p) for eq in free) < 1e-7
    # The least potential energy first, in which the weight counts.
    potentials = [eq.energy - eq.force @ eq.p for eq in free]
    assert potentials == sorted(potentials)


def models(robot, units, centre, dt):
    """Of the robot in other units and of itself, at the same pose."""
    for one, of in ((units.robot(robot), units), (robot, Units(1.0, 1.0, 1.0))):
        pose = solve_statics(one, of.length * centre.p, centre.q)
        plant, x = Plant(one), np.concatenate([pose.p, [0.0, 0.0], pose.q])
        plant.reset(x, pose)
        yield linearise(plant, x, np.zeros(one.n_rods), of.time * dt), x


@pytest.mark.parametrize("dt", [0.01, 0.002])
def test_gains(pair, centre, units, dt):
    (here, _), (there, _) = models(pair, units, centre, dt)
    tuning = load_tuning(CONTROLLERS / "lemniscate.toml")
    gain, cost = riccati(here, units.tuning(tuning))
    expected, expected_cost = riccati(there, tuning)
    state = units.state(2)
    assert gain * state * units.time == pytest.approx(expected, rel=1e-6, abs=1e-6 * np.abs(expected).max())
    # The cost is a number.
    assert cost * np.outer(state, state) == pytest.approx(
        expected_cost, rel=1e-6, abs=1e-6 * np.abs(expected_cost).max()
    )
    noise = load_tuning(CONTROLLERS / "default.toml")
    found = DisturbanceObserver(units.tuning(noise).observer, 0.0, 0.0, here).gain
    expected = DisturbanceObserver(noise.observer, 0.0, 0.0, there).gain
    per = np.array([units.length] * 2 + [units.speed] * 2 + [units.force] * 2) / units.length
    assert found / per[:, None] == pytest.approx(expected, rel=1e-6, abs=1e-6 * np.abs(expected).max())


def test_gains_of_three_rods(units):
    """More motors than the tip sees: what the angles weigh is no more than makes the equation solvable."""
    scene = load_scene(MODELS / "scenes" / "three_rods.toml")
    (here, _), (there, _) = models(scene.robot, units, scene.start(), 0.01)
    gain, _ = riccati(here, units.tuning(scene.tuning))
    expected, _ = riccati(there, scene.tuning)
    assert gain * units.state(3) * units.time == pytest.approx(expected, rel=1e-4, abs=1e-5 * np.abs(expected).max())


def test_pose_limits(pair, units):
    there = inverse_statics(pair, (0.1, 0.25), mode="LR")
    limits = PoseLimits(0.8, (-0.1, 0.1), (0.2, 0.3), 0.5, 40.0)
    rows = []
    for of in (units, Units(1.0, 1.0, 1.0)):
        robot = of.robot(pair)
        plant, x = Plant(robot), np.concatenate([of.length * there.p, [0.0, 0.0], there.q])
        pose = solve_statics(robot, x[:2], x[4:])
        watch = LimitWatch(of.pose_limits(limits), plant)
        watch.reset(x, pose)
        found = watch.rows(x)
        rows.append((found.kinds, found.C * of.state(2), found.lower, found.upper))
    assert rows[0][0] == rows[1][0]
    assert set(rows[0][0]) == {"torque", "tip region", "rod margin", "stiffness"}
    for one, other in zip(rows[0][1:], rows[1][1:], strict=True):
        assert one == pytest.approx(other, rel=1e-6, abs=1e-6)


def test_snap(pair, centre, units):
    """A rod that loses its shape falls to the same one."""
    ends = []
    for of in (units, Units(1.0, 1.0, 1.0)):
        plant = Plant(of.robot(pair), on_snap="jump")
        p = of.length * centre.p
        plant.reset(np.concatenate([p, [0.0, 0.0], centre.q]), solve_statics(plant.robot, p, centre.q))
        for turn in np.linspace(0.0, 5.0, 40):
            force = plant.force(p, centre.q + [turn, 0.0])
        (snap,) = plant.snaps
        ends.append((snap.q, snap.energy_lost / of.torque, *(force / of.force)))
    assert ends[0] == pytest.approx(ends[1], rel=1e-4)


TRACKED = [
    pytest.param(units, name, id=f"{name}-{id_}", marks=() if name == "default" and k < 2 else pytest.mark.slow)
    for name, count in (("default", 5), ("lemniscate", 2))
    for k, (units, id_) in enumerate(zip(UNITS[:count], IDS[:count], strict=True))
]


@pytest.mark.parametrize(("units", "name"), TRACKED)
def test_tracking(units, name):
    """The closed loop with an observer, an unknown load and a sensor."""
    assert_similar(units, name)


@pytest.mark.parametrize("solver", ["osqp", "daqp"])
@pytest.mark.parametrize("input_weight", [1.0, 1e3])
def test_plans_are_as_sharp_in_any_units(pair, centre, units, solver, input_weight):
    """A solver that stops early stops at the same place: its tolerance is one of angles, not of rad/s."""
    tuning = replace(load_tuning(CONTROLLERS / "measured.toml"), solver=solver, tolerance=1e-3)
    tuning = replace(tuning, input_weight=input_weight * tuning.input_weight)
    plans = []
    for of, (model, x) in zip((units, Units(1.0, 1.0, 1.0)), models(pair, units, centre, 0.01), strict=True):
        limits = motor_limits(of.robot(pair), of.time * 0.01)
        start = x + of.state(2) * np.array([0.02, -0.03, 0.1, 0.0, 0.0, 0.0])
        reference = Reference(np.tile(x, (tuning.horizon, 1)), np.zeros((tuning.horizon, 2)))
        plans.append(LinearMPC(of.tuning(tuning), limits).solve(start, model, reference, np.zeros(2)))
    here, there = plans
    assert there.status == here.status == "solved"
    assert bool(there.active) == (input_weight == 1.0)
    assert (here.iterations, here.active) == (there.iterations, there.active)
    assert here.inputs * units.time == pytest.approx(there.inputs, rel=1e-6, abs=1e-6)
    assert here.primal_residual == pytest.approx(there.primal_residual, rel=1e-3, abs=1e-12)
    assert here.dual_residual == pytest.approx(there.dual_residual, rel=1e-3, abs=1e-9)


@pytest.mark.parametrize("units", UNITS[:1] + UNITS[-1:], ids=IDS[:1] + IDS[-1:])
@pytest.mark.parametrize("name", ["lqr", pytest.param("pd", marks=pytest.mark.slow)])
def test_laws_without_a_solver(units, name):
    assert_similar(units, name)


def assert_similar(units, name):
    tuning = load_tuning(CONTROLLERS / f"{name}.toml")
    scene = replace(load_scene(MODELS / "scenes" / "lemniscate.toml"), duration=0.4, force=(0.2, -0.1), tip_noise=1e-5)
    scene = scene.tuned(tuning)
    here, there = (simulate(s, s.make_plant(), make_controller(s), 3) for s in (units.scene(scene), scene))
    largest = there.error.max()
    assert largest > 2e-4
    assert here.error / units.length == pytest.approx(there.error, rel=0.01, abs=2e-3 * largest)
    assert here.summary()["fallbacks"] == there.summary()["fallbacks"] == 0


def test_nonlinear_plans(pair, centre, units):
    """IPOPT sees the same problem, of order one, whatever the robot is measured in."""
    tuning = replace(load_tuning(CONTROLLERS / "measured.toml"), horizon=3)
    plans = []
    for of, (model, x) in zip((units, Units(1.0, 1.0, 1.0)), models(pair, units, centre, 0.01), strict=True):
        robot = of.robot(pair)
        hands, algebraic = rod_unknowns(robot, solve_statics(robot, x[:2], x[4:]))
        limits = motor_limits(robot, of.time * 0.01)
        mpc = NonlinearMPC(of.tuning(tuning), limits, symbolic_dynamics(robot, hands), algebraic)
        model = replace(model, force=of.force * np.array([0.2, -0.1]))
        start = x + of.state(2) * np.array([0.02, -0.03, 0.1, 0.0, 0.0, 0.0])
        reference = Reference(np.tile(x, (tuning.horizon, 1)), np.zeros((tuning.horizon, 2)))
        plans.append(mpc.solve(start, model, reference, np.zeros(2)))
    here, there = plans
    assert there.status == here.status == "solved"
    assert there.active
    assert (here.iterations, here.active) == (there.iterations, there.active)
    assert here.inputs * units.time == pytest.approx(there.inputs, rel=1e-6, abs=1e-7)
    assert here.states / units.state(2) == pytest.approx(there.states, rel=1e-6, abs=1e-8)
    assert here.primal_residual < 1e-9


def test_limits_that_give_way(pair, centre, units):
    """A start beyond the stops: the same plan, and the same slack."""
    tuning = replace(load_tuning(CONTROLLERS / "default.toml"), max_iterations=4000)
    plans = []
    for of, (model, x) in zip((units, Units(1.0, 1.0, 1.0)), models(pair, units, centre, 0.01), strict=True):
        limits = replace(motor_limits(of.robot(pair), of.time * 0.01), angle_upper=x[4:] - 0.5)
        reference = Reference(np.tile(x, (tuning.horizon, 1)), np.zeros((tuning.horizon, 2)))
        plans.append(LinearMPC(of.tuning(tuning), limits).solve(x, model, reference, np.zeros(2)))
    here, there = plans
    assert here.fallback == there.fallback == "softened"
    assert here.slack["angle"] == pytest.approx(there.slack["angle"], abs=1e-4)
    assert here.inputs * units.time == pytest.approx(there.inputs, abs=1e-3)
    assert here.iterations == there.iterations
