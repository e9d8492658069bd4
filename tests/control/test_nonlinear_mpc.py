"""The nonlinear MPC against the plant, against the linear one, and where it fails."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from pcr_mpc import (
    InfeasibleError,
    LinearMPC,
    Plant,
    Reference,
    UnreachableError,
    UnstableError,
    linearise,
    load_scene,
    load_tuning,
)
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.control.nonlinear import nlp_solver
from pcr_mpc.control.nonlinear.collocation import gauss_tableau
from pcr_mpc.control.nonlinear.nonlinear_mpc import NonlinearMPC
from pcr_mpc.plant.statics.symbolic import rod_unknowns, symbolic_dynamics
from tests.conftest import CONTROLLERS, MODELS

DT = 0.01


def make_nonlinear_mpc(robot, pose, tuning, limits, **options):
    hands, algebraic = rod_unknowns(robot, pose)
    return NonlinearMPC(tuning, limits, symbolic_dynamics(robot, hands), algebraic, **options)


@pytest.fixture(scope="module")
def tuning():
    return replace(load_tuning(CONTROLLERS / "measured.toml"), horizon=5)  # IPOPT takes long to set up


@pytest.fixture(scope="module")
def plant(pair):
    return Plant(pair, integrator="rk4", dt=1e-4)


@pytest.fixture
def model(plant, target, centre):
    plant.reset(target, centre)
    return linearise(plant, target, (0.0, 0.0), DT)


@pytest.fixture(scope="module")
def reference(tuning, target):
    return Reference(np.tile(target, (tuning.horizon, 1)), np.zeros((tuning.horizon, 2)))


@pytest.fixture
def wide(pair):
    return Limits(6.0, 3.0, *pair.angle_limits.T)


def far(target):
    return target + np.array([0.02, -0.03, 0.1, 0.0, 0.0, 0.0])


def simulated(plant, x, inputs, force):
    """States of the plant at the ends of the periods."""
    states = [x]
    for u in inputs:
        for _ in range(round(DT / plant.dt)):
            x = plant.step(x, u, force)
        states.append(x)
    return np.array(states)


@pytest.mark.parametrize(("points", "accuracy"), [(2, 2e-7), (3, 1e-9)])
def test_the_plan_is_what_the_plant_does(tuning, target, centre, reference, pair, plant, wide, points, accuracy):
    """Gauss collocation with 10 ms periods against RK4 with 0.1 ms steps, under a known force."""
    force = np.array([0.4, -0.3])
    mpc = make_nonlinear_mpc(pair, centre, tuning, wide, points=points)
    plant.reset(target, centre)
    model = linearise(plant, target, np.zeros(2), DT, force)
    plan = mpc.solve(far(target), model, reference, np.zeros(2))
    assert plan.status == "solved"
    assert np.abs(plan.inputs).max() > 1.0  # a motion worth predicting
    plant.reset(far(target), centre)
    states = simulated(plant, far(target), plan.inputs, force)
    assert np.abs(plan.states[:, :2] - states[:, :2]).max() < accuracy
    assert np.abs(plan.states - states).max() < 100 * accuracy
    # The linear model of the first period is moved to agree with it.
    assert plan.models(far(target), plan.inputs[0]) == pytest.approx(plan.states[1], abs=1e-12)


def test_near_balance_it_is_the_linear_mpc(tuning, target, centre, model, reference, pair, wide):
    tuning = replace(tuning, tolerance=1e-10)
    found = []
    for size in (1e-5, 1e-6):
        x = target + size * np.array([1.0, -2.0, 3.0, 1.0, -1.0, 2.0])
        linear = LinearMPC(tuning, wide).solve(x, model, reference, np.zeros(2))
        plan = make_nonlinear_mpc(pair, centre, tuning, wide).solve(x, model, reference, np.zeros(2))
        # What the linear model leaves out is of second order in the deviation.
        found.append(np.abs(plan.inputs - linear.inputs).max() / np.abs(linear.inputs).max())
    assert found[0] < 1e-2
    assert found[1] < 0.2 * found[0]


def test_limits_hold_in_every_plan(tuning, target, centre, model, reference, pair):
    limits = Limits(1.5, 0.7, target[4:] - 0.02, target[4:] + 0.02)
    mpc = make_nonlinear_mpc(pair, centre, tuning, limits)
    plant = Plant(pair, integrator="rk4", dt=1e-3)
    x, u = far(target), np.array([0.3, -0.2])
    plant.reset(x, centre)
    touched = np.zeros(3, dtype=bool)
    for _ in range(15):
        plan = mpc.solve(x, model, reference, u)
        assert (plan.status, plan.fallback) == ("solved", None)
        change = np.diff(np.vstack([u, plan.inputs]), axis=0)
        turned = plan.states[1:, 4:] - target[4:]
        assert np.abs(plan.inputs).max() <= 1.5
        assert np.abs(change).max() <= 0.7 + 1e-9
        assert np.abs(turned).max() <= 0.02 + 1e-9
        touched |= (
            np.array([np.abs(a).max() for a in (plan.inputs, change, turned)]) > np.array([1.5, 0.7, 0.02]) - 1e-5
        )
        u = plan.inputs[0]
        x = simulated(plant, x, [u], np.zeros(2))[-1]
    assert touched.all()  # each of the limits was in the way at some time


def test_a_change_of_rate_counts_from_the_last_input(tuning, target, centre, model, reference, pair):
    for previous in (-2.0, 2.0):
        limits = Limits(6.0, 0.5, *pair.angle_limits.T)
        mpc = make_nonlinear_mpc(pair, centre, tuning, limits)
        plan = mpc.solve(target, model, reference, np.full(2, previous))
        assert plan.inputs[0] == pytest.approx(np.full(2, 0.75 * previous))
        # In the NLP itself, not only by clipping its first input.
        assert (plan.states[1, 4:] - target[4:]) / DT == pytest.approx(plan.inputs[0])


def test_failure_has_a_name(tuning, target, centre, model, reference, pair, wide):
    mpc = make_nonlinear_mpc(pair, centre, tuning, wide, max_iterations=1)
    plan = mpc.solve(far(target), model, reference, np.array([2.0, 0.0]))
    assert (plan.fallback, plan.status) == ("hold", "Maximum_Iterations_Exceeded")
    assert not plan.inputs.any()
    with pytest.raises(InfeasibleError, match="Maximum_Iterations_Exceeded after 1 iterations") as caught:
        make_nonlinear_mpc(pair, centre, replace(tuning, fallback="raise"), wide, max_iterations=1).solve(
            far(target), model, reference, np.zeros(2)
        )
    assert caught.value.iterations == 1


def test_a_success_is_not_taken_on_trust(tuning, target, centre, model, reference, pair, wide, monkeypatch):
    def status(dynamics):
        mpc = NonlinearMPC(tuning, wide, dynamics, along)
        return mpc.solve(far(target), model, reference, np.zeros(2)).status

    hands, along = rod_unknowns(pair, centre)
    dynamics = symbolic_dynamics(pair, hands)
    arguments = dynamics.sx_in()
    acceleration, residual, _ = dynamics(*arguments)
    past = ca.Function(
        "past", arguments, [acceleration, residual, ca.SX(1)], ["p", "v", "q", "z", "f"], ["a", "r", "b"]
    )
    assert status(dynamics) == "solved"
    assert status(past) == "a rod past its limit of stability"
    monkeypatch.setattr(nlp_solver, "LARGEST_RESIDUAL", -1.0)
    assert status(dynamics).startswith("broken equations")


def test_the_last_plan_answers_as_long_as_it_lasts(tuning, target, centre, model, reference, pair, wide):
    mpc = make_nonlinear_mpc(pair, centre, tuning, wide)
    solved = mpc.solve(far(target), model, reference, np.zeros(2))
    u = solved.inputs[0]
    out_of_reach = replace(reference, states=reference.states + np.array([0.5, 0, 0, 0, 0, 0]))
    beyond = far(target)
    beyond[4:] = pair.angle_limits[:, 1] + 0.2  # further than a period at the rate limit brings it back
    for k in range(1, tuning.horizon):
        # IPOPT finds no way; from the second time on there is not even a start.
        plan = mpc.solve(beyond, model, out_of_reach, u)
        assert plan.fallback == "shifted_plan"
        assert plan.status.startswith("no start: tip") == (k > 1)
        assert plan.inputs[1:-k] == pytest.approx(solved.inputs[k + 1 :])
        # The rates in force are the plan's only as far as the stops allow: beyond them it brakes and comes back.
        assert plan.inputs[0] == pytest.approx(np.maximum(u - 3.0, -6.0))
        u = plan.inputs[0]
    assert mpc.solve(beyond, model, out_of_reach, u).fallback == "hold"
    again = mpc.solve(far(target), model, reference, u)
    assert (again.status, again.fallback) == ("solved", None)
    assert mpc.solve(beyond, model, out_of_reach, again.inputs[0]).fallback == "shifted_plan"


def test_a_missing_measurement_is_answered(tuning, target, centre, model, reference, pair):
    mpc = make_nonlinear_mpc(pair, centre, tuning, Limits(6.0, 2.0, *pair.angle_limits.T))
    mpc.prepare(model)
    plan = mpc.fall_back("no measurement", np.full(6, np.nan), reference, np.array([5.0, 0.0]))
    assert (plan.fallback, plan.status, plan.models) == ("hold", "no measurement", None)
    assert plan.inputs[:, 0] == pytest.approx([3.0, 1.0] + [0.0] * (tuning.horizon - 2))
    with pytest.raises(ValueError, match="x is not finite"):
        mpc.solve(np.full(6, np.nan), model, reference, np.zeros(2))


def test_reset_repeats_bit_for_bit(tuning, target, centre, model, reference, pair, wide):
    mpc = make_nonlinear_mpc(pair, centre, tuning, wide)

    def run():
        x, u, found = far(target), np.zeros(2), []
        for _ in range(4):
            plan = mpc.solve(x, model, reference, u)
            u, x = plan.inputs[0], plan.states[1]
            found.append(plan.inputs)
        return np.array(found)

    first = run()
    mpc.reset()
    assert (run() == first).all()


@pytest.mark.parametrize("prepared", [False, True])
def test_a_retuned_one_is_one_that_was_tuned_so(tuning, target, centre, model, pair, wide, prepared):
    other = replace(tuning, horizon=3, input_weight=0.5, velocity_weight=30.0)
    mpc, new = (make_nonlinear_mpc(pair, centre, one, wide) for one in (replace(tuning, horizon=2), other))
    for one in (mpc, new) if prepared else ():
        one.prepare(model)
    mpc.retune(other)
    assert mpc.tuning is other
    # The terminal weight is that of the model that it was prepared for, not of the first that it meets.
    met = replace(model, B=1.5 * model.B)
    reference = Reference(np.tile(target, (3, 1)), np.zeros((3, 2)))
    plans = [one.solve(far(target), met, reference, np.zeros(2)) for one in (mpc, new)]
    np.testing.assert_array_equal(plans[0].inputs, plans[1].inputs)
    if prepared:
        fresh = make_nonlinear_mpc(pair, centre, other, wide).solve(far(target), met, reference, np.zeros(2))
        assert np.abs(fresh.inputs - plans[0].inputs).max() > 1e-3


@pytest.mark.parametrize("horizon", [1, 2])
def test_short_horizons(tuning, target, centre, model, pair, wide, horizon):
    reference = Reference(np.tile(target, (horizon, 1)), np.zeros((horizon, 2)))
    mpc = make_nonlinear_mpc(pair, centre, replace(tuning, horizon=horizon), wide)
    x, u = far(target), np.zeros(2)
    for _ in range(3):
        plan = mpc.solve(x, model, reference, u)
        assert (plan.status, plan.inputs.shape) == ("solved", (horizon, 2))
        u, x = plan.inputs[0], plan.states[1]
    with pytest.raises(ValueError, match=r"built for 0\.01 s"):
        mpc.solve(x, replace(model, dt=0.02), reference, u)


def test_three_rods(tuning, wide):
    scene, tuning = load_scene(MODELS / "scenes" / "three_rods.toml"), replace(tuning, horizon=10)
    pose = scene.start()
    x = np.concatenate([pose.p, [0.0, 0.0], pose.q])
    plant = Plant(scene.robot)
    plant.reset(x, pose)
    reference = Reference(np.tile(x, (tuning.horizon, 1)), np.zeros((tuning.horizon, 3)))
    limits = Limits(6.0, 3.0, *scene.robot.angle_limits.T)
    mpc = make_nonlinear_mpc(scene.robot, pose, tuning, limits)
    moved = x + np.array([1e-3, 0, 0, 0, 0, 0, 0])
    plan = mpc.solve(moved, linearise(plant, x, np.zeros(3), DT), reference, np.zeros(3))
    assert plan.status == "solved"
    assert np.abs(plan.states[-1, :2] - pose.p).max() < 5e-4


def test_gauss_tableau_integrates_polynomials():
    for points in (1, 2, 3, 4):
        a, b, c = gauss_tableau(points)
        for power in range(2 * points):
            assert b @ c**power == pytest.approx(1 / (power + 1))
        for power in range(points):
            assert a @ c**power == pytest.approx(c ** (power + 1) / (power + 1))


def test_symbolic_dynamics_are_the_plants(pair, poses):
    force, v = np.array([0.3, -0.2]), np.array([0.1, 0.5])
    for pose in poses:
        hands, along = rod_unknowns(pair, pose)
        z = along(pose.p[None], pose.q[None])[0]
        acceleration, residual, beyond = symbolic_dynamics(pair, hands)(pose.p, v, pose.q, z, force)
        expected = (force - pose.force - pair.drag * v) / pair.tip_mass
        assert acceleration.full().ravel() == pytest.approx(expected, rel=1e-9)
        assert np.abs(residual.full()).max() < 1e-12
        assert not beyond.full().any()
    z[1] *= 3.0  # far beyond the limit of a rod with its tip held
    assert symbolic_dynamics(pair, hands)(pose.p, v, pose.q, z, force)[2].full().ravel().tolist() == [1.0, 0.0]


def test_unknowns_are_followed_along_the_branch_alone(pair, centre):
    hands, along = rod_unknowns(pair, centre)
    assert hands == (-1.0, 1.0)
    turns = np.linspace(0.0, 6.0, 40)
    with pytest.raises(UnstableError, match="rod 0 cannot follow"):
        along(np.tile(centre.p, (40, 1)), centre.q + turns[:, None] * [1.0, 0.0])
    with pytest.raises(UnreachableError):
        along(np.array([[0.0, 1.0]]), centre.q[None])
    with pytest.raises(ValueError, match="for each of 2 rods"):
        symbolic_dynamics(pair, (1.0,))


def test_a_solution_that_leads_nowhere_does_not_spoil_the_next(tuning, target, centre, model, reference, pair, wide):
    mpc, fresh = (make_nonlinear_mpc(pair, centre, tuning, wide) for _ in range(2))
    mpc.solve(far(target), model, reference, np.zeros(2))
    mpc._point = replace(mpc._point, unknowns=np.full_like(mpc._point.unknowns, 1e6))
    plan = mpc.solve(far(target), model, reference, np.zeros(2))
    assert plan.status == "solved"
    np.testing.assert_allclose(plan.inputs, fresh.solve(far(target), model, reference, np.zeros(2)).inputs, atol=1e-5)
