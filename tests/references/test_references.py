"""Every path, with every blend: continuous to the acceleration, at rest at both ends, closed where it is repeated."""

import math
import pickle
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import cumulative_simpson

from pcr_mpc import (
    Blended,
    Circle,
    Hold,
    Lemniscate,
    Line,
    ModelError,
    PickAndPlace,
    Polygon,
    Spline,
    Tabulated,
    Waypoints,
)
from pcr_mpc.loop.references.blended import duration_of

from .drawn import rows, truth

SQUARE = ((-0.03, 0.22), (0.03, 0.22), (0.03, 0.28), (-0.03, 0.28))
_T = np.linspace(0.0, 3.0, 61)
ROUND = np.stack([0.03 * np.cos(2 * np.pi * _T / 3), 0.25 + 0.03 * np.sin(2 * np.pi * _T / 3)], axis=1)
ALONG = 0.02 * np.pi * np.stack([-np.sin(2 * np.pi * _T / 3), np.cos(2 * np.pi * _T / 3)], axis=1)
INWARD = -((2 * np.pi / 3) ** 2) * (ROUND - [0.0, 0.25])

# name -> a path, and whether it is closed
PATHS = {
    "circle": (Circle((0.0, 0.25), 0.03, 3.0), True),
    "clockwise": (Circle((0.0, 0.25), 0.03, 3.0, 0.4, clockwise=True), True),
    "lap of a lemniscate": (Lemniscate((0.0, 0.25), (0.12, 0.06), 2.0, 0.0), True),
    "pick and place": (PickAndPlace((-0.06, 0.22), (0.06, 0.22), 0.05, 0.2, 0.6), False),
    "line": (Line(((0.0, 0.25), (0.04, 0.26)), 0.05), False),
    "polygon": (Polygon(SQUARE, 0.005, 0.06), True),
    "waypoints": (Waypoints(SQUARE, 0.05, radius=0.01), False),
    "waypoints with speeds": (Waypoints(SQUARE, (0.04, 0.08, 0.05), radius=0.004), False),
    "waypoints with times": (Waypoints(SQUARE, times=(0.0, 0.5, 1.5, 2.0), radius=0.004), False),
    "waypoints, closed": (Waypoints(SQUARE, times=(0.0, 0.5, 1.5, 2.0, 3.0), radius=0.004, closed=True), True),
    "waypoints with rests": (Waypoints(SQUARE, 0.05), False),
    "spline": (Spline(SQUARE, 0.05), False),
    "spline, closed": (Spline(SQUARE, 0.05, closed=True), True),
    "spline with times": (Spline(SQUARE, times=(0.0, 0.5, 1.5, 2.0)), False),
    "file": (Tabulated(_T, ROUND), False),
    "file, closed": (Tabulated(_T, ROUND, closed=True), True),
    "file with velocities": (Tabulated(_T, ROUND, ALONG), False),
    "file with accelerations": (Tabulated(_T, ROUND, ALONG, INWARD, closed=True), True),
    "file, smoothed": (Tabulated(*rows(), smoothing=5e-4), False),
}
EACH = pytest.mark.parametrize("name", PATHS)


def few(count):
    return settings(max_examples=count, derandomize=True, deadline=None, database=None,
                    suppress_health_check=list(HealthCheck))  # fmt: skip


@st.composite
def blended(draw, name):
    path, closed = PATHS[name]
    some = st.one_of(st.none(), st.floats(0.02, 0.4))
    repeat = draw(st.sampled_from([1, 2, 3, math.inf])) if closed else 1
    end = None if repeat == math.inf else draw(some)
    return Blended(path, repeat=repeat, start=draw(some), end=end, time_scale=draw(st.sampled_from([0.7, 1.0, 2.3])))


def speeds(path):
    """Largest speed and acceleration."""
    end = min(path.duration, 20.0)
    return np.linalg.norm(path(np.linspace(0.0, end, 801))[:, 1:], axis=2).max(axis=0)


@EACH
def test_velocity_and_acceleration_are_derivatives_and_continuous(name):
    @few(3)
    @given(blended(name), st.lists(st.floats(-0.1, 1.2), min_size=40, max_size=40))
    def check(path, shares):
        t, h = np.array(shares) * min(path.duration, 10.0), 1e-6
        v, a = speeds(path)
        here, ahead, back = path(t), path(t + h), path(t - h)
        assert np.abs((ahead[:, 0] - back[:, 0]) / (2 * h) - here[:, 1]).max() < 1e-5 * v
        assert np.abs((ahead[:, 1] - back[:, 1]) / (2 * h) - here[:, 2]).max() < 1e-4 * a
        # Where pieces meet, too: at knots, at the ends of blends and from lap to lap.
        seams = np.concatenate([[0.0, path.duration], np.linspace(0.0, 6.0, 121)])
        seams = seams[np.isfinite(seams)] * path.time_scale
        jump = path(seams + 1e-9) - path(seams - 1e-9)
        assert np.abs(jump).max(axis=(0, 2)) == pytest.approx(np.zeros(3), abs=2e-5 * a)

    check()


@EACH
def test_it_begins_and_ends_at_rest_and_stays(name):
    path = Blended(PATHS[name][0])
    before, first, last, after = path(np.array([-0.1, 0.0, path.duration, path.duration + 5.0]))
    v, a = speeds(path)
    for end in (before, first, last, after):
        assert np.abs(end[1]).max() < 1e-9 * v
        assert np.abs(end[2]).max() < 1e-9 * a
    inner = PATHS[name][0](np.array([0.0, PATHS[name][0].duration]))[:, 0]
    places = np.array([before[0], first[0], last[0], after[0]])
    assert places == pytest.approx(inner[[0, 0, 1, 1]])
    # Just at its duration, not before.
    assert np.abs(path(np.array([0.97 * path.duration]))[0, 1]).max() > 0.0


@EACH
def test_the_whole_path_is_gone_along(name):
    """The way that is covered does not depend on blends, laps or scale of time."""
    inner, closed = PATHS[name]

    def way(path):
        t = np.linspace(0.0, path.duration, 3001)
        speed = np.linalg.norm(path(t)[:, 1], axis=1)
        return cumulative_simpson(speed, x=t)[-1]

    once = way(inner)
    assert way(Blended(inner, start=0.3, time_scale=1.7)) == pytest.approx(once, rel=1e-3)
    if closed:
        assert way(Blended(inner, repeat=3, end=0.4)) == pytest.approx(3 * once, rel=1e-3)


@EACH
def test_laps_are_alike_and_time_scales(name):
    inner, closed = PATHS[name]
    path = Blended(inner)
    t = np.linspace(-0.5, path.duration + 0.5, 77)
    slow = Blended(inner, time_scale=2.5)(2.5 * t)
    assert slow * np.array([1.0, 2.5, 2.5**2])[:, None] == pytest.approx(path(t), abs=1e-12)
    assert Blended(inner, time_scale=2.5).duration == pytest.approx(2.5 * path.duration)
    if closed:
        lap = inner.duration
        laps = Blended(inner, repeat=3)
        t = np.linspace(laps._blends[0], lap, 50)
        assert laps(t + lap) == pytest.approx(laps(t), abs=1e-9 * max(1.0, speeds(inner)[1]))
    else:
        with pytest.raises(ModelError, match="from its end to its beginning the path jumps in"):
            Blended(inner, repeat=2)


@EACH
def test_it_is_a_value(name):
    path = Blended(PATHS[name][0], start=0.25)
    path(np.zeros(1))  # what it has computed by then is no part of it
    again = eval(repr(path))
    other = pickle.loads(pickle.dumps(path))
    assert path == again == other != Blended(PATHS[name][0], start=0.125)
    assert hash(path) == hash(again) == hash(other)
    t = np.linspace(0.0, 2.0, 9)
    assert (path(t) == again(t)).all()
    with pytest.raises(AttributeError):
        path.start = 1.0
    if PATHS[name][1]:
        endless = Blended(PATHS[name][0], repeat=math.inf)
        assert endless == eval(repr(endless)) == Blended(PATHS[name][0], repeat="for ever")
        assert endless.duration == math.inf


def test_paths_are_equal_in_another_process():
    paths = [path for path, _ in PATHS.values()]
    code = "import sys, pickle; paths = pickle.load(sys.stdin.buffer); sys.stdout.buffer.write(pickle.dumps(paths))"
    done = subprocess.run([sys.executable, "-c", code], input=pickle.dumps(paths), capture_output=True, check=True)
    back = pickle.loads(done.stdout)
    assert back == paths
    assert len({*back, *paths}) == len(paths)


# --- geometry ---------------------------------------------------------------------------------------------------------

CURVES = [name for name, (path, _) in PATHS.items() if hasattr(path, "curve")]


@pytest.mark.parametrize("name", CURVES)
def test_curves_are_by_arc_length(name):
    curve = PATHS[name][0].curve
    s, h = np.linspace(0.0, curve.length, 203)[1:-1], 1e-6
    here, ahead, back = curve(s), curve(s + h), curve(s - h)
    assert np.linalg.norm(here[:, 1], axis=1) == pytest.approx(1.0, abs=1e-12)
    assert (ahead[:, 0] - back[:, 0]) / (2 * h) == pytest.approx(here[:, 1], abs=1e-7)
    if name != "waypoints with rests":
        assert (ahead[:, 1] - back[:, 1]) / (2 * h) == pytest.approx(here[:, 2], abs=1e-4 * np.abs(here[:, 2]).max())


@few(20)
@given(st.floats(-3.0, 3.0), st.floats(0.002, 0.012), st.floats(-math.pi, math.pi))
def test_a_corner_is_round_as_stated_and_meets_its_legs(turn, radius, heading):
    """Against the definition of a corner: tangents, least radius, symmetry."""
    assume(abs(turn) > 0.05)
    first = np.array([math.cos(heading), math.sin(heading)])
    second = np.array([math.cos(heading + turn), math.sin(heading + turn)])
    corner = np.array([0.01, 0.2])
    ends = [tuple(p.tolist()) for p in (corner - first, corner, corner + second)]
    curve = Waypoints(ends, 0.05, radius=radius).curve
    s = np.linspace(0.0, curve.length, 4001)
    place, along, bend = np.moveaxis(curve(s), 1, 0)
    assert place[0] == pytest.approx(ends[0], abs=1e-12)
    assert place[-1] == pytest.approx(ends[2], abs=1e-12)
    assert along[[0, -1]] == pytest.approx(np.array([first, second]), abs=1e-12)
    assert np.linalg.norm(bend, axis=1).max() == pytest.approx(1 / radius, rel=1e-2)
    assert np.linalg.norm(bend, axis=1).max() <= (1 + 1e-9) / radius
    # Mirrored in the line that halves the corner.
    axis = second - first
    axis /= np.linalg.norm(axis)
    normal = np.array([-axis[1], axis[0]])
    middle = curve(np.array([curve.length / 2]))[0, 0]
    assert (middle - corner) @ normal == pytest.approx(0.0, abs=1e-9)
    assert (place - corner) @ axis == pytest.approx((place[::-1] - corner) @ axis, abs=1e-9)


def test_a_circle_as_a_spline_and_as_itself():
    around = 2 * np.pi * np.arange(24) / 24 - np.pi / 2
    points = np.stack([0.03 * np.cos(around), 0.25 + 0.03 * np.sin(around)], axis=1)
    spline, circle = Spline(points, 0.05, closed=True).curve, Circle((0.0, 0.25), 0.03, 3.0).curve
    assert spline.length == pytest.approx(2 * np.pi * 0.03, rel=1e-4)
    s = np.linspace(0.0, 0.18, 50)
    assert spline(s)[:, 0] == pytest.approx(circle(s)[:, 0], abs=2e-5)


def test_points_are_passed_at_their_times():
    times = (0.0, 0.4, 1.5, 2.0)
    spline = Spline(SQUARE, times=times)(np.array(times))
    assert spline[:, 0] == pytest.approx(np.array(SQUARE))
    assert spline[[0, -1], 1:] == pytest.approx(np.zeros((2, 2, 2)), abs=1e-12)
    rests = Waypoints(SQUARE, times=times)(np.array(times))
    assert rests[:, 0] == pytest.approx(np.array(SQUARE))
    assert rests[:, 1:] == pytest.approx(np.zeros((4, 2, 2)), abs=1e-12)
    rounded = Waypoints(SQUARE, times=times, radius=0.005)(np.array(times))
    # In the middle of a corner it goes at 45 degrees, and is nearest to the point.
    assert np.abs(rounded[1:3, 1]) @ [1, -1] == pytest.approx(np.zeros(2), abs=1e-12)
    near = Waypoints(SQUARE, times=times, radius=0.005)(0.4 + np.linspace(-0.05, 0.05, 101))[:, 0]
    assert np.linalg.norm(near - SQUARE[1], axis=1).argmin() == 50


@few(10)
@given(st.lists(st.floats(0.05, 5.0), min_size=3, max_size=6))
def test_it_never_goes_back(ways):
    """Legs of very different speeds."""
    points = tuple((0.02 * i, 0.2 + 0.01 * (i % 2)) for i in range(len(ways) + 1))
    path = Waypoints(points, times=np.concatenate([[0.0], np.cumsum(ways)]), radius=0.001)
    s, rate, _ = path._progress(np.linspace(0.0, path.duration, 5001))
    assert rate.min() >= -1e-12
    assert (np.diff(s) >= -1e-12).all()


def test_speeds_are_kept():
    t = np.linspace(0.1, 2.0, 50)
    for path in (Polygon(SQUARE, 0.005, 0.06), Spline(SQUARE, 0.06), Waypoints(SQUARE, 0.06, radius=0.01)):
        assert np.linalg.norm(path(t)[:, 1], axis=1) == pytest.approx(0.06)
    rests = Waypoints(SQUARE, (0.06, 0.03, 0.05))
    speed = np.linalg.norm(rests(np.linspace(0.0, rests.duration, 20001))[:, 1], axis=1)
    thirds = np.searchsorted(np.linspace(0.0, rests.duration, 20001), rests._knots[0])
    largest = [speed[a:b].max() for a, b in pairwise(thirds)]
    assert largest == pytest.approx([0.06, 0.03, 0.05], rel=1e-6)


# --- rows -------------------------------------------------------------------------------------------------------------


def test_rows_are_met_and_what_is_between_is_near():
    t = np.linspace(0.1, 2.9, 400)
    truth = np.stack([0.03 * np.cos(2 * np.pi * t / 3), 0.25 + 0.03 * np.sin(2 * np.pi * t / 3)], axis=1)
    for given_too, error in (((), 3e-7), ((ALONG,), 1e-9), ((ALONG, INWARD), 1e-9)):
        path = Tabulated(_T + 7.5, ROUND, *given_too)
        assert path.duration == pytest.approx(3.0)
        assert path.residuals.max() < 1e-12
        assert np.abs(path(t)[:, 0] - truth).max() < error
    path = Tabulated(_T, ROUND, ALONG, INWARD)
    assert path(_T)[:, 1] == pytest.approx(ALONG)
    assert path(_T)[:, 2] == pytest.approx(INWARD)


def test_smoothing_finds_what_is_behind_the_noise():
    t, points = rows()
    path = Tabulated(t, points, smoothing=5e-4)
    assert np.sqrt((path.residuals**2).mean() / 2) == pytest.approx(5e-4, rel=1e-2)
    fine = np.linspace(0.2, path.duration - 0.2, 500)
    # Times count from the first row, whose own jitter is one of 3 ms.
    error = np.linalg.norm(path(fine)[:, 0] - truth(fine), axis=1)
    assert np.sqrt((error**2).mean()) < 4e-4
    rough = np.linalg.norm(Tabulated(t, points)(fine)[:, 2], axis=1).max()
    smooth = np.linalg.norm(path(fine)[:, 2], axis=1).max()
    assert smooth < 1.5 < 5.0 < rough


# --- what cannot be ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "key", "message"),
    [
        (lambda: Circle((0.0, 0.25), 0.0, 3.0), "radius", "is 0, expected a finite number > 0"),
        (lambda: Circle((0.0, math.nan), 0.1, 3.0), "centre", "not finite"),
        (lambda: Line(SQUARE, 0.1), "points", "a line has 2, found 4"),
        (lambda: Line(((0.0, 0.1), (0.0, 0.1)), 0.1), "points", r"points\[1\] is the same as the one before"),
        (lambda: Polygon((*SQUARE, SQUARE[0]), 0.005, 0.1), "corners", "the last is the first again"),
        (lambda: Polygon(SQUARE[:2], 0.005, 0.1), "corners", "at least 3 points, found 2"),
        (lambda: Waypoints(SQUARE), "speed", "give either speed or times"),
        (lambda: Waypoints(SQUARE, 0.1, (0.0, 1.0, 2.0, 3.0)), "speed", "give either"),
        (lambda: Waypoints(SQUARE, times=(0.0, 1.0, 2.0)), "times", "expected 4 numbers for these points, found 3"),
        (lambda: Waypoints(SQUARE, times=(0.0, 1.0, 1.0, 2.0)), "times", r"times\[2\] = 1 s is not after times\[1\]"),
        (lambda: Waypoints(SQUARE, times=(0.1, 1.0, 1.5, 2.0)), "times", "begin at 0.1 s, expected 0"),
        (lambda: Waypoints(SQUARE, (0.1, -0.1, 0.1)), "speed", "-0.1 m/s, expected more than 0"),
        (lambda: Waypoints(((0.0, 0.2), (0.1, 0.2), (0.0, 0.2)), 0.1, radius=0.01), "radius", "turns back at point 1"),
        (lambda: Spline(((0.0, 0.2), "nowhere"), 0.1), "points", "expected"),
        (lambda: Spline(3, 0.1), "points", "expected points"),
        (lambda: Tabulated(_T, ROUND[:-1]), "points", "60 rows for 61 times"),
        (lambda: Tabulated(_T[::-1], ROUND), "times", "row 1 is not after"),
        (lambda: Tabulated(_T, ROUND, None, INWARD), "accelerations", "without velocities"),
        (lambda: Tabulated(_T, ROUND, ALONG, smoothing=1e-3), "smoothing", "is for positions"),
        (lambda: Tabulated(_T[:3], ROUND[:3]), "points", "3 rows, expected at least 4"),
        (lambda: Tabulated(_T[:-1], ROUND[:-1], closed=True), "closed", "3.14 mm from its first"),
        (lambda: Circle((0.0, 0.25), 0.03, 3.0, clockwise="no"), "clockwise", "expected True or False"),
        (lambda: Spline(SQUARE, 0.1, closed=1), "closed", "expected True or False"),
        (lambda: Blended(PATHS["circle"][0], repeat="often"), "repeat", "expected a number, found 'often'"),
        (lambda: Blended(3), "path", "expected a trajectory"),
        (lambda: Blended(Hold((0.0, 0.2)), repeat=2), "repeat", "Hold has no duration"),
        (lambda: Blended(PATHS["circle"][0], repeat=1.5), "repeat", "a whole number"),
        (lambda: Blended(PATHS["circle"][0], start=0.0), "start", r"moves at 0.0628 m/s, and its velocity would jump"),
        (lambda: Blended(PATHS["circle"][0], end=0.0), "end", "moves at 0.0628 m/s"),
        (lambda: Blended(PATHS["circle"][0], start=4.0, end=3.0), "start", "half, 3.5 s, passes .* takes 3 s"),
        (lambda: Blended(PATHS["circle"][0], repeat=math.inf, end=1.0), "end", "has no end to blend"),
    ],
)
def test_what_cannot_be_is_refused_by_name(make, key, message):
    with pytest.raises(ModelError, match=message) as caught:
        make()
    assert caught.value.key == key


def test_corners_that_do_not_fit_say_which_would():
    with pytest.raises(
        ModelError, match=r"60 mm long, and corners of radius 30 mm take .* fits is ([\d.]+) mm"
    ) as caught:
        Polygon(SQUARE, 0.03, 0.1)
    largest = float(str(caught.value).split("fits is ")[1].split(" mm")[0])
    Polygon(SQUARE, 1e-3 * largest, 0.1)
    with pytest.raises(ModelError):
        Polygon(SQUARE, 1.001e-3 * largest, 0.1)
    with pytest.raises(ModelError, match=r"^radius is 5 m \(millimetres\? give metres\): the leg from"):
        Polygon(SQUARE, 5.0, 0.1)


def drift(t):
    """A function of one's own."""
    samples = np.zeros((len(t), 3, 2))
    samples[:, 0, 0], samples[:, 1, 0], samples[:, 0, 1] = 0.01 * t, 0.01, 0.25
    return samples


def test_a_path_of_ones_own_is_blended_like_any_other():
    assert duration_of(drift) == math.inf
    path = Blended(drift, start=0.5, time_scale=2.0)
    assert path.duration == math.inf
    first, later = path(np.array([0.0, 3.0]))
    assert first == pytest.approx(np.array([[0.0, 0.25], [0.0, 0.0], [0.0, 0.0]]))
    assert later == pytest.approx(np.array([[0.01 * 1.25, 0.25], [0.005, 0.0], [0.0, 0.0]]))
    assert pickle.loads(pickle.dumps(path)) == path

    class Timed:
        duration = 2.0

        def __call__(self, t):
            return drift(t)

    assert Blended(Timed()).duration == 2.5
    assert Blended(Timed())(np.array([9.0]))[0] == pytest.approx(np.array([[0.02, 0.25], [0.0, 0.0], [0.0, 0.0]]))


def test_a_lemniscate_with_a_ramp_is_a_blended_lap_without_end():
    figure = Lemniscate((0.0, 0.25), (0.12, 0.06), 2.0, 0.7)
    blended_lap = Blended(replace(figure, ramp=0.0), start=0.7, repeat=math.inf)
    t = np.linspace(0.0, 9.0, 301)
    assert blended_lap(t) == pytest.approx(figure(t), abs=1e-12)
