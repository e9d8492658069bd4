"""DAQP as the solver of the linear MPC: the same QPs as OSQP's, soft rows among them, and the same closed loop."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from pcr_mpc import (
    LinearMPC,
    ModelError,
    Reference,
    load_scene,
    load_tuning,
    make_controller,
    simulate,
)
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.control.mpc import terminal_weight
from pcr_mpc.control.qp import workspace
from pcr_mpc.control.qp.daqp_solver import DAQPSolver
from pcr_mpc.control.qp.limited import LimitedQP
from pcr_mpc.control.qp.osqp_solver import QPSolver
from pcr_mpc.control.qp.program import build_qp
from pcr_mpc.linearisation.linear_limits import LinearLimits
from pcr_mpc.linearisation.linear_model import LinearModels
from pcr_mpc.study.tuning.file import write_tuning
from tests.conftest import CONTROLLERS, MODELS

TUNING = replace(load_tuning(CONTROLLERS / "default.toml"), horizon=6, solver="daqp")
DT = 0.01


def soft_problem(size, hard, soft):
    """Rows of a QP with soft rows and their slacks."""
    ties = sp.vstack([sp.csc_matrix((hard, 2 * soft)), sp.hstack([sp.identity(soft), -sp.identity(soft)])])
    rows = sp.hstack([sp.csc_matrix(np.ones((hard + soft, size))), ties])
    slacks = sp.hstack([sp.csc_matrix((2 * soft, size)), sp.identity(2 * soft)])
    matrix = sp.csc_matrix(sp.vstack([rows, slacks]))
    matrix.sort_indices()
    return matrix


@pytest.mark.parametrize("price", [0.01, 1.0, 50.0])
def test_soft_rows_against_osqp(price):
    size, hard, soft = 5, 3, 6
    matrix = soft_problem(size, hard, soft)
    ours = DAQPSolver(matrix, 1e-8, 500, identity=True, soft=soft)
    others = QPSolver(matrix, 1e-10, 100_000, identity=True)
    rng, given, kept = np.random.default_rng(2), 0, 0
    for k in range(12):
        entries = matrix.data.copy()
        entries[: (hard + soft) * size] = rng.normal(size=(hard + soft) * size)
        middle = np.concatenate([np.zeros(hard), rng.normal(size=soft)])
        slack = np.full(soft, np.inf)
        slack[: 2 * (k % 2)] = 0.0  # two rows are hard in every other problem
        lower = np.concatenate([middle - 0.3, np.zeros(2 * soft)])
        upper = np.concatenate([middle + 0.3, slack, slack])
        if k % 4 == 0:
            prices = price * rng.uniform(0.5, 1.5, 2 * soft)
        q = np.concatenate([3 * rng.normal(size=size), prices])
        if k == 6:
            ours.reset()
        found = []
        for solver in (ours, others):
            solver.update(None, q, lower, upper, entries)
            found.append(solver.solve())
        assert found[0].x == pytest.approx(found[1].x, abs=1e-6)
        assert found[0].y == pytest.approx(found[1].y, abs=1e-5)
        assert max(found[0].primal_residual, found[0].dual_residual) < 1e-9
        given += np.count_nonzero(found[0].x[size:] > 1e-6)
        kept += np.count_nonzero(np.abs(found[0].y[hard : hard + soft]) > 1e-6)
    assert given > 5
    assert kept > 5


def test_soft_rows_need_a_cost_of_their_own():
    with pytest.raises(ValueError, match="2 soft rows, but P is not the identity"):
        DAQPSolver(soft_problem(3, 1, 2), soft=2)


def test_limits_of_poses_and_angles_against_osqp(target, model, pair):
    """The problem of `LimitedQP`: kept, softened, and from beyond a stop."""
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(3, 6))
    rows[:, 2:4] *= 0.01
    value = rows @ target
    limits = LinearLimits(("torque",) * 3, rows, value - 0.01, value + 0.01, np.ones(3))
    reference = Reference(np.tile(target, (TUNING.horizon, 1)), np.zeros((TUNING.horizon, 2)))
    kinds = limits.kinds
    ours = LimitedQP(replace(TUNING, tolerance=1e-9), 2, DT, kinds, reach=model.reach)
    others = LimitedQP(
        replace(TUNING, tolerance=1e-10, max_iterations=200_000, solver="osqp"), 2, DT, kinds, reach=model.reach
    )
    slacks = 0
    for k in range(6):
        x = target + np.array([0.02, -0.01, 0.1, 0.0, 0.03, -0.02]) * rng.normal(size=6)
        stops = target[4:] + 0.03 if k < 3 else x[4:] - 0.001  # beyond the stop
        motors = Limits(6.0, 1.0, target[4:] - 0.2, stops)
        qp = build_qp(x, model, reference, np.zeros(2), TUNING, motors, terminal_weight(model, TUNING))
        first, second = (one.solve(qp, x, LinearModels.of([model]), limits, soft_angles=True) for one in (ours, others))
        assert first.inputs == pytest.approx(second.inputs, abs=1e-4)
        assert first.active == second.active
        assert first.slack == pytest.approx(second.slack, rel=1e-4, abs=1e-6)
        slacks += len(first.slack)
    assert slacks >= 3


@pytest.mark.parametrize("name", ["lemniscate", "limited"])
def test_the_closed_loop_is_that_of_osqp(name, monkeypatch):
    """Both are near the exact solution of every QP: DAQP to rounding, OSQP to its tolerance."""
    seen = []

    class Recorded(DAQPSolver):
        def answer(self, problem, *arguments, **options):
            self.given = [np.array(each) for each in problem]  # they are overwritten
            return super().answer(problem, *arguments, **options)

        def judge(self, solution):
            super().judge(solution)
            seen.append((self._matrix, self.given, solution))

    scene = load_scene(MODELS / "scenes" / f"{name}.toml")
    scene = replace(scene, duration=0.6, trajectory=replace(scene.trajectory, ramp=0.2, period=1.5))
    tuning = scene.tuning
    loops = {}
    for kind in ("osqp", "daqp"):
        monkeypatch.setattr(workspace, "DAQPSolver", Recorded)
        tuned = scene.tuned(replace(tuning, solver=kind))
        loops[kind] = simulate(tuned, tuned.make_plant(), make_controller(tuned))
    ours, others = loops["daqp"], loops["osqp"]
    assert ours.summary()["control_rungs"]["solved"] == len(ours.u)
    assert ours.summary()["limit_violations"] == 0
    assert np.abs(ours.x[:, :2] - others.x[:, :2]).max() < 2e-5
    assert np.abs(ours.u - others.u).max() < 0.1
    assert ours.iterations.max() < 40
    if name == "lemniscate":  # no limit acts, and neither is asked
        assert not seen
        assert (ours.u == others.u).all()
        return
    tight = QPSolver(seen[0][0], 1e-9, 100_000)
    active = 0
    for _, given, solution in seen[::7]:
        tight.update(*given)
        exact = tight.solve()
        assert solution.x == pytest.approx(exact.x, abs=1e-5)
        assert max(solution.primal_residual, solution.dual_residual) < 1e-9
        active += np.count_nonzero(solution.y)
    assert active > 0


def test_the_ladder_answers_where_daqp_does_not(target, model, pair):
    limits = Limits(2.0, 0.3, *pair.angle_limits.T)
    mpc = LinearMPC(replace(TUNING, max_iterations=1), limits)
    far = target + np.array([0.05, -0.05, 0.0, 0.0, 0.0, 0.0])
    reference = Reference(np.tile(target, (TUNING.horizon, 1)), np.zeros((TUNING.horizon, 2)))
    plan = mpc.solve(far, model, reference, np.zeros(2))
    assert plan.fallback == "lqr"
    assert "maximum iterations" in plan.status
    beyond = target.copy()
    beyond[4] = pair.angle_limits[0, 1] + 0.2
    plan = LinearMPC(TUNING, Limits(6.0, 1.0, *pair.angle_limits.T)).solve(beyond, model, reference, np.zeros(2))
    assert plan.fallback == "softened"
    assert "infeasible" in plan.status
    assert plan.slack["angle"] > 0.1


def test_a_retuned_mpc_solves_with_the_new_solver(target, model, pair):
    limits = Limits(6.0, 1.0, *pair.angle_limits.T)
    reference = Reference(np.tile(target, (TUNING.horizon, 1)), np.zeros((TUNING.horizon, 2)))
    x = target + np.array([0.03, -0.02, 0.0, 0.0, 0.0, 0.0])
    mpc, new = (LinearMPC(replace(TUNING, solver=kind), limits) for kind in ("osqp", "daqp"))
    plans = [mpc.solve(x, model, reference, np.zeros(2))]
    mpc.retune(TUNING)
    plans += [one.solve(x, model, reference, np.zeros(2)) for one in (mpc, new)]
    np.testing.assert_array_equal(plans[1].inputs, plans[2].inputs)
    assert plans[1].dual_residual < 1e-10 < plans[0].dual_residual


def test_the_name_is_read_written_and_checked(tmp_path):
    path = tmp_path / "fast.toml"
    write_tuning(replace(TUNING, name="fast"), path, [])
    assert load_tuning(path).solver == "daqp"
    assert load_tuning(CONTROLLERS / "default.toml").solver == "osqp"
    path.write_text(path.read_text().replace('"daqp"', '"dapq"'))
    with pytest.raises(ModelError, match="dapq"):
        load_tuning(path)
    with pytest.raises(ValueError, match="solver is 'ipopt', expected one of osqp, daqp"):
        replace(TUNING, solver="ipopt")
