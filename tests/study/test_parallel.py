"""Finished rows are kept, whatever happens to the others."""

import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from pcr_mpc import load_scene
from pcr_mpc.errors import StudyError
from pcr_mpc.study.episodes.episodes import EXACT, Spread, run_episode
from pcr_mpc.study.episodes.parallel import collect, finished, local_workers
from pcr_mpc.study.episodes.provenance import described, differences
from tests.conftest import MODELS, ROOT

SETTINGS = {"scene": {"mass": 0.25, "rods": [1.0, 2.0]}}


class Here(Executor):
    """Runs everything at once in this process."""

    def submit(self, task, /, *arguments, **keywords):
        future = Future()
        try:
            future.set_result(task(*arguments, **keywords))
        except Exception as error:
            future.set_exception(error)
        return future


class Counting:
    """A task that remembers for which seeds it was run, and refuses some."""

    def __init__(self, refused=()):
        self.seen, self.refused = [], refused

    def __call__(self, seed):
        self.seen.append(seed)
        if seed in self.refused:
            raise ValueError(f"no {seed}")
        return {"seed": seed, "value": 0.1 * seed, "nothing": None}


def gather(task, seeds, path, settings=SETTINGS):
    return collect(Here(), task, seeds, path, settings, desc="test", progress=False)


def test_a_second_call_runs_only_what_is_missing(tmp_path):
    path = tmp_path / "new" / "rows.jsonl"
    first, second = Counting(), Counting()
    rows = gather(first, range(5), path)
    assert first.seen == [0, 1, 2, 3, 4]
    assert gather(second, range(3, 8), path) == [{"seed": s, "value": 0.1 * s, "nothing": None} for s in range(3, 8)]
    assert second.seen == [5, 6, 7]
    assert rows == gather(second, [4, 3, 2, 1, 0], path)
    assert second.seen == [5, 6, 7]


def test_other_settings_are_refused_and_named(tmp_path):
    path = tmp_path / "rows.jsonl"
    gather(Counting(), range(2), path)
    before = path.read_bytes()
    with pytest.raises(StudyError, match=r"2 rows of other settings: scene\.mass was 0\.25, is 0\.3 \(and 1 more\)"):
        gather(Counting(), range(3), path, {"scene": {"mass": 0.3, "rods": [1.0, 2.5]}})
    with pytest.raises(StudyError, match=r"code was None, is abc;"):
        gather(Counting(), range(3), path, {**SETTINGS, "code": "abc"})
    assert path.read_bytes() == before


def test_a_line_that_was_cut_off_is_run_again(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows = gather(Counting(), range(3), path)
    last = json.loads(path.read_text().splitlines()[-1])
    path.write_bytes(path.read_bytes()[:-7])
    again = Counting()
    assert gather(again, range(3), path) == rows
    assert again.seen == [last["seed"]]
    assert len([json.loads(line) for line in path.read_text().splitlines()]) == 4


def test_a_file_of_something_else_is_left_alone(tmp_path):
    path = tmp_path / "rows.jsonl"
    path.write_text("t,x\n0,1\n")
    with pytest.raises(StudyError, match=r"rows\.jsonl: not a file of a study"):
        gather(Counting(), range(3), path)
    assert path.read_text() == "t,x\n0,1\n"


def test_a_task_that_fails_is_reported_and_the_others_are_kept(tmp_path):
    path = tmp_path / "rows.jsonl"
    with pytest.raises(
        StudyError, match=r"1 of 4 tasks .* first, 2: ValueError: no 2; .*kept in .*rows\.jsonl"
    ) as info:
        gather(Counting(refused=[2]), range(4), path)
    assert info.value.lost == [2]
    again = Counting()
    assert len(gather(again, range(4), path)) == 4
    assert again.seen == [2]


def test_an_interrupted_call_keeps_its_rows_and_begins_no_others(tmp_path):
    path = tmp_path / "rows.jsonl"
    futures = [Future() for _ in range(4)]

    class Held(Executor):
        def submit(self, task, /, seed):
            return futures[seed]

    futures[0].set_result({"seed": 0})
    futures[1].set_result({"seed": 1})
    futures[2].result = lambda: (_ for _ in ()).throw(KeyboardInterrupt)
    futures[2].set_result(None)
    with pytest.raises(KeyboardInterrupt, match=r"interrupted with \d rows .*kept in .*same command goes on"):
        collect(Held(), Counting(), range(4), path, SETTINGS, desc="test", progress=False)
    assert futures[3].cancelled()
    kept = [json.loads(line)["seed"] for line in path.read_text().splitlines()[1:]]
    again = Counting()
    gather(again, range(4), path)
    assert sorted(kept + again.seen) == [0, 1, 2, 3]
    assert set(again.seen) >= {2, 3}


def die_on_two(seed):
    if seed == 2:
        os._exit(3)
    return {"seed": seed, "threads": os.environ["OMP_NUM_THREADS"]}


def test_a_worker_that_dies_is_reported_and_the_run_resumes(tmp_path):
    path = tmp_path / "rows.jsonl"
    with local_workers(1) as executor, pytest.raises(StudyError, match="BrokenProcessPool"):
        collect(executor, die_on_two, range(6), path, SETTINGS, desc="test", progress=False)
    again = Counting()
    assert [row["seed"] for row in gather(again, range(6), path)] == list(range(6))
    assert set(again.seen) >= {2, 3, 4, 5}
    assert all(json.loads(line).get("threads", "1") == "1" for line in path.read_text().splitlines()[1:])


def processes_of(parent):
    """Its children, by /proc."""
    found = subprocess.run(["ps", "-o", "pid=", "--ppid", str(parent)], capture_output=True, text=True, check=False)
    return [int(pid) for pid in found.stdout.split()]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for processes as Linux lists them")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL], ids=["interrupted", "killed"])
def test_a_study_that_is_stopped_keeps_its_rows_and_leaves_no_workers(how, tmp_path):
    path = tmp_path / "rows.jsonl"
    script = f"""
import pathlib, signal
from pcr_mpc.study.episodes.parallel import collect, local_workers
from tests.study.test_parallel import SETTINGS, slow
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with local_workers(1) as executor:
        collect(executor, slow, range(100), pathlib.Path({str(path)!r}), SETTINGS, desc="test")
"""
    (tmp_path / "study.py").write_text(script)
    study = subprocess.Popen([sys.executable, str(tmp_path / "study.py")], cwd=ROOT, stderr=subprocess.PIPE, text=True,
                             env={**os.environ, "PYTHONPATH": str(ROOT)})  # fmt: skip
    # The rows are there while the study still runs.
    wait_until(lambda: path.exists() and len(path.read_text().splitlines()) > 2)
    workers = processes_of(study.pid)
    assert workers
    study.send_signal(how)
    _, errors = study.communicate(timeout=30)
    if how == signal.SIGINT:
        assert "interrupted with" in errors
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers))
    kept = len(path.read_text().splitlines()) - 1
    again = Counting()
    assert len(gather(again, range(100), path)) == 100
    assert kept - 1 <= 100 - len(again.seen) <= kept < 100


def slow(seed):
    time.sleep(0.05)
    return {"seed": seed}


def wait_until(condition):
    for _ in range(600):
        if condition():
            return
        time.sleep(0.05)
    pytest.fail("nothing happened in 30 s")


def test_jobs_below_one_are_refused():
    with pytest.raises(ValueError, match="jobs is 0"), local_workers(0):
        pass


def test_results_come_as_they_are_finished():
    with ThreadPoolExecutor(2) as pool:
        pairs = dict(finished(pool, str, [3, 1, 2], desc="test", unit="task", progress=False))
    assert pairs == {1: "1", 2: "2", 3: "3"}


@pytest.fixture(scope="module")
def scene():
    scene = load_scene(MODELS / "scenes" / "lemniscate.toml")
    return replace(scene, duration=0.2, plant=replace(scene.plant, integrator="velocity_verlet"))


def without_timing(rows):
    return [{name: value for name, value in row.items() if name != "timing"} for row in rows]


@pytest.mark.slow
def test_processes_and_a_dask_cluster_give_the_same_rows(scene, tmp_path):
    """Bit for bit: in this process, in processes of their own, and on a cluster's worker with two threads."""
    distributed = pytest.importorskip("distributed")
    task, settings = partial(run_episode, scene, scene.tuning), described(scene, scene.tuning, Spread())
    with local_workers(1) as executor:
        local = collect(executor, task, range(4), tmp_path / "local.jsonl", settings, desc="local", progress=False)
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None, protocol="inproc://"
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        dask = collect(
            client.get_executor(), task, range(4), tmp_path / "dask.jsonl", settings, desc="dask", progress=False
        )
    assert without_timing(dask) == without_timing(local)
    assert without_timing(local) == without_timing([json.loads(json.dumps(task(seed))) for seed in range(4)])


def test_settings_name_what_differs(scene):
    old = described(scene, scene.tuning, Spread())
    assert json.loads(json.dumps(old)) == old
    assert differences(old, described(scene, scene.tuning, Spread())) == []
    robot = replace(scene.robot, tip_mass=0.3)
    assert differences(old, described(replace(scene, robot=robot), scene.tuning, Spread())) == [
        "scene.robot.tip_mass was 0.25, is 0.3"
    ]
    tuning = replace(scene.tuning, horizon=12)
    assert differences(old, described(scene, tuning, Spread())) == [
        f"scene.tuning.horizon was {scene.tuning.horizon}, is 12"
    ]
    changed = differences(old, described(scene, scene.tuning, EXACT))
    assert "spread.force was 1.0, is 0.0" in changed
    assert all(line.startswith("spread.") for line in changed)
