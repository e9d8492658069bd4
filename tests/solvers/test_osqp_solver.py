"""Each trap of OSQP's Python interface, and that the wrapper does not fall into it."""

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import minimize

from pcr_mpc import InfeasibleError
from pcr_mpc.control.qp.osqp_solver import QPSolver

N, M = 4, 6


@pytest.fixture
def solver():
    rng = np.random.default_rng(0)
    return QPSolver(sp.csc_matrix(rng.normal(size=(M, N))), tolerance=1e-7)


def data(seed=1):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(N, N))
    hessian = root @ root.T + np.eye(N)
    packed = np.concatenate([hessian[: j + 1, j] for j in range(N)])
    return {"P": packed, "q": rng.normal(size=N), "l": -0.3 * np.ones(M), "u": 0.2 * np.ones(M)}, hessian


def by_scipy(hessian, q, solver):
    a = solver._dense_a
    found = minimize(
        lambda x: x @ hessian @ x / 2 + q @ x,
        np.zeros(N),
        jac=lambda x: hessian @ x + q,
        method="SLSQP",
        constraints=[{"type": "ineq", "fun": lambda x: 0.2 - a @ x, "jac": lambda x: -a},
                     {"type": "ineq", "fun": lambda x: a @ x + 0.3, "jac": lambda x: a}],
        options={"ftol": 1e-14, "maxiter": 500},
    )  # fmt: skip
    return found.x


@pytest.mark.parametrize("seed", range(4))
def test_solution_against_another_solver(solver, seed):
    values, hessian = data(seed)
    solver.update(**values)
    solution = solver.solve()
    assert solution.x == pytest.approx(by_scipy(hessian, values["q"], solver), abs=1e-5)
    # KKT: stationarity, feasibility, multipliers only at active bounds and of the right sign.
    rows = solver._dense_a @ solution.x
    assert np.abs(hessian @ solution.x + values["q"] + solver._dense_a.T @ solution.y).max() == pytest.approx(
        solution.dual_residual, abs=1e-12
    )
    assert solution.dual_residual < 1e-5
    assert solution.primal_residual < 1e-5
    assert (solution.y[rows < 0.2 - 1e-4] <= 1e-6).all()
    assert (solution.y[rows > -0.3 + 1e-4] >= -1e-6).all()


def test_crossed_bounds_are_refused_and_the_old_data_stay(solver):
    values, _ = data()
    solver.update(**values)
    before = solver.solve().x
    bad = {**values, "l": values["l"].copy()}
    bad["l"][2] = 0.5
    with pytest.raises(InfeasibleError, match=r"row 2 cross: lower 0\.5 > upper 0\.2") as caught:
        solver.update(**bad)
    assert caught.value.limit == 2
    assert solver.solve().x == pytest.approx(before, abs=1e-6)


@pytest.mark.parametrize("name", ["P", "q", "l", "u"])
def test_wrong_lengths_are_refused(solver, name):
    values, _ = data()
    with pytest.raises(ValueError, match=f"{name} has shape"):
        solver.update(**{**values, name: values[name][:-1]})
    with pytest.raises(ValueError, match=f"{name} has shape"):
        solver.update(**{**values, name: np.tile(values[name], (2, 1))})


def test_strided_arrays_are_read_as_they_look(solver):
    values, _ = data()
    solver.update(**values)
    wanted = solver.solve().x
    table = np.zeros((N, 3))
    table[:, 1] = values["q"]
    solver.update(**{**values, "q": table[:, 1]})
    assert solver.solve().x == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize("name", ["P", "q", "l", "u"])
def test_a_nan_is_refused_and_poisons_nothing(solver, name):
    values, _ = data()
    solver.update(**values)
    wanted = solver.solve().x
    bad = values[name].copy()
    bad[1] = np.nan
    with pytest.raises(ValueError, match=f"{name} is not finite"):
        solver.update(**{**values, name: bad})
    solver.update(**values)
    assert solver.solve().x == pytest.approx(wanted, abs=1e-6)
    with pytest.raises(ValueError, match="x is not finite"):
        solver.warm_start(np.full(N, np.nan))


def test_infinite_bounds_are_bounds_not_errors(solver):
    values, hessian = data()
    values["l"], values["u"] = np.full(M, -np.inf), np.full(M, np.inf)
    solver.update(**values)
    assert solver.solve().x == pytest.approx(-np.linalg.solve(hessian, values["q"]), abs=1e-4)


def test_infeasible_has_no_x(solver):
    matrix = sp.csc_matrix(np.vstack([np.eye(N), np.ones((1, N))]))
    solver = QPSolver(matrix)
    values, _ = data()
    values["l"], values["u"] = np.r_[np.ones(N), -1.0], np.r_[2 * np.ones(N), 0.0]
    solver.update(**values)
    with pytest.raises(InfeasibleError, match="primal infeasible") as caught:
        solver.solve()
    assert "infeasible" in caught.value.status
    # And a good problem afterwards is solved as if nothing had happened.
    values["u"] = np.full(N + 1, 10.0)
    values["l"] = -values["u"]
    solver.update(**values)
    again = QPSolver(matrix)
    again.update(**values)
    assert solver.solve().x == pytest.approx(again.solve().x, abs=1e-5)


def test_too_few_iterations_are_not_a_solution():
    values, _ = data()
    solver = QPSolver(sp.csc_matrix(np.random.default_rng(0).normal(size=(M, N))), 1e-12, max_iterations=5)
    solver.update(**values)
    with pytest.raises(InfeasibleError, match="maximum iterations") as caught:
        solver.solve()
    assert caught.value.iterations == 5


def test_zeros_in_the_first_hessian_do_not_drop_out(solver):
    """The pattern is fixed at set-up, from an identity: off-diagonal entries must still arrive."""
    values, hessian = data()
    values["l"], values["u"] = np.full(M, -1e6), np.full(M, 1e6)
    solver.update(**values)
    assert solver.solve().x == pytest.approx(-np.linalg.solve(hessian, values["q"]), abs=1e-4)


def test_reset_is_reproducible_bit_for_bit(solver):
    def sequence():
        found = []
        for seed in range(5):
            solver.update(**data(seed)[0])
            solution = solver.solve()
            found.append((solution.x, solution.iterations))
        return found

    solver.reset()
    first = sequence()
    solver.reset()
    second = sequence()
    for (x, iterations), (y, others) in zip(first, second, strict=True):
        assert (x == y).all()
        assert iterations == others
