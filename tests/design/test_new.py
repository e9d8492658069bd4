"""A robot from a few numbers: written, checked, tracked; refused where it cannot work, with numbers that can."""

import contextlib
import io
import json
import math
import re
import shlex
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import InfeasibleError, ModelError, load_robot, load_scene, make_controller, simulate
from pcr_mpc.cli import main
from pcr_mpc.design.examination import examine
from pcr_mpc.design.motors import MOTORS, motor_named
from pcr_mpc.design.sizing import design
from pcr_mpc.design.strips import stiffer_upright
from pcr_mpc.design.toml_text import files
from pcr_mpc.design.wish import Wish
from pcr_mpc.plant.materials import MATERIALS
from tests.conftest import MODELS


def tracked(folder, laps=0.35):
    """Largest error of a written scene in its first laps, in rod lengths; with a verdict on the run."""
    scene = load_scene(folder / "scene.toml")
    duration = round(laps * scene.trajectory.period / scene.period) * scene.period
    run = simulate(replace(scene, duration=duration), scene.make_plant(), make_controller(scene))
    summary = run.summary()
    assert summary["verdict"] == ""
    assert summary["fallbacks"] == 0
    return 1e-3 * summary["max_mm"] / scene.robot.lengths.max()


def written(folder, **numbers):
    chosen = design(Wish("mine", **numbers))
    folder.mkdir(exist_ok=True)
    for name, text in files(chosen).items():
        (folder / name).write_text(text)
    return chosen


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    """The folder that `new` writes without an option."""
    folder = tmp_path_factory.mktemp("own") / "mine"
    with contextlib.redirect_stdout(io.StringIO()) as told:
        assert main(["new", str(folder)]) == 0
    (folder / "told.txt").write_text(told.getvalue())
    return folder


def test_the_page_shows_what_is_printed(mine):
    """Text as it stands, numbers to a digit that rounding may change."""
    number = re.compile(r"\d+\.?\d*(?:e[+-]\d+)?")
    page = (MODELS.parent / "docs" / "new_robot.md").read_text().partition("```text\n")[2].partition("```")[0]
    told = (mine / "told.txt").read_text()
    assert "round rods" not in told
    assert "its rods let the tip sag out of the plane" in told
    told = told.partition("\n\n")[0]
    assert number.sub("#", page.strip()) == number.sub("#", told.strip())
    shown, printed = ([float(one) for one in number.findall(text)] for text in (page, told))
    assert shown == pytest.approx(printed, rel=0.02)


def test_it_tracks(mine):
    assert tracked(mine) < 5e-5


def test_stiffness_and_density_are_those_of_the_wire(mine):
    """Nitinol of 1 mm: 75 GPa and 6450 kg/m^3, by hand."""
    robot = load_robot(mine / "robot.toml")
    assert robot.stiffnesses == pytest.approx([75e9 * math.pi * 0.001**4 / 64] * 2)
    assert [rod.line_density for rod in robot.rods] == pytest.approx([6450 * math.pi * 0.0005**2] * 2)
    assert robot.strain_limits == pytest.approx([MATERIALS["nitinol"].strain_limit] * 2)


def test_strips_of_spring_steel(tmp_path, capsys):
    """12 x 0.4 mm, by hand: E w t^3 / 12, rho w t; and it tracks."""
    folder = tmp_path / "mine"
    words = ["--material", "spring_steel", "--width", "12e-3", "--thickness", "0.4e-3", "--length", "0.42"]
    assert main(["new", str(folder), *words, "--tip-mass", "0.1", "--json"]) == 0
    remarks = {one["about"]: one["text"] for one in json.loads(capsys.readouterr().out)["remarks"]}
    # Rods of 31.6 g; they are 900 times as stiff out of the plane, where the tip of 0.1 kg sags by less than 1 mm.
    assert "3.2 times what its rods weigh, as was wished; 6 times" in remarks["tip mass"]
    assert "support" not in remarks
    assert main(["check", str(folder / "robot.toml"), "--json"]) == 0
    assert "support" not in {one["about"] for one in json.loads(capsys.readouterr().out)["remarks"]}
    robot = load_robot(folder / "robot.toml")
    assert robot.stiffnesses == pytest.approx([206e9 * 12e-3 * 0.4e-3**3 / 12] * 2)
    assert [rod.line_density for rod in robot.rods] == pytest.approx([7850 * 12e-3 * 0.4e-3] * 2)
    eq = load_scene(folder / "scene.toml").start()
    assert eq.max_strain == pytest.approx(0.2e-3 * np.abs(eq.motor_torque) / robot.stiffnesses, rel=1e-2)
    assert tracked(folder) < 1e-4
    assert "#   pcr-mpc new mine --rods 2 --material spring_steel --width 0.012 --thickness 0.0004 --length 0.42" in (
        folder / "robot.toml"
    ).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--width", "0.01"], "thickness is missing"),
        (["--thickness", "0.001"], "width is missing"),
        (["--width", "1e-4", "--thickness", "4e-4"], "less than the thickness, 0.4 mm"),
        (["--width", "1e-2", "--thickness", "4e-4", "--diameter", "1e-3"], "give one"),
        (["--width", "0.05", "--thickness", "0.02"], "at least 50 times as long, 1 m"),
        (["--width", "nan", "--thickness", "4e-4"], "width"),
        pytest.param(
            ["--width", "12e-3", "--thickness", "1.4e-3", "--material", "spring_steel", "--length", "0.42"],
            "nearest that works: 1.3 mm thickness",
            marks=pytest.mark.slow,
        ),
    ],
)  # fmt: skip
def test_strips_that_are_none(tmp_path, capsys, words, problem):
    assert main(["new", str(tmp_path / "mine"), *words]) == 1
    assert problem in capsys.readouterr().err
    assert not (tmp_path / "mine").exists()


def test_strain_is_curvature_times_the_radius(mine):
    """Curvature by differences along the wire; at the clamp it is tau / EI. `new` must stay within what it bears."""
    scene = load_scene(mine / "scene.toml")
    eq = scene.start()
    steps = np.diff(eq.shape(2001), axis=1)
    angles = np.unwrap(np.arctan2(steps[..., 1], steps[..., 0]))
    curvature = np.abs(np.diff(angles)) / (0.5 / 2000)
    assert eq.max_strain == pytest.approx(0.0005 * curvature.max(axis=1), rel=1e-3)
    assert 0.0005 * curvature[:, 0] == pytest.approx(
        0.0005 * np.abs(eq.motor_torque) / scene.robot.stiffnesses, rel=1e-2
    )
    assert eq.max_strain.max() < MATERIALS["nitinol"].strain_limit


def test_every_number_has_its_unit_or_its_source(mine):
    """A comment beside it, unless an earlier rod's same key has one; and the head says how to make it again."""
    for name in ("robot", "scene", "tuning"):
        explained = set()
        for line in (mine / f"{name}.toml").read_text().splitlines():
            if match := re.match(r"(\w+) = [\d\[-]", line):
                assert "#" in line or match[1] in explained, f"{name}: {line}"
                explained.add(match[1])
    text = (mine / "robot.toml").read_text()
    assert "#   pcr-mpc new mine --rods 2 --material nitinol --diameter 0.001 --length 0.5\n" in text
    assert MATERIALS["nitinol"].source.split()[0] in text


def test_nothing_is_overwritten(mine, capsys):
    before = (mine / "scene.toml").read_bytes()
    assert main(["new", str(mine), "--rods", "3"]) == 1
    assert "robot.toml: is there already; give another folder, or --force" in capsys.readouterr().err
    assert (mine / "scene.toml").read_bytes() == before


def test_json_says_what_was_chosen(tmp_path, capsys):
    given = ["--rods", "3", "--tip-mass", "0.05", "--motor", "xm430-w210"]
    assert main(["new", str(tmp_path / "three rods"), *given, "--json"]) == 0
    captured = capsys.readouterr()
    record = json.loads(captured.out)
    assert record["motor"] == "XM430-W210"
    assert record["tip_mass_kg"] == 0.05
    assert record["peaks"]["torque"]["used"] < 1
    following = captured.err.split("next: ")[1].splitlines()[0].split(", ")
    scene = str(tmp_path / "three rods" / "scene.toml")
    assert [shlex.split(one) for one in following] == [["pcr-mpc", "check", scene], ["pcr-mpc", "track", scene]]
    robot = load_robot(tmp_path / "three rods" / "robot.toml")
    assert (robot.n_rods, robot.tip_mass, robot.torque_limit) == (3, 0.05, 1.5)


def test_motors_by_name():
    assert motor_named("xl330-m288") is MOTORS["XL330-M288"]
    # 3 N m and 77 rev/min, as models/planar_pair.toml has them.
    assert motor_named("XM430-W210").torque_limit == pytest.approx(1.5)
    assert motor_named("XM430-W210").rate_limit == pytest.approx(0.75 * 77 * 2 * math.pi / 60)
    with pytest.raises(ModelError, match=r"'XM430' is not known; did you mean XM430-W210\?"):
        motor_named("XM430")


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"rods": 5}, "rods is 5, expected 2 to 4"),
        ({"length": 500.0}, r"5e\+05 times as long as thick, .* Numbers are in metres: 500 mm are 0\.5"),
        ({"material": "carbon"}, r"did you mean cfrp\? known are spring_steel \(steel wire and strip\)"),
        ({"material": "nitinl"}, r"'nitinl' is not known; did you mean nitinol\?"),
        ({"diameter": 1.0}, "no slender rods: they are to be at least 50 diameters long, 50 m"),
        ({"diameter": -1e-3}, "diameter: is -0.001"),
        ({"tip_mass": math.nan}, "tip_mass: expected a number, found nan"),
    ],
)
def test_numbers_of_another_kind_are_refused(numbers, message):
    with pytest.raises(ModelError, match=message):
        Wish("mine", **numbers)


def suggested(message, key):
    """Number after which the message names what it is of, in SI units."""
    found = re.search(rf"nearest that works: .*?([\d.]+) (mm|m) {key}", message)
    assert found, message
    return float(found[1]) * (1e-3 if found[2] == "mm" else 1.0)


@pytest.mark.slow
def test_a_rod_too_stiff_for_the_motor_is_refused_and_the_nearest_works():
    numbers = {"diameter": 3e-3, "length": 1.0, "motor": "XL330-M288"}
    with pytest.raises(InfeasibleError, match=r"N m of a motor at rest, where XL330-M288 has 0\.26 N m") as caught:
        design(Wish("mine", **numbers))
    assert caught.value.limit == "torque"
    message = str(caught.value)
    assert "or a stronger motor, such as XC330-M288" in message
    nearest = suggested(message, "diameter")
    assert 1.5e-3 < nearest < 3e-3
    assert design(Wish("mine", **{**numbers, "diameter": nearest})).motor.name == "XL330-M288"


def test_a_rod_that_no_motor_turns_is_refused(monkeypatch):
    monkeypatch.setattr("pcr_mpc.design.placing._nearest", lambda *_: ["x diameter"])  # which others look at
    with pytest.raises(InfeasibleError, match=r"N m of a motor at rest, where XM540-W270 has 5.3 N m .* diameter"):
        design(Wish("mine", material="cfrp", diameter=0.01, length=1.0))


@pytest.mark.slow
@pytest.mark.parametrize("key", ["diameter", "length"])
def test_a_rod_that_would_be_strained_beyond_its_limit_is_refused_and_the_nearest_works(key):
    numbers = {"material": "spring_steel", "diameter": 1.7e-3, "length": 0.41}
    with pytest.raises(InfeasibleError, match=r"strained to .* where spring_steel bears 0\.7 %") as caught:
        design(Wish("mine", **numbers))
    assert caught.value.limit == "strain"
    nearest = suggested(str(caught.value), key)
    assert 0.7 < nearest / numbers[key] < 1.4
    design(Wish("mine", **{**numbers, key: nearest}))


@pytest.mark.parametrize(
    ("mass", "message"),
    [
        (100.0, r"swings on these rods once in \d+.* s, .* at most ([\d.]+) kg"),
        (1e-3, r"is lighter than its rods, .* at least ([\d.e-]+) kg"),
    ],
)
def test_a_tip_of_the_wrong_mass_is_refused_and_the_nearest_works(mass, message):
    with pytest.raises(InfeasibleError, match=message) as caught:
        design(Wish("mine", tip_mass=mass))
    nearest = float(re.search(message, str(caught.value))[1])
    assert design(Wish("mine", tip_mass=nearest)).tip_mass == nearest


def test_motors_too_far_apart_are_refused(capsys, tmp_path):
    assert main(["new", str(tmp_path / "wide"), "--spacing", "1.2"]) == 1
    assert "motors 1.2 m apart cannot be joined" in capsys.readouterr().err
    assert not list((tmp_path / "wide").glob("*.toml"))


SPREAD = [
    {"rods": 2, "material": "nitinol_linear", "diameter": 2.1e-4, "length": 0.15, "spacing": 0.15},
    {"rods": 2, "material": "gfrp", "diameter": 5e-3, "length": 1.6},
    {"rods": 2, "material": "spring_steel", "diameter": 1.0e-3, "length": 0.4},
    {"rods": 3, "material": "gfrp", "diameter": 8.4e-4, "length": 0.49, "spacing": 0.23},
    {"rods": 4, "material": "titanium", "diameter": 3.7e-3, "length": 0.74},
]


@pytest.mark.slow
@pytest.mark.parametrize("numbers", SPREAD, ids=lambda one: "-".join(map(str, one.values())))
def test_robots_of_all_sizes_check_and_track(numbers, tmp_path):
    """From wires of 0.2 mm to rods of 4 mm, from 0.15 to 1.6 m."""
    written(tmp_path, **numbers)
    found = examine(load_scene(tmp_path / "scene.toml"), modes=False)
    assert found.errors == []
    assert max(row["used"] for row in found.figures["reference"]["peaks"].values()) < 1
    assert tracked(tmp_path, laps=0.35) < 1e-4


def test_sections_say_how_stiff_rods_are_out_of_the_plane(tmp_path):
    """A strip 4 mm wide and 1 mm thick beside a round rod of the same EI: (16 + 1) / 2."""
    steel = "youngs_modulus = 206e9\ndensity = 7850.0\n"
    strip = f"{steel}width = 4e-3\nthickness = 1e-3\n"
    wire = f"{steel}diameter = {(64 * 4e-3 * 1e-9 / 12 / math.pi) ** 0.25!r}\n"
    stated = "bending_stiffness = 0.05\nline_density = 0.01\n"
    file = tmp_path / "robot.toml"
    for sections, ratio in (((strip, wire), 8.5), ((strip, strip), 16.0), ((strip, stated), None)):
        rods = "".join(
            f"[[rods]]\nbase = [{x}, 0.0]\nlength = 0.5\nangle_limits = [-3.0, 3.0]\n{own}"
            for x, own in zip((-0.1, 0.1), sections, strict=True)
        )
        file.write_text(f'name = "pair"\n[motors]\nrate_limit = 6.0\nacceleration_limit = 300.0\ntorque_limit = 1.5\n'
                        f"[tip]\nmass = 0.2\ndrag = 0.1\n{rods}")  # fmt: skip
        assert stiffer_upright(load_robot(file), file) == (ratio if ratio is None else pytest.approx(ratio))
