"""What the docstrings of the linear MPC promise of its ladder, its resets and its reports, one promise a test."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import InfeasibleError, LinearMPC, Plant, Reference, Tuning, linearise, load_tuning
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.control.mpc import terminal_weight
from pcr_mpc.control.qp.limited import LimitedQP
from pcr_mpc.control.qp.program import build_qp
from pcr_mpc.control.qp.workspace import Workspace
from pcr_mpc.linearisation.linear_limits import LinearLimits
from pcr_mpc.linearisation.linear_model import LinearModels
from tests.conftest import CONTROLLERS

DT, N = 0.01, 5
NONE = np.zeros(2)


@pytest.fixture(scope="module")
def tuning() -> Tuning:
    return replace(load_tuning(CONTROLLERS / "default.toml"), horizon=N, max_iterations=4000)


@pytest.fixture(scope="module")
def slow(pair, centre, target):
    """Model of a robot whose tip is ten times as heavy."""
    plant = Plant(replace(pair, tip_mass=10 * pair.tip_mass))
    plant.reset(target, centre)
    return linearise(plant, target, NONE, DT)


@pytest.fixture(scope="module")
def reference(target):
    return Reference(np.tile(target, (N, 1)), np.zeros((N, 2)))


@pytest.fixture
def wide(pair):
    return Limits(6.0, 3.0, *pair.angle_limits.T)


def off(target, tip=(0.02, -0.03)):
    return target + np.array([*tip, 0, 0, 0, 0])


def keep_below(p_high):
    return LinearLimits(
        ("tip region",), np.eye(1, 6, 1) / 0.4, np.array([-np.inf]), np.array([p_high / 0.4]), np.array([0.4])
    )


def test_a_reset_forgets_the_terminal_weight(tuning, target, model, slow, reference, wide):
    used, fresh = LinearMPC(tuning, wide), LinearMPC(tuning, wide)
    kept = used.solve(off(target), slow, reference, NONE), used.solve(off(target), model, reference, NONE)
    used.reset()
    again, first = (mpc.solve(off(target), model, reference, NONE) for mpc in (used, fresh))
    assert (again.inputs == first.inputs).all()
    # Until the reset it was that of the first model.
    assert np.abs(kept[1].inputs - first.inputs).max() > 1e-2


def test_a_reset_forgets_the_last_plan_and_the_rung(tuning, target, model, reference, wide):
    mpc = LinearMPC(tuning, wide)
    mpc.solve(off(target), model, reference, NONE)
    assert mpc.fall_back("no model", target, reference, NONE).fallback == "shifted_plan"
    mpc.reset()
    fresh = LinearMPC(tuning, wide)
    plans = [one.fall_back("no model", target, reference, NONE) for one in (mpc, fresh)]
    assert [plan.fallback for plan in plans] == ["hold", "hold"]  # not even the gain of the LQR is left


def test_a_reset_repeats_bit_for_bit_where_limits_are_active(tuning, target, model, reference):
    mpc = LinearMPC(tuning, Limits(6.0, 3.0, target[4:] - 0.01, target[4:] + 0.01))

    def plans():
        x, u, found = off(target), NONE, []
        for _ in range(6):
            plan = mpc.solve(x, model, reference, u, keep_below(target[1] + 0.0005))
            found.append((plan.inputs.tolist(), plan.iterations, plan.active, dict(plan.slack)))
            u = plan.inputs[0]
            x = model(x, u)
        return found

    first = plans()
    assert any("angle" in active for _, _, active, _ in first)
    mpc.reset()
    assert plans() == first


def test_a_limited_qp_forgets_its_last_solution_at_a_reset(tuning, target, model, reference):
    limits = Limits(6.0, 3.0, target[4:] - 0.01, target[4:] + 0.01)
    qp = build_qp(off(target), model, reference, NONE, tuning, limits, terminal_weight(model, tuning))
    used, fresh = (LimitedQP(tuning, 2, DT, reach=model.reach) for _ in range(2))
    warm = 0.1 * np.ones(2 * N)

    def solve(solver):
        answer = solver.solve(qp, off(target), LinearModels.of([model]), None, soft_angles=False, warm=warm)
        return answer.solution.iterations, answer.inputs.tolist()

    cold = solve(fresh)
    solve(used)
    assert solve(used) != cold  # it does remember
    used.reset()
    assert solve(used) == cold


# The ladder


def test_a_shifted_plan_is_the_last_one_moved_on_and_brakes_at_its_end(tuning, target, model, reference, pair):
    limits = Limits(6.0, 0.05, *pair.angle_limits.T)
    mpc = LinearMPC(tuning, limits)
    plan = mpc.solve(off(target), model, reference, np.array([1.0, -1.0]))
    assert np.abs(plan.inputs[-1]).min() > 0.1  # still turning when it ends
    shifted = mpc.fall_back("no model", off(target), reference, plan.inputs[0])
    assert (shifted.fallback, shifted.status) == ("shifted_plan", "no model")
    assert shifted.inputs[:-1] == pytest.approx(plan.inputs[1:], abs=1e-3)
    last = shifted.inputs[-2]
    assert shifted.inputs[-1] == pytest.approx(last - 0.05 * np.sign(last))


@pytest.mark.parametrize("motor", [0, 1])
@pytest.mark.parametrize("side", [-1, 1])
def test_the_lqr_rung_stops_at_a_stop(tuning, target, model, reference, motor, side):
    """Whatever the error asks for: from 2 mrad short of a stop no further than the stop."""
    lower, upper = target[4:] - 9.0, target[4:] + 9.0
    (lower if side < 0 else upper)[motor] = target[4 + motor] + side * 2e-3
    mpc = LinearMPC(tuning, Limits(6.0, 6.0, lower, upper))
    mpc.prepare(model)
    pushed = 0
    for tip in np.random.default_rng(2).uniform(-0.4, 0.4, (20, 2)):
        plan = mpc.fall_back("no model", off(target, tip), reference, NONE)
        assert plan.fallback == "lqr"
        turned = side * DT * plan.inputs[0, motor]
        assert turned <= 2e-3 + 1e-12
        pushed += turned > 2e-3 - 1e-9
    assert pushed >= 5


def test_after_its_first_period_the_lqr_rung_brings_the_motors_to_rest(tuning, target, model, reference, pair):
    mpc = LinearMPC(tuning, Limits(6.0, 0.3, *pair.angle_limits.T))
    mpc.prepare(model)
    plan = mpc.fall_back("no model", off(target), reference, np.array([2.0, -1.0]))
    assert plan.fallback == "lqr"
    for before, after in zip(plan.inputs[:-1], plan.inputs[1:], strict=True):
        assert after == pytest.approx(np.sign(before) * np.maximum(np.abs(before) - 0.3, 0.0), abs=1e-12)


def test_hold_brings_the_motors_to_rest_within_the_change_of_rate(tuning, reference, pair):
    mpc = LinearMPC(tuning, Limits(6.0, 0.3, *pair.angle_limits.T))
    plan = mpc.fall_back("no measurement", np.full(6, np.nan), reference, np.array([1.0, -0.5]))
    assert (plan.fallback, plan.status, plan.states, plan.models) == ("hold", "no measurement", None, None)
    assert plan.inputs[:4] == pytest.approx(np.array([[0.7, -0.2], [0.4, 0.0], [0.1, 0.0], [0.0, 0.0]]))
    assert plan.active == ("rate change",)
    assert mpc.fall_back("again", np.full(6, np.nan), reference, NONE).active == ()


def test_a_limit_of_poses_that_gave_way_is_a_fall_back(tuning, target, model, reference, wide):
    mpc = LinearMPC(tuning, wide)
    outside = mpc.solve(target, model, reference, NONE, keep_below(target[1] - 0.02))
    assert (outside.fallback, outside.status) == ("softened", "cannot keep tip region")
    assert set(outside.slack) == {"tip region"}
    assert outside.slack["tip region"] == pytest.approx(outside.states[1:, 1].max() - target[1] + 0.02, rel=1e-2)
    inside = LinearMPC(tuning, wide).solve(target, model, reference, NONE, keep_below(target[1] + 0.02))
    assert (inside.fallback, inside.status, inside.slack) == (None, "solved", {})


@pytest.mark.parametrize("side", [-1, 1])
def test_slack_of_an_angle_is_in_radians(tuning, target, model, reference, side):
    """Beyond a stop by 0.2 rad: it gives by as much as the plan's angles are out."""
    lower, upper = target[4:] - 9.0, target[4:] + 9.0
    (lower if side < 0 else upper)[1] = target[5] - side * 0.2
    plan = LinearMPC(tuning, Limits(6.0, 6.0, lower, upper)).solve(target, model, reference, NONE)
    outside = np.maximum(lower - plan.states[1:, 4:], plan.states[1:, 4:] - upper).max()
    assert outside > 0.1
    assert plan.slack["angle"] == pytest.approx(outside, rel=1e-2)
    assert "angle" in plan.active
    assert plan.fallback == "softened"


def test_with_raise_only_solutions_count(tuning, target, model, reference, wide):
    strict = LinearMPC(replace(tuning, fallback="raise"), wide)
    assert strict.solve(target, model, reference, NONE, keep_below(target[1] - 0.02)).fallback == "softened"
    capped = LinearMPC(replace(tuning, fallback="raise", max_iterations=1), replace(wide, rate=0.1))
    with pytest.raises(InfeasibleError, match=r"not solved|are spent"):
        capped.solve(off(target), model, reference, NONE)


def test_rows_left_out_are_not_broken(tuning, target, model, reference, wide):
    """A stop that the unlimited plan passes by ten tolerances is one of the QP's rows."""
    tuning = replace(tuning, tolerance=1e-4)
    weight = terminal_weight(model, tuning)

    def solved(limits):
        qp = build_qp(off(target), model, reference, NONE, tuning, limits, weight)
        return Workspace(tuning, model).solve(qp, off(target), LinearModels.of([model]), None, limits, None)

    free = solved(wide)
    angles = free.states[1:, 4:]
    for side in (-1, 1):
        for by, left_out in ((0.5, True), (10.0, False)):
            stop = side * ((side * angles).max(axis=0) - by * tuning.tolerance * DT)
            limits = replace(wide, **{"angle_lower" if side < 0 else "angle_upper": stop})
            answer = solved(limits)
            # Only the smaller problem's answer needs its states to be judged.
            assert (answer.states is not None) == left_out


def test_without_a_solved_plan_there_is_none_to_move_on(tuning, target, model, reference, wide):
    """From the start on nothing is solved: the LQR answers every period, and without a measurement the hold."""
    mpc = LinearMPC(tuning, wide)
    mpc.prepare(model)
    plans = [mpc.fall_back("no model", off(target), reference, NONE) for _ in range(3)]
    assert [plan.fallback for plan in plans] == ["lqr"] * 3
    assert (plans[2].inputs == plans[0].inputs).all()
    blind = [mpc.fall_back("no measurement", np.full(6, np.nan), reference, NONE).fallback for _ in range(2)]
    assert blind == ["hold"] * 2
    mpc.solve(off(target), model, reference, NONE)
    assert mpc.fall_back("no model", off(target), reference, NONE).fallback == "shifted_plan"


# What a plan says


def test_a_plan_is_a_prediction_by_its_models(tuning, target, model, reference, wide):
    x = off(target)
    plan = LinearMPC(tuning, wide).solve(x, model, reference, NONE)
    assert plan.models is model
    assert (plan.states[0] == x).all()
    for k in range(N):
        assert plan.states[k + 1] == pytest.approx(model(plan.states[k], plan.inputs[k]), abs=1e-12)
    assert 0 < plan.iterations <= tuning.max_iterations
    assert plan.update_time > 0
    assert 0 < plan.solver_time < plan.solve_time
    for array in (plan.inputs, plan.states):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0.0


def test_models_of_a_graph_predict_as_a_model_does(target, model):
    later = replace(model, A=1.1 * model.A, c=model.c + 0.3)
    models, x, u = LinearModels.of([model, later]), off(target), np.array([0.7, -0.4])
    for k, one in enumerate((model, later)):
        assert models.moved(k, x, u) == pytest.approx(one(x, u), rel=1e-14)
        np.testing.assert_array_equal(models.moved(k, x, u), models[k](x, u))


def test_a_fall_back_predicts_too_where_it_can(tuning, target, model, reference, wide):
    mpc = LinearMPC(tuning, wide)
    mpc.solve(off(target), model, reference, NONE)
    plan = mpc.fall_back("no model", off(target), reference, NONE)
    assert plan.models is model
    assert plan.states[1] == pytest.approx(model(off(target), plan.inputs[0]), abs=1e-12)
    assert np.isnan([plan.primal_residual, plan.dual_residual]).all()
    assert plan.iterations == 0
    blind = mpc.fall_back("no measurement", np.full(6, np.nan), reference, NONE)
    assert (blind.models, blind.states) == (None, None)


def test_one_model_or_one_for_each_period(tuning, target, model, slow, reference, wide):
    many = [model, *[slow] * (N - 1)]
    plan = LinearMPC(tuning, wide).solve(off(target), many, reference, NONE)
    assert plan.models is many
    x = off(target)
    for one, u, after in zip(many, plan.inputs, plan.states[1:], strict=True):
        x = one(x, u)
        assert after == pytest.approx(x, abs=1e-12)
    with pytest.raises(ValueError, match=f"models has {N - 1} entries, expected 1 or the horizon {N}"):
        LinearMPC(tuning, wide).solve(off(target), many[1:], reference, NONE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x": np.full(6, np.nan)}, "x is not finite"),
        ({"x": np.zeros(5)}, r"x has shape \(5,\), expected \(6,\)"),
        ({"u_previous": np.array([np.inf, 0.0])}, "u_previous is not finite"),
        ({"u_previous": np.zeros(3)}, r"u_previous has shape \(3,\), expected \(2,\)"),
        ({"reference": Reference(np.zeros((N - 1, 6)), np.zeros((N, 2)))}, r"reference.states has shape \(4, 6\)"),
        ({"reference": Reference(np.zeros((N, 6)), np.full((N, 2), np.nan))}, "reference.inputs is not finite"),
    ],
)
def test_a_refused_argument_leaves_the_controller_as_it_was(tuning, target, model, reference, wide, change, message):
    given = {"x": off(target), "models": model, "reference": reference, "u_previous": NONE}
    touched, other = LinearMPC(tuning, wide), LinearMPC(tuning, wide)
    for mpc in (touched, other):
        mpc.solve(**given)
    with pytest.raises(ValueError, match=message):
        touched.solve(**{**given, **change})
    assert (touched.solve(**given).inputs == other.solve(**given).inputs).all()
