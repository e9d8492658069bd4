"""Rods by material and cross-section: EI and line density, what is refused, units, and the way there and back."""

import math
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import MATERIALS, Material, ModelError, Rod, Section, inverse_statics, load_robot
from pcr_mpc.loop.run.record import from_text, to_text
from tests.conftest import MODELS, ROOT

WHERE = {"base": (0.0, 0.0), "length": 0.4, "angle_limits": (-1.0, 1.0)}


@pytest.fixture
def robot_file(tmp_path):
    """Write planar_pair with other lines in place of its rods' numbers, and load it."""

    def write(*lines):
        text = (
            'name = "r"\n'
            + "".join(
                f"[[rods]]\nbase = [{x}, 0.0]\nlength = 0.4\nangle_limits = [-7.0, 7.0]\n" + "\n".join(lines) + "\n"
                for x in (-0.1, 0.1)
            )
            + "[tip]\nmass = 0.25\ndrag = 0.2\n"
            + "[motors]\nrate_limit = 6.0\nacceleration_limit = 300.0\ntorque_limit = 1.5\n"
        )
        path = tmp_path / "robot.toml"
        path.write_text(text)
        return path

    return write


# --- sections ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("section", "kind", "a", "b"),
    [
        (Section.round(2e-3), "round", 2e-3, 0.0),
        (Section.round(2e-3, 1.5e-3), "round", 2e-3, 1.5e-3),
        (Section.strip(10e-3, 0.7e-3), "strip", 10e-3, 0.7e-3),
    ],
)
def test_section_is_the_integral_over_it(section, kind, a, b):
    """Midpoint rule over a fine grid of the cross-section; y is in the plane of bending."""
    height, width = (b, a) if kind == "strip" else (a, a)
    y = height * ((np.arange(2000) + 0.5) / 2000 - 0.5)
    z = width * ((np.arange(2000) + 0.5) / 2000 - 0.5)
    radius = np.hypot(z[None], y[:, None])
    within = np.ones_like(radius, bool) if kind == "strip" else (radius <= a / 2) & (radius >= b / 2)
    cell = height * width / 4e6
    assert section.area == pytest.approx(within.sum() * cell, rel=2e-3)
    assert section.second_moment == pytest.approx((within * y[:, None] ** 2).sum() * cell, rel=2e-3)
    assert section.half_thickness == height / 2


def test_textbook_sections():
    """Gere and Goodno, Mechanics of Materials, appendix E."""
    assert Section.round(1.0).second_moment == pytest.approx(math.pi / 64)
    assert Section.round(2.0, 1.0).second_moment == pytest.approx(15 * math.pi / 64)
    assert Section.strip(3.0, 2.0).second_moment == pytest.approx(2.0)
    assert Section.round(1e-3).half_thickness == 0.5e-3


def test_inner_diameter_is_smaller():
    with pytest.raises(
        ModelError, match=r"inner_diameter is 0\.002 m, expected from 0 to less than the diameter 0.002"
    ):
        Section.round(2e-3, 2e-3)


# --- materials --------------------------------------------------------------------------------------------------------


def test_materials_are_what_they_are_called():
    stiffness = {"spring_steel": (190, 212), "nitinol": (40, 85), "nitinol_linear": (25, 45), "titanium": (105, 120),
                 "gfrp": (20, 50), "cfrp": (110, 160), "peek": (3, 5)}  # fmt: skip
    assert set(MATERIALS) == set(stiffness)
    for name, material in MATERIALS.items():
        low, high = stiffness[name]
        assert material.name == name
        assert low * 1e9 <= material.youngs_modulus <= high * 1e9
        assert 1000 <= material.density <= 8000
        assert 0.005 <= material.strain_limit <= 0.02
        assert len(material.source) > 60


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"youngs_modulus": 206.0}, "in pascals"),
        ({"youngs_modulus": 206e15}, "in pascals"),
        ({"density": 7.85}, "in kg/m"),
        ({"strain_limit": 0.8}, "not per cent"),
        ({"strain_limit": 0.0}, "strain_limit"),
        ({"youngs_modulus": math.nan}, "youngs_modulus"),
    ],
)
def test_material_of_another_unit_is_questioned(change, words):
    with pytest.raises(ModelError, match=words):
        replace(MATERIALS["spring_steel"], **change)


def test_rod_made_of_a_material():
    steel = Material("steel", 206e9, 7850.0, 0.007)
    rod = Rod.made_of(steel, Section.round(1.5e-3), **WHERE)
    assert rod.bending_stiffness == pytest.approx(0.0512, abs=5e-5)  # as models/ has said of this wire
    assert rod.line_density == pytest.approx(0.01387, abs=5e-6)
    assert (rod.half_thickness, rod.strain_limit) == (0.75e-3, 0.007)


# --- files ------------------------------------------------------------------------------------------------------------


def test_file_with_a_material(robot_file):
    rod = load_robot(robot_file('material = "nitinol"', "diameter = 1e-3")).rods[0]
    assert rod.bending_stiffness == pytest.approx(75e9 * math.pi * 1e-12 / 64)
    assert rod.line_density == pytest.approx(6450 * math.pi * 1e-6 / 4)
    assert (rod.half_thickness, rod.strain_limit) == (0.5e-3, MATERIALS["nitinol"].strain_limit)


def test_own_numbers_go_before_the_materials(robot_file):
    rod = load_robot(
        robot_file('material = "nitinol"', "diameter = 1e-3", "youngs_modulus = 60e9", "strain_limit = 0.01")
    ).rods[0]
    assert rod.bending_stiffness == pytest.approx(60e9 * math.pi * 1e-12 / 64)
    assert rod.line_density == pytest.approx(6450 * math.pi * 1e-6 / 4)
    assert rod.strain_limit == 0.01


def test_file_with_numbers_and_a_strip(robot_file):
    rod = load_robot(
        robot_file("youngs_modulus = 206e9", "density = 7850.0", "width = 20e-3", "thickness = 0.5e-3")
    ).rods[0]
    assert rod.bending_stiffness == pytest.approx(206e9 * 20e-3 * 1.25e-10 / 12)
    assert rod.line_density == pytest.approx(0.0785)
    assert (rod.half_thickness, rod.strain_limit) == (0.25e-3, math.inf)


def test_tube(robot_file):
    rod = load_robot(robot_file('material = "nitinol"', "diameter = 2e-3", "inner_diameter = 1e-3")).rods[0]
    assert rod.bending_stiffness == pytest.approx(75e9 * math.pi * 15e-12 / 64)


def test_measured_stiffness_with_a_section_that_tells_the_thickness(robot_file):
    rod = load_robot(
        robot_file("bending_stiffness = 0.06", "line_density = 0.0139", "diameter = 1.5e-3", "strain_limit = 0.007")
    ).rods[0]
    assert (rod.bending_stiffness, rod.line_density, rod.half_thickness) == (0.06, 0.0139, 0.75e-3)


def test_stated_and_computed_may_both_be_there_if_they_agree(robot_file):
    steel = ('material = "spring_steel"', "diameter = 1.5e-3")
    rod = load_robot(robot_file(*steel, "bending_stiffness = 0.0510", "line_density = 0.0139")).rods[0]
    assert (rod.bending_stiffness, rod.line_density) == (0.0510, 0.0139)
    with pytest.raises(ModelError, match=r"bending_stiffness: is 0.05, but youngs_modulus and section make it 0.05119"):
        load_robot(robot_file(*steel, "bending_stiffness = 0.05", "line_density = 0.0139"))
    with pytest.raises(ModelError, match=r"line_density: is 0.139, but density and section make it 0.01387"):
        load_robot(robot_file(*steel, "line_density = 0.139"))


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (['material = "nitinoll"', "diameter = 1e-3"], "did you mean 'nitinol'?"),
        (['material = "unobtainium"', "diameter = 1e-3"], "of another, state youngs_modulus"),
        (['material = "nitinol"', "diametre = 1e-3"], r"diametre: unknown key; did you mean 'diameter'"),
        (
            ['material = "nitinol"', "width = 1e-2", "thicknes = 1e-3"],
            r"thicknes: unknown key; did you mean 'thickness'",
        ),
        (['material = "fibreglass"', "diameter = 1e-3"], r"did you mean 'gfrp'\? known are .* gfrp \(glass fibre\)"),
        (['material = "nitinol"'], "says nothing without the rod's section"),
        (["bending_stiffness = 0.05", "line_density = 0.01", "strain_limit = 0.01"], "strain_limit: says nothing"),
        (["bending_stiffness = 0.05", "line_density = 0.01", "density = 7850.0"], "density: says nothing"),
        (['material = "nitinol"', "diameter = 1.5"], r"rods\[0\].diameter: the rod is 1.5 m thick .* in metres"),
        (['material = "nitinol"', "width = 10.0", "thickness = 0.7"], "thickness: the rod is 0.7 m thick"),
        (["youngs_modulus = 206", "density = 7850.0", "diameter = 1.5e-3"], "youngs_modulus is 206: is it in pascals"),
        (["youngs_modulus = 206e9", "density = 7.85", "diameter = 1.5e-3"], "density is 7.85: is it in kg/m"),
        (['material = "nitinol"', "diameter = 1e-3", "strain_limit = 0.8"], "strain_limit is 0.8: .* not per cent"),
        (['material = "nitinol"', "diameter = -1e-3"], "diameter: is -0.001"),
        (['material = "nitinol"', "diameter = 1e-3", "inner_diameter = 1e-3"], "inner_diameter is 0.001 m"),
        (['material = "nitinol"', "diameter = 1e-3", "width = 1e-2"], "found diameter, width; a section is"),
        (['material = "nitinol"', "thickness = 1e-3"], "found thickness; a section is"),
        (['material = "nitinol"', "inner_diameter = 1e-3"], "found inner_diameter; a section is"),
        (["youngs_modulus = 206e9", "diameter = 1.5e-3"], "line_density: missing; state it, or density"),
        (["line_density = 0.01"], "bending_stiffness: missing; state it, or youngs_modulus"),
        (["bending_stifness = 0.05", "line_density = 0.01"], "did you mean 'bending_stiffness'?"),
    ],
)
def test_refused(robot_file, lines, words):
    path = robot_file(*lines)
    with pytest.raises(ModelError, match=words) as caught:
        load_robot(path)
    assert str(path) in str(caught.value)


def test_megapascals_are_questioned(robot_file):
    path = robot_file("youngs_modulus = 206e3", "density = 7850.0", "diameter = 1.5e-3")
    with pytest.warns(UserWarning, match=r"206000 Pa, as soft as rubber; if it was meant in MPa, it is 2.06e\+11 Pa"):
        load_robot(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"thickness_ratio": 0.125}, "0.1 m thick and 0.4 m long"),
        ({"thickness_ratio": 0.0}, "thickness_ratio"),
        ({"thickness_ratio": math.nan}, "thickness_ratio"),
        ({"strain_limit": 0.01}, "without the thickness"),
        ({"thickness_ratio": 2.5e-3, "strain_limit": 1.0}, "not per cent"),
        ({"thickness_ratio": 2.5e-3, "strain_limit": -0.01}, "strain_limit"),
    ],
)
def test_rods_with_strain_that_cannot_be(change, words):
    with pytest.raises(ModelError, match=words):
        Rod(**WHERE, bending_stiffness=0.05, line_density=0.0139, **change)


def test_there_and_back(robot_file):
    robot = load_robot(robot_file('material = "cfrp"', "width = 13e-3", "thickness = 0.7e-3"))
    assert pickle.loads(pickle.dumps(robot)).rods == robot.rods
    assert from_text(to_text(robot)).rods == robot.rods
    old = to_text(load_robot(MODELS / "rfrfr.toml").rods[0])
    assert from_text(old).half_thickness is None


# --- the page ---------------------------------------------------------------------------------------------------------

PAGE = (ROOT / "docs" / "robots.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def test_the_page_lists_the_materials():
    rows = re.findall(r"^\| `(\w+)` \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| (.*) \|$", PAGE, re.MULTILINE)
    assert [row[0] for row in rows] == list(MATERIALS)
    for row, material in zip(rows, MATERIALS.values(), strict=True):
        expected = (material.youngs_modulus / 1e9, material.density, 100 * material.strain_limit)
        assert list(map(float, row[1:4])) == pytest.approx(expected)
        assert row[4] == material.source


def test_the_robot_of_the_page_can_be_built(tmp_path):
    (text,) = blocks("toml")
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    eq = inverse_statics(load_robot(path), (0.0, 0.3), mode="LR")
    assert eq.stable
    assert eq.overstrained == ()
    assert np.abs(eq.motor_torque).max() < eq.robot.torque_limit


def test_the_python_of_the_page_runs(capsys):
    (code,) = blocks("python")
    exec(code, {})
    assert list(map(float, capsys.readouterr().out.split())) == pytest.approx([0.05, 0.014058, 0.0085], rel=1e-5)


def test_the_page_compares_what_would_do():
    """Thickness, strain at the sharpest bend of the scenes and line density of each rod of EI = 0.05 N m^2."""
    number = r"([\d.]+)"
    pattern = rf"^\| (.*?) \| {number} mm \| {number} % \| {number} %.*? \| {number} kg/m \|$"
    rows = re.findall(pattern, PAGE, re.MULTILINE)
    names = ("spring_steel", "nitinol", "nitinol_linear", "gfrp", "spring_steel", "cfrp")
    for name, (words, thickness, strain, limit, density) in zip(names, rows, strict=True):
        material, across = MATERIALS[name], 1e-3 * float(thickness)
        section = Section.round(across)
        if "strip" in words:
            width = 12 * 0.05 / (material.youngs_modulus * across**3)
            section = Section.strip(width, across)
            assert f"{1e3 * width:.3g} mm wide" in words
        assert material.youngs_modulus * section.second_moment == pytest.approx(0.05, rel=0.01)
        assert float(density) == pytest.approx(material.density * section.area, rel=0.01)
        assert float(strain) == pytest.approx(100 * across / 2 / 0.0513, abs=0.01)
        assert float(limit) == pytest.approx(100 * material.strain_limit)
