"""Warm starts from an equilibrium's record, against cold solves, other methods and laws of scale."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import UnstableError, all_equilibria, inverse_statics, solve_statics
from pcr_mpc.compiled import has_compiler
from pcr_mpc.plant.rods.method import Shooting, by_machine_code, shooting_method
from pcr_mpc.plant.statics.first_rung import FirstRung

from .test_statics_batch import FIGURES, loop, require_same


@pytest.mark.parametrize("method", ["closed_form", "multiple_shooting"])
def test_a_near_guess_is_solved_on_the_warm_rung_to_what_a_cold_solve_finds(pair, centre, method):
    guess = solve_statics(pair, centre.p, centre.q, method=method)
    for move in ([1e-3, 0.0], [-2e-3, 1e-3]):
        p, q = centre.p + move, centre.q + [0.01, -0.005]
        warm, cold = (solve_statics(pair, p, q, method=method, guess=start) for start in (guess, None))
        assert (warm.rung, cold.rung) == ("warm", "cold")
        assert "nodes" not in vars(guess)  # it went on from the record
        require_same(warm, cold, rel=1e-7 if method == "multiple_shooting" else 1e-10)
        np.testing.assert_allclose(warm.shape(9), cold.shape(9), atol=1e-9)
        np.testing.assert_array_equal(warm.p, p)
        np.testing.assert_array_equal(warm.q, q)
        assert warm.stable


def test_a_warm_start_from_another_robot_of_the_kind_obeys_the_law_of_scale(pair, centre):
    """Rods three times as stiff have three times the loads at the same pose."""
    stiff = replace(pair, rods=tuple(replace(rod, bending_stiffness=3 * rod.bending_stiffness) for rod in pair.rods))
    p, q = centre.p + [1e-3, 2e-3], centre.q + [0.01, 0.0]
    eq = solve_statics(stiff, p, q, guess=centre)
    assert eq.robot == stiff
    assert eq.rung == "warm"
    exact = solve_statics(pair, p, q)
    assert eq.force == pytest.approx(3 * exact.force, rel=1e-10)
    assert eq.energy == pytest.approx(3 * exact.energy, rel=1e-10)


def test_what_was_changed_in_a_guess_counts_and_its_record_no_more(pair, centre):
    """Nodes of another mode lead there: the record of the old one would lead back."""
    held = {eq.mode: eq for eq in all_equilibria(pair, centre.p, centre.q)}
    spoiled = replace(held["LR"], nodes=held["LL"].nodes)
    for guess, mode in ((held["LR"], "LR"), (held["LL"], "LL"), (spoiled, "LL")):
        eq = solve_statics(pair, centre.p + [1e-3, 0.0], centre.q, guess=guess)
        assert eq.mode == mode
        assert eq.force == pytest.approx(held[mode].force, abs=2.0)


def test_what_nobody_asked_for_is_not_computed_and_copies_go_on_as_warm(pair, centre):
    eq = solve_statics(pair, centre.p + [1e-3, 0.0], centre.q, guess=centre)
    assert not {"nodes", "energy", "motor_torque"} & vars(eq).keys()
    packed = pickle.dumps(eq)
    assert len(packed) < len(pickle.dumps(pair)) + 2500
    other = pickle.loads(packed)
    for name in (*FIGURES, "nodes"):
        np.testing.assert_array_equal(getattr(other, name), getattr(eq, name))
    with pytest.raises(ValueError, match="read-only"):
        eq.nodes[...] = 0.0
    other = pickle.loads(packed)
    one, two = (solve_statics(pair, centre.p, centre.q, guess=start) for start in (eq, other))
    assert "nodes" not in vars(other)
    assert one.rung == two.rung == "warm"
    np.testing.assert_array_equal(one.force, two.force)
    with pytest.raises(AttributeError, match="no attribute 'tension'"):
        eq.tension  # noqa: B018


def test_the_warm_rung_does_not_walk_through_a_fold(pair, centre):
    """Towards a straight rod's other side there is no stable shape of this branch."""
    guess, end = centre, centre.q + [-3.5, 3.5]
    for part in np.linspace(0.0, 1.0, 400):
        try:
            guess = solve_statics(pair, centre.p, centre.q + part * (end - centre.q), guess=guess)
        except UnstableError:
            break
        assert not guess.unstable_rods
    assert 0.25 < part < 1.0


def test_motors_along_a_path_carry_what_is_wanted(pair, centre):
    p, _ = loop(centre, 40)
    eq = centre
    for k, tip in enumerate(p):
        wanted = np.array([0.3 * np.sin(0.2 * k), 0.2])
        eq = inverse_statics(pair, tip, wanted, guess=eq)
        assert eq.force == pytest.approx(wanted, abs=1e-8)
        np.testing.assert_array_equal(eq.p, tip)
    cold = solve_statics(pair, eq.p, eq.q, method="multiple_shooting", steps=4)
    assert cold.force == pytest.approx(wanted, abs=1e-6)
    assert cold.mode == "LR"


def test_shot_rods_are_the_same_by_machine_code_bit_for_bit(pair, centre):
    """Both counts of iterations, and that it is machine code at all: the interpreter would agree with itself."""
    coarse = {"method": "multiple_shooting", "segments": 2, "steps": 1}
    guess = solve_statics(pair, centre.p, centre.q, **coarse)
    p, q = centre.p + [1e-3, 2e-3], centre.q + [0.01, 0.0]
    method = shooting_method(Shooting(2, 1), None)
    for accuracy in (None, 1e-2):
        found = [
            FirstRung(pair, method, compiled=compiled).climb(guess.record, p, q, accuracy) for compiled in (False, True)
        ]
        assert found[0].iterations == found[1].iterations
        np.testing.assert_array_equal(found[0].record, found[1].record)
        np.testing.assert_array_equal(found[0].result, found[1].result)
    if has_compiler():
        assert by_machine_code(method).newton.class_name() == "GenericExternal"
