"""A start that follows from the reference is nowhere in the scene's file: the path's file and its row are named."""

import re

import numpy as np
import pytest

from pcr_mpc import ModelError, load_robot, load_scene, shipped
from pcr_mpc.cli import main


@pytest.fixture
def write(tmp_path):
    """Write circle_from_file with other points in its path, and no tip in [start]."""
    assert main(["copy", "circle_from_file", str(tmp_path)]) == 0
    scene = tmp_path / "scene.toml"
    text = re.sub(r"^(tip|repeat|closed|duration) = .*\n", "", scene.read_text(), flags=re.M)
    scene.write_text(re.sub(r"^(motors|mode) = .*$", 'mode = "LR"', text, flags=re.M))
    (path,) = tmp_path.glob("*.csv")

    def change(points):
        t = 0.1 * np.arange(len(points))
        path.write_text("t_s,x_m,y_m\n" + "".join(f"{a},{x},{y}\n" for a, (x, y) in zip(t, points, strict=True)))
        return scene, path

    return change


def line(start, stop):
    return np.linspace(start, stop, 12).tolist()


@pytest.mark.parametrize(
    ("points", "row"), [(line((0, 0.6), (0, 0.7)), 1), (line((0, 0.25), (0.0, 0.45)), r"([5-9]|1\d)")]
)
def test_a_path_beyond_reach_names_its_row(write, points, row):
    scene, _ = write(points)
    with pytest.raises(ModelError, match=rf"reference at t = .* \(at row {row} of its file\)") as caught:
        load_scene(scene)
    assert "start.tip" not in str(caught.value)


def test_x_and_y_exchanged(write, capsys):
    scene, path = write(line((0.25, 0.0), (0.24, 0.0)))
    words = "where the reference begins, no stable pose of mode LR"
    with pytest.raises(ModelError, match=f"{words}.* x and y exchanged there is one"):
        load_scene(scene).start()
    capsys.readouterr()
    for command in ("track", "check"):
        assert main([command, str(scene)]) == 1
        assert f"{path}: circle_from_file: {words}" in "".join(capsys.readouterr())


@pytest.mark.parametrize(
    ("key", "words"),
    [("length", r"rods\[0\]\.length is 400 m, 2e\+03 times .*, it is 0\.4 m"), ("base", r"motors are 200 m apart")],
)
def test_a_length_in_millimetres_is_questioned(tmp_path, key, words):
    text = shipped("planar_pair", "robot").read_text()
    scaled = {
        "length": lambda found: f"length = {1e3 * float(found[1])}",
        "base": lambda found: f"base = [{1e3 * float(found[1])}, 0.0]",
    }
    pattern = {"length": r"^length = (\S+)", "base": r"^base = \[(\S+), \S+\]"}[key]
    (tmp_path / "robot.toml").write_text(re.sub(pattern, scaled[key], text, flags=re.M))
    with pytest.warns(UserWarning, match=words):
        load_robot(tmp_path / "robot.toml")
