"""Cold starts over the workspace of the default robot, judged by the energy."""

import numpy as np
import pytest

from pcr_mpc import PCRError, solve_statics
from tests.conftest import random_pose


def check(pair, count, method, reach, seed, solved_at_least):
    tolerance = 1e-5 if method == "closed_form" else 1e-3
    rng = np.random.default_rng(seed)
    solved = failed = 0
    while solved + failed < count:
        p, q = random_pose(pair, rng, reach)
        try:
            eq = solve_statics(pair, p, q, method=method)
        except PCRError:  # anything else is a crash, and fails the test
            failed += 1
            continue
        if not eq.stable:
            continue  # a stable shape of every rod, but K is not positive definite
        solved += 1
        assert eq.residual_norm < 1e-9
        assert eq.drift < 1e-6
        # Same discretisation on both sides, so that its error in the energy cancels.
        h, gradient = 1e-4, []
        for axis in range(2):
            step = h * np.eye(2)[axis]
            energies = [
                solve_statics(pair, p + s * step, q, method=method, steps=12, guess=eq).energy for s in (-2, -1, 1, 2)
            ]
            gradient.append(np.dot(energies, [1, -8, 8, -1]) / (12 * h))
        size = np.linalg.norm(eq.rod_forces)
        assert np.linalg.norm(np.array(gradient) - eq.force) < tolerance * size, (p, q)
    assert solved >= solved_at_least * count


def test_multiple_shooting(pair):
    check(pair, 20, "multiple_shooting", 0.97, seed=1, solved_at_least=0.97)


@pytest.mark.slow
def test_multiple_shooting_over_1000_poses(pair):
    """Up to 0.97 of the rods' length: beyond, eight segments do not resolve the most taut rods (they say so)."""
    check(pair, 1000, "multiple_shooting", 0.97, seed=2, solved_at_least=0.99)


@pytest.mark.slow
def test_closed_form_over_1000_poses(pair):
    check(pair, 1000, "closed_form", 0.99, seed=3, solved_at_least=0.99)
