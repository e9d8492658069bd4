"""Horizons from one period to hundreds: the same problem, and a controller that is ready in seconds."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ModelError, build_qp, load_scene, load_tuning, make_controller, simulate
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.control.mpc import terminal_weight
from pcr_mpc.control.qp.condensing import _UNROLLED
from tests.conftest import CONTROLLERS, MODELS
from tests.solvers.test_qp import DT, cost, full, model, problem  # noqa: F401  a fixture

LONG = _UNROLLED + 6


@pytest.fixture(scope="module")
def lemniscate():
    return load_scene(MODELS / "scenes" / "lemniscate.toml")


@pytest.mark.parametrize("varying", [False, True])
def test_the_cost_over_a_long_horizon_is_that_of_a_simulation(pair, centre, model, varying):  # noqa: F811
    tuning = replace(load_tuning(CONTROLLERS / "default.toml"), horizon=LONG, velocity_weight=3.0, angle_weight=0.2)
    x, reference, previous = problem(model, centre, LONG)
    terminal, rng = terminal_weight(model, tuning), np.random.default_rng(5)
    models = [model] * LONG
    if varying:
        models = [replace(model, A=np.vstack([model.A[:4] + 1e-3 * rng.normal(size=(4, 6)), model.A[4:]]))
                  for _ in range(LONG)]  # fmt: skip
    limits = Limits(6.0, 3.0, *pair.angle_limits.T)
    qp = build_qp(x, models if varying else model, reference, previous, tuning, limits, terminal)
    hessian = full(qp.P, 2 * LONG)
    base = cost(models, x, np.zeros((LONG, 2)), reference, tuning, terminal)
    for _ in range(3):
        u = rng.normal(size=2 * LONG)
        wanted = cost(models, x, u.reshape(-1, 2), reference, tuning, terminal) - base
        assert u @ hessian @ u / 2 + qp.q @ u == pytest.approx(wanted, rel=1e-8)
    # Rates that break one limit each break one row each, by as much.
    still, turned = np.zeros((LONG, 2)), np.zeros((LONG, 2))
    still[3, 1] = 9.0
    turned[:, 0] = (pair.angle_limits[0, 1] - x[4]) / (DT * LONG) * 1.01
    for u, kind in ((still, 0), (turned, 2)):
        rows = qp.A @ u.ravel()
        broken = (rows > qp.u + 1e-12).reshape(3, -1).any(axis=1)
        assert broken[kind]
    assert (qp.u - qp.l)[: 2 * LONG] == pytest.approx(12.0)
    assert (qp.u + qp.l)[2 * LONG : 2 * LONG + 2] / 2 == pytest.approx(previous)
    assert DT * qp.l[4 * LONG :].reshape(-1, 2) + x[4:] == pytest.approx(np.tile(limits.angle_lower, (LONG, 1)))


@pytest.mark.parametrize("linearise", ["here", "along_plan"])
@pytest.mark.parametrize("horizon", [1, LONG])
def test_every_horizon_solves_its_steps(lemniscate, horizon, linearise):
    """On the reference to a tenth of a millimetre; a look-ahead of one period does with the LQR's terminal weight."""
    predicts = replace(lemniscate.tuning.model, linearise=linearise)
    tuning = replace(lemniscate.tuning, horizon=horizon, period=None, model=predicts)
    scene = replace(lemniscate.tuned(tuning), duration=0.3)
    run = simulate(scene, scene.make_plant(), make_controller(scene))
    assert run.events == []
    assert run.error.max() < 1e-4


def test_a_horizon_that_cannot_be_held_in_memory_is_refused(tmp_path):
    tuning = load_tuning(CONTROLLERS / "default.toml")
    with pytest.raises(ModelError, match=r"horizon is 100000, expected at most \d+"):
        replace(tuning, horizon=100_000)
    path = tmp_path / "far.toml"
    path.write_text((CONTROLLERS / "default.toml").read_text().replace("horizon = 10 ", "horizon = 1000000 "))
    with pytest.raises(ModelError, match=r"far\.toml: horizon: is 1000000") as caught:
        load_tuning(path)
    assert caught.value.key == "horizon"


@pytest.mark.slow
def test_a_horizon_of_two_hundred_is_ready_at_once(lemniscate):
    """As one list of instructions it took 400 s to be ready; now 5 s, of which this test would be the first to tell."""
    predicts = replace(lemniscate.tuning.model, linearise="along_plan")
    scene = replace(lemniscate.tuned(replace(lemniscate.tuning, horizon=200, model=predicts)), duration=0.05)
    run = simulate(scene, scene.make_plant(), make_controller(scene))
    assert run.events == []
