"""Paths from files: read as they are meant, or refused with row, line and what to do."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import Blended, ModelError, check_scene, load_path, load_run, load_scene, make_controller, simulate
from pcr_mpc.loop.references.tabulated import Tabulated
from tests.conftest import MODELS

from .drawn import rows, text

SCENES = MODELS / "scenes"
GOOD = "t_s,x_m,y_m\n0.0,0.0,0.25\n0.1,0.01,0.25\n0.3,0.02,0.26\n0.4,0.02,0.27\n0.7,0.01,0.27\n"


def written(tmp_path, content, encoding="utf-8"):
    path = tmp_path / "path.csv"
    path.write_text(content, encoding=encoding)
    return path


@pytest.mark.parametrize(
    "content",
    [
        GOOD,
        "\ufeff" + GOOD,  # a byte-order mark
        GOOD.replace("\n", "\r\n"),
        "# drawn by hand\n\n" + GOOD.replace("\n0.3", "\n\n# half way\n0.3"),
        GOOD.replace(",", " , "),
        "y_m,t_s,x_m\n" + "".join(f"{y},{t},{x}\n" for t, x, y in (line.split(",") for line in GOOD.split()[1:])),
        GOOD.replace("\n0.0,", "\n5.0,").replace("\n0.", "\n5."),  # a clock that does not begin at 0
    ],
)
def test_what_means_the_same_is_read_the_same(tmp_path, content):
    path = load_path(written(tmp_path, content))
    same = load_path(written(tmp_path, GOOD))
    assert path.points == same.points
    assert path.times == pytest.approx(same.times)
    assert path.points[2] == (0.02, 0.26)
    assert path.duration == pytest.approx(0.7)


def test_velocities_and_accelerations_are_taken(tmp_path):
    header = "t_s,x_m,y_m,vx_m_s,vy_m_s,ax_m_s2,ay_m_s2\n"
    path = load_path(written(tmp_path, header + "0,0,0.25,0,0,0,0\n1,0.1,0.25,0.3,0,0,-1\n"))
    assert path == Tabulated(
        (0.0, 1.0), ((0.0, 0.25), (0.1, 0.25)), ((0.0, 0.0), (0.3, 0.0)), ((0.0, 0.0), (0.0, -1.0))
    )
    assert path(np.array([1.0]))[0] == pytest.approx(np.array([[0.1, 0.25], [0.3, 0.0], [0.0, -1.0]]))


def columns(header, rows):
    return "\n".join([",".join(header), *(",".join(f"{value:.9f}" for value in row) for row in rows)]) + "\n"


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("count", [61, 400])
def test_rows_that_begin_and_end_at_rest_come_when_they_say(tmp_path, count, velocities):
    """Whatever spline goes through them: no blend makes them later."""
    u = np.linspace(0.0, 1.0, count)
    turned, rate = u**4 * (35 - 84 * u + 70 * u**2 - 20 * u**3), 140 * u**3 * (1 - u) ** 3 / 3.0
    angle, rate = 2 * np.pi * turned, 2 * np.pi * rate
    p = np.column_stack([0.03 * np.sin(angle), 0.25 - 0.03 * np.cos(angle)])
    v = 0.03 * rate[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    rows = np.column_stack([3.0 * u, p, v] if velocities else [3.0 * u, p])
    header = ("t_s", "x_m", "y_m", "vx_m_s", "vy_m_s")[: rows.shape[1]]
    path = Blended(load_path(written(tmp_path, columns(header, rows))))
    assert (path.duration, path.later) == (pytest.approx(3.0), 0.0)
    assert np.abs(path(3.0 * u)[:, 0] - p).max() < 1e-8  # as they are rounded
    # One that moves at once is begun in a blend, which is said.
    moving = Blended(load_path(written(tmp_path, columns(header[:3], rows[count // 4 :, :3]))))
    assert moving.later == pytest.approx(moving.full_speed[0] / 2)
    assert moving.later > 0.2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", r"is empty; its first line has the columns: t_s,x_m,y_m"),
        ("# nothing\n", "is empty"),
        ("0.0,0.0,0.25\n0.1,0.01,0.25\n", "begins with numbers; its first line has the names"),
        (GOOD.replace(",", ";"), "has semicolons between its columns; save it with commas"),
        (GOOD.replace(",", "\t"), "has tabs between its columns"),
        (GOOD.replace("x_m", "x_mm"), "column 'x_mm' is not known; did you mean x_m"),
        (GOOD.replace("t_s", "time"), "column 'time' is not known"),
        (GOOD.replace("y_m", "x_m"), "has column x_m twice"),
        (GOOD.replace("t_s,x_m,y_m", "t_s,x_m,vx_m_s"), "has no column y_m; found t_s, x_m, vx_m_s"),
        ("t_s,x_m,y_m,vx_m_s\n0,0,0.2,0\n", "has only one of vx_m_s and vy_m_s"),
        ("t_s,x_m,y_m,ax_m_s2,ay_m_s2\n0,0,0.2,0,0\n", "has accelerations without velocities"),
        (GOOD.replace("0.26", "0,26"), r"line 4 has 4 values for 3 columns; are there commas in its numbers\?"),
        (GOOD.replace(",0.26", ""), "line 4 has 2 values for 3 columns"),
        (GOOD.replace("0.26", "high"), "line 4: y_m is 'high', expected a finite number"),
        (GOOD.replace("0.26", "nan"), "line 4: y_m is 'nan'"),
        (GOOD.replace("0.26", ""), "line 4: y_m is ''"),
        (
            GOOD.replace("\n0.3", "\n0.1"),
            r"row 3 \(line 4\), t_s = 0.1, is the same time as the row before, t_s = 0.1;",
        ),
        (
            GOOD.replace("\n0.4", "\n0.2").replace("\n0.7", "\n0.1"),
            r"row 4 \(line 5\), t_s = 0.2, is earlier than the row before, t_s = 0.3; so are 1 more rows; sort",
        ),
        (
            GOOD.replace("0.25", "250"),
            r"reach 250 m, .* millimetres \(0.25 m\) divide them by 1000, .* centimetres \(2.5 m\) by 100",
        ),
        ("t_s,x_m,y_m\n" + "".join(f"{33 * i},0.0{i},0.2\n" for i in range(1, 30)), r"in 29 rows: are these milli"),
        (GOOD[:38], "2 rows, expected at least 4"),
        (GOOD[:25], "1 row, expected at least 4"),
        (GOOD[:12], "has no rows below its header"),
        ("t_s,x_m,y_m,vx_m_s,vy_m_s\n0,0,0.2,0,0\n", "1 row, expected at least 2"),
        ('t_s,x_m,y_m\n0,"0,0.2\n', "line 2 has 2 values|is no CSV"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(tmp_path, content, message):
    path = written(tmp_path, content)
    with pytest.raises(ModelError, match=message) as caught:
        load_path(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert caught.value.file == str(path)


def circle(tmp_path, rate, decimals):
    """A circle of 60 mm in 3 s, and the same as a file."""
    t = np.arange(3 * rate + 1) / rate
    phi = 2 * np.pi * t / 3
    points = np.stack([0.03 * np.cos(phi), 0.25 + 0.03 * np.sin(phi)], axis=1)
    lines = [f"{a:.4f},{x:.{decimals}f},{y:.{decimals}f}\n" for a, (x, y) in zip(t, points, strict=True)]
    return written(tmp_path, "t_s,x_m,y_m\n" + "".join(lines)), t, points


@pytest.mark.parametrize(("rate", "decimals"), [(1000, 6), (100, 4), (500, 3), (30, 5)])
def test_the_rounding_of_a_dense_file_does_not_shake_the_tip(tmp_path, rate, decimals):
    file, _, _ = circle(tmp_path, rate, decimals)
    path = load_path(file)
    unit = 10.0**-decimals
    assert path.smoothing == pytest.approx(unit / np.sqrt(12))
    fine = np.linspace(0.1, 2.9, 2000)
    phi = 2 * np.pi * fine / 3
    truth = np.stack([0.03 * np.cos(phi), 0.25 + 0.03 * np.sin(phi)], axis=1)
    assert np.linalg.norm(path(fine)[:, 0] - truth, axis=1).max() < unit
    assert path.residuals.max() < 2 * unit
    exact = 0.03 * (2 * np.pi / 3) ** 2
    assert np.linalg.norm(path(fine)[:, 2], axis=1).max() < 1.3 * exact
    through = load_path(file, smoothing=0.0)
    assert through.residuals.max() < 1e-12
    if rate > 30:
        assert np.linalg.norm(through(fine)[:, 2], axis=1).max() > 5 * exact  # else the test says nothing


def test_rows_that_mean_what_they_say_are_met(tmp_path):
    """Few rows, rows with all their digits, and corners."""
    assert load_path(written(tmp_path, GOOD)).smoothing == 0.0
    file, _, points = circle(tmp_path, 100, 15)
    assert load_path(file).residuals.max() < 1e-12
    t = np.linspace(0.0, 4.0, 121)
    corners = np.array([[-0.03, 0.22], [0.03, 0.22], [0.03, 0.28], [-0.03, 0.28], [-0.03, 0.22]])
    square = np.stack([np.interp(t, np.arange(5), column) for column in corners.T], axis=1)
    path = Tabulated(t, square)
    assert path.scatter == 0.0
    assert Tabulated(np.arange(121) / 30, points[::2][:121]).scatter == 0.0


def test_noise_is_seen_and_its_size(tmp_path):
    t, points = rows()
    assert Tabulated(t, points).scatter == pytest.approx(5e-4, rel=0.25)
    assert Tabulated(t, points, smoothing=5e-4).scatter == 0.0
    assert load_path(SCENES / "hand_drawn.csv").smoothing == 0.0  # not explained by its digits
    scene = replace(load_scene(SCENES / "hand_drawn.toml"), duration=0.6, period=0.02)
    rough = Blended(Tabulated(t, points))
    begin = tuple(rough(np.zeros(1))[0, 0].tolist())
    (line,) = [line for line in check_scene(replace(scene, trajectory=rough, start_tip=begin)) if "scatter" in line]
    assert f"smoothing = {Tabulated(t, points).scatter:.2g}" in line
    assert check_scene(scene) == []


def test_files_that_are_not_text_or_not_there(tmp_path):
    with pytest.raises(ModelError, match="is not UTF-8 text"):
        load_path(written(tmp_path, GOOD, "utf-16"))
    with pytest.raises(ModelError, match=r"none\.csv: no such file"):
        load_path(tmp_path / "none.csv")
    with pytest.raises(ModelError, match="is a folder"):
        load_path(tmp_path)


def test_the_hand_drawn_path_is_made_of_its_seed():
    assert (SCENES / "hand_drawn.csv").read_text() == text()
    path = load_path(SCENES / "hand_drawn.csv", smoothing=5e-4)
    t, points = rows()
    assert path.times == pytest.approx(t)
    assert np.array(path.points) == pytest.approx(points)


def test_a_scene_finds_its_file_and_its_record_needs_none(tmp_path):
    """Beside the scene, wherever that is; once a run is recorded, the file may be gone."""
    folder = tmp_path / "mine"
    folder.mkdir()
    scene_text = (SCENES / "circle_from_file.toml").read_text().replace("../../", f"{MODELS.parent}/")
    (folder / "scene.toml").write_text(scene_text.replace("../", f"{MODELS}/") + "\n")
    (folder / "circle_60mm.csv").write_bytes((SCENES / "circle_60mm.csv").read_bytes())
    scene = load_scene(folder / "scene.toml")
    assert scene == load_scene(SCENES / "circle_from_file.toml")
    short = replace(scene, duration=0.1)
    run = simulate(short, short.make_plant(), make_controller(short))
    run.save(tmp_path / "run")
    (folder / "circle_60mm.csv").unlink()
    back = load_run(tmp_path / "run").scene
    assert back == short
    again = simulate(back, back.make_plant(), make_controller(back))
    assert again.hash() == run.hash()
    with pytest.raises(ModelError, match=r"mine/circle_60mm\.csv: no such file .* relative to its folder, .*mine$"):
        load_scene(folder / "scene.toml")


def test_a_file_that_is_named_from_the_working_folder_is_found_for_the_message(tmp_path, monkeypatch):
    scene = (SCENES / "circle_from_file.toml").read_text()
    (tmp_path / "mine").mkdir()
    (tmp_path / "here.csv").write_text(GOOD)
    (tmp_path / "mine" / "scene.toml").write_text(
        scene.replace("../../", f"{MODELS.parent}/").replace("../", f"{MODELS}/").replace("circle_60mm", "here")
    )
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelError, match=r'reference\.file: mine/here\.csv: no such .*: write "\.\./here\.csv"$'):
        load_scene("mine/scene.toml")
