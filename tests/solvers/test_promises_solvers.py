"""What the docstrings of the solvers promise, one promise a test: on a mass on springs, where no rod takes time."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import scipy.sparse as sp

from pcr_mpc import InfeasibleError, LinearModel, Reference, build_qp, load_tuning
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.control.nonlinear.nlp_solver import Point
from pcr_mpc.control.nonlinear.nonlinear_mpc import NonlinearMPC
from pcr_mpc.control.qp.limited import LimitedQP
from pcr_mpc.control.qp.osqp_solver import QPSolver
from pcr_mpc.linearisation.linear_model import LinearModels
from tests.conftest import CONTROLLERS

DT, N = 0.01, 3
MASS, K, G = 0.5, np.diag([80.0, 120.0]), np.array([[10.0, -4.0], [3.0, 9.0]])
REST = np.zeros(2)


@pytest.fixture(scope="module")
def tuning():
    return replace(load_tuning(CONTROLLERS / "default.toml"), horizon=N)


@pytest.fixture(scope="module")
def model():
    """Of m p'' = -K p - G q + f, to second order in dt."""
    a, b = np.eye(6), np.zeros((6, 2))
    a[:2, 2:4] = DT * np.eye(2)
    a[2:4, :2], a[2:4, 4:] = -DT / MASS * K, -DT / MASS * G
    a[:2] += DT / 2 * (a[2:4] - np.eye(6)[2:4])
    b[4:] = DT * np.eye(2)
    e = np.vstack([DT**2 / 2 / MASS * np.eye(2), DT / MASS * np.eye(2), np.zeros((2, 2))])
    return LinearModel(a, b, np.zeros(6), e, DT, REST)


@pytest.fixture(scope="module")
def reference():
    return Reference(np.zeros((N, 6)), np.zeros((N, 2)))


def nonlinear(tuning, limits, **options):
    p, v, q, z, f = (ca.SX.sym(name, size) for name, size in (("p", 2), ("v", 2), ("q", 2), ("z", 1), ("f", 2)))
    results = [(f - K @ p - G @ q) / MASS, z - p[0], ca.SX(-1)]
    dynamics = ca.Function("mass", [p, v, q, z, f], results, ["p", "v", "q", "z", "f"], ["a", "r", "unstable"])
    return NonlinearMPC(tuning, limits, dynamics, lambda p, q: p[:, :1], **options)


def wide():
    return Limits(1e3, 1e3, np.full(2, -1e3), np.full(2, 1e3))


# Nonlinear MPC


@pytest.mark.parametrize(
    ("limits", "active"),
    [
        ({}, ()),
        ({"rate": 0.5}, ("rate",)),
        ({"rate_change": 0.5}, ("rate change",)),
        ({"angle_upper": np.full(2, 1e-3), "angle_lower": np.full(2, -1e-3)}, ("angle",)),
    ],
)
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_nonlinear_plan_names_the_limit_that_shapes_it(tuning, model, reference, limits, active, sign):
    mpc = nonlinear(tuning, replace(wide(), **limits))
    plan = mpc.solve(sign * np.array([0.02, -0.03, 0, 0, 0, 0]), model, reference, REST)
    assert plan.status == "solved"
    assert plan.active == active


def test_a_nonlinear_plan_solves_the_equations_and_agrees_with_its_model(tuning, model, reference):
    """Linear dynamics, known in closed form: the states follow by the matrix exponential."""
    from scipy.linalg import expm

    x = np.array([0.02, -0.03, 0.1, 0.2, 0.0, 0.1])
    plan = nonlinear(tuning, wide()).solve(x, model, reference, REST)
    a = np.zeros((8, 8))
    a[:2, 2:4], a[2:4, :2], a[2:4, 4:6], a[4:6, 6:] = np.eye(2), -K / MASS, -G / MASS, np.eye(2)
    state = x
    for u, after in zip(plan.inputs, plan.states[1:], strict=True):
        state = (expm(a * DT) @ np.concatenate([state, u]))[:6]
        assert after == pytest.approx(state, abs=1e-7)
    assert plan.models(x, plan.inputs[0]) == pytest.approx(plan.states[1], abs=1e-12)
    assert max(plan.primal_residual, plan.dual_residual) < 1e-6
    assert plan.iterations > 0
    assert plan.solver_time == plan.solve_time > 0


def test_a_nonlinear_fall_back_moves_only_solved_plans_on(tuning, model, reference):
    mpc = nonlinear(tuning, Limits(9.0, 0.3, np.full(2, -9.0), np.full(2, 9.0)))
    holds = [mpc.fall_back("no model", np.zeros(6), reference, np.array([1.0, 0.0])) for _ in range(2)]
    assert [plan.fallback for plan in holds] == ["hold", "hold"]
    assert holds[1].inputs == pytest.approx(np.array([[0.7, 0.0], [0.4, 0.0], [0.1, 0.0]]))
    solved = mpc.solve(np.array([0.02, -0.03, 0, 0, 0, 0]), model, reference, REST)
    shifted = mpc.fall_back("no model", np.zeros(6), reference, solved.inputs[0])
    assert (shifted.fallback, shifted.status) == ("shifted_plan", "no model")
    assert shifted.inputs[:-1] == pytest.approx(solved.inputs[1:], abs=1e-9)
    brake = np.sign(solved.inputs[-1]) * np.maximum(np.abs(solved.inputs[-1]) - 0.3, 0)
    assert shifted.inputs[-1] == pytest.approx(brake, abs=1e-9)
    mpc.reset()
    assert mpc.fall_back("no model", np.zeros(6), reference, REST).fallback == "hold"


def test_a_nonlinear_reset_forgets_the_terminal_weight(tuning, model, reference):
    heavy = replace(model, B=3 * model.B)
    used, fresh = nonlinear(tuning, wide()), nonlinear(tuning, wide())
    x = np.array([0.02, -0.03, 0, 0, 0, 0])
    used.solve(x, heavy, reference, REST)
    kept = used.solve(x, model, reference, REST)
    used.reset()
    again, first = (mpc.solve(x, model, reference, REST) for mpc in (used, fresh))
    assert (again.inputs == first.inputs).all()
    assert np.abs(kept.inputs - first.inputs).max() > 1e-3


def test_a_point_moved_on_continues_the_line_of_its_last_two_rows():
    rows = np.array([[1.0, 10.0], [2.0, 30.0], [4.0, 70.0]])
    moved = Point(rows, 2 * rows, 3 * rows).shifted()
    assert moved.unknowns.tolist() == [[2.0, 30.0], [4.0, 70.0], [6.0, 110.0]]
    assert moved.of_bounds.tolist() == [[4.0, 60.0], [8.0, 140.0], [8.0, 140.0]]
    assert moved.of_constraints.tolist() == [[6.0, 90.0], [12.0, 210.0], [12.0, 210.0]]


# OSQP


@pytest.fixture
def solver():
    return QPSolver(sp.csc_matrix(np.array([[1.0, 1.0], [1.0, -1.0]])), tolerance=1e-9)


GOOD = {"P": np.array([1.0, 0.0, 1.0]), "q": np.array([-1.0, -2.0]), "l": np.full(2, -9.0), "u": np.full(2, 9.0)}


def test_there_is_nothing_to_solve_before_an_update_or_after_a_reset(solver):
    for _ in range(2):
        with pytest.raises(ValueError, match="call update first"):
            solver.solve()
        solver.update(**GOOD)
        assert solver.solve().x == pytest.approx([1.0, 2.0], abs=1e-6)
        solver.reset()


def test_a_hessian_is_given_or_is_the_identity(solver):
    with pytest.raises(ValueError, match="P is missing"):
        solver.update(**{**GOOD, "P": None})
    identity = QPSolver(sp.csc_matrix(np.eye(2)), tolerance=1e-9, identity=True)
    with pytest.raises(ValueError, match="P is the identity of this solver"):
        identity.update(**GOOD)
    identity.update(**{**GOOD, "P": None})
    solution = identity.solve()
    assert solution.x == pytest.approx([1.0, 2.0], abs=1e-6)
    assert solution.dual_residual == pytest.approx(np.abs(solution.x + GOOD["q"] + solution.y).max())


def test_a_hessian_that_is_not_convex_is_refused_and_good_data_solved_afterwards(solver):
    solver.update(**GOOD)
    with pytest.raises(InfeasibleError, match="P has a negative eigenvalue") as caught:
        solver.update(**{**GOOD, "P": np.array([1.0, 0.0, -1.0])})
    assert (caught.value.status, caught.value.limit) == ("non convex", None)
    with pytest.raises(ValueError, match="call update first"):
        solver.solve()
    solver.update(**GOOD)
    assert solver.solve().x == pytest.approx([1.0, 2.0], abs=1e-6)


@pytest.mark.parametrize("row", [0, 1])
def test_crossed_bounds_name_their_row(solver, row):
    upper = GOOD["u"].copy()
    upper[row] = -9.5
    with pytest.raises(InfeasibleError, match=f"bounds of row {row} cross: lower -9 > upper -9.5") as caught:
        solver.update(**{**GOOD, "u": upper})
    assert (caught.value.status, caught.value.limit) == ("crossed bounds", row)


def test_iterations_allowed_for_one_solve_do_not_stay(solver):
    solver.update(**{**GOOD, "u": np.array([0.1, 9.0])})
    with pytest.raises(InfeasibleError, match="maximum iterations") as caught:
        solver.solve(most=1)
    assert caught.value.iterations == 1
    assert caught.value.run_time > 0
    assert solver.solve().x.sum() == pytest.approx(0.1, abs=1e-6)


def test_new_entries_of_the_matrix_count_for_solution_and_residuals(solver):
    solver.update(**{**GOOD, "u": np.array([1.0, 9.0])}, A=np.array([2.0, 1.0, 2.0, -1.0]))  # column by column
    solution = solver.solve()
    assert solution.x == pytest.approx([-0.25, 0.75], abs=1e-6)  # x + y <= 1/2, by the projection on it
    assert solution.y[0] == pytest.approx(0.625, abs=1e-6)
    assert solution.primal_residual < 1e-6
    with pytest.raises(ValueError, match=r"A has shape \(3,\), expected \(4,\)"):
        solver.update(**GOOD, A=np.ones(3))


# QP


def test_arguments_of_a_qp_are_checked(tuning, model, reference):
    def build(models=model, limits=None, terminal=None):
        return build_qp(np.zeros(6), models, reference, REST, tuning, limits or wide(), np.eye(6) if terminal is None
                        else terminal)  # fmt: skip

    with pytest.raises(ValueError, match="different periods"):
        build([model, replace(model, dt=0.02), model])
    with pytest.raises(ValueError, match="limits are for 3 motors, the model has 2"):
        build(limits=Limits(1.0, 1.0, np.zeros(3), np.ones(3)))
    with pytest.raises(ValueError, match=r"A, B, c of a model have shapes .*, expected those of 2 motors"):
        build(replace(model, A=np.eye(5)))
    with pytest.raises(ValueError, match=r"terminal_weight has shape \(5, 5\), expected \(6, 6\)"):
        build(terminal=np.eye(5))
    for count in (2, 4):
        with pytest.raises(ValueError, match=f"models has {count} entries, expected 1 or the horizon 3"):
            build([model] * count)


def test_a_qp_that_is_not_convex_is_refused_by_its_minor(tuning, model, reference):
    qp = build_qp(np.zeros(6), model, reference, REST, tuning, wide(), np.eye(6))
    P = qp.P.copy()
    P[2] = -1.0  # second entry of the diagonal
    with pytest.raises(InfeasibleError, match="the leading minor 2 of P is not positive") as caught:
        LimitedQP(tuning, 2, DT, reach=model.reach).solve(
            replace(qp, P=P), np.zeros(6), LinearModels.of([model]), None, soft_angles=False
        )
    assert caught.value.status == "non convex"
