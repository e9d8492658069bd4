"""The [reference] table: every kind with its keys and options, and what is wrong by name."""

import math
import re
import tomllib

import numpy as np
import pytest

from pcr_mpc import (
    Blended,
    Circle,
    Lemniscate,
    Line,
    ModelError,
    PickAndPlace,
    Polygon,
    Spline,
    Waypoints,
    load_path,
    load_scene,
)
from pcr_mpc.loop.references.reading import read_reference
from pcr_mpc.toml_table import Table
from tests.conftest import MODELS

SCENES = MODELS / "scenes"
POINTS = "[[0.0, 0.25], [0.03, 0.26], [0.0, 0.28]]"
THREE = ((0.0, 0.25), (0.03, 0.26), (0.0, 0.28))
CIRCLE = 'kind = "circle"\ncentre = [0.0, 0.25]\nradius = 0.03\n'
FIGURE = 'kind = "lemniscate"\ncentre = [0.0, 0.25]\nsize = [0.12, 0.06]\nperiod = 2.0\n'
PICK = 'kind = "pick_and_place"\npick = [-0.06, 0.22]\nplace = [0.06, 0.22]\nlift = 0.05\nwait = 0.2\nmove = 0.6\n'
PLACED = PickAndPlace((-0.06, 0.22), (0.06, 0.22), 0.05, 0.2, 0.6)


def read(text):
    with Table(SCENES / "scene.toml", "reference.", tomllib.loads(text)) as table:
        return read_reference(table)


@pytest.mark.parametrize(
    ("text", "path"),
    [
        (CIRCLE + "period = 3.0", Blended(Circle((0.0, 0.25), 0.03, 3.0))),
        (
            CIRCLE + "period = 3\nangle = 0.5\nclockwise = true\nrepeat = 4\nstart = 0.5\nend = 0.25\ntime_scale = 1.5",
            Blended(Circle((0.0, 0.25), 0.03, 3.0, 0.5, True), repeat=4, start=0.5, end=0.25, time_scale=1.5),
        ),
        (CIRCLE + f"speed = {2 * math.pi * 0.01!r}", Blended(Circle((0.0, 0.25), 0.03, 3.0))),
        (CIRCLE + 'period = 3\nrepeat = "for ever"', Blended(Circle((0.0, 0.25), 0.03, 3.0), repeat=math.inf)),
        ('kind = "line"\npoints = [[0, 0.2], [0.03, 0.24]]\nspeed = 0.1', Blended(Line(((0, 0.2), (0.03, 0.24)), 0.1))),
        (f'kind = "polygon"\ncorners = {POINTS}\nradius = 0.002\nspeed = 0.1', Blended(Polygon(THREE, 0.002, 0.1))),
        (
            f'kind = "waypoints"\npoints = {POINTS}\nspeed = [0.1, 0.2]\nradius = 0.002',
            Blended(Waypoints(THREE, (0.1, 0.2), radius=0.002)),
        ),
        (f'kind = "waypoints"\npoints = {POINTS}\ntimes = [0, 1, 3]', Blended(Waypoints(THREE, times=(0, 1, 3)))),
        (f'kind = "spline"\npoints = {POINTS}\nspeed = 0.1', Blended(Spline(THREE, 0.1))),
        # What is repeated is closed.
        (
            f'kind = "spline"\npoints = {POINTS}\nspeed = 0.1\nrepeat = 2',
            Blended(Spline(THREE, 0.1, closed=True), repeat=2),
        ),
        (f'kind = "spline"\npoints = {POINTS}\nspeed = 0.1\nclosed = true', Blended(Spline(THREE, 0.1, closed=True))),
        ('kind = "file"\nfile = "circle_60mm.csv"', Blended(load_path(SCENES / "circle_60mm.csv"))),
        (
            'kind = "file"\nfile = "hand_drawn.csv"\nsmoothing = 1e-3\nend = 0.5',
            Blended(load_path(SCENES / "hand_drawn.csv", smoothing=1e-3), end=0.5),
        ),
        (FIGURE + "ramp = 1.0", Lemniscate((0.0, 0.25), (0.12, 0.06), 2.0, 1.0)),
        (
            FIGURE + "ramp = 1.0\ntime_scale = 2.0",
            Blended(Lemniscate((0.0, 0.25), (0.12, 0.06), 2.0, 0.0), start=1.0, repeat=math.inf, time_scale=2.0),
        ),
        (
            FIGURE + "repeat = 3\nend = 0.5",
            Blended(Lemniscate((0.0, 0.25), (0.12, 0.06), 2.0, 0.0), repeat=3, end=0.5),
        ),
        (PICK, PLACED),
        (PICK + "time_scale = 2", Blended(PLACED, time_scale=2.0)),
    ],
)  # fmt: skip
def test_every_kind_is_read_as_it_says(text, path):
    found = read(text)
    assert found == path or (found(np.arange(9.0)) == pytest.approx(path(np.arange(9.0)), abs=1e-15))
    assert type(found) is type(path)


def test_a_time_is_kept_at_full_speed():
    path = read(f'kind = "polygon"\ncorners = {POINTS}\nradius = 0.002\ntime = 2.5').path
    assert path.duration == pytest.approx(2.5)
    assert read('kind = "line"\npoints = [[0, 0.2], [0.03, 0.24]]\ntime = 0.5').path.speed == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("text", "key", "message"),
    [
        (CIRCLE, "period", "give either period or speed"),
        (CIRCLE + "period = 3\nspeed = 0.1", "period", "give either period or speed"),
        (CIRCLE + "period = 3\nrepeat = 0", "repeat", 'an integer >= 1, or "for ever", found 0'),
        (CIRCLE + "period = 3\nrepeat = 2.0", "repeat", "an integer >= 1"),
        (CIRCLE + "period = 3\nstart = -1", "start", "expected a finite number >= 0"),
        (CIRCLE + "period = 3\nstrat = 1", "strat", "did you mean 'start'"),
        (CIRCLE + "period = 3\ntimescale = 1", "timescale", "did you mean 'time_scale'"),
        (CIRCLE + "period = 3\nstart = 0", "start", "its velocity would jump"),
        ('kind = "hold"\nposition = [0.0, 0.25]\nrepeat = 2', "repeat", "unknown key"),
        (FIGURE, "ramp", "missing"),
        (FIGURE + "ramp = 1.0\nstart = 1.0", "ramp", "which start says too"),
        (PICK + "repeat = 2", "repeat", "the path jumps in position by 0.12 m"),
        ('kind = "line"\npoints = [0.0, 0.25]\nspeed = 0.1', "points[0]", "expected two finite numbers"),
        ('kind = "line"\npoints = 3\nspeed = 0.1', "points", "a list of points"),
        ('kind = "waypoints"\npoints = [[0, 0.2], [0.1, 0.2]]', "speed", "give either speed or times"),
        (f'kind = "polygon"\ncorners = {POINTS}\nradius = 0.2\nspeed = 0.1', "radius", "the largest radius that fits"),
        ('kind = "file"\nfile = "none.csv"', "file", "no such file"),
        ('kind = "file"', "file", "missing"),
        ('kind = "files"\nfile = "x"', "kind", "expected one of none, hold, .* file, waypoints, circle"),
    ],
)
def test_what_is_wrong_is_named(text, key, message):
    with pytest.raises(ModelError, match=message) as caught:
        read(text)
    assert caught.value.key == key
    assert ".toml" in str(caught.value) or ".csv" in str(caught.value)


def test_tip_and_duration_may_be_left_to_the_reference(tmp_path):
    text = (SCENES / "square.toml").read_text().replace("../../", f"{MODELS.parent}/").replace('"../', f'"{MODELS}/')
    path = tmp_path / "scene.toml"
    path.write_text(text)
    scene = load_scene(path)
    assert scene.start_tip == tuple(scene.trajectory(np.zeros(1))[0, 0].tolist())
    assert scene.trajectory.duration <= scene.duration < scene.trajectory.duration + 10 * scene.period
    path.write_text(text.replace("repeat = 2", 'repeat = "for ever"'))
    with pytest.raises(ModelError, match="duration: missing"):
        load_scene(path)
    path.write_text(text.replace('mode = "LR"', ""))
    with pytest.raises(ModelError, match="give either tip and mode, or motors"):
        load_scene(path)


def test_a_start_at_the_first_row_is_where_the_smoothed_path_begins(tmp_path):
    text = (
        (SCENES / "hand_drawn.toml").read_text().replace("../../", f"{MODELS.parent}/").replace('"../', f'"{MODELS}/')
    )
    text = re.sub(r'file = "', f'file = "{SCENES}/', text)
    path = tmp_path / "scene.toml"
    path.write_text(text)
    begin = np.array(load_scene(path).start_tip)
    for off, refused in ((2e-5, False), (1e-3, True)):
        row = (begin + (off, 0.0)).tolist()
        path.write_text(text.replace('mode = "LR"', f'tip = {row}\nmode = "LR"'))
        if refused:
            with pytest.raises(ModelError, match="is not where the reference begins"):
                load_scene(path)
        else:
            assert load_scene(path).start_tip == tuple(begin.tolist())


def test_the_page_s_tables_are_read_and_its_python_runs(monkeypatch, capsys):
    page = (MODELS.parent / "docs" / "paths.md").read_text(encoding="utf-8")
    tables = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert len(tables) == 7
    for table in tables:
        path = read(table.replace("[reference]\n", ""))
        assert 0.9 < path.duration < 10.0
        assert path(np.array([0.0, path.duration]))[:, 1:] == pytest.approx(np.zeros((2, 2, 2)), abs=1e-9)
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(MODELS.parent)
    exec(code, {})
    said = re.findall(r"print\(.*\)  # (\S+)", code)
    for stated, printed in zip(said, capsys.readouterr().out.split(), strict=True):
        assert stated == printed or float(stated) == pytest.approx(float(printed), rel=0.05)
