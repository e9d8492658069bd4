"""Every rung of the controller's ladder, forced: an answer within the limits, and its name."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    InfeasibleError,
    LinearMPC,
    Reference,
    load_scene,
    load_tuning,
    make_controller,
    simulate,
)
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.control.mpc import terminal_weight
from pcr_mpc.control.qp.limited import LimitedQP
from pcr_mpc.control.qp.osqp_solver import QPSolver
from pcr_mpc.control.qp.program import build_qp
from tests.conftest import CONTROLLERS, MODELS

DT, RATE, CHANGE = 0.01, 6.0, 1.0


@pytest.fixture(scope="module")
def tuning():
    # Steps of centimetres under narrow limits take OSQP longer than the default allows.
    return replace(load_tuning(CONTROLLERS / "measured.toml"), max_iterations=4000)


@pytest.fixture(scope="module")
def reference(tuning, target):
    return Reference(np.tile(target, (tuning.horizon, 1)), np.zeros((tuning.horizon, 2)))


@pytest.fixture
def mpc(tuning, model, pair):
    mpc = LinearMPC(tuning, Limits(RATE, CHANGE, *pair.angle_limits.T))
    mpc.prepare(model)
    return mpc


def beyond_the_stop(target, pair, by):
    x = target.copy()
    x[4] = pair.angle_limits[0, 1] + by
    return x


def test_softened_returns_from_beyond_a_stop(mpc, target, model, reference, pair):
    x, u, rungs = beyond_the_stop(target, pair, 0.2), np.zeros(2), []
    for _ in range(40):
        plan = mpc.solve(x, model, reference, u)
        assert np.abs(plan.inputs[0] - u).max() <= CHANGE + 1e-12
        assert np.abs(plan.inputs[0]).max() <= RATE
        rungs.append(plan.fallback)
        if plan.fallback:
            assert plan.slack["angle"] > 0
            assert "angle" in plan.active
            assert "infeasible" in plan.status
        u = plan.inputs[0]
        x = model(x, u)
    assert rungs[0] == "softened"
    assert set(rungs) == {"softened", None}
    assert rungs[-1] is None  # back within the stops, and hard again
    assert x[4] < pair.angle_limits[0, 1]


def test_the_penalty_is_exact(tuning, target, model, reference, pair):
    """Where the angle limits can be kept, softening them changes nothing."""
    tuning = replace(tuning, tolerance=1e-9)
    limits = Limits(RATE, CHANGE, target[4:] - 0.02, target[4:] + 0.02)
    x = target + np.array([0.02, -0.01, 0.0, 0.0, 0.0, 0.0])
    qp = build_qp(x, model, reference, np.zeros(2), tuning, limits, terminal_weight(model, tuning))
    hard = QPSolver(qp.A, 1e-9)
    hard.update(qp.P, qp.q, qp.l, qp.u)
    solution = hard.solve()
    assert np.abs(solution.y[4 * tuning.horizon :]).max() > 1e-3  # an angle limit is active
    for soft in (True, False):
        softened = LimitedQP(tuning, 2, DT, reach=model.reach).solve(qp, x, [model], None, soft_angles=soft)
        assert softened.inputs == pytest.approx(solution.x, abs=1e-5)
        assert softened.slack == {}
        assert softened.active == ("rate change", "angle")


def test_shifted_plan_then_lqr_then_hold(mpc, target, model, reference, tuning):
    x = target + np.array([0.02, -0.01, 0.0, 0.0, 0.0, 0.0])
    first = mpc.solve(x, model, reference, np.zeros(2))
    u, plans = first.inputs[0], []
    for _ in range(tuning.horizon + 2):
        plans.append(mpc.fall_back("no model", x, reference, u))
        assert np.abs(plans[-1].inputs[0] - u).max() <= CHANGE + 1e-12
        u = plans[-1].inputs[0]
        x = model(x, u)
    assert [plan.fallback for plan in plans] == ["shifted_plan"] * (tuning.horizon - 1) + ["lqr"] * 3
    assert plans[0].inputs[0] == pytest.approx(first.inputs[1], abs=1e-3)
    blind = mpc.fall_back("no measurement", np.full(6, np.nan), reference, u)
    assert blind.fallback == "hold"
    assert np.isfinite(blind.inputs).all()
    assert np.abs(blind.inputs[-1]).max() == 0.0
    assert mpc.solve(x, model, reference, u).fallback is None  # and up again at once


def test_lqr_rung_is_the_lqr(mpc, target, model, reference, tuning, pair):
    """With the limits out of the way it is the input of the unlimited MPC with the Riccati terminal weight."""
    free = LinearMPC(
        replace(tuning, tolerance=1e-10, angle_weight=0.0), Limits(1e3, 1e3, *np.array([[-99.0] * 2, [99.0] * 2]))
    )
    free.prepare(model)
    balanced = replace(model, c=target - model.A @ target)
    x = target + 1e-3 * np.array([1.0, -2.0, 3.0, 1.0, 0.5, -0.5])
    by_lqr = free.fall_back("no model", x, reference, np.zeros(2)).inputs[0]
    assert by_lqr == pytest.approx(free.solve(x, balanced, reference, np.zeros(2)).inputs[0], abs=2e-3)


def test_capped_iterations_fall_back(tuning, target, model, reference, pair):
    mpc = LinearMPC(replace(tuning, max_iterations=5), Limits(2.0, 0.3, *pair.angle_limits.T))
    far = target + np.array([0.05, -0.05, 0.0, 0.0, 0.0, 0.0])
    plan = mpc.solve(far, model, reference, np.zeros(2))
    assert plan.fallback == "lqr"  # there is no earlier plan
    assert "maximum iterations" in plan.status
    with pytest.raises(InfeasibleError):
        LinearMPC(replace(tuning, max_iterations=5, fallback="raise"), Limits(2.0, 0.3, *pair.angle_limits.T)).solve(
            far, model, reference, np.zeros(2)
        )


class Faulty:
    """A controller whose sensor drops out from period 60 to 80."""

    def __init__(self, controller):
        self.controller, self.name = controller, controller.name
        self.start = controller.start

    def step(self, k, x):
        return self.controller.step(k, np.full_like(x, np.nan) if 60 <= k < 80 else x)


def test_a_sensor_that_drops_out_is_bridged():
    scene = replace(load_scene(MODELS / "scenes" / "lemniscate.toml"), duration=2.0)
    run = simulate(scene, scene.make_plant(), Faulty(make_controller(scene)))
    summary = run.summary()
    assert summary["failures"] == 0
    assert summary["max_mm"] < 0.1
    blind = replace(scene.tuning, observer=None)
    run = simulate(scene, scene.make_plant(), Faulty(make_controller(scene, blind)))
    assert run.summary()["control_rungs"] == {"solved": scene.n_periods}
    assert run.summary()["max_mm"] < 0.1
    assert run.summary()["refused_measurements"] == 2 * 20  # tip and encoders
    assert run.limit_violations() == 0


def test_a_plant_that_is_elsewhere_gets_answers():
    """Measurements that the model's rods cannot follow, out of their reach at last: each step has a named answer."""
    scene = replace(load_scene(MODELS / "scenes" / "lemniscate.toml"), duration=0.5)
    controller = make_controller(scene)
    pose = scene.start()
    controller.start(pose)
    u, rungs = np.zeros(2), set()
    for k in range(80):
        # Slowly enough for each of them to be believed.
        x = np.concatenate([pose.p + [0.0, 0.006 * k], [0.0, 0.0], pose.q + [0.05 * k, 0.05 * k]])
        decision = controller.step(k, x)
        assert np.isfinite(decision.u).all()
        assert decision.plan.status
        assert np.abs(decision.u - u).max() <= scene.robot.acceleration_limit * scene.period + 1e-9
        rungs.add(decision.plan.fallback)
        u = decision.u
    assert None in rungs
    # Rods are followed until they are straight, and what is out of reach is bridged: the limits of poses give way.
    assert "softened" in rungs
