"""A path of one's own, class or function, goes wherever a built-in one does."""

import pickle
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest

from pcr_mpc import Blended, Circle, load_run, load_scene, load_tuning, make_controller, run_episode, simulate
from pcr_mpc.errors import StudyError
from pcr_mpc.loop.references.reading import built_in
from pcr_mpc.loop.run.finding import digest
from pcr_mpc.report.plots import animate_run, plot_run
from pcr_mpc.study.episodes import episodes
from pcr_mpc.study.episodes.parallel import finished, local_workers
from pcr_mpc.study.episodes.provenance import described, differences
from pcr_mpc.study.episodes.spread import Spread
from pcr_mpc.study.tuning.space import Search
from pcr_mpc.study.tuning.study import tune
from tests.conftest import CONTROLLERS, MODELS

TURN = Blended(Circle((0.0, 0.25), 0.02, 1.5))


@dataclass
class Turn:
    """With an array, and so neither hashed nor compared."""

    centre: np.ndarray

    def __call__(self, t):
        samples = TURN(t)
        samples[:, 0] += self.centre - [0.0, 0.25]
        return samples


def turn(t):
    return TURN(t)


@pytest.fixture(scope="module")
def scene():
    scene = load_scene(MODELS / "scenes/square.toml")
    begin = tuple(TURN(np.zeros(1))[0, 0].tolist())
    return episodes.lighter(replace(scene, start_tip=begin, duration=0.2))


OWN = {
    "class": Turn(np.array([0.0, 0.25])),
    "function": turn,
    "blended class": Blended(Turn(np.array([0.0, 0.25])), time_scale=1.0),
}


def each(usual):
    """One of them in the usual run, the others in the slow one."""
    names = [name if name == usual else pytest.param(name, marks=pytest.mark.slow) for name in OWN]
    return pytest.mark.parametrize("name", names)


@each("blended class")
def test_it_runs_as_the_built_in_one_and_comes_back_from_its_record(scene, name, tmp_path):
    mine = replace(scene, trajectory=OWN[name])
    ours = replace(scene, trajectory=TURN)
    run = simulate(mine, mine.make_plant(), make_controller(mine))
    same = simulate(ours, ours.make_plant(), make_controller(ours))
    assert run.hash() == same.hash()
    assert run.summary()["asked"] == same.summary()["asked"]
    assert run.events == []
    run.save(tmp_path)
    back = load_run(tmp_path)
    assert back.summary() == run.summary()
    again = simulate(back.scene, back.scene.make_plant(), make_controller(back.scene))
    assert again.x == pytest.approx(run.x, abs=1e-9)


def test_ours_are_known_and_those_of_others_are_not(scene):
    assert built_in(TURN)
    assert built_in(Blended(TURN, time_scale=2.0))
    assert not any(built_in(path) for path in OWN.values())
    assert not built_in(None)
    digests = {digest(replace(scene, trajectory=path)) for path in (OWN["class"], Turn(np.array([0.0, 0.25])))}
    assert len(digests) == 1
    records = [described(replace(scene, trajectory=path), scene.tuning, Spread()) for path in OWN.values()]
    assert len(differences(records[0], records[1])) == 2  # the type, twice; not the samples


@pytest.mark.slow
def test_it_is_drawn(scene, tmp_path):
    mine = replace(scene, trajectory=OWN["class"])
    run = simulate(mine, mine.make_plant(), make_controller(mine))
    plot_run(run, tmp_path / "a.png")
    animate_run(run, tmp_path / "a.gif")
    assert (tmp_path / "a.png").stat().st_size > 10_000


@each("class")
def test_in_episodes_its_dynamics_are_solved_once(scene, name, monkeypatch):
    """Though a worker gets another copy with every task."""
    solved = []

    def counted(*arguments):
        solved.append(arguments)
        return dynamics(*arguments)

    dynamics = episodes.feed_forward
    monkeypatch.setattr(episodes, "feed_forward", counted)
    episodes._reference.cache_clear()
    rows = []
    for seed in (1, 2):
        mine = pickle.loads(pickle.dumps(replace(scene, trajectory=OWN[name])))
        rows.append(run_episode(mine, scene.tuning, seed))
    assert [row["failure"] for row in rows] == ["", ""]
    assert len(solved) == 1
    ours = run_episode(replace(scene, trajectory=TURN), scene.tuning, 2)
    assert ours["run_hash"] == rows[1]["run_hash"]
    assert len(solved) == 2
    other = Turn(np.array([0.001, 0.25]))
    run_episode(replace(scene, trajectory=other), scene.tuning, 1)
    assert len(solved) == 3
    episodes._reference.cache_clear()


@pytest.mark.slow
def test_it_goes_to_worker_processes(scene):
    mine = [replace(scene, trajectory=path) for path in OWN.values()]
    with local_workers(1) as executor:
        for task in mine:
            ((_, row),) = finished(
                executor, partial(run_episode, task, scene.tuning), [3], desc="a", unit="b", progress=False
            )
            assert row["run_hash"] == run_episode(task, scene.tuning, 3)["run_hash"]


@pytest.mark.slow
def test_a_controller_is_tuned_on_it(scene, tmp_path):
    mine = replace(scene, trajectory=OWN["class"], tuning=load_tuning(CONTROLLERS / "default.toml"))
    search = Search(mine, Spread(), 1, 0, f"sqlite:///{tmp_path / 'a.db'}", None, True)
    with local_workers(1) as executor:
        tune(search, 1, executor, progress=False)


def test_what_cannot_be_sent_is_named_before_a_worker_starts(scene):
    task = partial(run_episode, replace(scene, trajectory=lambda t: TURN(t)), scene.tuning)
    with (
        local_workers(1) as executor,
        pytest.raises(StudyError, match=r"scene\.trajectory is <function .*<lambda>.* not a lambda") as caught,
    ):
        list(finished(executor, task, [1, 2], desc="a", unit="b", progress=False))
    assert caught.value.part == "scene.trajectory"
    assert not executor._processes


def test_one_within_another_is_named_too(scene):
    task = partial(run_episode, replace(scene, trajectory=Blended(lambda t: TURN(t), start=0.1)), scene.tuning)
    with local_workers(1) as executor, pytest.raises(StudyError, match=r"blended\.path is <function .*<lambda>"):
        executor.submit(task, 1)
