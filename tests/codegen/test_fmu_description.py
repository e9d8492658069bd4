"""Descriptions of functional mock-up units, by the schema of FMI."""

import pytest

from pcr_mpc.cli import main
from pcr_mpc.codegen.fmu.description import model_description, unit_exponents
from pcr_mpc.codegen.fmu.variables import PARTS, layout
from pcr_mpc.codegen.subject import Subject
from pcr_mpc.loop.scene.file import load_scene
from tests.conftest import ROOT

fmpy = pytest.importorskip("fmpy")
validation = pytest.importorskip("fmpy.validation")


@pytest.fixture(scope="module")
def subject():
    return Subject.of_scene(load_scene(ROOT / "models" / "scenes" / "lemniscate.toml"))


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("part", PARTS)
def test_descriptions_are_valid(part, version, subject, tmp_path):
    about = model_description(layout(subject, part), version, name="some scene", token="{0}", times=(6.0, 0.01),
                              sources=["pcr_fmu.c"])  # fmt: skip
    (tmp_path / "modelDescription.xml").write_bytes(about)
    assert validation.validate_fmu(str(tmp_path)) == []
    read = fmpy.read_model_description(str(tmp_path))
    known = {variable.name: variable for variable in read.modelVariables}
    assert float(known["rods[0].bending_stiffness"].start) == subject.scene.robot.rods[0].bending_stiffness
    assert known["tip_mass"].variability == "tunable"
    if part == "controller":  # which has many variables, each of which takes its time
        return
    (tmp_path / "modelDescription.xml").write_bytes(about.replace(b'unit="m/s"', b'unit="knots"'))
    assert "knots" in str(validation.validate_fmu(str(tmp_path)))  # it would have been seen


def test_units_are_made_of_base_units():
    assert unit_exponents("N s/m") == {"kg": 1, "s": -1}
    assert unit_exponents("N m^2") == {"kg": 1, "m": 3, "s": -2}
    assert unit_exponents("1/rad^2") == {"rad": -2}


def test_a_unit_has_a_suffix(tmp_path, capsys):
    assert main(["fmu", "lemniscate", "--part", "plant", "--out", str(tmp_path / "plant.zip")]) == 1
    assert "ends with .fmu" in capsys.readouterr().err
