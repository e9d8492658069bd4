"""Errors say what is wrong and what to do, and what means the same is taken for the same."""

import ast
import importlib
import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import pcr_mpc
from pcr_mpc import (
    HoldMotors,
    ModelError,
    PCRError,
    Plant,
    UnstableError,
    inverse_statics,
    load_robot,
    load_scene,
    load_tuning,
    make_controller,
    rollout,
    simulate,
)
from pcr_mpc.cli import main
from pcr_mpc.control.observer import ObserverTuning
from pcr_mpc.loop.run.finding import digest
from pcr_mpc.loop.scene.settings import Finding
from pcr_mpc.plant.statics.free_tip import _require_usable
from pcr_mpc.study.episodes.episodes import Spread, run_episode
from pcr_mpc.study.episodes.provenance import described, differences
from pcr_mpc.study.tuning.file import to_tune, write_tuning
from tests.conftest import CONTROLLERS, MODELS

SCENES = MODELS / "scenes"


@pytest.fixture
def files(tmp_path):
    """A scene, its robot and its tuning, to be spoiled."""
    for folder, name in (("models", "planar_pair.toml"), ("models/scenes", "lemniscate.toml")):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / name).write_bytes((MODELS.parent / folder / name).read_bytes())
    (tmp_path / "controllers").mkdir()
    (tmp_path / "controllers/lemniscate.toml").write_bytes((CONTROLLERS / "lemniscate.toml").read_bytes())
    return tmp_path


# --- numbers ----------------------------------------------------------------------------------------------------------


def test_numpys_numbers_in_a_tuning_are_numbers(tmp_path):
    tuning = load_tuning(CONTROLLERS / "default.toml")
    numpys = replace(
        tuning, horizon=np.int64(6), max_iterations=np.uint16(100), position_weight=np.float64(3.0),
        input_weight=np.float32(0.5), tolerance=np.float64(1e-5), period=np.float64(0.01), pd=(np.float64(1.0), 2),
        observer=ObserverTuning(np.float64(1e-4)), model=replace(tuning.model, segments=np.int32(4)),
    )  # fmt: skip
    pythons = replace(
        tuning, horizon=6, max_iterations=100, position_weight=3.0, input_weight=0.5, tolerance=1e-5, period=0.01,
        pd=(1.0, 2.0), observer=ObserverTuning(1e-4), model=replace(tuning.model, segments=4),
    )  # fmt: skip
    assert numpys == pythons
    assert repr(numpys) == repr(pythons)  # which is what is written to files
    numpys = replace(numpys, pd=(0.0, 0.0))
    write_tuning(numpys, tmp_path / "a.toml", [])
    assert load_tuning(tmp_path / "a.toml") == numpys


@pytest.mark.parametrize("value", [0, -1, 1.0, 2.5, True, np.True_, "6", None, np.float64(6.0), np.int64(0)])
@pytest.mark.parametrize("name", ["horizon", "max_iterations"])
def test_other_counts_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=rf"^{name} = .* must be a whole number of at least 1"):
        replace(load_tuning(CONTROLLERS / "default.toml"), **{name: value})


def test_a_rollout_takes_numpys_threads(pair, centre):
    x = np.tile(np.concatenate([centre.p, [0.0, 0.1], centre.q]), (3, 1))
    inputs = np.zeros((5, 2))
    one = rollout(Plant(pair), x, inputs)
    assert (rollout(Plant(pair), x, inputs, threads=np.int64(2)).x == one.x).all()
    for threads in (0, True, 1.5):
        with pytest.raises(ValueError, match=r"threads = .* must be a whole number of at least 1"):
            rollout(Plant(pair), x, inputs, threads=threads)


def test_a_seed_is_checked_and_ends_in_the_summary():
    scene = replace(load_scene(SCENES / "release.toml"), duration=0.02)
    run = simulate(scene, scene.make_plant(), HoldMotors(2), seed=np.int64(3))
    assert json.loads(json.dumps(run.summary()))["seed"] == 3
    with pytest.raises(ValueError, match="seed = -1 must be a whole number of at least 0"):
        simulate(scene, scene.make_plant(), HoldMotors(2), seed=-1)
    lemniscate = load_scene(SCENES / "lemniscate.toml")
    with pytest.raises(ValueError, match="seed = -1"):
        run_episode(lemniscate, lemniscate.tuning, -1)


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["models/planar_pair.toml", "models/scenes/lemniscate.toml", "controllers/lemniscate.toml"]
)
def test_a_byte_order_mark_is_no_content(files, name):
    before = load_scene(files / "models/scenes/lemniscate.toml")
    path = files / name
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert load_scene(files / "models/scenes/lemniscate.toml") == before
    (files / "controllers/default.toml").write_bytes((CONTROLLERS / "default.toml").read_bytes())
    assert to_tune(files / "models/scenes/lemniscate.toml")[0].tuning.name == "default"


def test_another_encoding_is_named(files):
    path = files / "models/planar_pair.toml"
    path.write_text(path.read_text(), encoding="utf-16")
    with pytest.raises(ModelError, match=r"planar_pair\.toml: is not UTF-8 text .*; save it as UTF-8"):
        load_robot(path)


def test_a_folder_is_named_as_one(files, capsys):
    with pytest.raises(ModelError, match=r"models: is a folder, expected a file$"):
        load_robot(files / "models")
    assert main(["statics", str(files / "models"), "--q", "1", "2"]) == 1
    assert capsys.readouterr().err == f"pcr-mpc: {files / 'models'}: is a folder, and statics takes a robot\n"


@pytest.mark.parametrize("command", ["track", "timing"])
def test_a_file_where_the_results_should_go_is_named(files, capsys, command):
    taken = files / "taken"
    taken.write_text("mine")
    assert main([command, str(SCENES / "lemniscate.toml"), "--out", str(taken)]) == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"pcr-mpc: {taken}: a file is where a folder")
    assert taken.read_text() == "mine"


def test_a_missing_default_names_the_option(files):
    with pytest.raises(ModelError, match=r"default\.toml: no such file; .* with --start"):
        to_tune(files / "models/scenes/lemniscate.toml")
    scene, known = to_tune(files / "models/scenes/lemniscate.toml", CONTROLLERS / "frozen.toml")
    assert (scene.tuning.name, known.name) == ("frozen", "lemniscate")


def test_a_scene_without_a_reference_has_nothing_to_tune():
    for start in (None, CONTROLLERS / "default.toml"):
        with pytest.raises(ModelError, match="release has nothing to track"):
            to_tune(SCENES / "release.toml", start)


# --- keys -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("place", "key", "nearest", "words"),
    [
        ("drag", "motor", "motors", "did you mean 'motors'"),  # of the whole file
        ("rod", "motor", None, "motors are described by"),
        ("rod", "platform", None, "no platform"),
        ("rod", "tendon", None, "tendons are not described"),
        ("rod", "friction", None, "no friction"),
        ("rod", "torsion_stiffness", None, "planar"),
        ("rod", "elasticity", None, "bending_stiffness"),
        ("rod", "colour", None, r"unknown key \(known here: base, length,"),
        ("rod", "curvatur", "curvature", "did you mean 'curvature'"),
        ("rod", "densty", "density", "did you mean 'density'"),
    ],
)
def test_only_what_is_near_is_suggested(files, place, key, nearest, words):
    path = files / "models/planar_pair.toml"
    text, line = path.read_text(), f"{key} = 1.0\n"
    path.write_text(text.replace("base = ", f"{line}base = ", 1) if place == "rod" else line + text)
    with pytest.raises(ModelError, match=words) as caught:
        load_robot(path)
    assert (caught.value.key, caught.value.nearest) == (key, nearest)
    assert nearest or "did you mean" not in str(caught.value)


# --- poses and motions ------------------------------------------------------------------------------------------------


def test_unstable_poses_name_rods_only_if_there_are_some(pair):
    """Between two balances both rods hold their shape, and the tip does not."""
    between = next(eq for eq in pcr_mpc.all_equilibria(pair, (0.18, 0.12), (0.0, np.pi)) if not eq.stable)
    assert between.unstable_rods == ()
    for eq, words in ((between, r"N/m; choose"), (replace(between, unstable_rods=(0, 1)), r"N/m, unstable rods 0, 1;")):
        with pytest.raises(UnstableError, match=words):
            _require_usable(eq)


class Jolt:
    """The tip at rest but for one period, in which it is said to accelerate."""

    def __init__(self, acceleration, place=(0.0, 0.25)):
        self.acceleration, self.place = acceleration, place

    def __call__(self, t):
        samples = np.zeros((len(t), 3, 2))
        samples[:, 0] = self.place
        samples[np.abs(t - 0.3) < 0.004, 2, 0] = self.acceleration
        return samples


def test_a_kink_in_the_reference_names_its_acceleration_and_what_would_do():
    scene = replace(load_scene(SCENES / "lemniscate.toml"), duration=0.5, trajectory=Jolt(200.0))
    with pytest.raises(
        PCRError, match=r"reference at t = 0\.300 s: it asks for an acceleration of 200 m/s\^2"
    ) as caught:
        make_controller(scene).start(scene.start())
    # Both sides of what it says, by inverse statics alone: slower by f, the acceleration is less by f^2.
    slower = float(str(caught.value).split("factor of at least ")[1].split()[0])
    mass, pose = scene.robot.tip_mass, scene.start()
    inverse_statics(scene.robot, (0.0, 0.25), (-mass * 200.0 / slower**2, 0.0), guess=pose)
    with pytest.raises(PCRError):
        inverse_statics(scene.robot, (0.0, 0.25), (-mass * 200.0 / (slower - 0.15) ** 2, 0.0), guess=pose)


def test_a_pose_out_of_reach_is_not_blamed_on_the_acceleration():
    scene = replace(load_scene(SCENES / "lemniscate.toml"), duration=0.5, trajectory=Jolt(200.0, (0.0, 0.45)))
    with pytest.raises(PCRError, match=r"reference at t = 0\.000 s: tip") as caught:
        make_controller(scene).start(load_scene(SCENES / "lemniscate.toml").start())
    assert "acceleration" not in str(caught.value)


@pytest.mark.parametrize(
    ("returned", "words"),
    [
        (lambda t: np.zeros((len(t), 2)), r"shape \(\d+, 2\), expected \(\d+, 3, 2\)"),
        (lambda t: np.full((len(t), 3, 2), np.nan), "is not finite"),
        (lambda t: None, "expected numbers"),
    ],
)
def test_what_a_trajectory_of_ones_own_returns_is_checked(returned, words):
    scene = replace(load_scene(SCENES / "lemniscate.toml"), duration=0.1)
    pose = scene.start()
    with pytest.raises(ValueError, match=f"what the trajectory function returned.*{words}"):
        make_controller(replace(scene, trajectory=returned)).start(pose)


@dataclass(frozen=True)
class Table:
    """A trajectory of one's own as a dataclass with an array."""

    places: np.ndarray

    def __call__(self, t):
        samples = np.zeros((len(t), 3, 2))
        samples[:, 0] = self.places[0]
        return samples


@pytest.mark.parametrize(
    "trajectories",
    [
        (Jolt(0.0), Jolt(0.0), Jolt(1.0)),
        (Table(np.array([[0.0, 0.25]])), Table(np.array([[0.0, 0.25]])), Table(np.array([[0.0, 0.26]]))),
        (lambda t: Jolt(0.0)(t), lambda t: Jolt(0.0)(t), lambda t: Jolt(1.0)(t)),
    ],
    ids=["class", "dataclass", "function"],
)
def test_a_trajectory_of_ones_own_goes_everywhere_that_ours_do(trajectories, tmp_path):
    """[need] and [chosen] hold for the same motion, and for no other."""
    scene = replace(load_scene(SCENES / "payload.toml"), duration=0.5, payload=None)
    assert scene.need is not None
    one, same, other = (replace(scene, trajectory=trajectory) for trajectory in trajectories)
    assert digest(one) == digest(same) != digest(other)
    one = replace(one, finding=Finding(1e-9, 0.0, digest(one)))
    run = simulate(replace(one, duration=0.05), one.make_plant(), HoldMotors(2))
    assert json.loads(json.dumps(run.summary()))["need"]["verified"] is False  # cut short
    run.save(tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text())["need"]["tip_accuracy_mm"] > 0
    assert replace(run, scene=one).summary()["need"]["verified"] is True
    assert replace(run, scene=replace(other, finding=one.finding)).summary()["need"]["verified"] is False
    records = [described(each, scene.tuning, Spread()) for each in (one, same, other)]
    assert differences(records[1], described(same, scene.tuning, Spread())) == []
    assert any("trajectory" in line for line in differences(records[1], records[2]))


def test_findings_that_were_written_still_hold():
    """Their digests are in the scene files."""
    held = [load_scene(path) for path in SCENES.glob("*.toml")]
    held = [scene for scene in held if scene.finding is not None]
    assert len(held) >= 5
    assert all(scene.finding.digest == digest(scene) for scene in held)


# --- the command line -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["track", "x.toml", "--seed", "-1"], "--seed is -1, expected at least 0"),
        (["track", "x.toml", "--plant", "mujoco", "--links", "1"], "--links is 1, expected at least 2"),
        (["timing", "x.toml", "--steps", "0"], "--steps is 0, expected at least 1"),
        (["tune", "x.toml", "--trials", "0"], "--trials is 0, expected at least 1"),
        (["tune", "x.toml", "--jobs", "-1"], "--jobs is -1, expected at least 1"),
        (["tune", "x.toml", "--episodes", "-3"], "--episodes is -3, expected at least 1"),
        (["tune", "x.toml", "--seed", "-1"], "--seed is -1, expected at least 0"),
    ],
)
def test_numbers_of_the_command_line_name_their_option(arguments, words, capsys):
    assert main(arguments) == 1
    assert capsys.readouterr().err == f"pcr-mpc: {words}\n"


def test_version(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["--version"])
    assert caught.value.code == 0
    assert capsys.readouterr().out.startswith("pcr-mpc ")


HEAVY = ("casadi", "scipy", "matplotlib", "osqp", "optuna", "control")


def loaded(code):
    """Which of the heavy packages a new interpreter has loaded after some code."""
    code += f"\nimport sys; print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return ast.literal_eval(done.stdout.splitlines()[-1])


def test_early_errors_and_help_load_nothing_heavy():
    calls = (["--help"], ["--version"], ["track"], ["tune", "x", "--seed", "-1"], ["track", "nowhere.toml"])
    code = f"""
from pcr_mpc.cli import main
for arguments in {calls!r}:
    try:
        assert main(arguments) == 1
    except SystemExit:
        pass
"""
    assert loaded(code) == []


def test_a_robot_and_a_pose_load_neither_pictures_nor_solvers():
    code = f"import pcr_mpc; r = pcr_mpc.load_robot({str(MODELS / 'planar_pair.toml')!r})\n"
    assert loaded(code + "pcr_mpc.inverse_statics(r, (0, 0.25), mode='LR')") == ["casadi", "scipy"]
    assert loaded("import pcr_mpc") == []


def test_public_names_are_where_the_type_checker_looks_for_them():
    tree = ast.parse(Path(pcr_mpc.__file__).read_text(encoding="utf-8"))
    (branch,) = (node for node in tree.body if isinstance(node, ast.If) and isinstance(node.test, ast.Name))
    homes = {name.name: node.module for node in branch.body for name in node.names}
    assert sorted(homes) == sorted(pcr_mpc.__all__)
    for name, module in homes.items():
        assert getattr(pcr_mpc, name) is getattr(importlib.import_module(f"pcr_mpc.{module}"), name)
        assert name in dir(pcr_mpc)
    with pytest.raises(AttributeError, match="has no attribute 'solve_dynamics'"):
        _ = pcr_mpc.solve_dynamics


def test_the_package_says_that_it_has_types():
    assert (Path(pcr_mpc.__file__).parent / "py.typed").is_file()


@pytest.mark.slow
def test_type_checkers_see_the_types_in_the_wheel(tmp_path):
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    try:
        subprocess.run([*pip, "wheel", "-q", "--no-deps", "-w", tmp_path, MODELS.parent], check=True)
    except subprocess.CalledProcessError:
        pytest.skip("no wheel can be built here: hatchling is not at hand")
    (wheel,) = tmp_path.glob("*.whl")
    subprocess.run([*pip, "install", "-q", "--no-deps", "--target", tmp_path / "site", wheel], check=True)
    (tmp_path / "use.py").write_text("import pcr_mpc\nreveal_type(pcr_mpc.load_robot)\npcr_mpc.nothing\n")
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file=", "--ignore-missing-imports", "use.py"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
        env={"PYTHONPATH": str(tmp_path / "site"), "PATH": ""},
    )  # fmt: skip
    assert "-> pcr_mpc.plant.robot.Robot" in done.stdout
    assert 'has no attribute "nothing"' in done.stdout
