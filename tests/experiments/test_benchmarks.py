"""The guard against regressions fails when it must, and only then."""

import json

import pytest

from experiments.speed import benchmarks
from experiments.speed.benchmarks import Change, better_of, changes, show


@pytest.mark.parametrize(
    ("old", "new", "worse"),
    [
        (100.0, 100.0, False),
        (100.0, 50.0, False),
        (100.0, 49.9, True),
        (100.0, 1e4, False),
        (100.0, float("nan"), True),
        (100.0, None, True),
        (None, 1.0, False),
    ],
)
def test_worse_is_less_than_half_of_what_was_kept(old, new, worse):
    assert Change("ratio", old, new).worse is worse


@pytest.mark.parametrize("name", benchmarks.PROMISED)
def test_what_is_promised_counts_whatever_was_kept(name):
    least = benchmarks.NOISE * benchmarks.PROMISED[name]
    for old in (None, 0.1 * least, least):
        assert Change(name, old, 0.99 * least).worse
        assert Change(name, old, None).worse
        assert not Change(name, old, 1.01 * least).worse
    assert Change(name, 3 * least, 1.01 * least).worse
    assert "promised" in show([Change(name, least, 1.01 * least)])
    assert "promised" not in show([Change(name, least, 1.01 * benchmarks.PROMISED[name])])


def test_changes_cover_what_is_new_and_what_is_gone():
    found = changes({"kept": 2.0, "gone": 3.0}, {"kept": 4.0, "added": 5.0})
    assert [(one.name, one.old, one.new) for one in found] == [
        ("kept", 2.0, 4.0),
        ("added", None, 5.0),
        ("gone", 3.0, None),
    ]
    assert "TOO SMALL" in show(found)
    assert "| gone | 3 | - |" in show(found, markdown=True)


def test_the_better_of_two_measurements_counts():
    assert better_of({"a": 1.0, "b": 3.0}, {"a": 2.0, "b": 1.0}) == {"a": 2.0, "b": 3.0}


def run(monkeypatch, kept, measurements, *options):
    left = list(measurements)
    monkeypatch.setattr(benchmarks, "measure", lambda: left.pop(0))
    code = benchmarks.main(["--kept", str(kept), *options])
    assert not left  # as many measurements as expected
    return code


def test_a_ratio_must_be_worse_each_time_to_fail(tmp_path, monkeypatch, capsys):
    kept = tmp_path / "kept.json"
    assert run(monkeypatch, kept, [{"a": 10.0}]) == 0
    assert "is not there" in capsys.readouterr().out
    assert run(monkeypatch, kept, [{"a": 10.0, "b": 1.0}], "--write") == 0
    assert json.loads(kept.read_text())["ratios"] == {"a": 10.0, "b": 1.0}
    assert {"commit", "machine", "versions"} <= json.loads(kept.read_text()).keys()
    assert run(monkeypatch, kept, [{"a": 6.0, "b": 0.6}]) == 0
    assert run(monkeypatch, kept, [{"a": 4.0, "b": 1.0}, {"a": 9.0, "b": 0.1}]) == 0
    assert (
        run(monkeypatch, kept, [{"a": 4.0, "b": 1.0}, {"a": 3.0, "b": 0.1}, {"a": 4.0, "b": 1.0}, {"a": 5.0, "b": 0.1}])
        == 0
    )
    assert run(monkeypatch, kept, [{"a": 4.0, "b": 1.0}] + 3 * [{"a": 3.0, "b": 1.0}]) == 1
    assert json.loads(kept.read_text())["ratios"] == {"a": 10.0, "b": 1.0}


def test_kept_ratios_say_where_they_come_from():
    kept = json.loads(benchmarks.KEPT.read_text(encoding="utf-8"))
    assert kept["commit"]
    assert kept["ratios"]
    assert all(value > 0 for value in kept["ratios"].values())
