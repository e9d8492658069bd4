"""Each trap of DAQP's Python interface, and that the wrapper does not fall into it; and that it agrees with others."""

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import minimize

from pcr_mpc import InfeasibleError
from pcr_mpc.control.qp.daqp_solver import DAQPSolver
from pcr_mpc.control.qp.osqp_solver import QPSolver

from .qp_check import by_enumeration, packed

N, M = 3, 5
A = np.random.default_rng(0).normal(size=(M, N))


@pytest.fixture
def solver():
    return DAQPSolver(sp.csc_matrix(A), tolerance=1e-7)


def data(seed=1, size=0.3):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(N, N))
    hessian = root @ root.T + 0.1 * np.eye(N)
    bounds = {"l": -size * np.ones(M), "u": 0.7 * size * np.ones(M)}
    return {"P": packed(hessian), "q": rng.normal(size=N), **bounds}, hessian


@pytest.mark.parametrize("size", [0.05, 0.3, 100.0])
def test_solution_and_multipliers_against_every_active_set(solver, size):
    active = 0
    for seed in range(8):  # one after the other: every P is new, and the active set of the last one is the start
        values, hessian = data(seed, size)
        solver.update(**values)
        solution = solver.solve()
        x, y = by_enumeration(hessian, values["q"], A, values["l"], values["u"])
        assert solution.x == pytest.approx(x, abs=1e-9)
        assert solution.y == pytest.approx(y, abs=1e-8)
        assert max(solution.primal_residual, solution.dual_residual) < 1e-9
        active += np.count_nonzero(y)
    assert active == 0 if size == 100.0 else active >= 8


def test_bounds_on_x_itself_become_rows_where_they_no_longer_are(solver):
    """The first rows are DAQP's own bounds while they are the identity."""
    rows = np.vstack([np.eye(N), A[:2]])
    pattern = sp.csc_matrix(np.ones((M, N)))
    pattern.data[:] = rows.T.ravel()  # zeros stored
    solver = DAQPSolver(pattern, tolerance=1e-7)
    assert solver._bounds == N
    for matrix in (rows, A, rows):
        values, hessian = data(2)
        solver.update(**values, A=matrix.T.ravel())
        x, y = by_enumeration(hessian, values["q"], matrix, values["l"], values["u"])
        assert solver.solve().x == pytest.approx(x, abs=1e-9)
        assert solver.solve().y == pytest.approx(y, abs=1e-8)


def test_equalities(solver):
    values, hessian = data(3)
    values["l"][1] = values["u"][1] = 0.15
    values["l"][3] = values["u"][3] = -0.1
    solver.update(**values)
    x, y = by_enumeration(hessian, values["q"], A, values["l"], values["u"])
    solution = solver.solve()
    assert solution.x == pytest.approx(x, abs=1e-9)
    assert solution.y == pytest.approx(y, abs=1e-8)
    values["l"][1] = -0.3  # and an inequality again
    solver.update(**values)
    assert solver.solve().x == pytest.approx(by_enumeration(hessian, *[values["q"], A, values["l"], values["u"]])[0])


def test_parallel_rows(solver):
    rows = np.vstack([A[0], A[0], -2 * A[0], A[1], A[1] + 1e-9])
    solver = DAQPSolver(sp.csc_matrix(rows), tolerance=1e-7)
    for seed in range(6):
        values, hessian = data(seed, 0.05)
        solver.update(**values)
        solution = solver.solve()
        found = minimize(
            lambda x, h=hessian, q=values["q"]: x @ h @ x / 2 + q @ x, np.zeros(N), method="SLSQP",
            constraints=[{"type": "ineq", "fun": lambda x, v=values: np.r_[v["u"] - rows @ x, rows @ x - v["l"]]}],
            options={"ftol": 1e-14, "maxiter": 500},
        )  # fmt: skip
        assert solution.x == pytest.approx(found.x, abs=2e-6)
        assert max(solution.primal_residual, solution.dual_residual) < 1e-8


def test_crossed_bounds_are_refused_and_the_old_data_stay(solver):
    values, _ = data()
    solver.update(**values)
    before = solver.solve()
    bad = {**values, "l": values["l"].copy()}
    bad["l"][2] = 0.5
    with pytest.raises(InfeasibleError, match=r"row 2 cross: lower 0\.5 > upper 0\.21") as caught:
        solver.update(**bad)
    assert (caught.value.limit, caught.value.status) == (2, "crossed bounds")
    np.testing.assert_array_equal(solver.solve().x, before.x)


@pytest.mark.parametrize("name", ["P", "q", "l", "u"])
def test_wrong_shapes_and_nan_are_refused_and_poison_nothing(solver, name):
    """DAQP itself passes over an array of the wrong shape, and solves the old problem."""
    values, _ = data()
    solver.update(**values)
    wanted = solver.solve().x
    for wrong in (values[name][:-1], np.tile(values[name], (2, 1))):
        with pytest.raises(ValueError, match=f"{name} has shape"):
            solver.update(**{**values, name: wrong})
    bad = values[name].copy()
    bad[1] = np.nan
    with pytest.raises(ValueError, match=f"{name} is not finite"):
        solver.update(**{**values, name: bad})
    np.testing.assert_array_equal(solver.solve().x, wanted)
    with pytest.raises(ValueError, match="x is not finite"):
        solver.warm_start(np.full(N, np.nan))
    with pytest.raises(ValueError, match="A has shape"):
        solver.update(**values, A=np.ones(3))
    np.testing.assert_array_equal(solver.solve().x, wanted)


@pytest.mark.parametrize("kind", [QPSolver, DAQPSolver])
def test_arrays_are_read_as_they_look_and_once(kind):
    """DAQP keeps pointers: what a caller does to its arrays after `update` must change neither x nor the residuals."""
    solver = kind(sp.csc_matrix(A), tolerance=1e-9)
    values, _ = data()
    solver.update(**values)
    wanted = solver.solve()
    table = np.zeros((N, 3))
    table[:, 1] = values["q"]
    entries = np.array(A.T.ravel())
    given = {**{name: array.copy() for name, array in values.items()}, "q": table[:, 1], "A": entries}
    solver.reset()
    solver.update(**given)
    for array in given.values():
        array[:] = 7.0
    solution = solver.solve()
    assert solution.x == pytest.approx(wanted.x, abs=1e-8)
    assert max(solution.primal_residual, solution.dual_residual) < 1e-7


@pytest.mark.parametrize("kind", [QPSolver, DAQPSolver])
def test_a_reset_takes_the_first_rows_again(kind):
    solver = kind(sp.csc_matrix(A), tolerance=1e-9)
    values, hessian = data(size=0.05)
    solver.update(**values, A=2 * A.T.ravel())
    solver.reset()
    with pytest.raises(ValueError, match="no QP to solve"):
        solver.solve()
    solver.update(**values)
    solution = solver.solve()
    assert solution.x == pytest.approx(by_enumeration(hessian, values["q"], A, values["l"], values["u"])[0], abs=1e-7)
    assert solution.primal_residual < 1e-7


def test_infinite_bounds_are_bounds_not_errors(solver):
    values, hessian = data()
    values["l"], values["u"] = np.full(M, -np.inf), np.full(M, np.inf)
    solver.update(**values)
    assert solver.solve().x == pytest.approx(-np.linalg.solve(hessian, values["q"]), abs=1e-9)
    values["u"][4] = -1.0
    solver.update(**values)
    assert A[4] @ solver.solve().x <= -1 + 1e-9


def test_infeasible_names_the_row_and_spoils_nothing():
    rows = np.vstack([np.eye(N), np.ones((1, N)), [[1.0, -1.0, 0.0]]])
    solver = DAQPSolver(sp.csc_matrix(rows))
    values, hessian = data()
    values["l"], values["u"] = np.r_[np.ones(N), -9.0, -9.0], np.r_[2 * np.ones(N), 0.0, 9.0]
    solver.update(**values)
    with pytest.raises(InfeasibleError, match="primal infeasible after") as caught:
        solver.solve()
    assert caught.value.limit == 3
    assert caught.value.details["run_time"] > 0
    # Equalities that contradict each other are found before DAQP begins.
    values["l"], values["u"] = np.r_[1.0, 1.0, -9, -9.0, 0.5], np.r_[1.0, 1.0, 9, 9.0, 0.5]
    solver.update(**values)
    for _ in range(2):
        with pytest.raises(InfeasibleError, match="primal infeasible") as caught:
            solver.solve()
        assert caught.value.limit in (0, 1, 4)
        solver.warm_start(np.zeros(N), np.ones(M))
    values["u"] = np.full(M, 0.2)
    values["l"] = -values["u"]
    solver.update(**values)
    wanted = by_enumeration(hessian, values["q"], rows, values["l"], values["u"])[0]
    assert solver.solve().x == pytest.approx(wanted, abs=1e-9)


def test_a_hessian_that_is_not_convex_is_not_shifted_until_it_is(solver):
    """DAQP's default shifts it, and answers another problem, or an unbounded one."""
    values, hessian = data()
    solver.update(**values)
    wanted = solver.solve().x
    for bad in (hessian - 1.1 * np.linalg.eigvalsh(hessian)[0] * np.eye(N), np.zeros((N, N)), np.ones((N, N))):
        with pytest.raises(InfeasibleError, match="P is not positive definite") as caught:
            solver.update(**{**values, "P": packed(bad)})
        assert caught.value.status == "non convex"
        with pytest.raises(ValueError, match="no QP to solve"):
            solver.solve()
    solver.update(**values)
    np.testing.assert_array_equal(solver.solve().x, wanted)


def test_iterations_are_capped_and_counted():
    n = 12
    solver = DAQPSolver(sp.identity(n, format="csc"), max_iterations=50)
    values = {"P": packed(np.eye(n)), "q": -np.ones(n), "l": np.zeros(n), "u": np.full(n, 0.5)}
    solver.update(**values)
    for most in (1, 5):
        with pytest.raises(InfeasibleError, match="maximum iterations") as caught:
            solver.solve(most)
        assert caught.value.iterations == most
    solution = solver.solve()
    assert solution.iterations > 5
    assert solution.x == pytest.approx(np.full(n, 0.5))
    solver.update(**values)
    assert solver.solve().iterations <= 2  # from the active set of the last one
    solver.update(**values)
    solver.warm_start(np.zeros(n), np.zeros(n))
    assert solver.solve().iterations == solution.iterations  # from none
    for most in (solution.iterations - 1, solution.iterations):
        solver.reset()
        solver.update(**values)
        if most < solution.iterations:
            with pytest.raises(InfeasibleError, match="maximum iterations"):
                solver.solve(most)
    assert solver.solve(most).iterations == most
    for side in (1, -1):
        solver.reset()
        solver.update(**{**values, "q": -side * np.ones(n), "l": np.full(n, -0.5)})
        solver.warm_start(np.zeros(n), side * np.ones(n))
        assert solver.solve().iterations <= 2


def test_each_way_to_fail_has_its_name():
    for flag, status in ((-2, "cycling"), (-4, "maximum iterations"), (4, "solved inaccurate"), (-7, "DAQP's exit -7")):
        qp = DAQPSolver(sp.identity(2, format="csc"), 1e-8, 100)
        qp.update(np.array([1.0, 0.0, 1.0]), np.ones(2), -np.ones(2), np.ones(2))

        class Failing:
            def solve(self, flag=flag):
                return np.zeros(2), 0.0, flag, {"iterations": 3, "lam": np.zeros(2)}

            def update(self, **_):
                return 0

        qp._model = Failing()
        with pytest.raises(InfeasibleError, match=status) as caught:
            qp.solve()
        assert (caught.value.iterations, caught.value.limit) == (3, None)


def test_small_violations_count():
    """DAQP leaves rows out that are violated by less than 1e-6, whatever tolerance is asked for."""
    solver = DAQPSolver(sp.identity(2, format="csc"), tolerance=1e-7)
    solver.update(packed(np.eye(2)), np.array([-1.0 - 5e-7, 0.0]), -np.ones(2), np.ones(2))
    solution = solver.solve()
    assert solution.x == pytest.approx([1.0, 0.0], abs=1e-12)
    assert solution.y == pytest.approx([5e-7, 0.0], rel=1e-6)


def test_run_time_counts_updates_starts_and_solves(solver, monkeypatch):
    """By a clock that ticks with every look at it."""
    ticks = iter(range(100))
    monkeypatch.setattr("pcr_mpc.control.qp.daqp_solver.time.perf_counter", lambda: float(next(ticks)))
    solver.update(**data()[0])
    solver.warm_start(np.zeros(N), np.zeros(M))
    assert solver.solve().run_time == 3.0


class Careless:
    """DAQP with an error in x or in the multipliers."""

    def __init__(self, model, wrong_x, wrong_y):
        self._model, self._wrong = model, (wrong_x, wrong_y)

    def __getattr__(self, name):
        return getattr(self._model, name)

    def solve(self):
        x, value, flag, info = self._model.solve()
        return x + self._wrong[0], value, flag, {**info, "lam": info["lam"] + self._wrong[1]}


@pytest.mark.parametrize("size", [1.0, 1e4])
@pytest.mark.parametrize("wrong", ["x", "y"])
def test_a_solution_that_misses_the_tolerance_is_refused(wrong, size):
    """What the tolerance is relative to grows with the problem, as OSQP's does."""
    for off, accepted in ((0.5, True), (4.0, False)):
        solver = DAQPSolver(sp.identity(N, format="csc"), tolerance=1e-6)
        flat = 1e-3 if wrong == "x" else 1.0  # so flat that an error in x is none of the gradient
        solver.update(flat * packed(np.eye(N)), -2 * flat * size * np.ones(N), -size * np.ones(N), size * np.ones(N))
        error = off * 1e-6 * size
        solver._model = Careless(solver._model, error * (wrong == "x"), error * (wrong == "y"))
        if accepted:
            assert solver.solve().y == pytest.approx(flat * size * np.ones(N))
            continue
        with pytest.raises(InfeasibleError, match="solved inaccurate, residuals"):
            solver.solve()


def test_reset_is_reproducible_bit_for_bit(solver):
    def sequence():
        found = []
        for seed in range(6):
            solver.update(**data(seed)[0])
            solution = solver.solve()
            found.append((*solution.x, *solution.y, solution.iterations))
        return found

    first = sequence()
    solver.reset()
    assert sequence() == first


@pytest.mark.parametrize("kind", [DAQPSolver, QPSolver])
def test_a_reset_of_what_was_not_used_costs_nothing(kind, monkeypatch):
    """A controller has a solver for each combination of limits, and forgets all of them where a problem jumps."""
    solver, made = kind(sp.csc_matrix(A), tolerance=1e-7), []
    set_up = kind._set_up
    monkeypatch.setattr(kind, "_set_up", lambda self: [made.append(self), set_up(self)])
    solver.reset()
    assert not made
    uses = [
        lambda: solver.update(**data()[0]),
        lambda: solver.warm_start(np.zeros(N), np.ones(M)),
        lambda: solver.answer(tuple(data()[0].values()), None, np.empty(N), np.empty(M), sound=True),
    ]
    for count, use in enumerate(uses, 1):
        use()
        solver.reset()
        solver.reset()
        assert len(made) == count
