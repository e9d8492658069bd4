"""The maps of where the loop fails: what they count, and what they predict."""

import numpy as np
import pytest

from experiments import loop_stability
from experiments.loop_stability import Cell, Map, agreement, boundaries, predicted, read_rows, run_cell
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
    assert agreement(rows, [STUDY]) == (2, 1)
    assert boundaries(rows[1:], STUDY) == [(1, 3)]  # a line that is not finished does not count


def test_finished_cells_are_read_back_and_drawn(tmp_path):
    rows = rows_of((2, 4, 1), (3, 4, 3))
    rows[-1] |= {"rms_mm": float("nan"), "failure": "stopped"}
    write_rows(tmp_path / "rows.csv", rows)
    again = read_rows(tmp_path / "rows.csv")
    assert again[:-1] == rows[:-1]
    assert again[-1]["failure"] == "stopped"
    loop_stability.plot(again, STUDY, tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 1000


@pytest.mark.slow
def test_a_cell_is_predicted_as_its_margin_says():
    """The lemniscate's tuning bears 22 ms; a stiffer robot bears less, and so do longer periods."""
    late = [predicted(Cell("lemniscate", "delay_stiffness", ms, 1.0)) for ms in (20.0, 24.0)]
    assert late[0] < 1.0 < late[1]
    assert predicted(Cell("lemniscate", "delay_stiffness", 20.0, 1.7)) > 1.0
    assert predicted(Cell("lemniscate", "lag_horizon", 20.0, 6.0)) == pytest.approx(0.97, abs=0.03)
    assert np.isfinite(predicted(Cell("lemniscate", "delay_period", 20.0, 20.0)))


@pytest.mark.slow
def test_a_loop_that_is_lost_at_once_is_lost():
    """Both runs are soon as far off as can be, and their difference grows no more."""
    row = run_cell(Cell("frozen", "delay_stiffness", 16.0, 1.4))
    assert row["rms_mm"] > 50.0
    assert row["stable"] == 0
