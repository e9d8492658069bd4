"""A scene that needs a delay margin: read, told, counted, and never undercut."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ModelError, load_scene, load_tuning
from pcr_mpc.report.tables import _margin_lines
from pcr_mpc.study.episodes.spread import Spread
from pcr_mpc.study.tuning import score as tuning_score
from pcr_mpc.study.tuning import space as tuning_space
from pcr_mpc.study.tuning import study as tuning_study
from pcr_mpc.study.tuning.score import Costs, measure, score
from tests.conftest import CONTROLLERS, MODELS

from .test_parallel import Here

START = Costs(10.0, 0.04, 100.0, 250.0, 1.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def scene():
    scene = load_scene(MODELS / "scenes" / "lemniscate.toml").tuned(load_tuning(CONTROLLERS / "frozen.toml"))
    return replace(scene, duration=0.1, delay_margin=0.02)


def written(tmp_path, text):
    scenes = MODELS / "scenes"
    scene = (scenes / "lemniscate.toml").read_text(encoding="utf-8").replace('"../', f'"{scenes.as_posix()}/../')
    path = tmp_path / "scene.toml"
    path.write_text(f"{scene}\n[need]\n{text}\n", encoding="utf-8")
    return path


def test_a_scene_may_need_a_margin_and_nothing_else(tmp_path):
    scene = load_scene(written(tmp_path, "delay_margin = 0.03"))
    assert (scene.need, scene.delay_margin) == (None, 0.03)
    both = "delay_margin = 0.03\ntip_accuracy = 0.1\nplant_step = 100\ncontrol_step = 1000"
    scene = load_scene(written(tmp_path, both))
    assert (scene.need.tip_accuracy, scene.delay_margin) == (1e-4, 0.03)


@pytest.mark.parametrize("text", ["delay_margin = 0.0", "delay_margin = nan", "delay_margn = 0.03", ""])
def test_what_is_no_need_is_refused(tmp_path, text):
    with pytest.raises(ModelError):
        load_scene(written(tmp_path, text))


def test_what_is_missing_counts_as_failures(scene, monkeypatch):
    row = dict.fromkeys(("rms_mm", "effort_rad_s2"), 1.0) | {"failure": ""}
    row |= {"timing": {"control_cpu_us": 1.0, "late": 0.0}}
    monkeypatch.setattr(tuning_score, "run_episode", lambda *_: row)
    costs = measure(scene, scene.tuning, scene.tuning, [0], Spread())
    assert costs.delay_margin_ms == pytest.approx(6.8, abs=0.4)
    assert costs.margin_lack == pytest.approx(1.0 - costs.delay_margin_ms / 20.0)
    assert measure(replace(scene, delay_margin=0.006), scene.tuning, scene.tuning, [0], Spread()).margin_lack == 0.0
    assert measure(replace(scene, delay_margin=None), scene.tuning, scene.tuning, [0], Spread()).delay_margin_ms == 0.0
    better = replace(START, tracking_mm=1.0, margin_lack=0.2)
    assert score(better, START) > score(START, START)


@pytest.mark.usefixtures("quick_storage")
def test_no_tuning_below_the_need_is_shipped(scene, tmp_path, monkeypatch):
    """The best by far lacks a hundredth of the margin; the best of the others is chosen, and none if all lack it."""
    pytest.importorskip("optuna")

    def formula(scene, start, tuning, seeds, spread, *, most=0.05):
        off = abs(np.log10(tuning.input_weight / 0.1))
        return replace(START, tracking_mm=1.0 + off, margin_lack=0.01 * (tuning.input_weight > most))

    monkeypatch.setattr(tuning_study, "measure", formula)
    search = tuning_space.Search(scene, Spread(), 2, 0, f"sqlite:///{tmp_path / 'study.db'}")
    chosen = tuning_study.tune(search, 8, Here(), progress=False)
    rows = tuning_study.finished_trials(search)
    assert any(row["margin_lack"] for row in rows)
    assert chosen is not None
    assert chosen.costs.margin_lack == 0.0
    monkeypatch.setattr(tuning_study, "measure", lambda *given, **more: formula(*given, **more, most=0.0))
    other = tuning_space.Search(scene, Spread(), 2, 0, f"sqlite:///{tmp_path / 'other.db'}")
    assert tuning_study.tune(other, 4, Here(), progress=False) is None


@pytest.mark.parametrize(
    ("predicted", "needed", "words"),
    [(21.5, 30.0, "NOT ENOUGH"), (21.5, 20.0, "needed are 20 ms"), (0.0, None, "NOT STABLE"), (None, 30.0, "no limit")],
)
def test_the_table_of_a_run_says_it(predicted, needed, words):
    (line,) = _margin_lines({"predicted_ms": predicted, "needed_ms": needed})
    assert words in line
    assert ("NOT" in line) == (words.startswith("NOT"))
