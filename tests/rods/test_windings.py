"""Motor angles that differ by whole turns hold the same pose: which of them is answered."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ModelError, Rod, forward_statics, inverse_statics, load_robot, solve_statics
from pcr_mpc.cli import main
from tests.conftest import MODELS

TURN = 2 * np.pi
CENTRE = (3.36683603, -0.22524337)  # rad, that hold the default robot at (0, 0.25)


def with_stops(robot, lower, upper):
    return replace(robot, rods=tuple(replace(rod, angle_limits=(lower, upper)) for rod in robot.rods))


@pytest.mark.parametrize("stop", [20.0, 1e3])
def test_motors_that_may_turn_far_are_not_wound_up(pair, stop):
    free = with_stops(pair, -stop, stop)
    assert inverse_statics(free, (0.0, 0.25), mode="LR").q == pytest.approx(CENTRE, abs=1e-7)


@pytest.mark.parametrize("p", [(-0.08, 0.28), (0.0, -0.25)])
def test_no_motor_is_more_than_half_a_turn_from_its_rods_chord(pair, p):
    eq = inverse_statics(with_stops(pair, -50.0, 50.0), p)
    chords = np.arctan2(*(eq.p - pair.bases).T[::-1])
    assert (np.abs(eq.q - chords) <= np.pi).all()
    assert eq.q == pytest.approx(solve_statics(pair, p, eq.q).q)
    assert np.abs(solve_statics(pair, p, eq.q).force).max() < 1e-7


def test_where_the_stops_ask_for_turns_the_nearest_is_taken(pair):
    eq = inverse_statics(with_stops(pair, 8.0, 30.0), (0.0, 0.25), mode="LR")
    assert eq.q == pytest.approx((CENTRE[0] + TURN, CENTRE[1] + 2 * TURN), abs=1e-7)
    eq = inverse_statics(with_stops(pair, -30.0, -8.0), (0.0, 0.25), mode="LR")
    assert eq.q == pytest.approx((CENTRE[0] - 2 * TURN, CENTRE[1] - 2 * TURN), abs=1e-7)


def test_a_guess_keeps_its_turns(pair):
    free = with_stops(pair, -50.0, 50.0)
    guess = solve_statics(free, (0.0, 0.25), np.array(CENTRE) + (2 * TURN, -TURN))
    eq = inverse_statics(free, (0.01, 0.26), guess=guess)
    plain = inverse_statics(pair, (0.01, 0.26), mode="LR")
    assert eq.q == pytest.approx(plain.q + (2 * TURN, -TURN), abs=1e-7)
    assert forward_statics(free, eq.q, guess=eq).q == pytest.approx(eq.q, abs=0)


def test_limits_in_degrees_are_questioned(pair, tmp_path):
    with pytest.raises(ModelError, match=r"60.*300.*degrees.*1\.047.*5\.236"):
        replace(pair.rods[0], angle_limits=(60.0, 300.0))
    text = (MODELS / "planar_pair.toml").read_text()
    path = tmp_path / "degrees.toml"
    path.write_text(text.replace("[1.04, 5.24]", "[60, 300]"))
    with pytest.raises(ModelError, match=r"degrees\.toml: .*angle_limits.*degrees"):
        load_robot(path)
    path.write_text(text.replace("[-2.1, 2.1]", "[-120, 120]"))
    with pytest.warns(UserWarning, match=r"degrees\.toml: .*angle_limits.*120.*19\.1 turns.*-2\.094.*2\.094"):
        assert load_robot(path).rods[1].angle_limits == (-120.0, 120.0)


@pytest.mark.parametrize("stops", [(-20.0, 20.0), (12.0, 25.0), (-25.0, 3.0)])
def test_limits_of_a_few_turns_are_not_questioned(pair, tmp_path, stops):
    assert isinstance(replace(pair.rods[0], angle_limits=stops), Rod)
    path = tmp_path / "turns.toml"
    text = (MODELS / "planar_pair.toml").read_text()
    path.write_text(text.replace("[1.04, 5.24]", str(list(stops))))
    assert load_robot(path).rods[0].angle_limits == stops


def test_angles_in_degrees_are_questioned_on_the_command_line(capsys):
    robot = str(MODELS / "planar_pair.toml")
    for angles in (["192.9", "-12.9"], ["3.37", "-12.9"], ["60", "0"]):
        assert main(["statics", robot, "--q", *angles]) == 1
        said = capsys.readouterr().err
        assert "--degrees" in said
        assert "stops" in said
    assert main(["statics", robot, "--p", "0", "0.25", "--q", "192.9", "-12.9"]) == 1
    assert "--degrees" in capsys.readouterr().err
    assert main(["statics", robot, "--q", "192.9", "-12.9", "--degrees"]) == 0
    assert "(3.36674, -0.225147)" in capsys.readouterr().out
    assert main(["statics", robot, "--q", "192.9", "50000", "--degrees"]) == 1
    assert "--degrees" not in capsys.readouterr().err


def test_a_warning_is_one_line_on_the_command_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)  # put back afterwards
    path = tmp_path / "degrees.toml"
    path.write_text((MODELS / "planar_pair.toml").read_text().replace("[-2.1, 2.1]", "[-120, 120]"))
    with pytest.warns(UserWarning, match="angle_limits") as caught:
        assert main(["statics", str(path), "--p", "0", "0.25", "--mode", "LR"]) == 0
    assert "(3.36684, -0.225243)" in capsys.readouterr().out
    (one,) = caught
    line = warnings.formatwarning(one.message, one.category, one.filename, one.lineno)
    assert line.startswith("pcr-mpc: warning: ")
    assert line.count("\n") == 1
