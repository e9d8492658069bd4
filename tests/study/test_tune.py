"""The search for a tuning: scored against the start, shared, resumable, and believed on other episodes only."""

import json
import random
import re
import shutil
import sys
import threading
import tomllib
from concurrent.futures import Future
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import PCRError, load_scene, load_tuning
from pcr_mpc.cli import main
from pcr_mpc.errors import StudyError
from pcr_mpc.report.studies.trade_off import pareto
from pcr_mpc.study.episodes.episodes import EXACT, Spread
from pcr_mpc.study.tuning import score as tuning_score
from pcr_mpc.study.tuning import space as tuning_space
from pcr_mpc.study.tuning import study as tuning_study
from pcr_mpc.study.tuning.file import default_path, to_tune, write_tuning
from pcr_mpc.study.tuning.score import Costs, measure, score
from tests.conftest import CONTROLLERS, MODELS

from .test_parallel import Here

pytest.importorskip("optuna")
pytestmark = pytest.mark.usefixtures("quick_storage")

START = Costs(10.0, 0.04, 100.0, 250.0, 1.0, 0.25, 0.0)


class Shuffled(Here):
    """Results are ready when they like."""

    def submit(self, task, /, *arguments, **keywords):
        done, late = super().submit(task, *arguments, **keywords), Future()
        threading.Timer(random.uniform(0.0, 0.02), lambda: late.set_result(done.result())).start()
        return late


@pytest.fixture(scope="module")
def scene():
    scene = load_scene(MODELS / "scenes" / "lemniscate.toml").tuned(load_tuning(CONTROLLERS / "measured.toml"))
    return replace(scene, duration=0.1)


@pytest.fixture
def search(scene, tmp_path):
    return tuning_space.Search(scene, Spread(), 2, 0, f"sqlite:///{tmp_path / 'study.db'}")


@pytest.fixture
def counted(monkeypatch):
    """Measured costs replaced by a formula with a known best: an input weight of 0.1; counts the calls."""
    calls = []

    def formula(scene, start, tuning, seeds, spread):
        calls.append((tuning, tuple(seeds)))
        off = abs(np.log10(tuning.input_weight / 0.1))
        return Costs(0.1 + off, 0.1, 10.0, 100.0, 1.0, 0.0, 0.0)

    monkeypatch.setattr(tuning_study, "measure", formula)
    return calls


def test_the_start_scores_one_and_every_cost_counts():
    assert score(START, START) == 1.0
    assert score(replace(START, late=0.5), replace(START, late=0.5)) == 1.0
    for name in ("tracking_mm", "nominal_mm", "effort_rad_s2", "step_time", "failure_rate"):
        assert score(replace(START, **{name: 0.8 * getattr(START, name)}), START) < 1.0, name
        assert score(replace(START, **{name: 1.2 * getattr(START, name)}), START) > 1.0, name
    # A step that does not fit its period is no better than a failure.
    assert score(replace(START, late=0.1), START) > 1.0


def test_no_tracking_makes_up_for_failures_and_no_nanometres_for_tracking():
    sound = replace(START, failure_rate=0.0)
    assert score(replace(sound, tracking_mm=0.0, nominal_mm=0.0, effort_rad_s2=0.0, failure_rate=0.1), sound) > 1.0
    tiny = replace(START, nominal_mm=1e-3)
    assert score(replace(START, nominal_mm=1e-6), tiny) == 1.0
    lost = Costs(np.inf, np.inf, np.inf, np.inf, np.inf, 1.0, 0.0)
    assert np.isfinite(score(lost, START))
    assert score(lost, lost) == 1.0


def test_a_step_that_fits_ten_times_into_its_period_is_fast_enough(scene, monkeypatch):
    """Below that the clock's noise would decide between tunings; above, the share of the period counts."""
    start, times = scene.tuning, {}

    def timed(scene, tuning, seed, spread):
        row = dict.fromkeys(("rms_mm", "effort_rad_s2"), 1.0)
        return {**row, "failure": "", "timing": {"control_cpu_us": times[tuning.horizon, tuning.period], "late": 0.0}}

    monkeypatch.setattr(tuning_score, "run_episode", timed)
    times |= {(10, None): 400.0, (5, None): 900.0, (20, None): 2000.0, (10, 0.005): 2000.0}
    relative = [
        measure(scene, start, replace(start, horizon=horizon, period=period), [0], EXACT).step_time
        for horizon, period in times
    ]
    assert relative == pytest.approx([1.0, 1.0, 2.0, 4.0])


def test_costs_are_those_of_the_episodes(scene):
    start = scene.tuning
    other = replace(start, input_weight=0.1)
    same, changed = (measure(scene, start, tuning, [0, 1], Spread()) for tuning in (start, other))
    assert same.step_time == 1.0
    assert same.failure_rate == 0.0
    assert score(same, same) == 1.0
    assert changed.effort_rad_s2 < same.effort_rad_s2
    assert changed.tracking_mm != same.tracking_mm
    assert measure(scene, start, start, [0], EXACT).tracking_mm == same.nominal_mm
    # Not even begun: all is lost, and nothing is raised.
    lost = measure(scene, start, replace(start, model=replace(start.model, segments=10**6, method="multiple_shooting")),
                   [0], Spread())  # fmt: skip
    assert lost.failure_rate == 1.0
    assert lost.tracking_mm == np.inf


def test_the_first_trial_is_the_start_and_a_second_call_adds(search, counted):
    chosen = tuning_study.tune(search, 12, Here(), progress=False)
    trials = tuning_study.finished_trials(search)
    assert [trial["trial"] for trial in trials] == list(range(13))
    assert trials[0]["score"] == 1.0
    assert trials[0]["input_weight"] == search.start.input_weight
    assert counted[0] == (search.start, (0, 1))
    # Chosen by what it does on episodes that the search has not seen.
    assert counted[-1][1] == (2, 3, 4, 5)
    assert chosen is not None
    least = min(trial["score"] for trial in trials)
    # Of those that are as good as the best, within 1 %, the one with the shortest horizon.
    tied = [trial for trial in trials if trial["score"] < least * np.exp(0.01)]
    wanted = min(tied, key=lambda trial: (trial["horizon"], trial["score"]))
    assert (chosen.trial, chosen.score) == (wanted["trial"], wanted["score"])
    assert chosen.score < 1.0
    assert chosen.confirmed == pytest.approx(chosen.score)
    assert 0.001 < chosen.tuning.input_weight < 10.0
    before = len(counted)
    tuning_study.tune(search, 3, Here(), progress=False)
    assert len(tuning_study.finished_trials(search)) == 16
    assert len([call for call in counted[before:] if call[1] == (0, 1)]) == 3


def test_guesses_come_first_and_the_known_tuning_before_them(search, counted):
    """Those of an expert, as far as the scene has room for them, and none twice."""
    known = replace(search.start, name="lemniscate", horizon=7, velocity_weight=2.5)
    search = replace(search, known=known)
    guesses = tuning_space.guesses(search)
    assert len(guesses) == 1 + len(tuning_space.GUESSES)
    tuning_study.tune(search, len(guesses) + 2, Here(), progress=False)
    tried = [tuning for tuning, seeds in counted if seeds == (0, 1)]
    assert tried[0] == search.start
    assert tried[1] == replace(known, name=search.start.name)
    assert tried[1 : 1 + len(guesses)] == [tuning_space.candidate(search, guess) for guess in guesses]
    robust = load_tuning(CONTROLLERS / "robust.toml")
    assert replace(robust, name=search.start.name) in tried
    assert len(set(tried)) == len(guesses) + 3


def test_guesses_that_the_scene_has_no_room_for_are_left_out(search):
    late = replace(search, scene=replace(search.scene, delay=2))
    assert tuning_space.space(late) == tuning_space.space(replace(search, keep_period=True))
    assert 0 < len(tuning_space.guesses(late)) < len(tuning_space.GUESSES)
    blind = replace(search, scene=replace(search.scene, tuning=replace(search.start, observer=None)))
    for one in (late, blind):
        names = set(tuning_space.space(one))
        assert all(set(guess) == names for guess in tuning_space.guesses(one))
    far = replace(search, known=replace(search.start, horizon=99))
    assert tuning_space.guesses(far) == tuning_space.guesses(search)


def test_trials_do_not_depend_on_who_runs_them(search, counted, tmp_path):
    """In turn, or by threads that finish as they like: the same trials, after the guesses, too."""
    again = replace(search, storage=f"sqlite:///{tmp_path / 'again.db'}")
    tuning_study.tune(search, 20, Here(), progress=False)
    with Shuffled() as executor:
        tuning_study.tune(again, 20, executor, progress=False)
    assert tuning_study.finished_trials(again) == tuning_study.finished_trials(search)


def test_a_trial_without_a_result_is_named_and_the_others_are_kept(search, counted, monkeypatch):
    formula = tuning_study.measure

    def failing(*arguments, **keywords):
        if len(counted) == 3:
            counted.append(None)
            raise ArithmeticError("lost")
        return formula(*arguments, **keywords)

    monkeypatch.setattr(tuning_study, "measure", failing)
    with pytest.raises(StudyError, match=r"1 of 6 trials ended without a result.*trial 3: ArithmeticError: lost"):
        tuning_study.tune(search, 6, Here(), progress=False)
    assert [row["trial"] for row in tuning_study.finished_trials(search)] == [0, 1, 2, 4, 5, 6]


def test_what_does_not_last_on_other_episodes_is_not_chosen(search, counted, monkeypatch):
    formula = tuning_study.measure

    def lucky(scene, start, tuning, seeds, spread):
        costs = formula(scene, start, tuning, seeds, spread)
        return costs if tuple(seeds) == (0, 1) or tuning == start else replace(costs, failure_rate=1.0)

    monkeypatch.setattr(tuning_study, "measure", lucky)
    assert tuning_study.tune(search, 5, Here(), progress=False) is None
    assert min(trial["score"] for trial in tuning_study.finished_trials(search)) < 1.0


def test_of_equals_the_shorter_horizon_is_chosen(search, counted, monkeypatch):
    formula = tuning_study.measure

    def flat(scene, start, tuning, seeds, spread):
        costs = formula(scene, start, tuning, seeds, spread)
        if tuning == start:
            return costs
        return replace(costs, tracking_mm=0.5 + 1e-4 * abs(tuning.horizon - 20))

    monkeypatch.setattr(tuning_study, "measure", flat)
    chosen = tuning_study.tune(search, 8, Here(), progress=False)
    trials = tuning_study.finished_trials(search)
    assert min(trials, key=lambda row: row["score"])["horizon"] == 20
    assert chosen.tuning.horizon == min(row["horizon"] for row in trials) == 4


def test_an_interrupted_study_goes_on(search, counted, monkeypatch):
    formula = tuning_study.measure

    def interrupted(*arguments, **keywords):
        if len(counted) == 3:
            raise KeyboardInterrupt
        return formula(*arguments, **keywords)

    monkeypatch.setattr(tuning_study, "measure", interrupted)
    with pytest.raises(KeyboardInterrupt, match=r"3 trials are kept in sqlite:.*the same command adds"):
        tuning_study.tune(search, 6, Here(), progress=False)
    monkeypatch.setattr(tuning_study, "measure", formula)
    tuning_study.tune(search, 4, Here(), progress=False)
    assert len(tuning_study.finished_trials(search)) == 7


def test_other_settings_are_refused(search, counted):
    tuning_study.tune(search, 1, Here(), progress=False)
    with pytest.raises(StudyError, match=r"study lemniscate with other settings: episodes was 2, is 3"):
        tuning_study.tune(replace(search, episodes=3), 1, Here(), progress=False)


def test_trials_stay_within_what_the_scene_allows(search, counted):
    late = replace(search, scene=replace(search.scene, delay=2))
    tuning_study.tune(late, 10, Here(), progress=False)
    assert {tuning.period for tuning, _ in counted} == {None}
    assert len({tuning.horizon for tuning, _ in counted}) > 3
    assert {tuning.model.linearise for tuning, _ in counted} == {"here", "along_plan"}
    trials = tuning_study.finished_trials(late)[1:]
    assert {row["weigh_velocity"] for row in trials} == {False, True}
    searched = [tuning for tuning, seeds in counted if seeds == (0, 1)][1:]
    assert [t.velocity_weight > 0 for t in searched] == [row["weigh_velocity"] for row in trials]


def test_the_period_is_searched_where_there_is_no_delay(search, counted):
    tuning_study.tune(search, 15, Here(), progress=False)
    assert {tuning.period for tuning, _ in counted} == {None, 0.005, 0.02}


def test_only_the_linear_mpc_is_tuned(search):
    pd = replace(search, scene=replace(search.scene, tuning=replace(search.start, law="pd")))
    with pytest.raises(ValueError, match="has law 'pd'"):
        tuning_study.tune(pd, 1, Here(), progress=False)


def test_without_optuna_it_says_what_to_install(search, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(PCRError, match=r"pip install pcr_mpc\[tune\]"):
        tuning_study.tune(search, 1, Here(), progress=False)
    with pytest.raises(PCRError, match=r"pip install pcr_mpc\[tune\]"):
        tuning_space.space(search)


def test_a_written_tuning_reads_back(tmp_path):
    tuning = load_tuning(CONTROLLERS / "measured.toml")
    path = tmp_path / "new" / "mine.toml"
    model = replace(tuning.model, linearise="along_plan", predict_delay=False, segments=4, method="multiple_shooting",
                    scheme="rk4", steps=2, inertia="constant")  # fmt: skip
    observer = replace(tuning.observer, tip_noise=2e-5, force_walk=3e-5, force_noise=0.5)
    full = replace(tuning, name="mine", period=0.005, velocity_weight=1.23e-7, angle_weight=0.5, horizon=30,
                   tolerance=1e-9, fallback="raise", model=model, observer=observer)  # fmt: skip
    for one in (full, replace(full, observer=None, period=None)):
        write_tuning(one, path, ["Where it comes from.", "  Figures: 1"])
        assert load_tuning(path) == one
        assert path.read_text().startswith("# Where it comes from.\n#   Figures: 1\n")
    before = path.read_text()
    with pytest.raises(StudyError, match="cannot write"):
        write_tuning(replace(full, law="pd", pd=(1.0, 2.0)), path, [])
    assert path.read_text() == before
    assert [file.name for file in path.parent.iterdir()] == ["mine.toml"]


def test_the_tuning_of_a_scene_belongs_beside_its_own():
    assert default_path(MODELS / "scenes" / "limited.toml", "limited") == CONTROLLERS / "limited.toml"


def test_pareto_front():
    x, y = np.array([3.0, 1.0, 2.0, 2.0, 4.0]), np.array([1.0, 5.0, 3.0, 4.0, 1.0])
    assert pareto(x, y).tolist() == [[1.0, 5.0], [2.0, 3.0], [3.0, 1.0]]
    assert pareto(x[:0], y[:0]).shape == (0, 2)


@pytest.mark.slow
def test_tune_writes_a_tuning_that_beats_its_start(tmp_path, monkeypatch, capsys):
    """In a process of its own: the start's observer is blind to a heavy load, so every episode of it fails."""
    for folder in (MODELS, CONTROLLERS):
        shutil.copytree(folder, tmp_path / folder.name)
    scene = tmp_path / "models/scenes/pick_and_place.toml"
    text = scene.read_text().replace("duration = 1.6", "duration = 0.3").replace("pick_and_place.toml", "default.toml")
    (tmp_path / "controllers/pick_and_place.toml").unlink()
    scene.write_text(text + "\n[load]\nforce = [2.0, -4.0]\n")
    poor = tmp_path / "controllers/default.toml"
    poor.write_text(poor.read_text().replace("force_walk = 0.005", "force_walk = 1.0e-6"))
    monkeypatch.chdir(tmp_path)
    command = ["tune", str(scene), "--trials", "2", "--jobs", "1", "--episodes", "1", "--json"]
    assert main(command) == 0
    captured = capsys.readouterr()
    assert "2/2" in captured.err
    record = json.loads(captured.out)
    assert record["trials"] == 3
    written = tmp_path / "controllers/pick_and_place.toml"
    assert record["chosen"]["file"] == str(written)
    assert record["chosen"]["score"] < 1.0
    assert record["chosen"]["confirmed"] < 1.0
    tuning = load_tuning(written)
    assert tuning.name == "pick_and_place"
    own = load_scene(scene)
    own.tuned(tuning)
    costs, start = (measure(own, own.tuning, one, [1], Spread()) for one in (tuning, own.tuning))
    assert score(costs, start) < 1.0
    text = written.read_text()
    assert tomllib.loads(text)["law"] == "linear_mpc"
    for words in (
        'the scene "pick_and_place"',
        "seeds 1 to 2",
        f"Score {record['chosen']['confirmed']:.3f}",
        "code at",
    ):
        assert words in text
    assert (tmp_path / "results/tune/pick_and_place/trade_off.png").stat().st_size > 10_000
    assert len((tmp_path / "results/tune/pick_and_place/trials.csv").read_text().splitlines()) == 4


def test_a_new_robot_s_tuning_bears_its_name_and_is_what_is_tuned(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "mine", "--length", "0.5"]) == 0
    scene, known = to_tune(tmp_path / "mine" / "scene.toml")
    assert scene.tuning.name == scene.name == "mine"
    assert known is None


def test_a_scene_that_was_tuned_is_tuned_from_the_default_again(tmp_path, monkeypatch):
    """What was found before is tried first, but what is to be beaten is the same as then."""
    for folder in (MODELS, CONTROLLERS):
        shutil.copytree(folder, tmp_path / folder.name)
    scene = tmp_path / "models/scenes/hold_with_load.toml"
    scene.write_text(re.sub(r"controllers/\w+\.toml", "controllers/hold_with_load.toml", scene.read_text()))
    default = load_tuning(CONTROLLERS / "default.toml")
    known = replace(default, name="hold_with_load", period=0.005, horizon=14)
    write_tuning(known, tmp_path / "controllers/hold_with_load.toml", [], force=True)
    monkeypatch.chdir(tmp_path)
    searches = []

    def stopped(search, *_):
        searches.append(search)
        raise PCRError("enough")

    monkeypatch.setattr("pcr_mpc.cli.study.tune", stopped)
    assert main(["tune", str(scene)]) == 1
    assert main(["tune", str(scene), "--start", str(CONTROLLERS / "slow_motors.toml")]) == 1
    assert main(["tune", str(MODELS / "scenes/limited.toml"), "--start", str(CONTROLLERS / "default.toml")]) == 1
    assert [search.start for search in searches] == [default, load_tuning(CONTROLLERS / "slow_motors.toml"), default]
    assert [search.scene.period for search in searches] == [0.01] * 3
    assert [search.known for search in searches[:2]] == [known] * 2


def test_tune_without_success_writes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pcr_mpc.cli.study.tune", lambda *_: None)
    monkeypatch.setattr("pcr_mpc.cli.study.finished_trials", lambda _: [
        {"trial": 0, "score": 1.0, **START.row()}, {"trial": 1, "score": 1.5, **START.row()}])  # fmt: skip
    out = tmp_path / "tuned.toml"
    assert main(["tune", str(MODELS / "scenes/lemniscate.toml"), "--trials", "1", "--out", str(out)]) == 0
    assert "none of 2 trials beats default: no tuning is written" in capsys.readouterr().out
    assert not out.exists()
    assert main(["tune", str(MODELS / "scenes/lemniscate.toml"), "--trials", "0"]) == 1
    assert "--trials is 0, expected at least 1" in capsys.readouterr().err
