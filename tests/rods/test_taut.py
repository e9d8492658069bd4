"""Rods pulled nearly straight: cold starts and warm ones, against mpmath, the separatrix and the energy."""

from dataclasses import replace

import casadi as ca
import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from pcr_mpc import ConvergenceError, Plant, UnstableError, forward_statics, solve_statics
from pcr_mpc.plant.rods.closed_form import elastica
from pcr_mpc.plant.rods.closed_form.chart import critical_load

from .test_elastica import by_mpmath

MOST = 1e6  # EI/L^2, of the pulls that are promised


def pull_of(slack, phi):
    """Tip force in EI/L^2 of a rod on the separatrix, clamped phi from its chord, by repeated root finding.

    With delta from clamp to force the rod loses 2 (1 - cos(delta/2)) / lambda along the force and moves 2 sin(delta/2)
    / lambda across it.
    """
    load = 1e9
    for _ in range(100):
        across = 2 / load
        delta = brentq(
            lambda d, across=across: d - np.arcsin(min(across * np.sin(d / 2) / (1 - slack), 1.0)) - abs(phi), 0, 6.28
        )
        off = across * np.sin(delta / 2)
        missing = (slack * (2 - slack) + off**2) / (1 + np.sqrt((1 - slack) ** 2 - off**2))  # along, of a length of 1
        before, load = load, 2 * (1 - np.cos(delta / 2)) / missing
        if abs(load - before) < 1e-12 * load:
            break
    return load**2


def where_slacks_are(robot, slacks):
    """Tip above the bases at which the two rods have these slacks."""
    (x0, y0), (x1, _) = robot.bases
    r0, r1 = robot.lengths * (1 - np.asarray(slacks))
    x = (x0 + x1) / 2 + (r0**2 - r1**2) / (2 * (x1 - x0))
    return np.array([x, y0 + np.sqrt(r0**2 - (x - x0) ** 2)])


def slacks_and_angles(robot, p, q):
    slacks = robot.slacks(p)
    chords = np.arctan2(*(p - robot.bases).T[::-1])
    return slacks, np.angle(np.exp(1j * (chords - q)))


@pytest.mark.parametrize(("seed", "count"), [(12, 150), pytest.param(13, 2500, marks=pytest.mark.slow)])
def test_cold_start_of_any_pull_and_clamp(pair, seed, count):
    """Both rods with a slack and a clamp angle of their own: none fails, and all pull as on the separatrix."""
    rng = np.random.default_rng(seed)
    taut = stiffest = 0
    for _ in range(count):
        small = rng.choice([-1, 1]) * 10 ** rng.uniform(-3, 0, 2)
        phi = np.where(rng.random(2) < 0.5, rng.uniform(-3.1, 3.1, 2), small)
        # On the separatrix a pull of lambda^2 takes a slack of 4 sin(phi/4)^2 / lambda.
        load = np.sqrt(10 ** rng.uniform(1.0, np.log10(MOST) - 0.1, 2))
        p = where_slacks_are(pair, np.clip(4 * np.sin(phi / 4) ** 2 / load, 2e-9, 0.5))
        q = np.arctan2(*(p - pair.bases).T[::-1]) - phi
        eq = solve_statics(pair, p, q)
        assert eq.converged
        assert not eq.unstable_rods
        for slack, angle, n, unit in zip(
            *slacks_and_angles(pair, p, q), eq.rod_forces, pair.stiffnesses / pair.lengths**2, strict=True
        ):
            pull = np.hypot(*n) / unit
            if pull > 900:  # exp(-30) from the separatrix
                # What the tip is off by counts twice in the force. Of the 12 worst of 2500 poses, against 50 digits,
                # this formula is off by 0.25e-15 / slack at most, the rods by 1.4e-15 / slack: roundings of the tip,
                # which stay when a pose is solved again from its solution.
                assert pull == pytest.approx(pull_of(slack, angle), rel=1e-8 + 2e-15 / slack)
                taut += 1
                stiffest = max(stiffest, pull)
    assert taut > count
    assert stiffest > 0.5 * MOST


def test_cold_start_of_slender_rods(pair):
    """Nearly straight rods from buckled to pulled: the rod's own equation leads from the clamp to the tip."""
    rng = np.random.default_rng(1)
    for _ in range(40):
        slacks = 10 ** rng.uniform(-8.5, -1.5, 2)
        p = where_slacks_are(pair, slacks)
        q = np.arctan2(*(p - pair.bases).T[::-1]) + np.sqrt(slacks) * rng.uniform(-5.0, 5.0, 2)
        eq = solve_statics(pair, p, q)
        assert not eq.unstable_rods
        for base, length, nodes in zip(pair.bases, pair.lengths, eq.nodes, strict=True):
            theta, n_x, n_y, m = nodes[:, 0]

            def slope(_, y, n_x=n_x, n_y=n_y):
                cos, sin = np.cos(y[2]), np.sin(y[2])
                return [cos, sin, y[3], n_x * sin - n_y * cos]

            end = solve_ivp(slope, (0, 1), [0, 0, theta, m], "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
            assert end[:2] == pytest.approx((p - base) / length, abs=1e-11)
            assert end[3] == pytest.approx(0.0, abs=1e-7)


def test_pull_of_five_thousand(pair):
    """A symmetric pose, its force known by stepping from slack rods (6 digits, for the angles are rounded)."""
    p, q = np.array([0.0, 0.38716769]), (1.6180344, 1.52355826)
    eq = solve_statics(pair, p, q)
    assert eq.force[1] == pytest.approx(3047.439, rel=1e-4)
    assert eq.mode == "LR"
    h = 1e-7
    below, above = (solve_statics(pair, p + (0, d), q).energy for d in (-h, h))
    assert eq.force[1] == pytest.approx((above - below) / (2 * h), rel=1e-5)


@pytest.mark.parametrize("unknowns", [(-30.0, 31.5), (-98.5, 99.0), (-99.2, 100.0), (-101.0, 100.5), (-420.0, 421.0),
                                      (-999.0, 1000.0)])  # fmt: skip
def test_pendulum_beyond_floating_point_numbers(unknowns):
    """K' of the tautest rod here is 1e-434; on both sides of where the formulas change."""
    symbols = ca.SX.sym("l"), ca.SX.sym("u")
    results = elastica.pendulum(*symbols, any_pull=True)
    graph = ca.Function("pendulum", list(symbols), [*results, ca.jacobian(ca.vertcat(*results), ca.vertcat(*symbols))])
    *found, slopes = (np.array(value) for value in graph(*unknowns))
    with mpmath.workdps(int(unknowns[1]) + 50):
        delta, rate, c = by_mpmath(*unknowns)
        # The derivatives in u are the pendulum's equation.
        exact = [float(value) for value in (rate, mpmath.sin(delta), mpmath.cos(delta))]
        assert slopes[:, 1] == pytest.approx(exact, abs=1e-12)
        # A digit of log(tip_angle) is worth as much of the angle.
        assert [float(v[0, 0]) for v in found] == pytest.approx([float(delta), float(rate), float(c)], abs=1e-12)
        by_angle = (by_mpmath(mpmath.mpf(unknowns[0]) + mpmath.mpf(1e-9), unknowns[1])[0] - delta) / mpmath.mpf(1e-9)
        assert slopes[0, 0] == pytest.approx(float(by_angle), abs=1e-5)


def test_following_to_taut_poses_and_back(pair):
    """In one move from a slack pose to pulls up to the greatest promised, as cold, and back to the bit of a digit."""
    slack = forward_statics(pair, (3.0, 0.14))
    rng = np.random.default_rng(3)
    pulls = []
    for _ in range(25):
        phi = np.array([-1, 1]) * rng.uniform(0.1, 2.0, 2)
        p = where_slacks_are(pair, 4 * np.sin(phi / 4) ** 2 / np.sqrt(10 ** rng.uniform(2, 5.9, 2)))
        q = np.arctan2(*(p - pair.bases).T[::-1]) - phi
        cold = solve_statics(pair, p, q)
        try:
            there = solve_statics(pair, p, q, guess=slack)
        except UnstableError:
            continue  # the motors turned past where a slack rod snaps
        if there.mode != cold.mode:
            continue
        pulls.append(np.hypot(*there.rod_forces.T).max() * 0.4**2 / 0.05)
        assert there.force == pytest.approx(cold.force, rel=1e-9, abs=1e-9 * np.abs(cold.rod_forces).max())
        back = solve_statics(pair, slack.p, slack.q, guess=there)
        assert back.force == pytest.approx(slack.force, abs=1e-9)
    assert len(pulls) > 15
    assert max(pulls) > 1e5


def test_advice_belongs_to_the_method(pair, centre):
    """The closed form has no segments of which there could be more."""
    taut = where_slacks_are(pair, (2e-9, 2e-9))
    q = np.array([3.1, 0.0])
    with pytest.raises(ConvergenceError) as closed:
        solve_statics(pair, taut, q, guess=np.zeros((2, 4, 8)))
    with pytest.raises(ConvergenceError, match="use more segments"):
        solve_statics(pair, taut, q, method="multiple_shooting", steps=1)
    assert "segments" not in str(closed.value)


def test_limit_of_stability_of_any_taut_rod():
    """A rod of any tip angle loses stability where a full loop is about to leave it, without a gap or a jump."""
    angles = -np.linspace(13.1, 200.0, 60)
    short_of_loop = [2 * (np.log(8.0) - at) - critical_load(at) for at in angles]
    assert np.all(np.diff(short_of_loop) > -1e-9)
    assert np.abs(np.diff(short_of_loop)).max() < 0.01
    assert 0.5 < short_of_loop[0] < short_of_loop[-1] < 0.56


def test_guess_without_a_load(pair, centre):
    """Nodes of straight rods that carry nothing: a bad guess, and no arithmetic error."""
    with pytest.raises(ConvergenceError):
        solve_statics(pair, where_slacks_are(pair, (1e-4, 2e-4)), (3.1, 0.0), guess=np.zeros((2, 4, 8)))


def test_condensed_weight_of_taut_rods(pair):
    """What the weight adds to F goes to a limit as the rods are drawn straight, also where k' is no number."""
    laden, added = replace(pair, gravity=(0.0, -9.81)), []
    for pull in (1e5, 2e5, 9e5):
        phi = np.array([-0.3, 0.3])
        p = where_slacks_are(pair, 4 * np.sin(phi / 4) ** 2 / np.sqrt(pull))
        q = np.arctan2(*(p - pair.bases).T[::-1]) - phi
        pose = solve_statics(pair, p, q)
        plant = Plant(laden, weight="condensed")
        plant.reset(np.concatenate([p, [0.0, 0.0], q]), pose)
        added.append(plant.force(p, q) - pose.force)
    assert added[1] == pytest.approx(added[0], rel=0.01, abs=1e-5)
    assert added[2] == pytest.approx(added[0], rel=0.03, abs=1e-5)
