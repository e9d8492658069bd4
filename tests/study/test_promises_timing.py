"""What timing and tuning promise to name and to draw; on made-up times and costs."""

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pcr_mpc import load_scene, load_tuning
from pcr_mpc.control.plan import Plan
from pcr_mpc.errors import CompilerError
from pcr_mpc.loop.controller.tracking import TrackingController
from pcr_mpc.loop.parts.controllers import Decision
from pcr_mpc.report.timing import timing_tables
from pcr_mpc.study.episodes.spread import Spread
from pcr_mpc.study.timing import timing
from pcr_mpc.study.timing.stopwatch import WARM_UP
from pcr_mpc.study.tuning.score import Costs
from tests.conftest import CONTROLLERS, MODELS

from .test_parallel import Here


@pytest.fixture(scope="module")
def scene():
    scene = load_scene(MODELS / "scenes" / "lemniscate.toml").tuned(load_tuning(CONTROLLERS / "default.toml"))
    return replace(scene, duration=0.1)


def busy(seconds):
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        pass


@pytest.fixture
def timed(scene, monkeypatch):
    """Timing of a controller whose parts say what they took, and that takes a millisecond besides."""
    steps = []

    def step(self, k, x):
        steps.append(k)
        busy(1e-3)
        iterations = 5 if len(steps) % 2 else 10
        return Decision(np.zeros(2), Plan(np.zeros((1, 2)), None, None, "solved", iterations=iterations,
                                          update_time=2e-6, solve_time=7e-6, solver_time=4e-6), 1e-6)  # fmt: skip

    monkeypatch.setattr(TrackingController, "start", lambda self, pose: None)
    monkeypatch.setattr(TrackingController, "step", step)
    monkeypatch.setattr(timing, "_plants", lambda scene: [])
    monkeypatch.setattr(timing, "call_overhead", lambda *_: [{"name": "graph", "code": "interpreted", "us": 1.25}])
    return timing.time_scene(scene, 60)


def test_parts_of_a_control_step_have_their_own_names(timed):
    parts = timed["control_parts"]
    assert list(parts) == ["look ahead", "QP update", "QP handed over", "inside OSQP", "rest"]
    stated = {"look ahead": 1.0, "QP update": 2.0, "QP handed over": 3.0, "inside OSQP": 4.0}
    assert {name: parts[name] for name in stated} == pytest.approx(stated)
    assert parts["rest"] > 980
    components = {one["name"]: one for one in timed["components"]}
    for name, us in stated.items():
        assert (components[name]["p50"], components[name]["n"]) == (pytest.approx(us), 60 - WARM_UP)
    assert components["control step"]["p50"] >= components["rest"]["p50"]
    assert {row["iterations"] for row in timed["iterations"]} == {5, 10}
    assert "control step between plant steps" in components


def test_timing_in_words_has_units_budgets_and_shares(timed):
    text = timing_tables(timed)
    rows = {line.split("  ")[0].strip(): line for line in text.splitlines()}
    assert rows["look ahead"].split()[-3:] == ["1.0", "0", "%"]
    for words in ("wall time [us]", "deadlines missed", "100 Hz", "200 Hz", "500 Hz", "QP iterations", "mean [us]",
                  "relative error of F along the run", "casadi"):  # fmt: skip
        assert words in text
    assert rows["graph"].split()[-1] == "1.25"


def test_c_stands_beside_python_or_it_is_said_why_not(scene, monkeypatch):
    monkeypatch.setattr(timing, "_plants", lambda scene: [])
    monkeypatch.setattr(timing, "_solvers", lambda *_: [])
    monkeypatch.setattr(timing, "call_overhead", lambda *_: [{"name": "graph", "code": "interpreted", "us": 1.25}])
    asked = []

    def in_c(scene, solver, steps):
        asked.append((solver, steps))
        if solver == "daqp":
            raise CompilerError("there is no compiler")
        times = np.full((steps, 2), [44e-6, 55e-6])
        worst = {"iterations": 500, "flops": 2000, "iteration_us": 0.5, "rest_us": 30.0, "us": 280.0}
        return {"control": times, "plant": times / 4, "worst": worst}

    found = timing.time_scene(scene, 200, in_c=in_c)
    assert asked == [("osqp", 200), ("daqp", 40)]
    times = {(one["name"], one["method"]): one for one in found["components"]}
    control, plant = times["control step", "C, OSQP"], times["plant step", "C"]
    assert (control["p99.9"], control["cpu"]["p50"], control["n"]) == (pytest.approx(55), pytest.approx(44), 180)
    assert plant["cpu"]["max"] == pytest.approx(11)
    assert sum(found["histogram"]["control step in C"]["no collector"]) == 180
    text = timing_tables(found)
    rows = {line.split("  ")[0].strip(): line.split() for line in text.splitlines()}
    assert rows["control step, C, OSQP"][-6:] == ["44.0", "44.0", "44.0", "44.0", "44.0", "180"]
    assert rows["control step, Python"][-1] == "180"
    assert "500 iterations x 0.5 us (all soft rows, 2e+03 operations) + 30 us = 280 us" in text
    assert "no times of C with DAQP: there is no compiler" in text


def test_times_beyond_the_ends_count_at_the_ends(scene, monkeypatch):
    wall = np.concatenate([np.full(WARM_UP, 1e-3), [1e-9, 50e-6, 50e-6, 10.0]])
    times = timing.Times(wall, wall, np.arange(len(wall)) % 2 == 0, np.empty(0))
    counts = timing._counts(times)
    both = np.array(counts["collector on"]) + counts["collector off"]
    assert both.sum() == 4
    assert (both[0], both[-1], both.max()) == (1, 1, 2)
    assert sum(counts["collector on"]) == 2


def test_each_method_is_called_as_often_as_is_said_and_has_its_error(monkeypatch):
    """By multiple shooting a fifth of the steps, by single shooting a hundredth."""
    calls = []

    def counted(plant, run, n):
        calls.append((plant.method, n))
        return SimpleNamespace(record=lambda name, method, *_: {"name": name, "method": method})

    monkeypatch.setattr(timing, "_plant_times", lambda plant, scene, run, n, label: counted(plant, run, n))
    monkeypatch.setattr(timing, "_force_times", counted)
    monkeypatch.setattr(timing, "_counts", lambda times: {})
    monkeypatch.setattr(timing, "call_overhead", lambda *_: [])
    release = replace(load_scene(MODELS / "scenes" / "release.toml"), duration=0.1)
    found = timing.time_scene(release, 10_000)
    each = [("closed_form", 10_000), ("multiple_shooting", 2_000), ("single_shooting", 100)]
    assert calls == [(release.plant.method, 10_000)] + [call for call in each for _ in range(2)]
    errors = {c["method"]: c["force_error"] for c in found["components"] if c["name"] == "plant step"}
    assert errors["closed_form"] < 1e-11
    assert 1e-10 < errors["multiple_shooting"] < 1e-5
    assert 0.0 < errors["single_shooting"] < 1e-4


# --- tuning -----------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("quick_storage")
def test_the_sampler_has_the_seed_of_the_search(scene, tmp_path, monkeypatch):
    """Another seed, other trials; that the same gives the same is tested elsewhere."""
    pytest.importorskip("optuna")
    from pcr_mpc.study.tuning import space as tuning_space
    from pcr_mpc.study.tuning import study as tuning_study

    monkeypatch.setattr(tuning_study, "measure", lambda *_, **__: Costs(1.0, 0.1, 10.0, 100.0, 1.0, 0.0, 0.0))
    monkeypatch.setattr(tuning_study, "guesses", lambda search: [])
    found = []
    for number, seed in enumerate((0, 1)):
        search = tuning_space.Search(scene, Spread(), 2, seed, f"sqlite:///{tmp_path / f'{number}.db'}")
        tuning_study.tune(search, 2, Here(), progress=False)
        rows = tuning_study.finished_trials(search)[1:]
        found.append([row["input_weight"] for row in rows])
    assert len(set(found[0] + found[1])) == 4  # nor is it the same draw for each trial


def test_episodes_of_a_search_are_its_own(scene):
    pytest.importorskip("optuna")
    from pcr_mpc.study.tuning.space import Search

    search = Search(scene, Spread(), 3, 10, "")
    assert list(search.seeds) == [10, 11, 12]
    assert list(search.other_seeds) == [13, 14, 15, 16, 17, 18]
    with pytest.raises(ValueError, match="nothing to track; what is tuned is the law"):
        _ = Search(replace(scene, tuning=None), Spread(), 3, 10, "").start


def test_parameters_become_tunings_of_three_digits_and_back(scene):
    pytest.importorskip("optuna")
    from pcr_mpc.study.tuning.space import Search, candidate, parameters, space

    search = Search(scene, Spread(), 3, 0, "")
    params = {**parameters(search, search.start), "input_weight": 0.0123456, "velocity_weight": 1.23456,
              "weigh_velocity": True, "force_noise": 0.0199999, "horizon": 7, "period": 0.005}  # fmt: skip
    tuning = candidate(search, params)
    assert (tuning.input_weight, tuning.velocity_weight, tuning.horizon, tuning.period) == (0.0123, 1.23, 7, 0.005)
    assert tuning.observer.force_noise == 0.02
    assert candidate(search, {**params, "weigh_velocity": False}).velocity_weight == 0.0
    assert candidate(search, {**params, "period": scene.period}).period is None
    assert candidate(search, parameters(search, search.start)) == search.start
    far = replace(search, scene=replace(scene, tuning=replace(scene.tuning, horizon=44, input_weight=200.0)))
    ranges = space(far)
    assert (ranges["horizon"].low, ranges["horizon"].high) == (4, 44)
    assert (ranges["input_weight"].low, ranges["input_weight"].high) == (1e-5, 200.0)
    assert "period" not in space(replace(search, keep_period=True))
    assert "period" not in space(replace(search, scene=replace(scene, deadline=0.004)))
    brief = replace(search, scene=replace(scene, duration=0.01))
    assert set(space(brief)["period"].choices) == {0.005, 0.01}


def test_what_was_measured_is_kept_where_c_is_interrupted():
    def stopped(*_):
        raise KeyboardInterrupt

    scene = load_scene(MODELS / "scenes" / "lemniscate.toml")
    assert timing._in_c(stopped, scene, 500, [], {}, progress=False) == [{"solver": "OSQP", "missing": "interrupted"}]
