"""The yardsticks do what their names say, and the models along the plan are where the plan is."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import Plant, inverse_statics, linearise, load_scene, load_tuning, make_controller, simulate
from pcr_mpc.control.laws import LQR, PD, FeedForward
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.control.qp.program import Reference
from tests.conftest import CONTROLLERS, MODELS

DT = 0.01


@pytest.fixture(scope="module")
def scene():
    return replace(load_scene(MODELS / "scenes" / "lemniscate.toml"), duration=1.5)


def rms_mm(scene, name):
    run = simulate(scene, scene.make_plant(), make_controller(scene, load_tuning(CONTROLLERS / f"{name}.toml")))
    assert run.limit_violations() == 0
    return run.summary()["rms_after_1s_mm"]


@pytest.fixture(scope="module")
def at_rest(pair, centre):
    x = np.concatenate([centre.p, [0, 0], centre.q])
    plant = Plant(pair)
    plant.reset(x, centre)
    return x, linearise(plant, x, (0, 0), DT)


def test_open_loop_is_blind(scene, at_rest, pair):
    x, model = at_rest
    law = FeedForward(load_tuning(CONTROLLERS / "open_loop.toml"), Limits(6.0, 3.0, *pair.angle_limits.T))
    law.prepare(model)
    reference = Reference(x[None], np.array([[0.4, -0.2]]))
    for elsewhere in (x, x + 0.01):
        assert law.solve(elsewhere, model, reference, np.zeros(2)).inputs[0] == pytest.approx([0.4, -0.2])
    assert law.fall_back("no measurement", np.full(6, np.nan), reference, np.zeros(2)).inputs[0].any()
    assert rms_mm(scene, "open_loop") < 0.02
    assert rms_mm(replace(scene, force=(0.5, -1.0)), "open_loop") > 5.0


def test_lqr_settles_like_its_closed_loop_matrix(at_rest, pair):
    """A - B K has the poles of the discrete Riccati equation: its cost-to-go falls by the stage cost at every step."""
    x, model = at_rest
    tuning = load_tuning(CONTROLLERS / "lqr.toml")
    law = LQR(tuning, Limits(1e3, 1e3, x[4:] - 9, x[4:] + 9))
    law.prepare(model)
    reference = Reference(x[None], np.zeros((1, 2)))
    columns = [law.solve(x + 1e-3 * e, model, reference, np.zeros(2)).inputs[0] / 1e-3 for e in np.eye(6)]
    closed = model.A + model.B @ np.array(columns).T
    assert np.abs(np.linalg.eigvals(closed)).max() < 1.0
    # Optimal: no gain nearby gives a lower cost from any of these starts.
    gain = -np.array(columns).T
    q, r = np.diag([tuning.position_weight] * 2 + [0, 0] + [1e-6 * tuning.position_weight] * 2), tuning.input_weight

    def cost(gain):
        y, total = np.eye(6), 0.0
        for _ in range(600):
            u = -gain @ y
            total += np.sum(y * (q @ y)) + r * np.sum(u * u)
            y = model.A @ y + model.B @ u
        return total

    best, rng = cost(gain), np.random.default_rng(3)
    for _ in range(5):
        assert cost(gain * (1 + 1e-2 * rng.standard_normal(gain.shape))) > best


def test_lqr_on_a_moving_reference_is_the_feed_forward(at_rest, pair):
    x, model = at_rest
    law = LQR(load_tuning(CONTROLLERS / "lqr.toml"), Limits(1e3, 1e3, *pair.angle_limits.T))
    law.prepare(model)
    now, rates = x + np.array([0, 0, 0.2, -0.1, 0, 0]), np.array([0.3, 0.7])
    after = now + DT * np.concatenate([now[2:4], [0, 0], rates])
    plan = law.solve(now, model, Reference(after[None], rates[None]), np.zeros(2))
    assert plan.inputs[0] == pytest.approx(rates, abs=1e-9)


def test_pd_moves_the_motors_to_the_inverse_statics_of_a_displaced_tip(pair, centre, at_rest):
    x, model = at_rest
    tuning = replace(load_tuning(CONTROLLERS / "pd.toml"), pd=(0.5, 0.0))
    law = PD(
        tuning, Limits(1e3, 1e3, *pair.angle_limits.T), lambda p, q, force: inverse_statics(pair, p, force, centre).q
    )
    law.prepare(model)
    reference = Reference(x[None], np.zeros((1, 2)), np.zeros((1, 2)))
    measured = x + np.array([2e-3, -1e-3, 0, 0, 0, 0])
    u = law.solve(measured, model, reference, np.zeros(2)).inputs[0]
    wanted = inverse_statics(pair, centre.p - 0.5 * np.array([2e-3, -1e-3]), guess=centre).q
    assert x[4:] + DT * u == pytest.approx(wanted, abs=1e-12)


def test_yardsticks_rank_as_they_should(scene):
    errors = {name: rms_mm(scene, name) for name in ("lqr", "pd", "frozen", "default", "measured")}
    assert errors["measured"] < 0.6 * errors["frozen"]
    assert errors["default"] < errors["frozen"]
    assert errors["frozen"] < 0.1 * min(errors["pd"], errors["lqr"])
    assert max(errors.values()) < 1.0


def test_limits_of_the_one_step_laws_are_named(at_rest, pair):
    x, model = at_rest
    law = FeedForward(load_tuning(CONTROLLERS / "open_loop.toml"), Limits(2.0, 3.0, x[4:] - 0.01, x[4:] + 1))
    law.prepare(model)
    for wanted, active in (([0.1, 0.0], ()), ([9.0, 0.0], ("rate",)), ([-1.5, 0.0], ("angle",))):
        plan = law.solve(x, model, Reference(x[None], np.array([wanted])), np.zeros(2))
        assert plan.active == active
    assert plan.inputs[0] == pytest.approx([-1.0, 0.0])
