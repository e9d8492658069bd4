import csv

import numpy as np
import pytest

from experiments.control.linear_validity import main
from experiments.control.linear_validity_radius import (
    ALLOWED,
    motor_directions,
    predicted_radius,
    radius_along,
    relative_error,
    second_derivative,
    smallest_radius,
    tip_directions,
)
from pcr_mpc import Plant, inverse_statics, solve_statics


@pytest.mark.parametrize("tip", [(0.06, 0.22), (0.2, 0.15), (0.0, 0.37)])
@pytest.mark.parametrize("directions", [tip_directions(8), motor_directions(8)], ids=["tip", "motors"])
def test_the_second_derivative_predicts_the_radius(pair, centre, tip, directions):
    """To 2 %: at 1 % of error the third derivative contributes of the order of 1 %."""
    pose = inverse_statics(pair, tip, guess=centre)
    radius, _, ended_by = smallest_radius(Plant(pair), pose, directions)
    assert ended_by == "1 % error"
    assert radius == pytest.approx(predicted_radius(pose, second_derivative(pose), directions), rel=0.02)


@pytest.mark.parametrize("direction", [tip_directions(8)[1], motor_directions(8)[3]], ids=["tip", "motors"])
def test_the_error_at_the_radius_is_one_percent(pair, centre, direction):
    """By `solve_statics`, which starts from the pose every time; the search follows the plant's branch."""
    radius, _ = radius_along(Plant(pair), centre, direction)
    motion = radius * direction
    exact = solve_statics(pair, centre.p + motion[:2], centre.q + motion[2:], guess=centre)
    assert relative_error(exact.force, centre, motion) == pytest.approx(ALLOWED, rel=2e-3)


def test_mirrored_poses_have_the_same_radius(pair, centre):
    radii = [
        smallest_radius(Plant(pair), inverse_statics(pair, (x, 0.2), guess=centre), tip_directions(8))[0]
        for x in (-0.12, 0.12)
    ]
    assert radii[0] == pytest.approx(radii[1], rel=1e-6)


@pytest.mark.slow
def test_quick_run(tmp_path):
    main(["--quick", "--out", str(tmp_path)])
    rows = {}
    for name in ("map", "horizon", "loop"):
        with open(tmp_path / f"linear_validity_{name}.csv", encoding="utf-8") as handle:
            rows[name] = list(csv.DictReader(handle))
    assert (tmp_path / "linear_validity.png").stat().st_size > 10_000
    # Tips out of reach are kept, with the reason.
    assert {bool(row["failure"]) for row in rows["map"]} == {True, False}
    assert all(bool(row["failure"]) != bool(row["tip_radius_mm"]) for row in rows["map"])
    # The error relative to the distance moved is of first order in the rate.
    slow = [float(row["relative_error"]) for row in rows["horizon"] if float(row["rate_rad_s"]) == 0.01]
    assert len(slow) == 16
    assert max(slow) < 1e-3
    rms = {row["linearised"]: float(row["rms_mm"]) for row in rows["loop"]}
    assert rms["every step"] < 0.05
    assert rms["once"] == pytest.approx(2.36, rel=0.02)
    assert np.isfinite([float(row["max_mm"]) for row in rows["loop"]]).all()
