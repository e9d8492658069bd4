"""Batches of held poses, against cold solves, other methods, laws of scale and energy differences."""

import numpy as np
import pytest

from pcr_mpc import (
    Equilibria,
    UnreachableError,
    all_equilibria,
    inverse_statics,
    load_robot,
    solve_statics,
    solve_statics_batch,
)
from pcr_mpc.plant.rods.closed_form import elastica
from pcr_mpc.plant.rods.equations import sample_rod
from tests.conftest import MODELS

FIGURES = ("force", "dforce_dp", "dforce_dq", "motor_torque", "dtorque_dq", "energy", "rod_forces")


def loop(centre, count, size=0.01, turn=0.05):
    """A closed path of tip and motors through the centre."""
    angle = np.linspace(0.0, 2 * np.pi, count)
    p = centre.p + size * np.stack([np.cos(angle) - 1.0, np.sin(angle)], axis=1)
    return p, centre.q + turn * np.stack([np.sin(angle), np.cos(angle) - 1.0], axis=1)


def require_same(found, wanted, row=None, rel=1e-9):
    for name in FIGURES:
        value = np.asarray(getattr(found, name) if row is None else getattr(found, name)[row])
        right = np.asarray(getattr(wanted, name))
        np.testing.assert_allclose(value, right, rtol=0, atol=rel * max(1.0, np.abs(right).max()), err_msg=name)


@pytest.mark.parametrize("along", [True, False])
@pytest.mark.parametrize("method", ["closed_form", "multiple_shooting", "single_shooting"])
def test_rows_are_what_cold_solves_find(pair, centre, method, along):
    p, q = loop(centre, 12)
    batch = solve_statics_batch(pair, p, q, guess=centre, along=along, method=method)
    assert isinstance(batch, Equilibria)
    assert batch.method == method
    assert batch.reason == ("",) * 12
    assert batch.solved.all()
    assert not batch.unstable.any()
    rel = {"closed_form": 1e-10, "multiple_shooting": 1e-5, "single_shooting": 1e-4}[method]
    for row in range(12):
        exact = solve_statics(pair, p[row], q[row])
        require_same(batch, exact, row, rel=rel)
        assert batch.stable[row] == exact.stable
        again = solve_statics(pair, p[row], q[row], guess=batch.nodes(row))
        assert again.force == pytest.approx(exact.force, rel=1e-9)
    with pytest.raises(ValueError, match="read-only"):
        batch.force[...] = 0.0


@pytest.mark.parametrize("along", [True, False])
def test_forces_and_torques_are_what_the_energy_changes_by(general, bent, along):
    """Along a path, for rods with weight, curvature, varying stiffness and stretch: multiple shooting."""
    p, q = loop(bent, 65)
    batch = solve_statics_batch(general, p, q, guess=bent, along=along)
    assert batch.method == "multiple_shooting"
    loads = np.hstack([batch.force, batch.motor_torque])
    moves = np.diff(np.hstack([p, q]), axis=0)
    slopes = np.zeros((65, 4, 4))
    slopes[:, :2, :2], slopes[:, :2, 2:] = batch.dforce_dp, batch.dforce_dq
    slopes[:, 2:, :2] = batch.dforce_dq.transpose(0, 2, 1)
    slopes[:, [2, 3], [2, 3]] = batch.dtorque_dq
    # Hermite's rule: the trapezium and its correction by the slopes at both ends.
    work = np.einsum("ki,ki->k", (loads[1:] + loads[:-1]) / 2, moves)
    work -= np.einsum("ki,kij,kj->k", moves, slopes[1:] - slopes[:-1], moves) / 12
    assert np.ptp(batch.energy) > 1e-2
    np.testing.assert_allclose(np.diff(batch.energy), work, atol=1e-7 * np.ptp(batch.energy))


@pytest.mark.parametrize("along", [True, False])
def test_rows_that_fail_say_why_and_leave_the_others_alone(pair, centre, along):
    p, q = loop(centre, 100)
    bad = {0: "p is not finite", 7: "q is not finite", 8: "whose length is 0.4 m", 41: "take off the whole turns"}
    p[0, 0], q[7, 1], p[8], q[41, 0] = np.nan, np.inf, [0.6, 0.0], 1e7
    p[60], bad[60] = [-0.1, np.sqrt(0.12)], "straight"  # 0.4 m from the second base
    batch = solve_statics_batch(pair, p, q, guess=centre, along=along)
    for row in range(100):
        if row in bad:
            assert bad[row] in batch.reason[row]
            assert all(np.isnan(getattr(batch, name)[row]).all() for name in (*FIGURES, "residual_norm", "drift"))
            assert not batch.stable[row]
            with pytest.raises(ValueError, match=f"row {row} was not solved"):
                batch.nodes(row)
        else:
            assert batch.reason[row] == ""
    np.testing.assert_array_equal(np.flatnonzero(~batch.solved), sorted(bad))
    for row in (1, 9, 42, 61, 99):
        require_same(batch, solve_statics(pair, p[row], q[row]), row, rel=1e-10)
    with pytest.raises(UnreachableError):
        solve_statics(pair, p[60], q[60])


@pytest.mark.parametrize("cold", [True, False])
def test_a_path_that_comes_to_a_fold_goes_on_from_the_pose_before(pair, centre, cold):
    """Poses beyond the fold fail, also on a path that began cold; back on this side the old branch goes on."""
    part = np.concatenate([np.linspace(0.0, 1.0, 120), np.linspace(1.0, 0.0, 120)])
    q = centre.q + part[:, None] * [-3.5, 3.5]
    batch = solve_statics_batch(pair, np.tile(centre.p, (240, 1)), q, guess=None if cold else centre, along=True)
    beyond = np.flatnonzero(~batch.solved)
    # There and back the poses are the same.
    np.testing.assert_array_equal(beyond, np.arange(beyond[0], 240 - beyond[0]))
    assert 30 < beyond[0] < 119
    assert all("would snap to another shape" in batch.reason[row] for row in beyond)
    assert batch.solved[:30].all()
    assert batch.solved[-30:].all()
    np.testing.assert_allclose(batch.energy[-30:], batch.energy[:30][::-1], rtol=1e-9)


def test_rows_far_from_the_guess_are_followed_to(pair, centre):
    """More than a few Newton iterations reach: continuation by turns of one motor, the tip held."""
    q = centre.q + np.array([[0.0, 0.0], [1.2, 0.0], [0.0, -1.2], [0.6, -0.6]])
    batch = solve_statics_batch(pair, np.tile(centre.p, (4, 1)), q, guess=centre)
    assert batch.solved.all()
    for row, angles in enumerate(q):
        eq, turn = centre, angles - centre.q
        for part in np.linspace(0.02, 1.0, 50):
            eq = solve_statics(pair, centre.p, centre.q + part * turn, method="multiple_shooting", guess=eq)
        require_same(batch, eq, row, rel=1e-5)


def test_without_a_guess_the_shape_of_least_energy_is_taken(pair, centre):
    p, q = loop(centre, 4)
    for along in (True, False):
        batch = solve_statics_batch(pair, p, q, along=along)
        for row in range(4):
            least = all_equilibria(pair, p[row], q[row])[0]
            assert batch.energy[row] == pytest.approx(least.energy, rel=1e-9)


def test_taut_rows_are_refined_as_one_pose_is(pair):
    """Where one step a segment drifts too much for a taut rod, more are taken."""
    p = np.stack([np.zeros(200), np.linspace(0.381, 0.385, 200)], axis=1)
    q = np.tile([1.9, np.pi - 1.9], (200, 1))
    guess = solve_statics(pair, p[0], q[0], method="multiple_shooting")
    coarse = solve_statics_batch(pair, p, q, guess=guess, along=True, method="multiple_shooting", steps=1)
    batch = solve_statics_batch(pair, p, q, guess=guess, along=True, method="multiple_shooting")
    assert coarse.drift[-1] > 1e-6
    assert batch.solved.all()
    assert (batch.drift < 2e-5 * np.array([min(pair.slacks(tip)) for tip in p])).all()
    exact = solve_statics(pair, p[-1], q[-1])
    errors = [np.abs(found.force[-1] - exact.force).max() for found in (coarse, batch)]
    assert errors[1] < errors[0] / 10


def test_a_robot_of_three_rods(pair):
    robot = load_robot(MODELS / "three_rods.toml")
    centre = inverse_statics(robot, (0.01, 0.12), mode="LLL")
    k = np.arange(10)
    p, q = centre.p + 1e-3 * np.stack([np.sin(k), np.cos(k)], axis=1), np.tile(centre.q, (10, 1))
    batch = solve_statics_batch(robot, p, q, guess=centre)
    assert batch.dforce_dq.shape == (10, 2, 3)
    for row in (0, 9):
        require_same(
            batch, solve_statics(robot, p[row], q[row], method="multiple_shooting", guess=centre), row, rel=1e-5
        )


def test_wrong_arguments_of_a_batch_are_named(pair, centre):
    p, q = loop(centre, 3)
    three_rods = inverse_statics(load_robot(MODELS / "three_rods.toml"), (0.01, 0.12), mode="LLL")
    wrong = [
        (ValueError, r"p has shape \(2,\)", (p[0], q), {}),
        (ValueError, r"q has shape \(3, 1\)", (p, q[:, :1]), {}),
        (ValueError, "p has 2 rows, q 3", (p[1:], q), {}),
        (ValueError, "expected numbers", (p, [["a", "b"]] * 3), {}),
        (TypeError, "guess is a list", (p, q), {"guess": [1.0]}),
        (ValueError, "guess has 3 rods", (p, q), {"guess": three_rods}),
        (ValueError, "guess has 3 rods", (p, q), {"guess": three_rods, "method": "single_shooting"}),
        (ValueError, "method is 'newton'", (p, q), {"method": "newton"}),
    ]
    for kind, words, arguments, options in wrong:
        with pytest.raises(kind, match=words):
            solve_statics_batch(pair, *arguments, **options)
    for along in (True, False):
        none = solve_statics_batch(pair, np.empty((0, 2)), np.empty((0, 2)), guess=centre, along=along)
        assert none.force.shape == (0, 2)
        assert none.stable.shape == none.solved.shape == (0,)


@pytest.mark.slow
def test_machine_code_gives_the_same_bits(pair, centre, compiler):
    p, q = loop(centre, 20)
    for along in (True, False):
        one, two = (solve_statics_batch(pair, p, q, guess=centre, along=along, compiled=c) for c in (False, True))
        for name in FIGURES:
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


@pytest.mark.parametrize("along", [True, False])
def test_every_other_row_may_fail(pair, centre, along):
    p, q = loop(centre, 60)
    p[::2] += 1.0
    batch = solve_statics_batch(pair, p, q, guess=centre, along=along)
    np.testing.assert_array_equal(batch.solved, np.arange(60) % 2 == 1)
    p[::2] -= 1.0
    np.testing.assert_allclose(
        batch.force[1::2], solve_statics_batch(pair, p, q, guess=centre, along=along).force[1::2], atol=1e-10
    )


def test_poses_that_are_not_stable_are_told(pair, centre):
    """A saddle: rods that are stable with the tip held, which motors at rest do not hold."""
    p, q = np.array([centre.p, [0.0, 0.15]]), np.array([centre.q, [2.25, np.pi - 2.25]])
    batch = solve_statics_batch(pair, p, q)
    np.testing.assert_array_equal(batch.stable, [True, False])
    assert not batch.unstable.any()
    assert np.linalg.eigvalsh(batch.dforce_dp[1])[0] < 0 < np.linalg.eigvalsh(batch.dforce_dp[0])[0]


@pytest.mark.parametrize("method", ["closed_form", "multiple_shooting"])
def test_rods_beyond_their_limit_are_told_after_a_warm_start_too(pair, method):
    """k = 0.6, load 7.2: lambda_c is 6.7. The first rung is for stable rods."""
    nodes = elastica.nodes(np.array([np.log(2 * np.arccos(0.6)), 7.2, 1.0]), 0.0, 8)
    p = pair.rods[0].base + pair.rods[0].length * sample_rod(nodes, 2)[:2, -1]
    other = np.arctan2(*(p - pair.rods[1].base)[::-1]) + 0.5
    gentle = solve_statics(pair, p, (0.5, other)).nodes[1]
    guess = solve_statics(pair, p, (0.0, other), method=method, guess=np.stack([nodes, sample_rod(gentle, 9)[2:, :8]]))
    tips, angles = p + np.array([[1e-6, 0.0], [0.0, 1e-6]]), np.tile(guess.q, (2, 1))
    for tip in tips:
        assert solve_statics(pair, tip, guess.q, method=method, guess=guess).unstable_rods == (0,)
    for along in (True, False):
        batch = solve_statics_batch(pair, tips, angles, method=method, guess=guess, along=along)
        np.testing.assert_array_equal(batch.unstable, [[True, False]] * 2)
        assert not batch.stable.any()


def test_many_guesses_are_gone_on_from_each_by_itself(pair, centre):
    """In any order; what is too far for one step is left with a reason."""
    p, q = loop(centre, 70)
    start = solve_statics_batch(pair, p, q, guess=centre, along=True)
    order = np.random.default_rng(0).permutation(70)
    found = solve_statics_batch(pair, p[order], q[order] + 1e-3, guess=start.rows(order))
    assert found.solved.all()
    wanted = solve_statics_batch(pair, p, q + 1e-3, guess=centre, along=True)
    for name in FIGURES:
        assert getattr(found, name) == pytest.approx(getattr(wanted, name)[order], rel=1e-7, abs=1e-9), name
    far = solve_statics_batch(
        pair, centre.p + [[0.0, 0.0], [0.0, -0.2]], [centre.q] * 2, guess=start.rows(np.zeros(2, int))
    )
    assert far.solved.tolist() == [True, False]
    assert "in one step" in far.reason[1]
    with pytest.raises(ValueError, match="guess holds 70 poses"):
        solve_statics_batch(pair, p[:3], q[:3], guess=start)
