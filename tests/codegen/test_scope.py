"""What C can be generated of, and what is refused by name."""

from dataclasses import replace

import pytest

from pcr_mpc.cli import main
from pcr_mpc.codegen.scope import check_scope
from pcr_mpc.control.observer import ObserverTuning
from pcr_mpc.control.tuning import LearningTuning, load_tuning
from pcr_mpc.errors import GenerationError
from pcr_mpc.loop.hardware.motors import Motors
from pcr_mpc.loop.scene.file import load_scene
from tests.codegen.conftest import SCENES
from tests.conftest import ROOT

NOT_IN_C = {"release": "reference"}


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_scene_is_generated_or_refused_by_name(path):
    scene, part = load_scene(path), NOT_IN_C.get(path.stem)
    if part is None:
        assert check_scope(scene, scene.tuning) is scene.tuning
        return
    with pytest.raises(GenerationError) as error:
        check_scope(scene, scene.tuning)
    assert error.value.part == part


REFUSED = {
    "lqr": "law",
    "nonlinear": "law",
    "open_loop": "law",
    "pd": "law",
}


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"motors": Motors(saturated=True)}, "motors at their torque limit"),
        ({"plant": {"on_snap": "jump"}}, "snapping plant"),
        ({"plant": {"method": "single_shooting"}}, "method of the plant's rods"),
        ({"plant": {"inertia": "full"}}, "inertia of the plant"),
        ({"tuning": {"fallback": "raise"}}, "fallback"),
        ({"tuning": {"learning": LearningTuning()}}, "learning"),
        ({"tuning": {"observer": ObserverTuning(adapts=("tip_mass",))}}, "observer that adapts"),
        ({"start_velocity": (0.1, 0.0)}, "start that moves, at [m/s]"),
    ],
)
def test_what_c_does_not_have_is_said_by_name(changes, part):
    scene = load_scene(SCENES / "lemniscate.toml")
    whole = {key: replace(getattr(scene, key), **value) if isinstance(value, dict) else value
             for key, value in changes.items()}  # fmt: skip
    scene = replace(scene, **whole)
    with pytest.raises(GenerationError, match="C has no") as error:
        check_scope(scene, scene.tuning)
    assert error.value.part == part


@pytest.mark.parametrize("path", sorted((ROOT / "controllers").glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_tuning_is_generated_or_refused_by_name(path):
    scene = load_scene(SCENES / "lemniscate.toml")
    tuning, part = load_tuning(path), REFUSED.get(path.stem)
    if part is None:
        assert check_scope(scene.tuned(tuning), tuning) is tuning
        return
    with pytest.raises(GenerationError) as error:
        check_scope(scene.tuned(tuning), tuning)
    assert error.value.part == part


def test_files_of_others_are_left_alone(tmp_path, capsys):
    (tmp_path / "README.md").write_text("mine")
    assert main(["generate", str(SCENES / "lemniscate.toml"), "--out", str(tmp_path)]) == 1
    assert "README.md" in capsys.readouterr().err
    assert (tmp_path / "README.md").read_text() == "mine"


def test_a_folder_has_one_solver(tmp_path, capsys):
    """Their sources would be compiled together."""
    (tmp_path / "osqp").mkdir()
    assert main(["generate", str(SCENES / "lemniscate.toml"), "--solver", "daqp", "--out", str(tmp_path)]) == 1
    assert "was generated with osqp" in capsys.readouterr().err
    assert not (tmp_path / "pcr.h").exists()
