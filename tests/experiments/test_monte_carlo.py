"""The study of robustness repeats, resumes, and replays its episodes."""

import json
from contextlib import contextmanager

import numpy as np
import pytest

from experiments.control import monte_carlo
from experiments.control.monte_carlo import correlations, main, sizes, summarise, worst
from pcr_mpc.study.episodes.episodes import EXACT, Spread
from tests.conftest import MODELS
from tests.study.test_parallel import Here

BRIEF = ["--duration", "0.1", "--episodes", "2", "--seed", "7"]


@pytest.fixture
def here(monkeypatch):
    @contextmanager
    def workers(jobs, dask):
        yield Here()

    monkeypatch.setattr(monte_carlo, "workers", workers)


def row(seed, failure="", rms=1.0, violations=0, **changes):
    figures = {"rms_mm": rms, "rms_after_1s_mm": None, "max_mm": rms, "effort_rad_s2": 1.0, "fallbacks": 0}
    return {"seed": seed, **Spread().sample(2, seed).row(), "failure": failure, **figures,
            "limit_violations": violations, **changes}  # fmt: skip


def test_twice_the_same_numbers_and_the_worst_is_replayed(here, tmp_path, capsys):
    first, second = tmp_path / "first", tmp_path / "second"
    assert main([*BRIEF, "--out", str(first)]) == 0
    text = capsys.readouterr().out
    assert main([*BRIEF, "--out", str(second)]) == 0
    assert (first / "episodes.csv").read_bytes() == (second / "episodes.csv").read_bytes()
    summaries = [json.loads((folder / "summary.json").read_text()) for folder in (first, second)]
    assert summaries[0].pop("timing") != summaries[1].pop("timing")
    assert summaries[0] == summaries[1]
    summary = summaries[0]
    assert (summary["episodes"], summary["seeds"], summary["limit_violations"]) == (2, [7, 8], 0)
    assert (first / "monte_carlo.png").stat().st_size > 10_000
    for words in ("failure rate", "95 % interval", "RMS [mm]", "limit violations  0"):
        assert words in text
    seed = summary["worst_seed"]
    assert f"--duration 0.1 --out {first} --replay {seed}" in text

    assert main([*BRIEF, "--out", str(first), "--replay", str(seed)]) == 0
    assert "RMS" in capsys.readouterr().out
    replayed = json.loads((first / f"seed_{seed}" / "summary.json").read_text())
    rows = [json.loads(line) for line in (first / "episodes.jsonl").read_text().splitlines()[1:]]
    (mine,) = (one for one in rows if one["seed"] == seed)
    assert replayed["run_hash"] == mine["run_hash"]
    assert replayed["rms_mm"] == pytest.approx(mine["rms_mm"])
    assert (first / f"seed_{seed}" / "track.png").stat().st_size > 10_000


def test_a_second_call_resumes_unless_told_otherwise(here, tmp_path, monkeypatch, capsys):
    seen = []
    run = monte_carlo.run_episode

    def counting(scene, tuning, seed):
        seen.append(seed)
        return run(scene, tuning, seed)

    monkeypatch.setattr(monte_carlo, "run_episode", counting)
    out = ["--out", str(tmp_path), "--duration", "0.1"]
    assert main([*out, "--episodes", "2"]) == 0
    assert main([*out, "--episodes", "3"]) == 0
    assert seen == [0, 1, 2]
    assert main([*out, "--episodes", "1", "--fresh"]) == 0
    assert seen == [0, 1, 2, 0]
    capsys.readouterr()
    assert main(["--out", str(tmp_path), "--duration", "0.12", "--episodes", "1"]) == 1
    assert "rows of other settings: scene.duration was 0.1, is 0.12" in capsys.readouterr().err


def test_a_robot_as_identified_is_sampled_from_its_uncertainty(here, tmp_path, capsys):
    text = (MODELS / "planar_pair.toml").read_text(encoding="utf-8")
    out = ["--out", str(tmp_path / "out"), "--duration", "0.1", "--episodes", "1", "--robot"]
    assert main([*out, str(MODELS / "planar_pair.toml")]) == 1
    assert "has no [uncertainty]" in capsys.readouterr().err
    path = tmp_path / "mine.toml"
    path.write_text(text + '\n[uncertainty]\nnames = ["tip_mass", "rods[0].length"]\nsd = [1e-7, 1e-4]\n')
    assert main([*out, str(path)]) == 0
    assert f"--robot {path}" in capsys.readouterr().out
    head, line = (tmp_path / "out" / "episodes.jsonl").read_text().splitlines()
    assert '"known"' in head
    row, assumed = json.loads(line), Spread().sample(2, 0)
    assert row["mass"] == pytest.approx(1.0, abs=5e-6)
    assert row["length0"] != 1.0
    assert (row["stiffness0"], row["length1"]) == (assumed.stiffness[0], 1.0)


def test_the_interval_is_that_of_clopper_and_pearson():
    """0 of 10: upper end 1 - 0.025^(1/10); 5 of 10: 0.1871 to 0.8129, a table's values."""
    none = summarise([row(seed) for seed in range(10)])
    assert none["interval_95"] == pytest.approx([0.0, 1 - 0.025**0.1])
    half = summarise([row(seed, failure="x" if seed < 5 else "") for seed in range(10)])
    assert half["failure_rate"] == 0.5
    assert half["interval_95"] == pytest.approx([0.1871, 0.8129], abs=1e-4)
    delays = half["by_periods_of_unknown_delay"]
    assert sum(count["failed"] for count in delays.values()) == 5
    assert sum(count["episodes"] for count in delays.values()) == 10


def test_the_worst_episode_is_a_failed_one():
    rows = [row(0, rms=9.0), row(1, "strayed", rms=5.0), row(2, "strayed", rms=6.0)]
    assert worst(rows)["seed"] == 2
    assert worst(rows[:1])["seed"] == 0
    assert worst([*rows, row(3, "never began", rms=None)])["seed"] == 3


def test_what_matters_is_found():
    rows = [row(seed) for seed in range(200)]
    for one in rows:
        one["rms_mm"] = 1.0 + np.hypot(one["force_x_N"], one["force_y_N"]) ** 2
    found = correlations(rows)
    assert found["load"] == pytest.approx(1.0)
    assert max(abs(value) for name, value in found.items() if name != "load") < 0.25
    assert "delay" not in correlations([one for one in rows if one["delay"] == 0])
    assert set(sizes({**row(0), **EXACT.sample(2, 0).row()}).values()) == {0.0}


def test_failures_are_one_clear_line(here, tmp_path, capsys):
    assert main(["--episodes", "0", "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err == "monte_carlo: --episodes is 0, expected at least 1\n"
    scene = monte_carlo.MODELS / "scenes" / "release.toml"
    assert main(["--scene", str(scene), "--out", str(tmp_path)]) == 1
    assert "release has nothing to track" in capsys.readouterr().err
