"""Times of calls become control periods: jitter, late and missing calls, clocks that are set."""

import math

import pytest

from pcr_mpc.loop.live.clock import Clock

PERIOD = 0.01


def periods(times):
    """The period that each call is for, and the kinds of events."""
    clock, k, found, kinds = Clock(PERIOD), -1, [], []
    for time in times:
        tick = clock.tick(time)
        k += tick.periods
        found.append(k)
        kinds += [kind for kind, _ in tick.events]
    return found, kinds


def test_calls_on_time_count_one_each():
    assert periods([7.0 + PERIOD * k for k in range(6)]) == ([0, 1, 2, 3, 4, 5], [])
    assert periods([None] * 4) == ([0, 1, 2, 3], [])


def test_jitter_decides_nothing():
    """Each call a third of a period early or late, which an ordinary rounding of times would bear, and more."""
    assert periods([0.0, 0.0133, 0.0167, 0.0333, 0.0367, 0.05]) == ([0, 1, 2, 3, 4, 5], [])
    # Half a period off for good: rounding would count 0 and 2 in turn.
    assert periods([0.0, 0.0151, 0.0249, 0.0351, 0.0449, 0.0551]) == ([0, 1, 2, 3, 4, 5], [])


def test_missing_calls_are_counted_and_real_time_is_kept():
    assert periods([0.0, 0.01, 0.05, 0.06])[0] == [0, 1, 5, 6]
    slow = [0.011 * k for k in range(101)]
    assert periods(slow)[0][-1] == pytest.approx(110, abs=1)
    fast = [0.009 * k for k in range(101)]
    found, kinds = periods(fast)
    assert found[-1] == pytest.approx(90, abs=1)
    assert kinds == []


def test_how_late_a_call_is():
    clock = Clock(PERIOD)
    clock.tick(0.0)
    assert clock.tick(0.012).late == pytest.approx(0.002)
    assert clock.tick(0.019).late == pytest.approx(-0.001)
    assert clock.tick(0.049).late == pytest.approx(-0.001)


def test_times_that_do_not_go_on_count_for_nothing():
    found, kinds = periods([1.0, 1.01, 1.01, 1.012, 1.005, 1.02])
    assert found == [0, 1, 1, 1, 1, 2]
    assert kinds == ["clock", "early", "clock"]


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_what_is_no_time_is_one_period_later(wrong):
    found, kinds = periods([1.0, 1.01, wrong, 1.03])
    assert found == [0, 1, 2, 3]
    assert kinds == ["clock"]


def test_a_clock_that_was_set_is_followed_from_the_second_call_on():
    found, kinds = periods([100.0, 100.01, 3.0, 3.01, 3.02])
    assert found == [0, 1, 1, 2, 3]
    assert kinds == ["clock", "clock"]
