"""The maps of where the loop fails: what they count, and what they predict."""

import numpy as np
import pytest

from experiments.control import loop_stability
from experiments.control.loop_stability import (
    Line,
    Map,
    agreement,
    boundaries,
    chosen,
    filled,
    predicted,
    read_rows,
    run_line,
)
from pcr_mpc.report.csv_rows import write_rows

STUDY = Map("delay_stiffness", "x", "y", (0.0, 1.0, 2.0, 3.0), (1.0, 2.0, 3.0))


def rows_of(measured, said):
    """Rows that are stable, and predicted to be, in so many cells of each line."""
    return [
        {"controller": "c", "map": STUDY.name, "x": x, "y": y, "stable": float(i < stable), "failure": "",
         "predicted_radius": 0.9 if i < ahead else 1.1, "rms_mm": 1.0}
        for y, stable, ahead in zip(STUDY.y, measured, said, strict=True) for i, x in enumerate(STUDY.x)
    ]  # fmt: skip


def test_boundaries_are_counted_in_cells():
    rows = rows_of((2, 4, 1), (3, 4, 3))
    assert boundaries(rows, STUDY) == [(2, 3), (1, 3)]  # the line without a loss has no boundary
    assert agreement(rows, [STUDY]) == {(STUDY.name, "c"): (2, 1)}
    assert boundaries(rows[1:], STUDY) == [(1, 3)]  # a line that is not finished does not count
    assert boundaries(rows_of((0, 0, 1), (0, 1, 0)), STUDY) == [(0, 1), (1, 0)]  # nor one of which nothing holds


@pytest.mark.parametrize("boundary", range(17))
def test_the_boundary_is_between_two_neighbours_that_are_measured(boundary):
    asked = {}
    chosen(lambda i: asked.setdefault(i, i < boundary), 16)
    assert {0, 5, 10, 15} <= set(asked)
    assert len(asked) <= 7
    if 0 < boundary < 16:
        assert asked[boundary - 1]
        assert not asked[boundary]


def test_cells_that_are_not_measured_are_as_the_nearest_that_is():
    values = np.array([1.0, np.nan, np.nan, np.nan, np.nan])  # the last was measured, and has no figure
    found = filled(values, np.array([True, False, False, False, True]))
    assert np.array_equal(np.isnan(found), [False, False, False, True, True])
    assert found[1] == 1.0


def test_finished_cells_are_read_back_and_drawn(tmp_path):
    rows = rows_of((2, 4, 1), (3, 4, 3))
    rows[-1] |= {"rms_mm": float("nan"), "failure": "stopped"}
    write_rows(tmp_path / "rows.csv", rows)
    again = read_rows(tmp_path / "rows.csv")
    assert again[:-1] == rows[:-1]
    assert again[-1]["failure"] == "stopped"
    loop_stability.plot(again, STUDY, tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 1000


def test_of_a_line_some_cells_are_measured(monkeypatch):
    """A loop that is lost at once: both runs are soon as far off as can be, and their difference grows no more."""
    monkeypatch.setattr(loop_stability, "DURATION", 1.2)
    monkeypatch.setattr(loop_stability, "POSES", 2)
    rows = run_line(Line("frozen", "delay_stiffness", 1.4, (0.0, 58.0, 59.0, 60.0)))
    assert np.array_equal([row["stable"] for row in rows], [1, 0, np.nan, 0], equal_nan=True)
    assert rows[0]["rms_mm"] < 0.5
    assert "from where it should be" in rows[-1]["failure"]


@pytest.mark.slow
def test_a_cell_is_predicted_as_its_margin_says():
    """The lemniscate's tuning bears 22 ms; a stiffer robot bears less, and so do longer periods."""
    late = predicted(Line("lemniscate", "delay_stiffness", 1.0, (20.0, 24.0)))
    assert late[0] < 1.0 < late[1]
    assert predicted(Line("lemniscate", "delay_stiffness", 1.7, (20.0,)))[0] > 1.0
    assert predicted(Line("lemniscate", "lag_horizon", 6.0, (20.0,)))[0] == pytest.approx(0.97, abs=0.03)
    assert np.isfinite(predicted(Line("lemniscate", "delay_period", 20.0, (20.0,)))[0])
