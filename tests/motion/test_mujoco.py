"""The robot in MuJoCo, whose code is not ours, moves as the rods of distributed mass do."""

import copy
import json
import pickle
import re
import shutil
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    ConvergenceError,
    ModelError,
    PCRError,
    Plant,
    inverse_statics,
    load_robot,
    load_scene,
    load_tuning,
    make_controller,
    simulate,
    solve_statics,
)
from pcr_mpc.cli import main
from pcr_mpc.errors import ReadOnlyError
from pcr_mpc.plant.mujoco.hinge_chain import settled_chains
from pcr_mpc.plant.mujoco.mjcf import coordinates, mjcf
from pcr_mpc.plant.mujoco.plant import _WARNINGS, MuJoCoPlant
from tests.conftest import CONTROLLERS, MODELS

from .test_distributed import distance, released
from .test_inertia import rollout, state

mujoco = pytest.importorskip("mujoco")


def in_mujoco(robot, pose, velocity=(0.3, -0.2), u=(0.0, 0.0), seconds=0.2, **settings):
    """States from the pose on, as `released` gives them."""
    plant, x = MuJoCoPlant(robot, **settings), state(pose, velocity)
    plant.reset(x, pose)
    return rollout(plant, x, seconds, u)


@pytest.fixture(scope="module")
def displaced(pair, centre):
    return solve_statics(pair, centre.p + [0.03, 0.02], centre.q, guess=centre)


def test_the_file_is_the_robot(pair, centre):
    """Masses, inertia about the base, stiffness; and its keyframe is the pose."""
    model = mujoco.MjModel.from_xml_string(mjcf(pair, pose=centre, links=20))
    data = mujoco.MjData(model)
    assert (model.nq, model.nu, model.neq) == (2 * 20 + 2, 2, 2)
    assert model.body_mass.sum() == pytest.approx(0.25 + 2 * 0.0139 * 0.4)
    # Straight at the start: the first hinge carries the inertia of a rod about its end.
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    assert inertia[0, 0] == pytest.approx(0.0139 * 0.4**3 / 3, rel=1e-9)
    assert inertia[-2:, -2:] == pytest.approx(0.25 * np.eye(2))
    # All springs in series bend as the rod does but for half a link at its free end.
    compliances = np.append(1 / model.jnt_stiffness[1:20], 1 / model.actuator_gainprm[0, 0])
    assert compliances.sum() == pytest.approx(0.4 * (1 - 1 / 40) / 0.05)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    mujoco.mj_kinematics(model, data)
    for name in ("end0", "end1", "pin"):
        assert data.site(name).xpos == pytest.approx([*centre.p, 0.0], abs=1e-12)
    assert data.ctrl == pytest.approx(centre.q, abs=0)


def test_the_chains_start_in_mujocos_equilibrium(pair, displaced):
    """With a tip too heavy to move, nothing moves."""
    heavy = replace(pair, tip_mass=1e9)
    pose = replace(displaced, robot=heavy)
    plant, x = MuJoCoPlant(heavy, links=20), state(pose, (0.0, 0.0))
    plant.reset(x, pose)
    began = plant._data.qpos.copy()
    rollout(plant, x, 0.02)
    assert np.abs(plant._data.qpos - began).max() < 1e-6
    assert plant.gap < 1e-6
    # And moves with the tip as the equilibria do.
    v, dt = np.array([0.3, -0.2]), 1e-6
    moved = solve_statics(pair, displaced.p + dt * v, displaced.q, guess=displaced)
    rates = settled_chains(displaced, v, 20).rates
    slopes = (settled_chains(moved, v, 20).angles - settled_chains(displaced, v, 20).angles) / dt
    assert rates == pytest.approx(slopes, abs=1e-3)
    qpos, qvel = coordinates(settled_chains(displaced, v, 20), displaced.p, v)
    assert (len(qpos), len(qvel)) == (42, 42)


@pytest.mark.parametrize("case", ["velocity", "displaced", "motors", "drag"])
def test_it_moves_as_distributed_rods_do(pair, centre, displaced, case):
    """The error of the chains falls as the square of the links."""
    robot, pose, settings = pair, centre, {"seconds": 0.1}
    if case == "displaced":
        pose, settings["velocity"] = displaced, (0.0, 0.0)
    if case == "motors":
        settings["u"] = (1.0, -0.5)
    if case == "drag":
        robot = replace(pair, drag=3.0)
    reference = released(robot, pose, dt=1e-3, **settings)
    errors = [distance(in_mujoco(robot, pose, links=links, **settings), reference) for links in (10, 20, 40)]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.2)
    assert errors[2] < 0.01 * distance(reference, reference[:1])


def test_the_release_of_the_scene(pair, centre):
    """models/scenes/release.toml for a second, against distributed rods and against the paper's massless ones."""
    reference = released(pair, centre, seconds=1.0)[1:]
    errors = {
        "chains": distance(in_mujoco(pair, centre, seconds=1.0, dt=2e-3, substeps=4)[1:], reference),
        "none": distance(released(pair, centre, seconds=1.0, inertia="none", integrator="rk4")[1:], reference),
    }
    assert errors["chains"] < 0.3
    assert errors["none"] > 2.0


def test_chains_with_weight_start_in_mujocos_equilibrium(inextensible):
    """A tip too heavy to move is held up by a force that carries it."""
    robot = replace(inextensible, tip_mass=1e9)
    pose = solve_statics(robot, (0.01, 0.24), (3.2, 0.1))
    plant, x = MuJoCoPlant(robot, links=20), state(pose, (0.0, 0.0))
    plant.reset(x, pose)
    began = plant._data.qpos.copy()
    for _ in range(20):
        x = plant.step(x, (0.0, 0.0), -robot.tip_weight)
    assert np.abs(plant._data.qpos - began).max() < 1e-6


def test_weight_curvature_and_varying_stiffness(inextensible):
    pose, settings = inverse_statics(inextensible, (0.0, 0.25), mode="LR"), {"u": (1.0, -0.5), "seconds": 0.1}
    reference = released(inextensible, pose, **settings)
    errors = [distance(in_mujoco(inextensible, pose, dt=2e-3, links=n, **settings), reference) for n in (10, 20)]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)
    assert errors[1] < 0.01 * distance(reference, reference[:1])


def test_a_load_on_the_tip(pair, centre):
    moved = []
    for plant in (MuJoCoPlant(pair, links=20), Plant(pair, inertia="full", integrator="gauss")):
        x = state(centre)
        plant.reset(x, centre)
        for _ in range(50):
            x = plant.step(x, (0.0, 0.0), (0.5, -0.3))
        moved.append(x[:2] - centre.p)
    assert np.linalg.norm(moved[1]) > 1e-3
    assert moved[0] == pytest.approx(moved[1], abs=0.02 * np.linalg.norm(moved[1]))


def test_orders_of_the_time_step(pair, displaced):
    """MuJoCo's own step is of first order; extrapolated, of second, and better with a twentieth of the steps."""
    settings = {"velocity": (0.0, 0.0), "links": 10, "dt": 8e-3, "seconds": 0.16}
    exact = in_mujoco(pair, displaced, substeps=128, **settings)
    for extrapolated, substeps, order in ((False, (16, 32), 1.0), (True, (8, 16), 2.0)):
        errors = [
            distance(in_mujoco(pair, displaced, substeps=n, extrapolated=extrapolated, **settings), exact)
            for n in substeps
        ]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.3)
    alone = distance(in_mujoco(pair, displaced, substeps=160, extrapolated=False, **settings), exact)
    assert distance(in_mujoco(pair, displaced, substeps=8, **settings), exact) < alone


def test_motors_turn_exactly_and_stop_at_their_limits(pair, centre):
    """As those of the other plants do, to the last bit."""
    plants, u = (MuJoCoPlant(pair, links=4), Plant(pair)), (7.0, -9.0)
    states = []
    for plant in plants:
        x = state(centre)
        plant.reset(x, centre)
        states.append(rollout(plant, x, 0.1, u)[:, 4:])
    assert (states[0] == states[1]).all()
    assert states[0][-1] == pytest.approx(centre.q + 0.1 * pair.rate_limit * np.array([1.0, -1.0]))
    tight = replace(pair, rods=tuple(replace(rod, angle_limits=(-0.3, 3.4)) for rod in pair.rods))
    plant, x = MuJoCoPlant(tight, links=4), state(centre)
    plant.reset(x, centre)
    assert rollout(plant, x, 0.1, u)[-1, 4:] == pytest.approx([3.4, -0.3])


def test_the_pin_holds(pair, centre):
    plant, x = MuJoCoPlant(pair), state(centre, (1.0, -0.8))
    plant.reset(x, centre)
    gaps = []
    for k in range(100):
        x = plant.step(x, (3.0, 2.0) if k < 50 else (-3.0, -2.0))
        gaps.append(plant.gap)
    assert max(gaps) < 2e-6


def test_three_rods():
    robot = load_robot(MODELS / "three_rods.toml")
    pose = inverse_statics(robot, (0.0, 0.115), mode="LLL")
    u = (0.3, -0.2, 0.1)
    reference = released(robot, pose, (0.05, 0.0), u, seconds=0.1, dt=1e-3)
    errors = [
        distance(in_mujoco(robot, pose, (0.05, 0.0), u, seconds=0.1, links=links), reference) for links in (10, 20)
    ]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.15)


def test_a_state_from_outside_finds_the_chains_at_rest(pair, centre):
    plant, x = MuJoCoPlant(pair, links=10), state(centre)
    plant.reset(x, centre)
    states = rollout(plant, x, 0.02, (2.0, 1.0))
    # Another state in between, and the chains of before are forgotten.
    plant.step(states[0], (0.0, 0.0))
    calmed = plant.step(states[10], (2.0, 1.0))
    assert 1e-7 < np.abs(calmed - states[11]).max() < 1e-2
    plant.reset(x, centre)
    assert rollout(plant, x, 0.02, (2.0, 1.0)) == pytest.approx(states, abs=0)


def test_a_step_that_fails_changes_nothing(pair, centre, tmp_path, monkeypatch, capfd):
    """And MuJoCo neither prints nor writes its log file."""
    monkeypatch.chdir(tmp_path)
    plant, x = MuJoCoPlant(pair, links=10), state(centre)
    plant.reset(x, centre)
    x = rollout(plant, x, 0.01, (2.0, 1.0))[-1]
    with pytest.raises(ConvergenceError, match=r"MuJoCo gave up: .*QACC") as caught:
        plant.step(x, (2.0, 1.0), (1e15, 0.0))
    assert (caught.value.state == x).all()
    after = plant.step(x, (2.0, 1.0))
    plant.reset(state(centre), centre)
    assert after == pytest.approx(rollout(plant, state(centre), 0.011, (2.0, 1.0))[-1], abs=1e-12)
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")
    assert mujoco.get_mju_user_warning() is None


def test_bad_arguments_are_named(pair, monkeypatch):
    weightless = replace(pair, rods=(pair.rods[0], replace(pair.rods[1], line_density=0.0)))
    with pytest.raises(ModelError, match="rod 1 has line_density 0 kg/m, but MuJoCo has no bodies without mass"):
        mjcf(weightless)
    with pytest.raises(ModelError, match="rod 1 has line_density 0"):
        MuJoCoPlant(weightless)
    stretching = replace(pair, rods=(pair.rods[0], replace(pair.rods[1], axial_stiffness=1e4)))
    with pytest.raises(ModelError, match="rod 1 stretches, but the links of the model for MuJoCo are rigid"):
        MuJoCoPlant(stretching)
    with pytest.raises(ValueError, match="links = 1 must be a whole number from 2 to 1000"):
        MuJoCoPlant(pair, links=1)
    with pytest.raises(ValueError, match=r"dt is 0\.0 s"):
        MuJoCoPlant(pair, dt=0.0)
    with pytest.raises(ValueError, match="substeps = 0 must be"):
        MuJoCoPlant(pair, substeps=0)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(PCRError, match=r"MuJoCo is not installed; pip install 'pcr_mpc\[mujoco\]'"):
        MuJoCoPlant(pair)


def test_a_model_with_the_rods_inertia_drives_it_better():
    scene = replace(load_scene(MODELS / "scenes" / "lemniscate.toml"), duration=2.0)
    scene = scene.tuned(load_tuning(CONTROLLERS / "frozen.toml"))
    errors = {}
    for inertia in ("none", "condensed"):
        tuning = replace(scene.tuning, model=replace(scene.tuning.model, inertia=inertia))
        plant = MuJoCoPlant(scene.robot, dt=scene.plant.dt, substeps=1)
        errors[inertia] = simulate(scene, plant, make_controller(scene, tuning)).summary()["rms_after_1s_mm"]
    assert errors["none"] < 0.02
    assert errors["condensed"] < 0.7 * errors["none"]


@pytest.fixture
def short(tmp_path):
    shutil.copytree(MODELS, tmp_path / "models")
    shutil.copytree(CONTROLLERS, tmp_path / "controllers")
    path = tmp_path / "models/scenes/lemniscate.toml"
    path.write_text(re.sub(r"duration = 6\.0", "duration = 0.5", path.read_text()))
    return path


def test_track(short, tmp_path, capsys):
    arguments = ["track", str(short), "--plant", "mujoco", "--links", "10", "--no-pictures", "--out", str(tmp_path),
                 "--controller", str(CONTROLLERS / "measured.toml")]  # fmt: skip
    assert main([*arguments, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["plant"] == f"MuJoCo {mujoco.__version__}, 10 links, discrete at 500 us extrapolated, dt = 1 ms"
    errors = summary["by_model_inertia"]
    assert list(errors) == ["none", "condensed"]
    # So few links hide which is better.
    assert errors["none"]["rms_mm"] == summary["rms_mm"] != errors["condensed"]["rms_mm"] < 0.5
    assert json.loads((tmp_path / "summary.json").read_text()) == summary
    assert main(arguments) == 0
    table = capsys.readouterr().out
    assert re.search(r"rods' inertia in the controller's model +RMS.*\n.*\n +none .*\n +condensed ", table)


def test_track_refuses_what_does_not_go_together(short, capsys):
    assert main(["track", str(short), "--links", "10"]) == 1
    assert "--links goes with --plant mujoco" in capsys.readouterr().err
    assert main(["track", str(short), "--plant", "mujoco", "--method", "closed_form"]) == 1
    assert "--method has no use with --plant" in capsys.readouterr().err


def test_export(tmp_path, capsys):
    """The file stays where it was put, in MuJoCo alone."""
    out = tmp_path / "robots" / "pair.xml"
    arguments = ["export", str(MODELS / "planar_pair.toml"), "--p", "0", "0.25", "--mode", "LR", "--out", str(out)]
    assert main(arguments) == 0
    assert f"40 links a rod, mode LR: {out}" in capsys.readouterr().out
    model = mujoco.MjModel.from_xml_path(str(out))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_step(model, data, 400)
    assert data.site("pin").xpos == pytest.approx([0.0, 0.25, 0.0], abs=2e-4)
    assert main([*arguments, "--links", "5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["links"] == 5


@pytest.mark.slow
def test_endless_links_are_the_distributed_rods(pair, displaced):
    """Extrapolated in links, two engines agree to hundredths of a millimetre for a second."""
    chains = [in_mujoco(pair, displaced, (0.0, 0.0), seconds=1.0, links=links) for links in (40, 80)]
    endless = (4 * chains[1] - chains[0]) / 3
    for inertia, integrator, largest in (("full", "gauss", 0.01), ("condensed", "rk4", 0.01), ("constant", "rk4", 0.5)):
        states = released(pair, displaced, (0.0, 0.0), seconds=1.0, dt=1e-3, inertia=inertia, integrator=integrator)
        assert distance(states, endless) < largest
    assert distance(states, endless) > 0.3


@pytest.mark.slow
def test_endless_links_are_the_distributed_rods_that_sag(heavy, sagging):
    chains = [in_mujoco(heavy, sagging, seconds=1.0, links=links) for links in (40, 80)]
    endless = (4 * chains[1] - chains[0]) / 3
    errors = [
        distance(released(heavy, sagging, seconds=1.0, dt=1e-3, inertia=inertia, integrator=integrator), endless)
        for inertia, integrator in (("full", "gauss"), ("condensed", "rk4"), ("none", "rk4"))
    ]
    assert errors[0] < 0.01 < errors[1] < 0.06
    assert errors[2] > 20.0


def test_a_warning_belongs_to_the_plant_whose_thread_steps(pair, centre, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    failing, x = MuJoCoPlant(pair, links=10), state(centre)
    failing.reset(x, centre)

    def fail():
        with pytest.raises(ConvergenceError, match="MuJoCo gave up"):
            failing.step(x, (2.0, 1.0), (1e15, 0.0))

    with _WARNINGS.heard(mujoco) as mine:
        thread = threading.Thread(target=fail)
        thread.start()
        thread.join()
        assert mine == []
        assert mujoco.get_mju_user_warning() is not None  # the step that ended did not stop this one's listening
    assert mujoco.get_mju_user_warning() is None
    assert not list(tmp_path.iterdir())


def test_settings_are_read_only_and_copies_start_afresh(pair, centre):
    plant, x = MuJoCoPlant(pair, links=10, substeps=3), state(centre)
    for name in ("dt", "robot", "links", "substeps", "extrapolated", "payload", "method"):
        with pytest.raises(ReadOnlyError, match=f"MuJoCoPlant.{name} "):
            setattr(plant, name, getattr(plant, name))
    plant.reset(x, centre)
    plant.carry(0.01, x)
    expected = MuJoCoPlant(pair, links=10, substeps=3)
    expected.reset(x, centre)
    expected = rollout(expected, x, 0.01, (2.0, 1.0))
    for other in (pickle.loads(pickle.dumps(plant)), copy.deepcopy(plant)):
        other.reset(x, centre)
        assert rollout(other, x, 0.01, (2.0, 1.0)) == pytest.approx(expected, abs=0)
