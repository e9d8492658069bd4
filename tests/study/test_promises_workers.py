"""What studies promise about scores, workers and where figures come from."""

import os
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc.errors import StudyError
from pcr_mpc.study.episodes import provenance
from pcr_mpc.study.episodes.parallel import collect, finished, local_workers
from pcr_mpc.study.timing.stopwatch import distribution
from pcr_mpc.study.tuning.score import Costs, score

from .test_parallel import Here

START = Costs(10.0, 0.04, 100.0, 250.0, 1.0, 0.0, 0.0)


def test_the_score_is_the_weighted_mean_that_it_is_said_to_be():
    """Of twice a cost: 5 ninths of it for tracking, 2 without mismatch, 1 for effort, 1 for time; 20 for a failure."""
    for name, weight in (("tracking_mm", 5), ("nominal_mm", 2), ("effort_rad_s2", 1), ("step_time", 1)):
        double = replace(START, **{name: 2 * getattr(START, name)})
        assert score(double, START) == pytest.approx(1 + weight / 9), name
        half = replace(START, **{name: getattr(START, name) / 2})
        assert score(half, START) == pytest.approx(1 - weight / 18), name
    assert score(replace(START, failure_rate=0.1), START) == pytest.approx(3.0)
    assert score(replace(START, late=0.1), START) == pytest.approx(3.0)
    # Not worth lowering below 10 um and 2 um; a hundred times as bad is bad enough.
    for name, floor in (("tracking_mm", 0.01), ("nominal_mm", 2e-3)):
        none, least = (replace(START, **{name: value}) for value in (0.0, floor))
        assert score(none, START) == pytest.approx(score(least, START))
    assert score(replace(START, tracking_mm=1e9), START) == pytest.approx(1 + 99 * 5 / 9)
    # The microseconds themselves are for the reader: they are another machine's tomorrow.
    assert score(replace(START, step_time_us=1e9), START) == 1.0


# --- provenance, workers ----------------------------------------------------------------------------------------------


def git(folder, *arguments):
    identity = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
    subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True)


def test_a_commit_is_dirty_once_the_code_was_changed(tmp_path, monkeypatch):
    package = tmp_path / "package"
    package.mkdir()
    (package / "errors.py").write_text("1\n")
    (tmp_path / "README").write_text("1\n")
    git(tmp_path, "init", "-q")
    monkeypatch.setattr(provenance, "_PACKAGE", package)
    assert provenance.commit().startswith("version ")  # in somebody else's repository
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "all")
    clean = provenance.commit()
    assert len(clean) == 12
    assert set(clean) <= set("0123456789abcdef")
    (tmp_path / "README").write_text("2\n")
    assert provenance.commit() == clean  # beside the code
    digest = provenance.source_digest()
    (package / "errors.py").write_text("2\n")
    assert provenance.commit() == f"{clean}-dirty"
    assert provenance.source_digest() != digest
    (package / "errors.py").write_text("1\n")
    assert (provenance.commit(), provenance.source_digest()) == (clean, digest)
    (package / "new.py").write_text("")
    assert provenance.commit() == f"{clean}-dirty"
    assert provenance.source_digest() != digest
    monkeypatch.setattr(provenance, "_PACKAGE", tmp_path / "nowhere")
    assert provenance.commit().startswith("version ")


def test_workers_leave_the_environment_as_it_was(monkeypatch):
    """Threads are counted for them alone, and put back, whatever happens."""
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    before = dict(os.environ)
    with local_workers(1):
        assert os.environ["OMP_NUM_THREADS"] == os.environ["MKL_NUM_THREADS"] == "1"
    assert dict(os.environ) == before
    with pytest.raises(ArithmeticError), local_workers(1):
        raise ArithmeticError
    assert dict(os.environ) == before


def test_no_cores_more_than_are_ours():
    mine = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count())
    with local_workers() as executor:
        assert executor._max_workers == len(mine)


def square(x):
    if x < 0:
        raise ValueError(f"{x} is negative")
    return {"seed": x, "square": x * x}


def test_lost_tasks_are_told_at_the_end_and_all_of_them():
    with pytest.raises(
        StudyError, match=r"2 of 4 tasks ended without a result; the first, -[12]: ValueError"
    ) as caught:
        list(finished(Here(), square, [3, -1, -2, 2], desc="a", unit="b", progress=False))
    assert sorted(caught.value.lost) == [-2, -1]
    assert isinstance(caught.value.__cause__, ValueError)


def test_rows_come_in_the_order_of_their_seeds_and_each_once(tmp_path):
    rows = collect(Here(), square, [3, 1, 3, 2], tmp_path / "a.jsonl", {}, desc="a", progress=False)
    assert [row["seed"] for row in rows] == [1, 2, 3]
    assert len((tmp_path / "a.jsonl").read_text().splitlines()) == 4


def test_nothing_to_count_has_no_percentiles():
    assert distribution(np.empty(0)) == {
        **dict.fromkeys(("p50", "p95", "p99", "p99.9", "max", "mean")), "n": 0}  # fmt: skip
    found = distribution(np.arange(1.0, 1001.0) * 1e-6)
    assert found == pytest.approx(
        {"p50": 500.5, "p95": 950.05, "p99": 990.01, "p99.9": 999.001, "max": 1000.0, "mean": 500.5, "n": 1000}
    )
