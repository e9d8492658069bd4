"""All of a tuning takes effect between two steps, and what a controller knows is kept."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import LinearMPC, Reference, load_scene, load_tuning, make_controller
from pcr_mpc.control.laws import LQR, PD, FeedForward
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.control.observer import ObserverTuning
from pcr_mpc.errors import PCRError, ReadOnlyError
from pcr_mpc.loop.parts.assembled import motor_limits
from pcr_mpc.loop.parts.foresight import Foresight
from tests.conftest import CONTROLLERS, MODELS

TUNING = replace(load_tuning(CONTROLLERS / "measured.toml"), horizon=5, law="linear_mpc")
CHANGES = {
    "weights": {"input_weight": 0.3, "velocity_weight": 50.0},
    "angle weight": {"angle_weight": 10.0},
    "longer": {"horizon": 8},
    "shorter": {"horizon": 3},
    "solver": {"tolerance": 1e-7, "max_iterations": 3999},
}


def held(target, tuning, off=0.0):
    states = np.tile(target, (tuning.horizon, 1))
    states[:, 0] += off
    return Reference(states, np.zeros((tuning.horizon, 2)))


def near(target):
    return target + np.array([0.002, -0.003, 0.01, 0.0, 0.01, -0.02])


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("prepared", [True, False])
def test_a_retuned_mpc_is_one_that_was_tuned_so_from_the_start(pair, target, model, change, prepared):
    limits, tuning = motor_limits(pair, 0.01), replace(TUNING, **CHANGES[change])
    mpc, new = LinearMPC(TUNING, limits), LinearMPC(tuning, limits)
    for one in (mpc, new) if prepared else ():
        one.prepare(model)
    if not prepared:
        new.solve(near(target), model, held(target, tuning), np.zeros(2))
        new.reset()
    for _ in range(3):
        old = mpc.solve(near(target), model, held(target, TUNING), np.array([0.1, 0.0])).inputs[0]
    mpc.retune(tuning)
    assert mpc.tuning is tuning
    arguments = near(target), model, held(target, tuning), np.array([0.1, 0.0])
    plan = mpc.solve(*arguments)
    np.testing.assert_array_equal(plan.inputs, new.solve(*arguments).inputs)
    if change != "solver":
        assert np.abs(plan.inputs[0] - old).max() > 1e-6


def test_a_retuned_mpc_keeps_its_last_rates_for_a_fall_back(pair, target, model):
    mpc = LinearMPC(TUNING, motor_limits(pair, 0.01))
    rates = mpc.solve(near(target), model, held(target, TUNING), np.zeros(2)).inputs
    tuning = replace(TUNING, horizon=3)
    mpc.retune(tuning)
    plan = mpc.fall_back("no model", np.full(6, np.nan), held(target, tuning), rates[0])
    assert plan.fallback == "shifted_plan"
    assert plan.inputs.shape == (3, 2)
    np.testing.assert_array_equal(plan.inputs[0], rates[1])


def test_tunings_are_read_only(pair):
    limits = motor_limits(pair, 0.01)
    for law in (LinearMPC(TUNING, limits), LQR(TUNING, limits), FeedForward(TUNING, limits)):
        with pytest.raises(ReadOnlyError, match=r"tuning cannot be set .*call retune"):
            law.tuning = replace(TUNING, input_weight=1.0)


@pytest.mark.parametrize("law", [LQR, FeedForward, PD])
@pytest.mark.parametrize("stopped_by", [PCRError, KeyboardInterrupt])
def test_a_law_whose_retuning_fails_decides_as_before(pair, target, model, law, stopped_by, monkeypatch):
    more = [lambda p, q, force: q + 0.1 * p] if law is PD else []
    one, other = (law(replace(TUNING, pd=(0.3, 0.02)), motor_limits(pair, 0.01), *more) for _ in range(2))
    for each in (one, other):
        each.prepare(model)
    prepare = law.prepare

    def half(self, model, combinations=()):
        prepare(self, replace(model, dt=0.5), combinations)
        raise stopped_by("half way")

    with monkeypatch.context() as patch:
        patch.setattr(law, "prepare", half)
        with pytest.raises(stopped_by, match="half way"):
            one.retune(replace(TUNING, pd=(0.9, 0.2), input_weight=5.0))
    assert one.tuning == other.tuning
    reference = replace(held(target, TUNING, off=0.01), forces=np.zeros((TUNING.horizon, 2)))
    arguments = near(target), model, reference, np.zeros(2)
    np.testing.assert_array_equal(one.solve(*arguments).inputs, other.solve(*arguments).inputs)
    one.retune(tuning := replace(TUNING, pd=(0.9, 0.2), input_weight=5.0))
    assert one.tuning is tuning


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda mpc: pickle.loads(pickle.dumps(mpc))])
def test_copies_of_an_mpc_start_afresh_with_the_tuning_of_now(pair, target, model, copied):
    mpc = LinearMPC(TUNING, motor_limits(pair, 0.01))
    mpc.solve(near(target), model, held(target, TUNING), np.zeros(2))
    tuning = replace(TUNING, horizon=4, input_weight=0.2)
    mpc.retune(tuning)
    other, new = copied(mpc), LinearMPC(tuning, mpc.limits)
    assert other.tuning == tuning
    arguments = near(target), model, held(target, tuning), np.zeros(2)
    np.testing.assert_array_equal(other.solve(*arguments).inputs, new.solve(*arguments).inputs)


def test_a_law_that_holds_a_function_says_that_it_cannot_be_copied(pair):
    law = PD(TUNING, motor_limits(pair, 0.01), lambda p, q, force: q)
    with pytest.raises(TypeError, match=r"PD .*pickle its controller"):
        pickle.dumps(law)


def absurd(kind, target, model, limits):
    """(x, model, offset of the reference, u_previous, limits) of a problem that cannot be meant."""
    x, zero = target.copy(), np.zeros(2)
    stronger = replace(model, B=np.vstack([1e6 * model.B[:4], model.B[4:]]))
    return {
        "reference": (x, model, 1e4, zero, limits),
        "distant": (x, model, -1e12, zero, limits),
        "x": (x + np.array([1e5, -1e4, 0, 0, 0, 0]), model, 0.0, zero, limits),
        "angles": (x + np.array([0, 0, 0, 0, 1e4, 1e4]), model, 0.0, zero, limits),
        "speed": (x + np.array([0, 0, 1e7, 0, 0, 0]), model, 0.0, zero, limits),
        "u": (x, model, 0.0, np.full(2, 1e6), limits),
        "model": (x + 0.01, stronger, 0.0, zero, limits),
        "constant": (x, replace(model, c=model.c + 1e6), 0.0, zero, limits),
        "limits": (near(target), model, 0.1, zero, Limits(1e6, 1e6, np.full(2, -1e6), np.full(2, 1e6))),
        "still": (near(target), model, 0.1, zero, Limits(1e-9, 1e-9, target[4:] - 1e-9, target[4:] + 1e-9)),
    }[kind]


@pytest.mark.parametrize("kind", ["reference", "distant", "x", "angles", "speed", "u", "model", "constant", "limits",
                                  "still"])  # fmt: skip
@pytest.mark.parametrize("prepared", [True, False])
def test_an_absurd_problem_does_not_spoil_the_next(pair, target, model, kind, prepared):
    tuning = replace(load_tuning(CONTROLLERS / "measured.toml"), horizon=10)
    limits = motor_limits(pair, 0.01)
    mpc, fresh = LinearMPC(tuning, limits), LinearMPC(tuning, limits)
    for one in (mpc, fresh):
        if prepared:
            one.prepare(model)
    x, other, off, u, mpc.limits = absurd(kind, target, model, limits)
    for _ in range(2 if prepared else 1):
        mpc.solve(x, other, held(target, tuning, off), u)
    mpc.limits = limits
    arguments = near(target), model, held(target, tuning), np.array([0.1, -0.05])
    plan, expected = mpc.solve(*arguments), fresh.solve(*arguments)
    assert plan.status == expected.status == "solved"
    assert plan.fallback is None
    np.testing.assert_allclose(plan.inputs, expected.inputs, atol=1e-3)


def begun(scene, tuning, periods):
    """A controller that has seen a few periods of a robot that leaves its reference a little."""
    controller = make_controller(scene.tuned(tuning))
    pose = scene.start()
    controller.start(pose)
    for k in range(periods):
        x = np.concatenate([pose.p + k * np.array([2e-5, -1e-5]), [0, 0], pose.q + 1e-4 * k])
        controller.step(k, x)
    return controller, np.concatenate([pose.p + periods * np.array([2e-5, -1e-5]), [0, 0], pose.q + 1e-4 * periods])


# Solved sharply: what is compared are decisions, one from a warm and one from a cold start.
BASE = replace(
    TUNING,
    tolerance=1e-9,
    max_iterations=100_000,
    observer=ObserverTuning(),
    model=replace(TUNING.model, linearise="here"),
)
TUNINGS = {
    "horizon and weights": replace(BASE, horizon=9, input_weight=0.3, velocity_weight=50.0),
    "observer": replace(BASE, observer=ObserverTuning(tip_noise=1e-3)),
    "along the plan": replace(BASE, model=replace(BASE.model, linearise="along_plan"), input_weight=0.02),
    "inertia": replace(BASE, model=replace(BASE.model, inertia="condensed"), input_weight=0.02),
    "method": replace(BASE, model=replace(BASE.model, method="multiple_shooting"), input_weight=0.02),
    "no prediction of delays": replace(BASE, model=replace(BASE.model, predict_delay=False), input_weight=0.02),
    "lqr": replace(BASE, law="lqr"),
    "pd": replace(BASE, law="pd", pd=(0.3, 0.02)),
    "feed forward": replace(BASE, law="feed_forward"),
}


@pytest.fixture(scope="module")
def scene():
    return replace(load_scene(MODELS / "scenes" / "lemniscate.toml"), duration=0.1, delay=2)


@pytest.fixture(scope="module")
def untouched(scene):
    """Decision of the next period without retuning."""
    controller, x = begun(scene, BASE, 4)
    return controller.step(4, x)


@pytest.mark.parametrize("change", TUNINGS)
def test_a_retuned_controller_decides_as_one_that_was_tuned_so_from_the_start(scene, untouched, change):
    tuning = TUNINGS[change]
    controller, x = begun(scene, BASE, 4)
    new, _ = begun(scene, tuning, 4)
    # The same knowledge: of the state, of the force, of the rates before and on the way.
    new.observer.x, new.observer.force = controller.observer.x.copy(), controller.observer.force.copy()
    old, work = controller._work, new._work
    work.u, work.sent = old.u, copy.copy(old.sent)
    work.on_the_way.clear()
    work.on_the_way.extend(list(old.sent)[len(old.sent) - work.delay :])
    work.foresight.target_from(old.foresight)
    controller.retune(tuning)
    assert controller.name == tuning.name
    assert controller.tuning is tuning
    found, expected = controller.step(4, x), new.step(4, x)
    np.testing.assert_allclose(found.u, expected.u, atol=2e-5)
    assert found.plan.inputs.shape == expected.plan.inputs.shape
    assert found.plan.status == expected.plan.status
    if change not in ("observer", "method"):
        assert np.abs(untouched.u - found.u).max() > 1e-3  # what is told apart


def test_retuning_to_the_same_changes_nothing(scene):
    controller, x = begun(scene, BASE, 4)
    other, _ = begun(scene, BASE, 4)
    controller.retune(BASE)
    np.testing.assert_array_equal(controller.step(4, x).u, other.step(4, x).u)


def test_an_observer_that_is_retuned_keeps_its_estimates(scene):
    controller, _ = begun(scene, BASE, 4)
    state, force = controller.observer.x.copy(), controller.observer.force.copy()
    assert np.abs(force).max() > 0
    gain = controller.observer.gain.copy()
    controller.retune(TUNINGS["observer"])
    np.testing.assert_array_equal(controller.observer.x, state)
    np.testing.assert_array_equal(controller.observer.force, force)
    assert np.abs(controller.observer.gain - gain).max() > 0.1
    controller.retune(replace(BASE, observer=None))
    assert controller.observer is None


def test_a_retuning_that_is_refused_changes_nothing(scene):
    controller, x = begun(scene, BASE, 4)
    other, _ = begun(scene, BASE, 4)
    with pytest.raises(ValueError, match=r"control period of 0.02 s.*0.01 s"):
        controller.retune(replace(BASE, period=0.02))
    assert controller.tuning is BASE
    np.testing.assert_array_equal(controller.step(4, x).u, other.step(4, x).u)


@pytest.mark.parametrize("failing", ["pose", "reset", "target_from"])
@pytest.mark.parametrize("law", ["linear_mpc", "lqr"])
@pytest.mark.parametrize("stopped_by", [PCRError, KeyboardInterrupt])
def test_a_retuning_that_fails_half_way_changes_nothing(scene, monkeypatch, failing, law, stopped_by):
    tuning = replace(BASE, law=law)
    controller, x = begun(scene, tuning, 4)
    other, _ = begun(scene, tuning, 4)

    def fail(*_):
        raise stopped_by("half way")

    with monkeypatch.context() as patch:
        patch.setattr(Foresight, failing, fail)
        with pytest.raises(stopped_by, match="half way"):
            controller.retune(replace(tuning, horizon=9, input_weight=10.0, velocity_weight=50.0))
    assert controller.tuning is tuning
    for k in (4, 5):
        found, expected = controller.step(k, x), other.step(k, x)
        np.testing.assert_array_equal(found.plan.inputs, expected.plan.inputs)
        assert (found.plan.status, found.plan.fallback) == (expected.plan.status, expected.plan.fallback)


def test_a_controller_is_retuned_before_its_start_and_copied_as_it_is_tuned_now(scene):
    tuning = TUNINGS["along the plan"]
    early = make_controller(scene.tuned(BASE))
    early.retune(tuning)
    late, x = begun(scene, BASE, 4)
    late.retune(tuning)
    new = make_controller(scene.tuned(tuning))
    decisions = []
    for controller in (new, early, pickle.loads(pickle.dumps(late))):
        assert controller.tuning == tuning
        controller.start(scene.start())
        decisions.append([controller.step(k, x).u for k in range(2)])
    for one in decisions[1:]:
        np.testing.assert_array_equal(one, decisions[0])
