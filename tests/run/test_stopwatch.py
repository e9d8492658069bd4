"""Times are sorted into the right drawers."""

import gc

import numpy as np
import pytest

from pcr_mpc.study.timing import overhead, stopwatch
from pcr_mpc.study.timing.stopwatch import WARM_UP, Times, measure


def test_record_keeps_the_first_calls_apart():
    n = 1000
    wall = np.concatenate([np.full(WARM_UP, 5e-3), np.full(n, 1e-4)])
    cpu, collecting = wall - 1e-6, np.arange(WARM_UP + n) % 2 == 0
    wall[-1] += 2e-3  # somebody interrupted
    wall[-3] = cpu[-3] = 2e-3  # nobody did
    record = Times(wall, cpu, collecting, np.array([1e-5, 3e-5])).record("step", "m", (1000.0, 480.0))
    assert (record["p50"], record["p99"], record["n"]) == (pytest.approx(100), pytest.approx(100), n)
    assert record["max"] == pytest.approx(2100)
    assert record["p99.9"] == pytest.approx(1e6 * np.percentile(wall[WARM_UP:], 99.9))
    assert record["first"] == pytest.approx([5000] * WARM_UP)
    assert record["misses"] == {"1000 Hz": {"wall": 2, "cpu": 1}, "480 Hz": {"wall": 1, "cpu": 0}}
    assert record["interrupted"] == 1
    assert record["collector_on"]["n"] == record["collector_off"]["n"] == n // 2
    assert record["collector_on"]["max"] == pytest.approx(100)
    assert record["collector_off"]["max"] == pytest.approx(2100)
    assert record["collections"]["n"] == 2
    assert record["collections"]["mean"] == pytest.approx(20)
    assert record["collections"]["share"] == pytest.approx(4e-5 / wall[collecting].sum())


class Clock:
    """Time that passes only where a test says so: elapsed and spent by the thread."""

    def __init__(self):
        self.elapsed = self.spent = 0.0

    def pass_by(self, elapsed, spent):
        self.elapsed += elapsed
        self.spent += spent

    def perf_counter(self):
        return self.elapsed

    def thread_time(self):
        return self.spent


def test_measure_times_the_call_alone_with_the_collector_on_and_off_in_turns(monkeypatch):
    seen, clock = [], Clock()
    monkeypatch.setattr(stopwatch, "time", clock)

    def passing(phase, info):  # a collection takes 2 ms
        if phase == "stop":
            clock.pass_by(2e-3, 2e-3)

    def call(k):
        seen.append((k, gc.isenabled()))
        clock.pass_by(1e-4, 1e-4)
        if k == 3:
            gc.collect()
        if k == 5:
            clock.pass_by(0.01, 0.0)  # asleep

    def before(k):
        if k == 4:
            gc.collect()
            clock.pass_by(0.01, 0.0)

    was_on = gc.isenabled()
    gc.disable()  # no collections but those above: of others nobody knows when they come
    monkeypatch.setattr(gc, "enable", lambda: None)
    gc.callbacks.insert(0, passing)
    try:
        times = measure(call, 600, before)
    finally:
        gc.callbacks.remove(passing)
        monkeypatch.undo()
        (gc.enable if was_on else gc.disable)()
    assert [k for k, _ in seen] == list(range(600))
    wall, cpu = np.full(600, 1e-4), np.full(600, 1e-4)
    wall[3] = cpu[3] = 2.1e-3
    wall[5] = 0.0101
    assert times.wall == pytest.approx(wall, abs=1e-12)
    assert times.cpu == pytest.approx(cpu, abs=1e-12)
    assert times.pauses == pytest.approx([2e-3], abs=1e-12)


def test_the_collector_is_on_and_off_in_turns_and_as_it_was_afterwards():
    seen = []
    assert gc.isenabled()
    times = measure(lambda k: seen.append(gc.isenabled()), 600)
    assert gc.isenabled()
    assert seen == times.collecting.tolist() == [True] * 500 + [False] * 100
    gc.disable()
    try:
        measure(lambda k: None, 600)
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_overhead_is_of_the_fastest_and_of_the_same_step(monkeypatch, pair, centre):
    clock, graphs, rolled = Clock(), [], []
    costs = iter([3.0, 2.0, 5.0])

    class Seen(overhead.BufferedFunction):
        def __init__(self, function):
            super().__init__(function)
            graphs.append(self)

        def __call__(self):
            clock.pass_by(9.0, 7.0)
            return super().__call__()

    def roll(plant, x, inputs, guess):
        rolled.append((x, inputs.shape))
        clock.pass_by(1.0, next(costs))

    monkeypatch.setattr(overhead, "BufferedFunction", Seen)
    monkeypatch.setattr(overhead, "rollout", roll)
    monkeypatch.setattr(overhead, "time", clock)
    for name, value in (("_BATCHES", 2), ("_CALLS", 2), ("_ROLLED", 1000), ("_ROLLOUTS", 3)):
        monkeypatch.setattr(overhead, name, value)
    rows = {row["name"]: row for row in overhead.call_overhead(pair, centre)}
    assert {row["code"] for row in rows.values()} == {"interpreted"}
    assert rows["graph"]["us"] == pytest.approx(7e6)
    assert rows["plain call"]["us"] == rows["Plant.step"]["us"] == 0.0  # there this clock stands
    assert rows["rollout"]["us"] == pytest.approx(1e6 * 2.0 / 1000)
    (graph,) = graphs
    start = [*centre.p, 0.05, -0.05, *centre.q]
    assert graph.inputs[1] == pytest.approx(start)
    assert np.any(graph.inputs[0])  # the rods' memory
    assert [(pytest.approx(start), (1000, 2))] * 3 == [(x.tolist(), shape) for x, shape in rolled]
