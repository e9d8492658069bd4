from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from pcr_mpc import InfeasibleError, LinearMPC, Reference, load_tuning
from pcr_mpc.control.motor_limits import Limits
from tests.conftest import CONTROLLERS


@pytest.fixture(scope="module")
def tuning():
    # Steps of centimetres under narrow limits take OSQP longer than the default allows.
    return replace(load_tuning(CONTROLLERS / "default.toml"), max_iterations=4000)


@pytest.fixture
def reference(tuning, target):
    return Reference(np.tile(target, (tuning.horizon, 1)), np.zeros((tuning.horizon, 2)))


def far(target):
    return target + np.array([0.02, -0.03, 0, 0, 0, 0])


def test_limits_hold_exactly(tuning, target, model, reference, pair):
    limits = Limits(1.5, 0.7, *pair.angle_limits.T)
    mpc = LinearMPC(tuning, limits)
    x, u = far(target), np.zeros(2)
    for _ in range(150):
        plan = mpc.solve(x, model, reference, u)
        assert plan.status == "solved"
        assert np.abs(plan.inputs[0]).max() <= 1.5
        assert np.abs(plan.inputs[0] - u).max() <= 0.7 + 1e-12
        assert plan.primal_residual < 1e-3
        assert np.isfinite([plan.dual_residual, plan.update_time, plan.solve_time]).all()
        u = plan.inputs[0]
        x = model(x, u)
    assert np.abs(x[:2] - target[:2]).max() < 1e-3


def test_angle_limits_hold_in_the_plan(tuning, target, model, reference):
    limits = Limits(6.0, 6.0, target[4:] - 0.02, target[4:] + 0.02)
    mpc = LinearMPC(tuning, limits)
    plan = mpc.solve(far(target), model, reference, np.zeros(2))
    angles = plan.states[1:, 4:]
    assert np.abs(angles - target[4:]).max() <= 0.02 + 1e-4
    free = LinearMPC(tuning, Limits(6.0, 6.0, target[4:] - 9, target[4:] + 9))
    assert np.abs(free.solve(far(target), model, reference, np.zeros(2)).states[1:, 4:] - target[4:]).max() > 0.03


def test_leaving_rows_out_first_changes_nothing(tuning, target, model, reference, pair):
    """The plan under active limits on the change of rate equals that of the whole QP."""
    from pcr_mpc import build_qp
    from pcr_mpc.control.mpc import terminal_weight
    from pcr_mpc.control.qp.osqp_solver import QPSolver

    tuning = replace(tuning, tolerance=1e-9)
    limits = Limits(3.0, 0.5, *pair.angle_limits.T)
    plan = LinearMPC(tuning, limits).solve(far(target), model, reference, np.zeros(2))
    qp = build_qp(far(target), model, reference, np.zeros(2), tuning, limits, terminal_weight(model, tuning))
    solver = QPSolver(qp.A, 1e-9)
    solver.update(qp.P, qp.q, qp.l, qp.u)
    assert plan.inputs.ravel() == pytest.approx(solver.solve().x, abs=1e-5)


def test_an_infeasible_problem_raises_if_asked_to(tuning, target, model, reference):
    limits = Limits(1.0, 6.0, target[4:] + 0.5, target[4:] + 1.0)  # the motors cannot get there in one horizon
    with pytest.raises(InfeasibleError, match="not solved") as caught:
        LinearMPC(replace(tuning, fallback="raise"), limits).solve(target, model, reference, np.zeros(2))
    assert caught.value.limit >= 4 * tuning.horizon  # a row of the angles


def test_a_tight_angle_limit_is_solved_not_fallen_back_from(tuning, target, model, reference):
    mpc = LinearMPC(tuning, Limits(6.0, 3.0, target[4:] - 0.01, target[4:] + 0.01))
    x, u = far(target), np.zeros(2)
    for _ in range(40):
        plan = mpc.solve(x, model, reference, u)
        assert plan.fallback is None
        u = plan.inputs[0]
        x = model(x, u)
        assert np.abs(x[4:] - target[4:]).max() < 0.01 + 1e-5


@pytest.mark.parametrize("horizon", [1, 2, 60])
def test_any_horizon(tuning, target, model, pair, horizon):
    """Where no limit is met, the cost-to-go at its end makes the plan of every horizon that of the LQR."""
    tuning = replace(tuning, horizon=horizon, tolerance=1e-9, angle_weight=1.0)
    reference = Reference(np.tile(target, (horizon, 1)), np.zeros((horizon, 2)))
    mpc = LinearMPC(tuning, Limits(6.0, 6.0, *pair.angle_limits.T))
    x = target + 1e-2 * (far(target) - target)
    weights = np.diag([tuning.position_weight] * 2 + [tuning.velocity_weight] * 2 + [1.0] * 2)
    a, b = np.array(model.A), np.array(model.B)
    cost = solve_discrete_are(a, b, weights, tuning.input_weight * np.eye(2))
    gain = np.linalg.solve(b.T @ cost @ b + tuning.input_weight * np.eye(2), b.T @ cost @ a)
    wanted, off = [], x - target
    for _ in range(horizon):
        wanted.append(-gain @ off)
        off = a @ off + b @ wanted[-1]
    plan = mpc.solve(x, model, reference, np.zeros(2))
    assert plan.status == "solved"
    assert plan.active == ()
    assert plan.inputs == pytest.approx(np.array(wanted), abs=1e-4 * np.abs(wanted).max())
    assert np.abs(wanted).max() > 1e-3


def test_another_period_is_refused(tuning, target, model, reference, pair):
    mpc = LinearMPC(tuning, Limits(6.0, 3.0, *pair.angle_limits.T))
    mpc.solve(target, model, reference, np.zeros(2))
    with pytest.raises(ValueError, match=r"built for 2 and 0\.01 s"):
        mpc.solve(target, replace(model, dt=0.02), reference, np.zeros(2))


def test_reset_repeats_bit_for_bit(tuning, target, model, reference, pair):
    mpc = LinearMPC(tuning, Limits(2.0, 1.0, *pair.angle_limits.T))

    def run():
        x, u, found = far(target), np.zeros(2), []
        for _ in range(10):
            plan = mpc.solve(x, model, reference, u)
            u = plan.inputs[0]
            x = model(x, u)
            found.append(plan.inputs)
        return np.array(found)

    first = run()
    mpc.reset()
    assert (run() == first).all()
