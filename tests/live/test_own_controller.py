"""Controllers of one's own need `start` and `step`, and run wherever the toolkit's do."""

import json
import pickle
import re
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pcr_mpc import (
    Decision,
    HoldMotors,
    ModelError,
    load_scene,
    plot_run,
    run_episode,
    simulate,
    simulate_episode,
    summary_table,
)
from pcr_mpc.cli import main
from pcr_mpc.loop.controller.own_controller import OwnController, built
from pcr_mpc.study.episodes.episodes import EXACT
from pcr_mpc.study.episodes.provenance import described
from tests.conftest import MODELS

SCENE = MODELS / "scenes" / "lemniscate.toml"

# As somebody writes it who has read one page.
SPRING = """\
import numpy as np


class Spring:
    def __init__(self, scene):
        self.path, self.period = scene.trajectory, scene.period

    def start(self, pose):
        self.lever = np.linalg.inv(pose.dforce_dq) @ pose.dforce_dp

    def step(self, k, x):
        p, v = self.path(np.array([k * self.period]))[0, :2]
        return -self.lever @ (v + 2.0 * (p - x[:2]))
"""


class Still:
    def start(self, pose):
        self.n = len(pose.q)

    def step(self, k, x):
        return [0.0] * self.n


class Column(Still):
    def step(self, k, x):
        return np.zeros((self.n, 1))


class Decided(Still):
    def step(self, k, x):
        return Decision(np.zeros(self.n))


class Buffered(Still):
    """Writes into the same array each time."""

    def start(self, pose):
        self.u = np.zeros(len(pose.q))

    def step(self, k, x):
        self.u[:] = 0.01 * k
        return self.u


class Named(Still):
    name = "quite still"


class Needy:
    def __init__(self, scene, gain):
        pass


@pytest.fixture(scope="module")
def scene():
    return replace(load_scene(SCENE), duration=0.1)


@pytest.mark.parametrize("kind", [Still, Column, Decided, Named])
def test_any_shape_of_answer_will_do(scene, kind):
    run = simulate(scene, scene.make_plant(), kind())
    still = simulate(scene, scene.make_plant(), HoldMotors(2))
    assert run.controller == ("quite still" if kind is Named else kind.__name__)
    assert run.hash() == still.hash()
    assert (run.tuning, run.believed) == (None, None)


def test_an_array_that_is_written_into_again_is_what_it_was(scene):
    """With a delay the rates are on the way while the next ones are made."""
    run = simulate(replace(scene, delay=2), scene.make_plant(), Buffered())
    per = run.steps_per_period
    assert np.allclose(run.u[:, 0], 0.01 * np.arange(len(run.u)))
    assert np.allclose(run.applied[::per][2:], run.u[:-2])


def test_such_a_run_is_kept_and_drawn(scene, tmp_path):
    run = simulate(scene, scene.make_plant(), Still())
    run.save(tmp_path / "run")
    plot_run(run, tmp_path / "run.png")
    assert "controller  Still" in summary_table(run.summary())
    assert (tmp_path / "run.png").stat().st_size > 10_000


def test_what_takes_a_scene_is_handed_it(scene):
    held = HoldMotors(2)
    assert built(held, scene) is held
    assert isinstance(built(Still, scene), Still)
    assert built(lambda it: it.name, scene) == "lemniscate"
    with pytest.raises(ModelError, match=r"Needy\(scene, gain\) needs more than a scene; give its arguments defaults"):
        built(Needy, scene)
    with pytest.raises(ModelError, match="3 is no controller"):
        built(3, scene)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "mine_of_test.py").write_text(SPRING)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.modules.pop("mine_of_test", None)


def test_track_runs_a_class_by_its_name(folder, capsys):
    short = SCENE.read_text().replace('"../', f'"{MODELS}/').replace("duration = 6.0", "duration = 1.0")
    (folder / "short.toml").write_text(short.replace(f"{MODELS}/../controllers", f"{MODELS.parent}/controllers"))
    arguments = ["track", "short.toml", "--controller", "mine_of_test:Spring", "--no-pictures", "--json"]
    assert main(arguments) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["controller"] == "Spring"
    # It knows no dynamics, and swings; to hold still costs 35 mm.
    assert summary["rms_mm"] < 15.0


def test_a_file_is_named_as_well_as_a_module(folder, scene):
    one, other = (OwnController(f"mine_of_test{suffix}:Spring")(scene) for suffix in ("", ".py"))
    assert type(one).__name__ == type(other).__name__ == "Spring"


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("nobody:Spring", "there is no module nobody in "),
        ("nobody.py:Spring", "there is no file "),
        ("mine_of_test:Sprung", "module mine_of_test has no Sprung; did you mean Spring?"),
        ("wrong_of_test:Spring", "loading it failed: ZeroDivisionError: division by zero"),
        ("needs_of_test:Spring", "loading it failed: No module named 'no_such_library'"),
    ],
)
def test_a_class_that_cannot_be_had_is_one_clear_line(folder, capsys, spec, message):
    (folder / "wrong_of_test.py").write_text("1 / 0\n")
    (folder / "needs_of_test.py").write_text("import no_such_library\n")
    assert main(["track", str(SCENE), "--controller", spec]) == 1
    said = capsys.readouterr().err
    assert re.search(re.escape(message), said)
    assert "Traceback" not in said
    assert said.count("\n") == 1


def test_episodes_run_it_and_name_it(folder, scene):
    mine = OwnController("mine_of_test:Spring")
    assert pickle.loads(pickle.dumps(mine)) == mine
    exact = simulate_episode(scene, mine, 1, EXACT)
    plain = simulate(scene, scene.make_plant(), mine(scene))
    assert exact.hash() == plain.hash()
    row = run_episode(scene, mine, 3)
    assert (row["failure"], row["limit_violations"]) == ("", 0)
    kept = described(scene, mine, EXACT)
    assert kept["scene"]["controller"]["spec"] == "mine_of_test:Spring"
    (folder / "mine_of_test.py").write_text(SPRING.replace("2.0", "3.0"))
    assert described(scene, mine, EXACT) != kept  # a study that was begun with another file is another study


def test_episodes_in_other_processes_find_it(folder, scene):
    mine = OwnController("mine_of_test:Spring")
    with ProcessPoolExecutor(1) as executor:
        (row,) = executor.map(partial(run_episode, scene, mine), [3])
    assert row["run_hash"] == run_episode(scene, mine, 3)["run_hash"]
