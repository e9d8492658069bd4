"""Plans that no limit shapes need no solver: the optimum without limits, judged as a solver's answer is."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize

from pcr_mpc import InfeasibleError, LinearMPC, Reference, build_qp, load_tuning
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.control.mpc import terminal_weight
from pcr_mpc.control.qp.checked import CheckedQP
from pcr_mpc.control.qp.condensing import without_limits
from pcr_mpc.linearisation.linear_limits import LinearLimits
from tests.conftest import CONTROLLERS

NONE = np.zeros(2)
NEAR = np.array([2e-3, -1e-3, 0.01, 0, 0.01, 0])


@pytest.fixture
def wide(pair):
    return Limits(6.0, 3.0, *pair.angle_limits.T)


def tuned(horizon=6, **more):
    return replace(load_tuning(CONTROLLERS / "default.toml"), horizon=horizon, **more)


def at_rest(target, tuning):
    return Reference(np.tile(target, (tuning.horizon, 1)), np.zeros((tuning.horizon, 2)))


def problem(tuning, target, model, limits):
    """Dense P and q of the QP a little beside the target."""
    qp = build_qp(target + NEAR, model, at_rest(target, tuning), NONE, tuning, limits, terminal_weight(model, tuning))
    size = len(qp.q)
    upper = np.zeros((size, size))
    column = np.concatenate([np.full(j + 1, j) for j in range(size)])
    row = np.concatenate([np.arange(j + 1) for j in range(size)])
    upper[row, column] = qp.P
    return upper + np.triu(upper, 1).T, qp.q, qp


@pytest.mark.parametrize("solver", ["osqp", "daqp"])
@pytest.mark.parametrize("horizon", [1, 6, 14])  # the last one is not unrolled
def test_the_optimum_is_that_of_other_methods_and_no_solver_is_asked(horizon, solver, target, model, wide, monkeypatch):
    tuning = tuned(horizon, solver=solver, max_iterations=4000)
    hessian, q, _ = problem(tuning, target, model, wide)
    mpc, x = LinearMPC(tuning, wide), target + NEAR
    with monkeypatch.context() as shut:
        shut.setattr(CheckedQP, "answer", None)
        plan = mpc.solve(x, model, at_rest(target, tuning), NONE)
    exact = np.linalg.solve(hessian, -q).reshape(-1, 2)
    assert plan.inputs == pytest.approx(exact, abs=1e-10 * np.abs(exact).max())
    assert (plan.status, plan.fallback, plan.active, plan.slack) == ("solved", None, (), {})
    assert (plan.iterations, plan.primal_residual) == (1, 0.0)
    assert plan.dual_residual == pytest.approx(np.abs(hessian @ plan.inputs.ravel() + q).max(), abs=1e-9)
    # The solver, which is asked where this path is shut, is as near as it says.
    monkeypatch.setattr("pcr_mpc.control.qp.workspace.Workspace._without_limits", lambda *_: None)
    asked = LinearMPC(tuning, wide).solve(x, model, at_rest(target, tuning), NONE)
    assert asked.inputs == pytest.approx(plan.inputs, abs=1e-3 if solver == "osqp" else 1e-8)


@pytest.mark.parametrize("solver", ["osqp", "daqp"])
def test_an_active_limit_makes_the_solver_answer(solver, target, model, wide, monkeypatch):
    tuning = tuned(solver=solver, tolerance=1e-8, max_iterations=20_000)
    mpc, x, reference = LinearMPC(tuning, wide), target + NEAR, at_rest(target, tuning)
    calls = []
    answer = CheckedQP.answer
    monkeypatch.setattr(CheckedQP, "answer", lambda *a, **more: calls.append(more) or answer(*a, **more))
    free = mpc.solve(x, model, reference, NONE).inputs
    assert not calls
    largest = float(np.abs(free).max())
    mpc.limits = Limits(0.6 * largest, 10.0 * largest, wide.angle_lower, wide.angle_upper)
    plan = mpc.solve(x, model, reference, NONE)
    assert len(calls) == 1
    assert plan.active == ("rate",)
    hessian, q, _ = problem(tuning, target, model, wide)
    best = minimize(
        lambda u: 0.5 * u @ hessian @ u + q @ u, np.zeros(len(q)), jac=lambda u: hessian @ u + q, method="L-BFGS-B",
        bounds=[(-0.6 * largest, 0.6 * largest)] * len(q), options={"ftol": 1e-16, "gtol": 1e-12, "maxiter": 5000},
    ).x  # fmt: skip
    assert plan.inputs.ravel() == pytest.approx(best, abs=2e-4 * largest)


@pytest.mark.parametrize("solver", ["osqp", "daqp"])
def test_after_a_plan_without_limits_the_solver_starts_from_multipliers_that_are_zero(
    solver, target, model, wide, monkeypatch
):
    tuning = tuned(solver=solver, max_iterations=4000)
    reference, limits, started = at_rest(target, tuning), [], []
    largest = float(np.abs(LinearMPC(tuning, wide).solve(target + NEAR, model, reference, NONE).inputs).max())
    mpc = LinearMPC(tuning, Limits(0.6 * largest, 10.0 * largest, wide.angle_lower, wide.angle_upper))
    of_solver = CheckedQP.__subclasses__()[solver == "osqp"]
    assert of_solver.__name__ == {"osqp": "QPSolver", "daqp": "DAQPSolver"}[solver]
    start = of_solver._start_from
    monkeypatch.setattr(of_solver, "_start_from", lambda self, x, y: started.append(y) or start(self, x, y))
    for distance in (1.0, 1.0, 0.1, 1.0):
        limits.append(mpc.solve(target + distance * NEAR, model, reference, NONE).active)
    assert limits == [("rate",), ("rate",), (), ("rate",)]
    assert [y is not None and not y.any() for y in started] == [False, True]


def test_a_limit_of_poses_or_of_angles_that_is_touched_makes_the_solver_answer(target, model, wide):
    tuning = tuned(max_iterations=4000)
    x, reference = target + NEAR, at_rest(target, tuning)
    free = LinearMPC(tuning, wide).solve(x, model, reference, NONE)
    highest = float(free.states[1:, 0].max())

    def below(value):
        return LinearLimits(("tip region",), np.eye(1, 6), np.array([-np.inf]), np.array([value]), np.array([1.0]))

    kept = LinearMPC(tuning, wide).solve(x, model, reference, NONE, below(highest + 1e-9))
    assert (kept.inputs == free.inputs).all()
    met = LinearMPC(tuning, wide).solve(x, model, reference, NONE, below(highest - 1e-4))
    assert "tip region" in met.active
    assert met.iterations > 1
    turned = free.states[1:, 4:].max(axis=0)
    stop = Limits(6.0, 3.0, wide.angle_lower, turned - 1e-4)
    assert "angle" in LinearMPC(tuning, stop).solve(x, model, reference, NONE).active


def test_what_is_not_convex_or_not_finite_has_no_optimum():
    triangle, q = ca.MX.sym("P", 6), ca.MX.sym("q", 3)
    graph = ca.Function("f", [triangle, q], [without_limits(triangle, q, unrolled=True)])
    assert np.isfinite(graph([2, 0, 2, 0, 1, 2], [1, 2, 3]).full()).all()
    for indefinite in ([-2, 0, 2, 0, 1, 2], [2, 3, 2, 0, 0, 2], [2, 0, 2, 0, 3, 2], [2, 0, 2, 0, 0, -1]):
        assert np.isnan(graph(indefinite, [1, 2, 3]).full()[0])
    for bad in (np.nan, np.inf):
        assert not np.isfinite(graph([2, 0, 2, 0, 1, 2], [1, 2, bad]).full()).all()


@pytest.mark.parametrize("factor", [1e200, np.nan, np.inf])
def test_hostile_models_are_refused_as_before(factor, target, model, wide):
    tuning = tuned(fallback="raise")
    mpc = LinearMPC(tuning, wide)
    mpc.prepare(model)
    broken = replace(model, B=np.full_like(model.B, factor))
    with pytest.raises((InfeasibleError, ValueError)):
        mpc.solve(target + NEAR, broken, at_rest(target, tuning), NONE)
