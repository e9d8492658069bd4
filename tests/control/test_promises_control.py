"""What the docstrings of observer, laws, tuning and limits promise, one promise a test."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from pcr_mpc import LinearModel, ModelError, Reference, Tuning, load_tuning
from pcr_mpc.control.laws import LQR, PD, FeedForward
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.control.observer import DisturbanceObserver, ObserverTuning
from pcr_mpc.control.tuning import Model
from tests.conftest import CONTROLLERS

DT = 0.01


@pytest.fixture(scope="module")
def model() -> LinearModel:
    """A mass of 0.5 kg on springs of 80 and 120 N/m that the motors move, to second order in dt; no rods needed."""
    mass, k, g = 0.5, np.diag([80.0, 120.0]), np.array([[10.0, -4.0], [3.0, 9.0]])
    a, b = np.eye(6), np.zeros((6, 2))
    a[:2, 2:4] = DT * np.eye(2)
    a[2:4, :2], a[2:4, 4:] = -DT / mass * k, -DT / mass * g
    a[:2] += DT / 2 * (a[2:4] - np.eye(6)[2:4])
    b[4:] = DT * np.eye(2)
    e = np.vstack([DT**2 / 2 / mass * np.eye(2), DT / mass * np.eye(2), np.zeros((2, 2))])
    return LinearModel(a, b, np.zeros(6), e, DT, np.zeros(2))


@pytest.fixture(scope="module")
def tuning() -> Tuning:
    return load_tuning(CONTROLLERS / "default.toml")


# Observer


@pytest.fixture
def observer(model):
    observer = DisturbanceObserver(ObserverTuning(), 1e-5, 0.02, model)
    observer.start(np.array([0.1, 0.2, 0.0, 0.0, 1.0, 2.0]))
    return observer


@pytest.mark.parametrize("side", [-1, 1])
def test_an_angle_is_known_to_half_a_step_of_its_encoder(observer, side):
    """Within the interval the prediction stays; outside it moves to the nearest edge, which is half a step away."""
    p = observer.x[:2].copy()
    for off, left in ((0.009, 0.0), (0.011, 0.001), (0.5, 0.49)):
        observer.start(np.array([0.1, 0.2, 0.0, 0.0, 1.0, 2.0]))
        observer.correct(p, np.array([1.0 + side * off, 2.0]))
        assert observer.x[4:] == pytest.approx([1.0 + side * left, 2.0], abs=1e-12)


def test_a_start_is_a_copy_without_a_force(observer):
    observer.correct(np.array([0.2, 0.1]), np.array([1.0, 2.0]))
    assert np.abs(observer.force).min() > 0
    x = np.arange(6.0)
    observer.start(x)
    assert observer.force.tolist() == [0.0, 0.0]
    observer.correct(np.array([5.0, 5.0]), x[4:])
    assert x.tolist() == np.arange(6.0).tolist()


def test_no_surprise_no_change(observer):
    before = observer.x.copy()
    observer.correct(before[:2], before[4:])
    assert (observer.x == before).all()
    assert not observer.force.any()


def test_what_is_not_measured_is_as_predicted(observer):
    x, found = observer.x.copy(), []
    tip, angles = x[:2] + [1e-3, -2e-3], x[4:] + 0.05
    for p, q in ((tip, None), (tip, x[4:]), (None, angles), (x[:2], angles), (None, None)):
        observer.start(x)
        observer.correct(p, q)
        found.append([*observer.x, *observer.force])
    assert found[0] == found[1] != found[4]
    assert found[2] == found[3] != found[4]
    assert found[4] == [*x, 0.0, 0.0]


@pytest.mark.parametrize("sign", [-1, 1])
def test_an_unknown_force_is_found_with_its_sign(observer, model, sign):
    force, x = sign * np.array([0.3, -0.2]), observer.x.copy()
    for _ in range(400):
        x = model(x, np.zeros(2)) + model.E @ force
        observer.predict(replace(model, c=model.E @ observer.force), np.zeros(2))
        observer.correct(x[:2], x[4:])
    assert observer.force == pytest.approx(force, rel=1e-3)
    assert observer.x == pytest.approx(x, abs=1e-6)


def test_the_greater_of_two_noises_counts(model):
    def gain(believed, sensor):
        return DisturbanceObserver(ObserverTuning(tip_noise=believed), sensor, 0.0, model).gain

    assert (gain(1e-3, 1e-5) == gain(1e-5, 1e-3)).all()
    assert (gain(1e-3, 1e-5) == gain(1e-3, 1e-3)).all()
    assert gain(1e-3, 0.0)[0, 0] < 0.9 * gain(1e-5, 0.0)[0, 0]  # the noisier, the less is believed


# Laws


@pytest.fixture
def limits():
    return Limits(2.0, 0.5, np.array([-9.0, -9.0]), np.array([9.0, 9.0]))


def displaced(tuning, proportional, derivative, x, reference):
    """Tip, angles and force that a PD law asks the inverse statics for."""
    asked = []

    def inverse(p, q, force):
        asked.append((p, q, force))
        return q

    law = PD(
        replace(tuning, pd=(proportional, derivative)), Limits(9.0, 9.0, *np.array([[-9.0] * 2, [9.0] * 2])), inverse
    )
    law.prepare(LinearModel(np.eye(6), np.zeros((6, 2)), np.zeros(6), np.zeros((6, 2)), DT, np.zeros(2)))
    plan = law.solve(x, None, reference, np.zeros(2))
    return (*asked[0], plan)


@pytest.mark.parametrize("sign", [-1, 1])
def test_pd_leads_the_tip_against_error_and_rate(tuning, sign):
    """A tip that is ahead, or too fast, is led back: by the gains times error and rate, each by itself."""
    wanted = np.array([0.1, 0.2, 0.3, -0.1, 1.0, 2.0])
    reference = Reference(wanted[None], np.zeros((1, 2)), np.array([[0.4, 0.5]]))
    now = wanted.copy()
    now[:2] -= DT * wanted[2:4]  # where the reference is one period before
    ahead, fast = now.copy(), now.copy()
    ahead[:2] += sign * np.array([1e-3, 2e-3])
    fast[2:4] += sign * np.array([0.1, 0.2])
    p, q, force, plan = displaced(tuning, 0.5, 0.02, now, reference)
    assert p == pytest.approx(wanted[:2])
    assert (q.tolist(), force.tolist()) == ([1.0, 2.0], [0.4, 0.5])
    assert plan.inputs == pytest.approx(np.zeros((1, 2)), abs=1e-9)
    assert displaced(tuning, 0.5, 0.02, ahead, reference)[0] == pytest.approx(
        wanted[:2] - sign * np.array([5e-4, 1e-3])
    )
    assert displaced(tuning, 0.5, 0.02, fast, reference)[0] == pytest.approx(wanted[:2] - sign * np.array([2e-3, 4e-3]))


@pytest.mark.parametrize("law", [LQR, FeedForward])
def test_one_step_laws_keep_every_limit_and_fall_back_to_rest(model, tuning, limits, law):
    law = law(tuning, replace(limits, angle_upper=np.array([1.003, 9.0])))
    law.prepare(model)
    x = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0])
    reference = Reference(x[None], np.array([[50.0, -50.0]]))
    plan = law.solve(x, model, reference, np.array([0.2, -0.2]))
    assert (plan.status, plan.fallback, plan.states, plan.models) == ("solved", None, None, model)
    assert plan.inputs == pytest.approx(np.array([[0.3, -0.7]]))  # the stop, and the change of rate
    fallen = law.fall_back("no measurement", np.full(6, np.nan), reference, np.array([1.2, -0.2]))
    if isinstance(law, LQR):
        assert (fallen.status, fallen.fallback) == ("no measurement", "hold")
        assert fallen.inputs == pytest.approx(np.array([[0.7, 0.0]]))
    else:
        assert fallen.fallback is None
        assert fallen.inputs == pytest.approx(np.array([[1.7, -0.7]]))


# Limits of motors


def test_met_by_names_what_is_in_the_way(limits):
    previous = np.array([1.8, 0.0])
    for u, met in (
        ([2.0, 0.0], ("rate",)),
        ([-2.0, 0.0], ("rate", "rate change")),
        ([1.8, 0.5], ("rate change",)),
        ([1.8, -0.5], ("rate change",)),
        ([1.8, 0.1], ("angle",)),
    ):
        assert limits.met_by(np.array(u), previous) == met


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rate": 0.0}, "rate = 0.0"), ({"rate": -1.0}, "rate = -1.0"), ({"rate": math.nan}, "rate = nan"),
        ({"rate_change": 0.0}, "rate_change = 0.0"), ({"rate_change": math.nan}, "rate_change = nan"),
        ({"angle_lower": np.array([0.0, 9.1])}, "lower <= upper"),
        ({"angle_lower": np.array([0.0, math.nan])}, "lower <= upper"),
        ({"angle_lower": np.zeros(3)}, "must be vectors"), ({"angle_upper": np.zeros((2, 1))}, "must be vectors"),
    ],
)  # fmt: skip
def test_limits_that_make_no_sense_are_refused(limits, change, message):
    with pytest.raises(ValueError, match=message):
        replace(limits, **change)
    assert replace(limits, rate=math.inf, angle_lower=limits.angle_upper).rate == math.inf


# Tuning


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("position_weight", (0.0, -1.0, math.nan, math.inf)),
        ("input_weight", (0.0, -1e-9, math.nan)),
        ("tolerance", (0.0, -1e-5)),
        ("velocity_weight", (-1e-9, math.nan)),
        ("angle_weight", (-1e-9, math.inf)),
        ("horizon", (0, -1, 2.0, True)),
        ("max_iterations", (0, 1.5)),
        ("law", ("mpc", "")),
        ("fallback", ("none", "")),
        ("period", (0.0, -0.01, math.nan)),
        ("pd", ((math.nan, 0.0), (0.0, math.inf))),
    ],
)
def test_a_tuning_that_makes_no_sense_is_refused(tuning, name, values):
    for value in values:
        with pytest.raises(ValueError, match=name):
            replace(tuning, **{name: value})
    assert replace(tuning, velocity_weight=0.0, angle_weight=0.0, horizon=1, max_iterations=1).horizon == 1


def test_what_a_model_or_an_observer_cannot_be_is_refused():
    for name in ("method", "scheme", "inertia", "linearise", "angles"):
        with pytest.raises(ValueError, match=f"{name} is 'magic', expected one of"):
            Model(**{name: "magic"})
    for field in fields(ObserverTuning):
        # No latency is one, too; and what is adapted are names.
        for value in {"adapts": (("inertia",),), "latency": (-1e-9, math.nan)}.get(field.name, (0.0, -1e-9, math.nan)):
            with pytest.raises(ValueError, match=field.name):
                ObserverTuning(**{field.name: value})


TOML = {
    "name": '"t"', "horizon": "7", "period": "0.02", "weights": {"position": "2.0", "velocity": "3.0", "angle": "4.0",
    "input": "5.0"}, "solver": {"name": '"daqp"', "tolerance": "1e-6", "max_iterations": "11", "fallback": '"raise"'},
    "model": {"method": '"multiple_shooting"', "segments": "3", "steps": "2", "scheme": '"rk4"',
    "inertia": '"condensed"', "linearise": '"along_plan"', "payload": "false", "predict_delay": "false",
    "angles": '"commanded"', "motor_lag": "0.04", "compiled": "false"},
    "observer": {"on": "true", "tip_noise": "1e-4", "force_noise": "0.02", "force_walk": "0.03",
    "adapts": '["stiffness"]', "adapt_walk": "0.05"},
}  # fmt: skip


def written(path, values, changes=()):
    values = {key: dict(value) if isinstance(value, dict) else value for key, value in values.items()}
    for table, key, value in changes:
        (values[table] if table else values)[key] = value
    lines = [f"{key} = {value}" for key, value in values.items() if not isinstance(value, dict)]
    for table, entries in values.items():
        if isinstance(entries, dict):
            lines += [f"[{table}]", *(f"{key} = {value}" for key, value in entries.items())]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_every_setting_of_a_file_arrives(tmp_path):
    """Each number differs from the others and from every default, so that none can be taken for another."""
    tuning = load_tuning(written(tmp_path / "t.toml", TOML))
    assert (tuning.name, tuning.horizon, tuning.period, tuning.fallback) == ("t", 7, 0.02, "raise")
    assert (tuning.position_weight, tuning.velocity_weight, tuning.angle_weight, tuning.input_weight) == (2, 3, 4, 5)
    assert (tuning.solver, tuning.tolerance, tuning.max_iterations) == ("daqp", 1e-6, 11)
    assert [getattr(tuning.model, f.name) for f in fields(tuning.model)] == [
        "multiple_shooting", 3, 2, "rk4", "condensed", "along_plan", False, False, "commanded", 0.04, False,
    ]  # fmt: skip
    assert tuning.observer == ObserverTuning(1e-4, 0.02, 0.03, ("stiffness",), 0.05)
    late = load_tuning(written(tmp_path / "t.toml", {**TOML, "observer": {"on": "true", "latency": "0.06"}}))
    assert late.observer == replace(ObserverTuning(), latency=0.06)
    assert load_tuning(written(tmp_path / "t.toml", TOML, [("observer", "on", "false")])).observer is None
    # A period of none is the scene's.
    assert load_tuning(written(tmp_path / "t.toml", TOML, [("", "period", "0")])).period is None


@pytest.mark.parametrize(
    ("table", "key", "value"),
    [
        ("weights", "position", "0.0"), ("weights", "position", "-1.0"), ("weights", "velocity", "-1.0"),
        ("weights", "angle", "-1.0"), ("weights", "input", "0.0"), ("weights", "input", "-1.0"),
        ("solver", "tolerance", "0.0"), ("solver", "max_iterations", "1.5"), ("solver", "fallback", '"none"'),
        ("observer", "tip_noise", "0.0"), ("observer", "force_noise", "-0.1"), ("observer", "force_walk", "0.0"),
        ("observer", "on", "1"), ("model", "method", '"magic"'), ("model", "method", '"single_shooting"'),
        ("model", "scheme", '"rk2"'),
        ("model", "inertia", '"full"'), ("model", "linearise", '"everywhere"'), ("model", "payload", "0"),
        ("", "period", "-0.01"), ("", "law", '"mpc"'), ("", "horizon", "7.0"), ("weights", "positoin", "1.0"),
    ],
)  # fmt: skip
def test_a_file_that_makes_no_sense_is_refused_by_its_key(tmp_path, table, key, value):
    with pytest.raises(ModelError, match=key):
        load_tuning(written(tmp_path / "t.toml", TOML, [(table, key, value)]))


def test_laws_without_a_horizon_need_none(tmp_path):
    base = {"name": '"t"', "weights": {"position": "1.0", "input": "1.0"}}
    lqr = load_tuning(written(tmp_path / "t.toml", {**base, "law": '"lqr"'}))
    assert (lqr.horizon, lqr.law, lqr.pd) == (1, "lqr", (0.0, 0.0))
    pd = load_tuning(written(tmp_path / "t.toml", {"name": '"t"', "law": '"pd"', "pd": {"position": "0.5"}}))
    assert (pd.horizon, pd.pd, pd.position_weight, pd.input_weight) == (1, (0.5, 0.0), 1.0, 1.0)
    with pytest.raises(ModelError, match="horizon"):
        load_tuning(written(tmp_path / "t.toml", base))
