"""Times are sorted into the right drawers."""

import gc
import time

import numpy as np
import pytest

from pcr_mpc.study.stopwatch import WARM_UP, Times, measure


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


def test_measure_times_the_call_alone_with_the_collector_on_and_off_in_turns():
    seen = []

    def call(k):
        seen.append((k, gc.isenabled()))
        if k == 3:
            gc.collect()
        if k == 5:
            time.sleep(0.01)

    def before(k):
        if k == 4:
            gc.collect()
            time.sleep(0.01)

    assert gc.isenabled()
    times = measure(call, 600, before)
    assert gc.isenabled()
    assert [k for k, _ in seen] == list(range(600))
    assert [on for _, on in seen] == times.collecting.tolist() == [True] * 500 + [False] * 100
    assert len(times.pauses) == 1
    assert 0 < times.pauses[0] < times.wall[3]
    assert times.wall[5] > 0.01 > times.cpu[5]
    assert times.wall[4] < times.wall[5]
