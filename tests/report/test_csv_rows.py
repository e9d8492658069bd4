"""Rows of a study as a CSV file."""

from pcr_mpc.report.csv_rows import write_rows


def test_rows_with_different_keys_share_a_header(tmp_path):
    path = tmp_path / "made" / "rows.csv"
    write_rows(path, [{"a": 1 / 3, "b": "x, y"}, {"a": 2.0, "c": 5}])
    assert path.read_text().splitlines() == ["a,b,c", '0.3333333333333333,"x, y",', "2.0,,5"]


def test_chosen_columns_and_digits(tmp_path):
    path = tmp_path / "rows.csv"
    write_rows(path, [{"a": 1 / 3, "b": 7, "left_out": 1}], columns=("b", "a"), digits=3)
    assert path.read_text().splitlines() == ["b,a", "7,0.333"]
