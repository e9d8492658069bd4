"""What the docstrings of free poses, stability and robots promise, one promise a test."""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    ConvergenceError,
    Equilibrium,
    ModelError,
    PCRError,
    Rod,
    UnreachableError,
    UnstableError,
    all_equilibria,
    assess_stability,
    forward_statics,
    inverse_statics,
    solve_statics,
)
from pcr_mpc.plant.statics.balance import settle
from pcr_mpc.plant.statics.free_tip import free_solver
from pcr_mpc.plant.statics.stability import count_conjugate_points, distance_to_fold


@pytest.fixture(scope="module")
def saddle(pair) -> Equilibrium:
    """Both rods stable with the tip held, K with a negative eigenvalue; in balance under its own force."""
    eq = solve_statics(pair, (0.0, 0.15), (2.25, np.pi - 2.25))
    assert not eq.unstable_rods
    assert eq.stiffness_eigenvalues[0] < -10 < 10 < eq.stiffness_eigenvalues[1]
    return eq


# Free poses


@pytest.mark.parametrize("motor", [0, 1])
@pytest.mark.parametrize("side", [0, 1])
def test_a_cold_search_keeps_to_the_stops(pair, centre, motor, side):
    """A stop just short of where the motor would have to be: no pose of that mode, on either side of either motor."""
    stops = [centre.q[motor] + 0.02, centre.q[motor] + 1.0] if side == 0 else [centre.q[motor] - 1.0, 0.0]
    for beyond, found in ((0.02, False), (-0.02, True)):
        stops[side] = centre.q[motor] + (1 - 2 * side) * beyond
        rods = list(pair.rods)
        rods[motor] = replace(rods[motor], angle_limits=tuple(stops))
        robot = replace(pair, rods=tuple(rods))
        if found:
            assert inverse_statics(robot, centre.p, mode="LR").q == pytest.approx(centre.q, abs=1e-7)
        else:
            with pytest.raises(ConvergenceError, match=r"no stable pose of mode LR found .* within the motor limits"):
                inverse_statics(robot, centre.p, mode="LR")


@pytest.mark.parametrize("side", [0, 1])
def test_a_branch_that_needs_a_motor_beyond_a_stop_says_which(pair, centre, side):
    stops = (centre.q[1] + 0.02, 9.0) if side == 0 else (-9.0, centre.q[1] - 0.02)
    robot = replace(pair, rods=(pair.rods[0], replace(pair.rods[1], angle_limits=stops)))
    with pytest.raises(UnreachableError, match=r"needs motor 1 at .* outside") as caught:
        inverse_statics(robot, centre.p, guess=centre)
    assert caught.value.rod == 1
    assert caught.value.angle == pytest.approx(centre.q[1])
    assert caught.value.limits == stops


def test_a_balance_that_is_not_stable_is_no_free_pose(pair, saddle):
    solver = free_solver(pair)
    solver.start(saddle.p, saddle.q, saddle.nodes)
    with pytest.raises(UnstableError, match="in balance but not stable") as caught:
        settle(solver, saddle.p, saddle.q, saddle.force)
    assert caught.value.eigenvalue == pytest.approx(saddle.stiffness_eigenvalues[0])
    assert caught.value.rod == ()
    assert caught.value.p == pytest.approx(saddle.p)
    assert caught.value.q == pytest.approx(saddle.q)


def test_forward_statics_carries_force_and_weight(pair, centre):
    robot, force = replace(pair, gravity=(1.0, -9.81)), np.array([0.4, -0.7])
    eq = forward_statics(robot, centre.q, force)
    assert eq.force == pytest.approx(force + robot.tip_mass * np.array([1.0, -9.81]), abs=1e-7)
    assert eq.q == pytest.approx(centre.q, abs=0)
    assert eq.stable
    again = forward_statics(robot, centre.q, force, guess=eq)
    assert again.p == pytest.approx(eq.p, abs=1e-9)


def test_inverse_statics_takes_the_pose_of_least_energy_or_of_the_mode(pair, centre):
    best = inverse_statics(pair, centre.p)
    modes = {}
    for mode in ("LL", "LR", "RL", "RR"):
        try:
            modes[mode] = inverse_statics(pair, centre.p, mode=mode)
        except ConvergenceError:
            continue
        assert modes[mode].mode == mode
    assert len(modes) > 1
    assert best.energy == pytest.approx(min(eq.energy for eq in modes.values()), rel=1e-9)


def test_wrong_arguments_of_statics_are_named(pair, centre):
    for mode in ("L", "LRL", "lr", "XY", 3):
        with pytest.raises(ValueError, match="expected 2 letters L or R"):
            inverse_statics(pair, centre.p, mode=mode)
    with pytest.raises(TypeError, match="guess is a list, expected an Equilibrium"):
        inverse_statics(pair, centre.p, guess=[1.0])
    with pytest.raises(TypeError, match="guess is a list, expected an Equilibrium"):
        forward_statics(pair, centre.q, guess=[1.0])
    with pytest.raises(ValueError, match="take off the whole turns"):
        forward_statics(pair, (2e6, 0.0))
    assert pair.checked_angles("q", (-1e6, 1e6)).tolist() == [-1e6, 1e6]
    with pytest.raises(ValueError, match="n_points is 1, expected at least 2"):
        centre.shape(1)
    assert centre.shape(2).shape == (2, 2, 2)


def test_a_force_that_no_angles_can_hold_is_an_error(pair, centre):
    with pytest.raises(ConvergenceError, match=r"on the branch of the guess; got .* of the way") as caught:
        inverse_statics(pair, (0.086, -0.084), (2.15, 1.03), guess=centre)
    assert caught.value.residual > 1e-6
    assert caught.value.iterations > 0
    assert caught.value.last.shape == (2,)


def test_rods_that_cannot_meet_have_no_free_pose(pair):
    far = replace(pair, rods=(pair.rods[0], replace(pair.rods[1], base=(5.0, 0.0))))
    with pytest.raises(ConvergenceError, match="check that the rods can meet") as caught:
        forward_statics(far, (0.0, 0.0))
    assert math.isnan(caught.value.residual)


# Stability


def least_gain(matrix: np.ndarray) -> float:
    """Least |G'v| over unit vectors v of force, by looking at them all."""
    angles = np.linspace(0, np.pi, 200_001)
    return float(np.linalg.norm(np.stack([np.cos(angles), np.sin(angles)], axis=1) @ matrix, axis=1).min())


@pytest.mark.parametrize("half", [0.36, 0.385])
def test_rods_that_only_just_meet_have_a_free_pose(pair, half):
    """By another method, and the one of least energy of those that a search over the whole region lists."""
    rods = [replace(rod, base=(math.copysign(half, rod.base[0]), 0.0), angle_limits=(-4.0, 4.0)) for rod in pair.rods]
    robot = replace(pair, rods=tuple(rods))
    q = (1.0, math.pi - 1.0)
    eq = forward_statics(robot, q)
    assert eq.stable
    again = solve_statics(robot, eq.p, q, method="multiple_shooting", guess=eq)
    assert again.force == pytest.approx([0.0, 0.0], abs=1e-4)
    if half == 0.36:
        assert eq.p == pytest.approx(all_equilibria(robot, q=q)[0].p, abs=1e-7)


def test_motor_authority_is_the_force_that_motors_move_least(poses):
    for eq in poses:
        verdict = assess_stability(eq)
        assert verdict.motor_authority == pytest.approx(least_gain(eq.dforce_dq), rel=1e-6)
        assert verdict.motor_authority < 0.99 * np.linalg.norm(eq.dforce_dq, 2)


def test_unstable_directions_are_counted(centre, saddle):
    assert assess_stability(centre).unstable_directions == 0
    assert assess_stability(centre).stable
    verdict = assess_stability(saddle)
    assert verdict.unstable_directions == 1
    assert not verdict.stable
    assert verdict.stiffness_eigenvalues == pytest.approx(np.linalg.eigvalsh(saddle.dforce_dp), abs=1e-6)
    assert (np.diff(verdict.stiffness_eigenvalues) > 0).all()


def test_rods_that_are_not_plain_have_no_margin(bent):
    verdict = assess_stability(bent)
    assert np.isnan(verdict.rod_margins).all()
    assert verdict.unstable_directions == 0


def test_a_sweep_that_does_not_resolve_taut_rods_says_so(pair):
    taut = solve_statics(pair, (0.0, 0.386), (1.9, np.pi - 1.9), method="closed_form")
    assert count_conjugate_points(taut, segments=16) == 0
    with pytest.raises(
        ConvergenceError, match=r"too taut for 4 segments: .* residual is [^0].* \(at most 1e-05 each\)"
    ) as caught:
        count_conjugate_points(taut, segments=4)
    assert caught.value.last.shape[1] == 4


def test_distance_to_fold_is_none_from_an_unstable_start_and_all_of_a_harmless_way(centre, saddle):
    assert distance_to_fold(saddle, saddle.p + [0.01, 0.0], saddle.q) == 0.0
    assert distance_to_fold(centre, centre.p + [0.01, 0.0], centre.q) == 1.0
    # Out of reach is no longer stable: the rod is straight where |p - base| = L.
    end = centre.p + [0.0, 0.4]
    straight = (math.sqrt(0.4**2 - 0.1**2) - centre.p[1]) / 0.4
    assert distance_to_fold(centre, end, centre.q) == pytest.approx(straight, abs=0.02)


def test_all_equilibria_refuses_what_it_cannot_list(general, centre):
    with pytest.raises(ModelError, match="all_equilibria"):
        all_equilibria(general, q=centre.q)


# The robot as data


def test_slacks_and_reach(pair):
    """On a rod's circle of reach, just inside, and just outside; a rod that stretches bears a hundredth more."""
    length, base = pair.rods[0].length, pair.rods[0].base
    direction = np.array([math.sin(0.3), math.cos(0.3)])
    for fraction, fine in ((0.999, True), (1.0, False), (1.001, False)):
        p = np.array(base) + fraction * length * direction
        assert pair.slacks(p)[0] == pytest.approx(1 - fraction, abs=1e-12)
        if fine:
            pair.require_reachable(p)
            continue
        with pytest.raises(UnreachableError, match="straight" if fraction == 1.0 else "m closer") as caught:
            pair.require_reachable(p)
        assert (caught.value.rod, caught.value.length) == (0, length)
        assert caught.value.distance == pytest.approx(fraction * length)
        assert pickle.loads(pickle.dumps(caught.value)).distance == caught.value.distance
    soft = replace(pair, rods=tuple(replace(rod, axial_stiffness=1e3) for rod in pair.rods))
    soft.require_reachable(np.array(base) + 1.009 * length * direction)
    with pytest.raises(UnreachableError):
        soft.require_reachable(np.array(base) + 1.011 * length * direction)
    with pytest.raises(UnreachableError):
        pair.require_reachable(np.array([np.nan, 0.0]))


ROD = {"base": (0.0, 0.0), "length": 0.4, "bending_stiffness": 0.05, "line_density": 0.0, "angle_limits": (-1.0, 1.0)}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("length", 0.0), ("length", -1.0), ("length", math.nan), ("length", math.inf), ("length", "0.4"),
        ("bending_stiffness", 0.0), ("line_density", -1e-9), ("line_density", True),
        ("axial_stiffness", 0.0), ("axial_stiffness", math.nan), ("angle_limits", (1.0, 1.0)),
        ("angle_limits", (2.0, 1.0)), ("curvature", (1.0,) * 66), ("curvature", ()), ("curvature", (1.0, math.nan)),
        ("stiffness_factors", (1.0, 0.0009)), ("stiffness_factors", (1.0, 1001.0)), ("stiffness_factors", ()),
    ],
)  # fmt: skip
def test_a_rod_refuses_numbers_that_make_no_sense(key, value):
    with pytest.raises(ModelError, match=key) as caught:
        Rod(**{**ROD, key: value})
    assert caught.value.key == key


def test_a_rod_takes_what_is_at_the_edge_and_numbers_of_numpy():
    rod = Rod(**{**ROD, "length": np.float32(0.5), "curvature": np.ones(65), "stiffness_factors": (1e-3, 1e3)})
    assert (rod.length, rod.line_density, type(rod.length)) == (0.5, 0.0, float)
    assert rod.curvatures == (1.0,) * 65
    assert not rod.stretches
    assert Rod(**ROD, axial_stiffness=1.0).stretches
    assert Rod(**ROD, curvature=2).curvatures == (2.0,)


@pytest.mark.parametrize(
    ("key", "value"),
    [("tip_mass", 0.0), ("drag", -1e-9), ("rate_limit", 0.0), ("acceleration_limit", -1.0), ("torque_limit", 0.0)],
)
def test_a_robot_refuses_numbers_that_make_no_sense(pair, key, value):
    with pytest.raises(ModelError, match=key):
        replace(pair, **{key: value})
    assert replace(pair, drag=0.0).drag == 0.0


def test_a_robot_needs_two_rods_at_different_bases(pair):
    for rods in (pair.rods[:1], (pair.rods[0], pair.rods[0]), ()):
        with pytest.raises(ModelError, match="two or more rods at different bases"):
            replace(pair, rods=rods)
    with pytest.raises(TypeError, match="rods holds 3, expected a Rod"):
        replace(pair, rods=(pair.rods[0], 3))


def test_why_a_robot_needs_shooting(pair, general):
    assert pair.needs_shooting is None
    reasons = [
        ({"curvature": 0.1}, "is curved at rest"),
        ({"stiffness_factors": (1.0, 0.9)}, "changes its stiffness"),
        ({"axial_stiffness": 1e3}, "stretches"),
    ]
    for change, reason in reasons:
        robot = replace(pair, rods=(pair.rods[0], replace(pair.rods[1], **change)))
        assert reason in robot.needs_shooting
        assert robot.plain() == pair
    heavy = replace(pair, gravity=(0.0, -9.81))
    assert "has weight" in heavy.needs_shooting
    assert heavy.weightless() == pair
    assert general.plain().gravity == general.gravity
    with pytest.raises(PCRError):
        all_equilibria(heavy, q=(3.0, 0.1))
