"""Equilibria against energy, symmetry, other methods and published numbers."""

import numpy as np
import pytest

from pcr_mpc import (
    ConvergenceError,
    UnreachableError,
    forward_statics,
    inverse_statics,
    load_robot,
    solve_statics,
)
from tests.conftest import MODELS

METHODS = ("closed_form", "multiple_shooting", "single_shooting")


def numerical_gradient(function, x, h=1e-4):
    """Fourth-order central differences."""
    steps = h * np.eye(len(x))
    return np.array([(8 * (function(x + e) - function(x - e)) - function(x + 2 * e) + function(x - 2 * e)) / 12 / h
                     for e in steps])  # fmt: skip


@pytest.mark.parametrize("method", METHODS)
def test_force_and_torque_are_gradients_of_the_energy(pair, poses, method):
    """The sign of F, K and tau: this is what the correction of eq. (13) is for."""
    options = {"method": method, "steps": 4}
    # Differences of the energy show the residual that a method stops at, divided by the step.
    tolerance = 1e-5 if method == "single_shooting" else 1e-7
    for eq in poses:
        eq = solve_statics(pair, eq.p, eq.q, guess=eq, **options)

        def energy(x, eq=eq):
            return solve_statics(pair, x[:2], x[2:], guess=eq, **options).energy

        gradient = numerical_gradient(energy, np.concatenate([eq.p, eq.q]))
        assert gradient[:2] == pytest.approx(eq.force, rel=tolerance)
        assert gradient[2:] == pytest.approx(eq.motor_torque, rel=tolerance)


@pytest.mark.parametrize("method", METHODS)
def test_derivatives_against_differences(pair, poses, method):
    options = {"method": method, "steps": 4}
    for eq in poses[:2]:
        eq = solve_statics(pair, eq.p, eq.q, guess=eq, **options)

        def loads(x, eq=eq):
            found = solve_statics(pair, x[:2], x[2:], guess=eq, **options)
            return np.concatenate([found.force, found.motor_torque])

        jacobian = numerical_gradient(loads, np.concatenate([eq.p, eq.q])).T
        scale = np.abs(jacobian).max()
        assert eq.dforce_dp == pytest.approx(jacobian[:2, :2], abs=1e-7 * scale)
        assert eq.dforce_dq == pytest.approx(jacobian[:2, 2:], abs=1e-7 * scale)
        assert eq.dforce_dq.T == pytest.approx(jacobian[2:, :2], abs=1e-7 * scale)
        assert np.diag(eq.dtorque_dq) == pytest.approx(jacobian[2:, 2:], abs=1e-7 * scale)
        assert eq.dforce_dp == pytest.approx(eq.dforce_dp.T, abs=1e-7 * scale)


@pytest.mark.parametrize("method", METHODS[1:])
def test_methods_agree(pair, poses, method):
    for exact in poses:
        eq = solve_statics(pair, exact.p, exact.q, method=method, guess=exact)
        assert eq.method == method
        for name in ("force", "dforce_dp", "dforce_dq", "motor_torque", "energy", "rod_forces"):
            wanted = np.asarray(getattr(exact, name))
            assert getattr(eq, name) == pytest.approx(wanted, abs=5e-5 * np.abs(wanted).max())
        assert eq.mode == exact.mode
        assert eq.stable == exact.stable
        assert eq.shape(20) == pytest.approx(exact.shape(20), abs=1e-4)


def test_rfrfr_forward(rfrfr):
    """Inputs published (Zaccaria; Gotelli), outputs by two independent computations."""
    eq = forward_statics(rfrfr, np.radians([120.0, 60.0]))
    assert eq.p == pytest.approx([0.0, 0.9275014786], abs=1e-9)
    assert eq.rod_forces[0] == pytest.approx([0.3777701295, 0.0], abs=1e-9)
    assert -eq.motor_torque[0] == pytest.approx(-0.3503823537, abs=1e-9)
    assert eq.dforce_dp == pytest.approx(np.diag([15.02206, 104.54356]), abs=1e-5)
    shooting = solve_statics(rfrfr, eq.p, eq.q, method="multiple_shooting", guess=eq)
    assert shooting.rod_forces[0] == pytest.approx([0.3777701295, 0.0], abs=1e-6)
    assert eq.stable
    assert eq.mode == "LR"


def test_mirror_symmetry(pair):
    left = solve_statics(pair, (0.05, 0.22), (3.2, -0.4))
    right = solve_statics(pair, (-0.05, 0.22), (np.pi + 0.4, np.pi - 3.2))
    assert right.force == pytest.approx(left.force * [-1, 1], abs=1e-9)
    assert right.motor_torque == pytest.approx(-left.motor_torque[::-1], abs=1e-10)
    assert right.energy == pytest.approx(left.energy, abs=1e-12)


def test_turned_and_scaled_robot(pair, poses):
    """Force scales with EI/L^2 and turns with the robot, whatever the method's units."""
    from dataclasses import replace

    angle, size, stiffness = 0.7, 2.5, 3.0
    turn = size * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rods = tuple(
        replace(rod, base=tuple(turn @ rod.base), length=size * rod.length, bending_stiffness=stiffness * 0.05)
        for rod in pair.rods
    )
    robot = replace(pair, rods=rods)
    for eq in poses:
        nodes = eq.nodes.copy()
        nodes[:, 0] += angle
        nodes[:, 1:3] = np.einsum("ij,rjs->ris", turn / size, nodes[:, 1:3])
        other = solve_statics(robot, turn @ eq.p, eq.q + angle, guess=nodes)
        assert other.force == pytest.approx(turn @ eq.force * stiffness / size**3, rel=1e-9)
        assert other.energy == pytest.approx(eq.energy * stiffness / size, rel=1e-9)


def test_inverse_and_forward_undo_each_other(pair, centre):
    force = (0.4, -0.7)
    eq = inverse_statics(pair, (0.04, 0.27), force, guess=centre)
    assert eq.force == pytest.approx(force, abs=1e-8)
    assert eq.mode == "LR"
    back = forward_statics(pair, eq.q, force, guess=centre)
    assert back.p == pytest.approx(eq.p, abs=1e-9)
    cold = forward_statics(pair, eq.q, force)
    assert cold.stable
    assert cold.energy - cold.p @ force <= back.energy - back.p @ force + 1e-9


def test_default_pose(centre):
    assert centre.q == pytest.approx([3.37, -0.23], abs=0.01)
    assert centre.stable
    assert np.abs(centre.force).max() < 1e-8


def test_inverse_with_a_motor_too_many():
    robot = load_robot(MODELS / "three_rods.toml")
    eq = inverse_statics(robot, (0.01, 0.12), (0.1, 0.2), mode="LLL")
    assert eq.force == pytest.approx([0.1, 0.2], abs=1e-8)
    assert (eq.mode, eq.stable) == ("LLL", True)


def test_warm_start_follows_the_branch(pair, centre):
    p, q = centre.p + [1e-3, 0], centre.q
    warm = solve_statics(pair, p, q, method="multiple_shooting", steps=4, guess=centre)
    cold = solve_statics(pair, p, q, method="multiple_shooting", steps=4)
    assert warm.force == pytest.approx(cold.force, abs=1e-8)
    assert warm.iterations <= 3


def test_unreachable(pair):
    with pytest.raises(UnreachableError, match=r"rod 0, whose length is 0\.4 m") as caught:
        solve_statics(pair, (0.4, 0.1), (3.0, 0.0))
    assert caught.value.rod == 0
    assert caught.value.distance == pytest.approx(np.hypot(0.5, 0.1))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0.0, np.nan), (3.0, 0.0)), "p is not finite"),
        (((0.0, 0.2, 0.1), (3.0, 0.0)), r"p has shape \(3,\), expected \(2,\)"),
        (((0.0, 0.2), (3.0,)), r"q has shape \(1,\), expected \(2,\)"),
        (((0.0, 0.2), (3.0, np.inf)), "q is not finite"),
    ],
)
def test_bad_arguments_are_named(pair, arguments, message):
    with pytest.raises(ValueError, match=message):
        solve_statics(pair, *arguments)


def test_bad_options_are_named(pair):
    for options, message in (
        ({"method": "newton"}, "method is 'newton'"),
        ({"segments": 0, "steps": 4}, "segments = 0"),
        ({"scheme": "rk5", "steps": 4}, "scheme is 'rk5'"),
        ({"guess": np.zeros((2, 4))}, r"guess has shape \(2, 4\)"),
    ):
        with pytest.raises(ValueError, match=message):
            solve_statics(pair, (0.0, 0.25), (3.3, -0.2), **options)


@pytest.mark.parametrize("method", METHODS[1:])
def test_a_hopeless_guess_is_an_error_not_an_answer(pair, method):
    nodes = np.full((2, 4, 8), 1e3)
    with pytest.raises(ConvergenceError, match="residual") as caught:
        solve_statics(pair, (0.0, 0.25), (3.3, -0.2), method=method, steps=4, guess=nodes)
    assert not caught.value.residual < 1e-6


def test_taut_rods_are_refined_or_refused(pair):
    """A rod at 0.96 of its length, clamped 2 rad off: one step per segment does not resolve it."""
    p, q = (0.1, 0.3274), (3.9, 0.3)
    coarse = solve_statics(pair, p, q, method="multiple_shooting", steps=2, guess=solve_statics(pair, p, q))
    refined = solve_statics(pair, p, q, method="multiple_shooting")
    exact = solve_statics(pair, p, q)
    assert coarse.drift > 1e-4
    assert refined.drift < 1e-6
    assert refined.force == pytest.approx(exact.force, rel=1e-4)
    with pytest.raises(ConvergenceError, match="segments"):
        solve_statics(pair, p, q, method="multiple_shooting", segments=1)


def test_taut_rods_are_drawn_to_their_tips(rfrfr):
    """Stretch 0.98: nodes close enough together that the centreline does not run away."""
    eq = solve_statics(rfrfr, (-0.78, 0.044), (-4.735, 0.577))
    assert eq.shape()[:, -1] == pytest.approx(np.tile(eq.p, (2, 1)), abs=1e-7)


def test_inverse_statics_keeps_to_stops_and_modes(pair, centre):
    with pytest.raises(UnreachableError, match="outside") as caught:
        inverse_statics(pair, (-0.22, 0.06), guess=centre)
    assert caught.value.angle > caught.value.limits[1]
    with pytest.raises(ValueError, match="either guess"):
        inverse_statics(pair, (0.01, 0.25), guess=centre, mode="RL")


def test_a_guess_of_another_robot_is_named(pair, centre):
    other = inverse_statics(load_robot(MODELS / "three_rods.toml"), (0.0, 0.115), mode="LLL")
    with pytest.raises(ValueError, match=r"expected \(2, 4, N\)"):
        inverse_statics(pair, (0.0, 0.25), guess=other)
    with pytest.raises(ValueError, match="guess has 3 rods"):
        solve_statics(pair, (0.0, 0.25), centre.q, guess=other)


def test_equilibria_are_frozen(centre):
    with pytest.raises(ValueError, match="read-only"):
        centre.force[0] = 1.0
