import control
import numpy as np
import pytest

from pcr_mpc import LinearModel, Plant, Reference, build_qp, linearise, load_tuning
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.control.mpc import LinearMPC, terminal_weight
from tests.conftest import CONTROLLERS

DT = 0.01


@pytest.fixture(scope="module")
def model(pair, centre):
    plant = Plant(pair)
    x = np.concatenate([centre.p, [0.1, -0.2], centre.q])
    plant.reset(x, centre)
    return linearise(plant, x, (0.0, 0.0), DT)


@pytest.fixture(scope="module")
def tuning():
    from dataclasses import replace

    return replace(load_tuning(CONTROLLERS / "default.toml"), horizon=7, velocity_weight=3.0, angle_weight=0.2)


@pytest.fixture(scope="module")
def limits(pair):
    return Limits(6.0, 3.0, *pair.angle_limits.T)


def problem(model, centre, horizon, seed=0):
    rng = np.random.default_rng(seed)
    x = np.concatenate([centre.p, [0.1, -0.2], centre.q]) + 1e-2 * rng.normal(size=6)
    states = x + 1e-2 * rng.normal(size=(horizon, 6))
    return x, Reference(states, rng.normal(size=(horizon, 2))), rng.normal(size=2)


def cost(models, x, inputs, reference, tuning, terminal):
    """The cost, written out by simulation."""
    stage = np.diag([tuning.position_weight] * 2 + [tuning.velocity_weight] * 2 + [tuning.angle_weight] * 2)
    total = 0.0
    for k, (model, u) in enumerate(zip(models, inputs, strict=True)):
        total += tuning.input_weight * np.sum((u - reference.inputs[k]) ** 2) / 2
        x = model(x, u)
        error = x - reference.states[k]
        total += error @ (terminal if k == len(models) - 1 else stage) @ error / 2
    return total


def full(packed, n):
    matrix = np.zeros((n, n))
    rows = np.concatenate([np.arange(j + 1) for j in range(n)])
    columns = np.repeat(np.arange(n), np.arange(1, n + 1))
    matrix[rows, columns] = packed
    return matrix + np.triu(matrix, 1).T


@pytest.mark.parametrize("varying", [False, True])
def test_cost_is_that_of_a_simulation(model, centre, tuning, limits, varying):
    x, reference, previous = problem(model, centre, tuning.horizon)
    terminal = terminal_weight(model, tuning)
    models = [model] * tuning.horizon
    if varying:
        rng = np.random.default_rng(5)
        models = []
        for _ in range(tuning.horizon):
            a, b = model.A.copy(), model.B.copy()
            a[:4] += 1e-2 * rng.normal(size=(4, 6))
            b[:4] += 1e-3 * rng.normal(size=(4, 2))
            models.append(LinearModel(a, b, model.c * np.r_[rng.normal(size=4), 1, 1], model.E, DT, np.zeros(2)))
    qp = build_qp(x, models if varying else model, reference, previous, tuning, limits, terminal)
    n = 2 * tuning.horizon
    hessian = full(qp.P, n)
    assert np.linalg.eigvalsh(hessian).min() > 0
    base = cost(models, x, np.zeros((tuning.horizon, 2)), reference, tuning, terminal)
    rng = np.random.default_rng(1)
    for _ in range(5):
        inputs = rng.normal(size=(tuning.horizon, 2))
        u = inputs.ravel()
        expected = cost(models, x, inputs, reference, tuning, terminal) - base
        assert u @ hessian @ u / 2 + qp.q @ u == pytest.approx(expected, rel=1e-7, abs=1e-7)


def test_one_model_or_the_same_model_many_times(model, centre, tuning, limits):
    x, reference, previous = problem(model, centre, tuning.horizon)
    terminal = terminal_weight(model, tuning)
    one = build_qp(x, model, reference, previous, tuning, limits, terminal)
    many = build_qp(x, [model] * tuning.horizon, reference, previous, tuning, limits, terminal)
    assert one.P == pytest.approx(many.P, rel=1e-9, abs=1e-9)
    assert one.q == pytest.approx(many.q, rel=1e-9, abs=1e-9)


def test_constraints_are_rates_changes_and_angles(model, centre, tuning, limits):
    x, reference, previous = problem(model, centre, tuning.horizon)
    qp = build_qp(x, model, reference, previous, tuning, limits, np.eye(6))
    rng = np.random.default_rng(2)
    inputs = rng.normal(size=(tuning.horizon, 2))
    rows = (qp.A @ inputs.ravel()).reshape(3, tuning.horizon, 2)
    lower, upper = qp.l.reshape(3, tuning.horizon, 2), qp.u.reshape(3, tuning.horizon, 2)
    assert rows[0] == pytest.approx(inputs)
    assert (upper[0], lower[0]) == (pytest.approx(np.full((7, 2), 6.0)), pytest.approx(np.full((7, 2), -6.0)))
    changes = np.diff(inputs, axis=0, prepend=previous[None])
    assert rows[1] - upper[1] == pytest.approx(changes - 3.0)
    assert rows[1] - lower[1] == pytest.approx(changes + 3.0)
    state, angles = x, []
    for u in inputs:
        state = model(state, u)
        angles.append(state[4:])
    assert DT * (rows[2] - upper[2]) == pytest.approx(np.array(angles) - limits.angle_upper)
    assert DT * (rows[2] - lower[2]) == pytest.approx(np.array(angles) - limits.angle_lower)


def test_without_active_limits_the_mpc_is_the_lqr(model, centre, tuning, pair):
    """Riccati terminal weight, reference in balance: the first input is -K (x - xr), for any horizon."""
    from dataclasses import replace

    tuning = replace(tuning, tolerance=1e-9)
    target = np.concatenate([centre.p, [0, 0], centre.q])
    balanced = LinearModel(model.A, model.B, target - model.A @ target, model.E, DT, np.zeros(2))
    stage = np.diag([tuning.position_weight] * 2 + [tuning.velocity_weight] * 2 + [tuning.angle_weight] * 2)
    gain, _, _ = control.dlqr(model.A, model.B, stage, tuning.input_weight * np.eye(2))
    x = target + np.array([1e-4, -2e-4, 1e-3, 0.0, 1e-3, -1e-3])
    for horizon in (3, 10):
        mpc = LinearMPC(replace(tuning, horizon=horizon), Limits(1e3, 1e3, *pair.angle_limits.T))
        reference = Reference(np.tile(target, (horizon, 1)), np.zeros((horizon, 2)))
        plan = mpc.solve(x, balanced, reference, np.zeros(2))
        # terminal_weight adds a trifle of weight on angles where the tuning has none; here it has some.
        assert plan.inputs[0] == pytest.approx(-gain @ (x - target), rel=1e-4)
        assert plan.states[-1] == pytest.approx(balanced(plan.states[-2], plan.inputs[-1]))


def test_wrong_shapes_are_named(model, centre, tuning, limits):
    x, reference, previous = problem(model, centre, tuning.horizon)
    with pytest.raises(ValueError, match=r"x has shape \(5,\), expected \(6,\)"):
        build_qp(x[:5], model, reference, previous, tuning, limits, np.eye(6))
    with pytest.raises(ValueError, match=r"reference.states has shape \(6, 6\), expected \(7, 6\)"):
        build_qp(x, model, Reference(reference.states[1:], reference.inputs), previous, tuning, limits, np.eye(6))
    with pytest.raises(ValueError, match="models has 3 entries, expected 1 or the horizon 7"):
        build_qp(x, [model] * 3, reference, previous, tuning, limits, np.eye(6))
