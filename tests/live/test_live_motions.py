"""Every motion of a target begins in its state and has two continuous derivatives, by differences."""

import numpy as np
import pytest

from pcr_mpc.loop.live.motions import Following, Pursuit, as_trajectory
from pcr_mpc.loop.references.trajectory import Hold, Lemniscate

PERIOD = 0.01
LEMNISCATE = Lemniscate((0.0, 0.25), (0.12, 0.06), 2.0, 1.0)
STATE = np.array([[0.02, 0.22], [0.1, -0.2], [1.0, 2.0]])
K = 130
MOTIONS = {
    "joining": lambda: Following.joining(LEMNISCATE, PERIOD, 40, STATE, K, 25),
    "joining a path that begins at speed": lambda: Following.joining(circle, PERIOD, K + 1, STATE, K, 25),
    "slowed": lambda: Following(LEMNISCATE, PERIOD, 0, np.zeros((3, 2)), 0, 1).stopped(K, 20),
    "slowed while joining": lambda: Following.joining(LEMNISCATE, PERIOD, 40, STATE, K - 10, 25).stopped(K, 20),
    "pursuit": lambda: Pursuit(PERIOD, (0.05, 0.2), (0.0, 0.0), K, 30.0, 0.3, 4.5, 84.0),
    "pursuit of what moves": lambda: Pursuit(PERIOD, (0.05, 0.2), (0.1, 0.05), K, 30.0, 0.3, 4.5, 84.0),
    "jog": lambda: Pursuit(PERIOD, None, (0.1, 0.05), K, 30.0, 0.3, 4.5, 84.0),
}


def circle(t):
    sin, cos = np.sin(4 * t), np.cos(4 * t)
    return 0.03 * np.stack([np.stack([cos, sin], 1), 4 * np.stack([-sin, cos], 1), -16 * np.stack([cos, sin], 1)], 1)


def state_of(motion):
    if isinstance(motion, Pursuit) or motion.ahead(STATE, K - 1, 1) is None:
        return STATE
    return motion.ahead(STATE, K - 1, 1)[0]


@pytest.mark.parametrize("name", MOTIONS)
def test_velocity_and_acceleration_are_continuous(name):
    motion = MOTIONS[name]()
    begin = state_of(motion)
    if "joining" in name and "slowed" not in name:
        assert np.allclose(begin, STATE, atol=1e-12)
    samples = np.concatenate([begin[None], motion.ahead(begin, K, 60)])
    p, v, a = np.moveaxis(samples, 1, 0)
    # Hermite's rule for positions, the trapezoid's for velocities.
    h = PERIOD
    way = h * (v[1:] + v[:-1]) / 2 - h**2 * (a[1:] - a[:-1]) / 12
    assert np.allclose(np.diff(p, axis=0), way, atol=4e-6)
    assert np.allclose(np.diff(v, axis=0), h * (a[1:] + a[:-1]) / 2, atol=4e-3)
    # No jump of acceleration: what changes in a period is little of what there is.
    assert np.abs(np.diff(a, axis=0)).max() < 0.5 * max(np.abs(a).max(), 1.0)


def test_what_is_joined_is_the_path_afterwards():
    motion = MOTIONS["joining"]()
    assert np.allclose(motion.ahead(STATE, K + 25, 5), LEMNISCATE(PERIOD * (K + 25 + np.arange(1, 6) - 40)))


def test_what_is_stopped_stands_on_the_path():
    path = Following(LEMNISCATE, PERIOD, 0, np.zeros((3, 2)), 0, 1)
    end = path.stopped(K, 20).ahead(STATE, K + 20, 1)[0]
    assert np.allclose(end[0], LEMNISCATE(np.array([PERIOD * (K + 10)]))[0, 0])
    assert (end[1:] == 0).all()


def test_a_pursuit_arrives_and_goes_along():
    still = MOTIONS["pursuit"]().ahead(STATE, K, 150)[-1]
    assert np.allclose(still, [[0.05, 0.2], [0, 0], [0, 0]], atol=1e-6)
    along = MOTIONS["pursuit of what moves"]().ahead(STATE, K, 150)[-1]
    assert np.allclose(along[0], [0.05 + 0.15, 0.2 + 0.075], atol=2e-5)
    assert np.allclose(along[1], [0.1, 0.05], atol=1e-5)


def test_a_pursuit_keeps_its_speed():
    samples = Pursuit(PERIOD, (0.5, 0.25), (0.0, 0.0), K, 30.0, 0.3, 4.5, 84.0).ahead(np.zeros((3, 2)), K, 100)
    assert 0.29 < np.hypot(*samples[:, 1].T).max() < 0.301


@pytest.mark.parametrize(
    "function",
    [
        lambda t: (0.1 * np.sin(3 * t), 0.2 * np.cos(2 * t)),
        lambda t: np.array([0.1 * np.sin(3 * t), 0.2 * np.cos(2 * t)]).T,
        lambda t: [[0.1 * np.sin(3 * float(t))], [0.2 * np.cos(2 * float(t))]],
    ],
)
def test_functions_of_time_will_do(function):
    t = np.array([0.0, 0.0005, 0.01, 0.7, 3.0])
    found = as_trajectory(function)(t)
    p = np.stack([0.1 * np.sin(3 * t), 0.2 * np.cos(2 * t)], 1)
    v = np.stack([0.3 * np.cos(3 * t), -0.4 * np.sin(2 * t)], 1)
    a = np.stack([-0.9 * np.sin(3 * t), -0.8 * np.cos(2 * t)], 1)
    for part, wanted, tolerance in zip(np.moveaxis(found, 1, 0), (p, v, a), (1e-12, 1e-9, 1e-6), strict=True):
        assert np.allclose(part, wanted, atol=tolerance)


def test_what_is_no_path_is_refused():
    assert as_trajectory(LEMNISCATE) is LEMNISCATE
    assert as_trajectory(Hold((0, 0.25))).position == (0, 0.25)
    with pytest.raises(ValueError, match=r"path is 3, expected a Trajectory or a function of time"):
        as_trajectory(3)
    with pytest.raises(ValueError, match=r"path returned shape \(3,\), expected \(len\(t\), 3, 2\)"):
        as_trajectory(lambda t: (1.0, 2.0, 3.0))
