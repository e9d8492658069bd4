from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from experiments.statics.finite_differences import error_curve
from pcr_mpc import Plant, linearise, load_robot
from tests.conftest import MODELS


def state(pose, velocity=(0.05, -0.1)):
    return np.concatenate([pose.p, velocity, pose.q])


def heavier(robot, times):
    return replace(robot, rods=tuple(replace(rod, line_density=times * rod.line_density) for rod in robot.rods))


@pytest.mark.parametrize("method", ["closed_form", "multiple_shooting"])
def test_jacobians_against_central_differences(pair, poses, method):
    """The error falls with the square of the step, then rises with rounding; its floor is below 1e-7."""
    for pose in poses[:2]:
        steps, errors = error_curve(pair, pose, method)
        assert errors.min() < 1e-7
        falling = (steps <= 1e-2) & (steps >= 3e-4)
        slope = np.polyfit(np.log(steps[falling]), np.log(errors[falling]), 1)[0]
        assert slope == pytest.approx(2.0, abs=0.2)
        assert errors[0] > 10 * errors.min()  # rounding


@pytest.mark.parametrize("inertia", ["none", "constant"])
@pytest.mark.parametrize("dt", [1e-3, 1e-2, 1e-1, 0.3])
def test_discretisation_is_exact(pair, poses, dt, inertia):
    """Against SciPy's matrix exponential of the whole affine system, impulses of the rates at its ends."""
    robot = heavier(pair, 20.0)
    plant = Plant(robot, inertia=inertia)
    for pose in poses:
        x, f_ext = state(pose), np.array([0.3, -0.2])
        plant.reset(x, pose)
        model = linearise(plant, x, (0.0, 0.0), dt, f_ext)
        eq = plant.equilibrium(x)
        mass, n = plant.mass(x[:2], x[4:])[0], 2
        inverse = np.linalg.inv(mass[:2, :2])
        whole = np.zeros((4 + 2 * n + 1, 4 + 2 * n + 1))
        whole[0:2, 2:4] = np.eye(2)
        whole[2:4, 0:2] = -inverse @ eq.dforce_dp
        whole[2:4, 2:4] = -pair.drag * inverse
        whole[2:4, 4:6] = -inverse @ eq.dforce_dq
        whole[4:6, 6:8] = np.eye(2)
        whole[2:4, 8] = inverse @ (f_ext - eq.force + eq.dforce_dp @ x[:2] + eq.dforce_dq @ x[4:])
        start, stop = np.eye(9), np.eye(9)
        start[2:4, 6:8] = -inverse @ mass[:2, 2:]
        stop[2:4, 6:8] = -start[2:4, 6:8]
        exact = stop @ expm(dt * whole) @ start
        assert model.A == pytest.approx(exact[:6, :6], rel=1e-8, abs=1e-8)
        assert model.B == pytest.approx(exact[:6, 6:8], rel=1e-8, abs=1e-8)
        assert model.c == pytest.approx(exact[:6, 8], rel=1e-8, abs=1e-8)


def test_prediction_error_is_of_second_order(pair, centre):
    """Halving the displacement from the point of linearisation quarters the error of one period."""
    plant = Plant(pair, integrator="rk4", dt=1e-3)
    x = state(centre, (0.0, 0.0))
    plant.reset(x, centre)
    model = linearise(plant, x, (0.0, 0.0), 0.02)
    errors = []
    for size in (0.02, 0.01, 0.005):
        y = x + size * np.array([0.6, -0.8, 0.5, 0.5, 1.0, -0.5])
        u = size * np.array([20.0, 10.0])
        predicted = model(y, u)
        plant.reset(y, centre)
        for _ in range(20):
            y = plant.step(y, u)
        errors.append(np.linalg.norm(predicted - y))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert rates == pytest.approx([2.0, 2.0], abs=0.2)


def differences(plant, pose, x, u):
    """A and B of one step of the plant, by central differences."""

    def step(y, w):
        plant.reset(x, pose)  # which is where the inertia is constant
        return plant.step(y, w)

    a = [(step(x + h, u) - step(x - h, u)) / 2e-4 for h in 1e-4 * np.eye(len(x))]
    b = [(step(x, u + h) - step(x, u - h)) / 2e-4 for h in 1e-4 * np.eye(len(u))]
    return np.array(a).T, np.array(b).T


@pytest.mark.parametrize("inertia", ["none", "constant", "condensed"])
def test_inertia_against_differences_of_a_step(pair, poses, inertia):
    """From rest, where the products of velocities vanish, whose slopes are left out; out of balance, heavy rods."""
    robot, dt = heavier(pair, 10.0), 5e-4
    for pose in poses:
        x, u = state(pose, (0.0, 0.0)), np.zeros(2)
        plant = Plant(robot, inertia=inertia, integrator="rk4", dt=dt)
        plant.reset(x, pose)
        model = linearise(plant, x, u, dt)
        a, b = differences(plant, pose, x, u)
        size = np.abs(a - np.eye(6))[2:4, [0, 1, 4, 5]].max()
        assert np.abs(model.A - a)[2:4].max() < 1e-3 * size
        assert np.abs(model.A - a)[[0, 1, 4, 5]].max() < 1e-3 * dt
        assert np.abs(model.B - b)[:2].max() < 1e-3 * np.abs(b[:2]).max()
        assert np.abs(model.B - b)[2:4].max() < 1e-3 * dt * size


@pytest.mark.parametrize(("v", "u"), [((0.3, -0.2), (2.0, -1.5)), ((0.8, 0.5), (6.0, 6.0))])
def test_what_the_linear_model_leaves_out_is_the_curvature_of_the_force(pair, centre, v, u):
    """In motion, over a control period, of rods ten times as heavy: as much as of rods without mass."""
    errors, robot = {}, heavier(pair, 10.0)
    for inertia in ("condensed", "none"):
        x, plant = state(centre, v), Plant(robot, inertia=inertia, integrator="rk4", dt=1e-3)
        plant.reset(x, centre)
        predicted = linearise(plant, x, u, 0.01)(x, np.array(u))
        plant.reset(x, centre)
        y = x
        for _ in range(10):
            y = plant.step(y, u)
        errors[inertia] = predicted - y
    for part in (slice(0, 2), slice(2, 4)):
        condensed, none = (np.linalg.norm(errors[inertia][part]) for inertia in ("condensed", "none"))
        assert 0.5 * none < condensed < 1.1 * none


@pytest.mark.parametrize("dt", [0.0, -1.0, np.nan, np.inf, 100.0])
def test_a_senseless_period_is_refused(pair, centre, dt):
    plant = Plant(pair)
    plant.reset(state(centre), centre)
    with pytest.raises(ValueError, match="dt"):
        linearise(plant, state(centre), (0.0, 0.0), dt)


def test_state_space(pair, centre):
    plant = Plant(pair)
    x = state(centre)
    plant.reset(x, centre)
    model = linearise(plant, x, (0.0, 0.0), 0.01)
    system = model.to_control()
    assert system.dt == 0.01
    assert system.A == pytest.approx(model.A)
    assert system.C @ x == pytest.approx(x[:2])
    # Two integrators of the motors, four damped poles of the stable pose.
    poles = np.abs(system.poles())
    assert np.sum(np.isclose(poles, 1.0)) == 2
    assert np.sum(poles < 0.999) == 4


def test_models_do_not_share_memory(pair, centre):
    plant = Plant(pair)
    x = state(centre)
    plant.reset(x, centre)
    first = linearise(plant, x, (0.0, 0.0), 0.01)
    kept = first.A.copy()
    y = x + [0.03, 0.01, 0, 0, 0.1, 0.1]
    linearise(plant, y, (0.0, 0.0), 0.02)
    assert (first.A == kept).all()


def test_three_rods():
    """The model of a period against the plant's own motion over it, in a hundred steps."""
    robot = load_robot(MODELS / "three_rods.toml")
    plant = Plant(robot, integrator="rk4", dt=1e-4)
    x = np.array([0.0, 0.115, 0, 0, 1.92, 4.02, -0.17])
    plant.reset(x)
    model = linearise(plant, x, np.zeros(3), 0.01)
    near = x + np.array([1e-4, -1e-4, 0.01, -0.02, 1e-4, 0.0, -1e-4])
    for start, u in ((x, np.zeros(3)), (near, np.array([0.1, -0.2, 0.05]))):
        moved = start
        for _ in range(100):
            moved = plant.step(moved, u)
        assert np.abs(moved - start).max() > 1e-4
        assert model(start, u) == pytest.approx(moved, abs=1e-6)
        assert model(start, u)[4:] == pytest.approx(start[4:] + 0.01 * u, abs=1e-12)


def test_effect_of_a_force(pair, centre):
    """E is what the constant of the model gains from an external force."""
    plant = Plant(pair)
    x = np.concatenate([centre.p, [0.1, -0.2], centre.q])
    plant.reset(x, centre)
    force = np.array([0.7, -1.3])
    without, with_force = linearise(plant, x, [0, 0], 0.01), linearise(plant, x, [0, 0], 0.01, f_ext=force)
    assert with_force.c - without.c == pytest.approx(without.E @ force, abs=1e-11)
    assert without.E[0, 0] == pytest.approx(0.5 * 0.01**2 / pair.tip_mass, rel=0.02)
