"""Limits of the motors are kept ever after, whoever asks for what: braking before a stop is part of keeping it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcr_mpc.control.motor_limits import Limits

DT = 0.01
RATE, ACCELERATION = 6.0, 40.0
LOWER, UPPER = np.array([-1.0, -0.02]), np.array([1.0, 0.02])


@pytest.fixture(scope="module")
def limits():
    return Limits(RATE, ACCELERATION * DT, LOWER, UPPER)


def one(rate, change, lower, upper):
    return Limits(rate, change, np.array([lower]), np.array([upper]))


def braked(u, change):
    """What a motor turns from now on that may slow down by ``change`` in each period, over dt."""
    turned = 0.0
    while u > 0.0:
        turned, u = turned + u, u - change
    return turned


@pytest.mark.parametrize("change", [0.05, 0.3, 2.0, 7.0, math.inf])
@pytest.mark.parametrize("room", [0.0, 1e-6, 0.004, 0.02, 0.0731, 0.2])
def test_the_greatest_rate_towards_a_stop_just_stops_there(change, room):
    """Found again by bisection on how far a motor turns that brakes."""
    low, high = 0.0, RATE
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if DT * braked(middle, change) <= room else (low, middle)
    # From the rate that it just may have: the change is no limit then.
    for sign in (1.0, -1.0):
        limits = one(RATE, change, *sorted((sign * (1.0 + room), -5.0 * sign)))
        found = limits.kept(np.array([sign * 50.0]), np.array([sign * low]), np.array([sign * 1.0]), DT)
        assert sign * found[0] == pytest.approx(low, abs=1e-9)


def test_away_from_the_stops_nothing_changes(limits):
    u = np.array([0.123456789, -0.2])
    assert (limits.kept(u, np.zeros(2), np.zeros(2), DT) == u).all()


@settings(max_examples=60)
@given(
    st.integers(0, 2**32 - 1),
    st.floats(0.05, 20.0),
    st.sampled_from([0.01, 0.1, 0.5, 3.0, 20.0, math.inf]),
    st.floats(0.0, 0.5),
)
def test_hostile_wishes_never_break_a_limit(seed, rate, change, width):
    """Wishes of any size, for 200 periods, from rest anywhere between the stops."""
    rng = np.random.default_rng(seed)
    lower, upper = np.array([-width, -1.0]), np.array([0.0, -1.0 + width])
    limits = Limits(rate, change, lower, upper)
    q, u = rng.uniform(lower, upper), np.zeros(2)
    for _ in range(200):
        wish = rng.choice([-1e9, -rate, 0.0, 0.3 * rate, rate, 1e9], 2)
        before, u = u, limits.kept(wish, u, q, DT)
        q = q + DT * u
        assert (np.abs(u) <= rate).all()
        assert (np.abs(u - before) <= change + 1e-9).all()
        assert (q >= lower - 1e-9).all()
        assert (q <= upper + 1e-9).all()


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_from_beyond_a_stop_at_full_rate_outwards(limits, side):
    """It brakes as hard as it may, comes back, and stays: rate and change of rate are kept meanwhile."""
    q, u = np.array([side * 1.1, 0.0]), np.array([side * RATE, 0.0])
    beyond = []
    for _ in range(120):
        before, u = u, limits.kept(np.array([side * 9.0, 0.0]), u, q, DT)
        q = q + DT * u
        assert np.abs(u - before).max() <= ACCELERATION * DT + 1e-12
        assert np.abs(u).max() <= RATE
        beyond.append(side * q[0] - 1.0)
    # Braking from 6 rad/s at 40 rad/s^2 takes 0.45 rad, less what the first period saves.
    assert max(beyond) == pytest.approx(0.1 + DT * braked(RATE - ACCELERATION * DT, ACCELERATION * DT), abs=1e-9)
    assert beyond[-1] == pytest.approx(0.0, abs=1e-9)
    back = beyond.index(max(beyond))
    assert max(beyond[back:]) == beyond[back]


def test_coming_back_does_not_run_into_the_other_stop():
    limits = one(RATE, 0.4, -0.01, 0.01)
    q, u = np.array([0.5]), np.zeros(1)
    lowest = []
    for _ in range(200):
        u = limits.kept(np.array([-9.0]), u, q, DT)
        q = q + DT * u
        lowest.append(q[0])
    assert min(lowest) >= -0.01 - 1e-9
    assert lowest[-1] == pytest.approx(-0.01, abs=1e-9)


def test_two_opinions_of_an_angle_keep_the_stop_for_both(limits):
    """The measured angle says there is room, the sum of the commands that there is none, or the other way round."""
    u, rest = np.array([2.0, 0.0]), np.zeros(2)
    inside, at_stop, beyond = (np.array([angle, 0.0]) for angle in (0.0, 1.0, 1.5))
    assert limits.kept(u, rest, inside, DT)[0] == pytest.approx(0.4)
    for measured, reckoned in ((inside, at_stop), (at_stop, inside), (inside, beyond), (beyond, inside)):
        assert limits.kept(u, rest, measured, DT, reckoned)[0] == 0.0
        assert limits.kept(-u, rest, measured, DT, reckoned)[0] == pytest.approx(-0.4)
    # Where both are beyond, it comes back.
    assert limits.kept(u, rest, beyond, DT, beyond + [0.1, 0.0])[0] == pytest.approx(-0.4)


def test_an_unknown_angle_has_no_stop(limits):
    found = limits.kept(np.array([0.3, 0.3]), np.zeros(2), np.array([np.nan, 0.02]), DT)
    assert found.tolist() == [0.3, 0.0]


def test_braking_ends_at_rest(limits):
    u, seen = np.array([1.0, -0.5]), []
    while u.any():
        u = limits.slowed(u)
        seen.append(u)
    assert np.array(seen) == pytest.approx(np.array([[0.6, -0.1], [0.2, 0.0], [0.0, 0.0]]))


def test_limits_that_are_none(limits):
    free = replace(
        limits, rate=math.inf, rate_change=math.inf, angle_lower=LOWER * math.inf, angle_upper=UPPER * math.inf
    )
    assert free.kept(np.array([1e6, -1e6]), np.zeros(2), np.zeros(2), DT).tolist() == [1e6, -1e6]
