"""What a run would refuse at its start is an error of `check`, with the file, the table and the key."""

import re
from dataclasses import replace

import pytest

from pcr_mpc import load_scene, make_controller, shipped
from pcr_mpc.cli import main
from pcr_mpc.control.observer import ObserverTuning
from pcr_mpc.control.tuning import LearningTuning, Model
from pcr_mpc.design.examination import examine
from pcr_mpc.design.rehearsal import rehearse
from pcr_mpc.loop.parts.assembled import make_model
from pcr_mpc.loop.references.trajectory import Hold
from pcr_mpc.loop.scene.settings import Payload


@pytest.fixture(scope="module")
def scene():
    scene = load_scene(shipped("lemniscate"))
    return replace(scene, trajectory=Hold(scene.start_tip), duration=0.4)


@pytest.fixture(scope="module")
def curved(scene):
    rods = tuple(replace(rod, curvature=0.2) for rod in scene.robot.rods)
    return replace(scene, robot=replace(scene.robot, rods=rods))


def told(scene, **model):
    return replace(scene, tuning=replace(scene.tuning, model=replace(scene.tuning.model, **model)))


@pytest.mark.parametrize(
    ("rods", "gravity", "method", "weight"),
    [
        ({}, (0.0, 0.0), "closed_form", "none"),
        ({"line_density": 0.01}, (0.0, -9.81), "closed_form", "condensed"),
        ({"curvature": 0.2}, (0.0, 0.0), "multiple_shooting", "none"),
        ({"stiffness_factors": (1.0, 0.5)}, (0.0, 0.0), "multiple_shooting", "none"),
        ({"axial_stiffness": 1e4}, (0.0, 0.0), "multiple_shooting", "none"),
    ],
)
def test_a_tuning_that_names_no_method_takes_what_the_rods_need(scene, rods, gravity, method, weight):
    changed = tuple(replace(rod, **rods) for rod in scene.robot.rods)
    model = make_model(replace(scene.robot, rods=changed, gravity=gravity), Model())
    assert (model.method, model.weight) == (method, weight)


def test_what_new_writes_of_a_robot_goes_on_when_its_rods_are_curved(curved, tmp_path):
    """The controller of a tuning without a method is made, and its model is not the closed form."""
    assert make_controller(told(curved, method=None)).work.watch is not None


@pytest.mark.parametrize(
    ("change", "about", "words"),
    [
        ({"method": "closed_form"}, "controller", r"\[model\] method .* is 'closed_form'.* is curved at rest"),
        ({"plant": {"method": "closed_form"}}, "plant", r"\[plant\] method 'closed_form' is for .* is curved at rest"),
        ({"plant": {"method": "single_shooting", "on_snap": "jump"}}, "plant", r"\[plant\] single shooting"),
        ({"plant": {"weight": "condensed", "method": "multiple_shooting"}}, "plant", r"\[plant\] weight='condensed'"),
    ],
)  # fmt: skip
def test_rods_of_another_kind_than_a_method_knows(scene, curved, change, about, words):
    plant, model = {"method": "multiple_shooting", **change.get("plant", {})}, {"method": change.get("method")}
    case = told(replace(curved, plant=replace(curved.plant, **plant)), **model)
    (found,) = rehearse(case, scene.start(), start=False)
    assert (found.level, found.about) == ("error", about)
    assert re.search(words, found.text)


@pytest.mark.parametrize(
    ("tuning", "others", "words"),
    [
        ({"learning": LearningTuning()}, {}, "does not come round"),
        ({"law": "nonlinear_mpc"}, {"payload": Payload(0.01, 0.1, 0.2)}, "knows no payload"),
        (
            {"observer": ObserverTuning(adapts=("stiffness",)), "model": Model(inertia="constant")},
            {},
            "observer.adapts",
        ),
    ],
)
def test_what_the_controller_refuses_at_its_start_is_found(scene, tuning, others, words):
    case = replace(scene, tuning=replace(scene.tuning, **tuning), **others)
    (found,) = rehearse(case, scene.start())
    assert words in found.text


def test_it_is_a_part_of_the_examination(scene):
    found = examine(replace(scene, plant=replace(scene.plant, method="single_shooting", on_snap="jump")), modes=False)
    assert [one.about for one in found.errors] == ["plant"]


def test_the_file_behind_is_named(tmp_path, capsys):
    assert main(["copy", "lemniscate", str(tmp_path)]) == 0
    robot, tuning, scene = (tmp_path / f"{name}.toml" for name in ("robot", "tuning", "scene"))
    robot.write_text(re.sub(r"^length", "curvature = 0.2\nlength", robot.read_text(), flags=re.M))
    assert main(["track", str(scene), "--out", str(tmp_path / "run")]) == 1
    said = capsys.readouterr().err
    assert f"pcr-mpc: {tuning}: [model] method of the tuning is 'closed_form'" in said
    assert "leave method out of [model]" in said
    scene.write_text(re.sub(r"^\[plant\]", '[plant]\nmethod = "closed_form"', scene.read_text(), flags=re.M))
    tuning.write_text(re.sub(r"^method.*\n", "", tuning.read_text(), flags=re.M))
    assert main(["track", str(scene), "--out", str(tmp_path / "run")]) == 1
    assert f"pcr-mpc: {scene}: [plant] method 'closed_form'" in capsys.readouterr().err
