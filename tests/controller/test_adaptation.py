"""Slow numbers in the observer: the filter by its Riccati equation, rows by other inverse dynamics, and in the loop."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import load_scene, load_tuning, make_controller, simulate
from pcr_mpc.codegen.scope import check_scope
from pcr_mpc.control.observer import DisturbanceObserver, ObserverTuning
from pcr_mpc.errors import GenerationError, ModelError
from pcr_mpc.loop.controller.adaptation import Adaptation, AdaptedTrack
from pcr_mpc.loop.demand.feed_forward import feed_forward
from pcr_mpc.loop.demand.track import Track
from pcr_mpc.loop.parts.assembled import resting_model
from pcr_mpc.loop.scene.settings import Payload
from pcr_mpc.study.tuning.file import write_tuning
from tests.conftest import CONTROLLERS, MODELS

PICKED, ADDED = 1.0, 0.1  # s, kg


@pytest.fixture(scope="module")
def scene():
    scene = load_scene(MODELS / "scenes" / "lemniscate.toml")
    return replace(scene, duration=2.6, plant=replace(scene.plant, integrator="velocity_verlet", payload="carried"))


def untold(scene, *adapts, payload=False, **settings):
    """The scene with a payload that the controller is not told of."""
    tuning = scene.tuning
    observer = replace(tuning.observer, adapts=adapts, **settings)
    tuning = replace(tuning, model=replace(tuning.model, payload=False), observer=observer)
    return replace(scene, payload=Payload(ADDED, PICKED, 99.0) if payload else None).tuned(tuning)


def run(scene, robot=None):
    controller = make_controller(scene)
    true = scene if robot is None else replace(scene, robot=robot)
    done = simulate(true, true.make_plant(), controller, 0)
    late = done.t > PICKED + 0.8
    return done, controller._work.adaptation, 1e3 * float(np.sqrt(np.mean(done.error[late] ** 2)))


def test_without_anything_to_tell_the_gain_is_the_steady_one(scene):
    resting = resting_model(scene.robot, scene.tuning.model, scene.start(), scene.period)
    tuning = ObserverTuning(adapts=("tip_mass", "stiffness"))
    adaptation = Adaptation(tuning, 5e-5, scene.robot, resting)
    gain = adaptation._update()
    assert gain[:6] == pytest.approx(DisturbanceObserver(tuning, 5e-5, 0.0, resting).gain, rel=1e-6)
    assert np.abs(gain[6:]).max() == 0.0


@pytest.mark.parametrize("gravity", [(0.0, 0.0), (0.0, -2.0)])
def test_rows_are_the_inverse_dynamics_of_the_other_robot(scene, gravity):
    """To first order; differences of velocities stand for accelerations."""
    rods = tuple(replace(rod, line_density=0.0) for rod in scene.robot.rods)  # whose weight would be another matter
    scene = replace(scene, duration=0.6, robot=replace(scene.robot, gravity=gravity, rods=rods))
    pose = scene.start()
    reference = feed_forward(scene, scene.robot, pose, 5)
    resting = resting_model(scene.robot, scene.tuning.model, pose, scene.period)
    for name in ("tip_mass", "stiffness"):
        apart = []
        for z in (0.04, 0.02):
            robot = scene.robot
            if name == "tip_mass":
                robot = replace(robot, tip_mass=(1 + z) * robot.tip_mass)
            else:
                stiffer = (replace(rod, bending_stiffness=(1 + z) * rod.bending_stiffness) for rod in robot.rods)
                robot = replace(robot, rods=tuple(stiffer))
            wanted = feed_forward(scene, robot, pose, 5)
            adaptation = Adaptation(ObserverTuning(adapts=(name,)), 1e-5, scene.robot, resting)
            track = Track(reference, np.zeros(9), 99, 55, lambda: reference)
            adapted = AdaptedTrack(track, adaptation, scene.period)
            assert (adapted.window(3, 1) == track.window(3, 1)).all()
            adaptation.z[:] = z
            rows = adapted.window(4, 1)
            for change, found in (
                (wanted.states - reference.states, rows[:, :6] - reference.states[6:61]),
                (wanted.inputs - reference.inputs, rows[:, 6:8] - reference.inputs[5:60]),
                (wanted.forces - reference.forces, rows[:, 8:] - reference.forces[6:61]),
            ):
                true = change[len(change) - len(reference.inputs) :][5:60]
                apart.append(np.abs(found - true).max() / max(np.abs(true).max(), 1e-9) if true.any() else 0.0)
                if not true.any():
                    assert np.abs(found).max() < 1e-12
        assert max(apart[:3]) < 0.06, (name, apart)
        assert max(apart[3:]) < 0.04, (name, apart)


def test_a_payload_that_nobody_told_of_is_found_and_carried(scene):
    _, none, plain = run(untold(scene, payload=True))
    assert none is None
    done, adaptation, error = run(untold(scene, "tip_mass", payload=True))
    assert adaptation.deviation("tip_mass") == pytest.approx(ADDED / scene.robot.tip_mass, rel=0.12)
    assert adaptation.deviation("stiffness") == 0.0
    assert error < 0.3 * plain
    assert done.limit_violations() == 0


@pytest.mark.slow
def test_rods_that_are_softer_than_believed_are_found(scene):
    rods = tuple(replace(rod, bending_stiffness=0.9 * rod.bending_stiffness) for rod in scene.robot.rods)
    softer = replace(scene.robot, rods=rods)
    _, _, plain = run(untold(scene), softer)
    _, adaptation, error = run(untold(scene, "stiffness"), softer)
    assert adaptation.deviation("stiffness") == pytest.approx(-0.1, abs=0.02)
    assert error < 0.4 * plain


@pytest.mark.slow
def test_where_all_is_as_believed_it_does_no_harm(scene):
    plain, _, error = run(untold(scene))
    adapting, adaptation, with_it = run(untold(scene, "tip_mass"))
    assert adapting.hash() != plain.hash()  # it is on
    assert with_it < 1.02 * error
    assert abs(adaptation.deviation("tip_mass")) < 1e-3


@pytest.mark.slow
def test_noise_is_hardly_taken_for_a_number(scene):
    noisy = untold(replace(scene, tip_noise=5e-5))
    _, _, error = run(noisy)
    _, adaptation, with_it = run(untold(noisy, "tip_mass"))
    assert with_it < 1.15 * error
    assert abs(adaptation.deviation("tip_mass")) < 0.03


def test_tunings_that_cannot_adapt_are_refused_and_others_are_kept(scene, tmp_path):
    for wrong, words in ((("mass",), "'mass' is none of tip_mass, stiffness"), (("stiffness",) * 2, "twice")):
        with pytest.raises(ModelError, match=words):
            ObserverTuning(adapts=wrong)
    adapting = untold(scene, "tip_mass")
    tuning = adapting.tuning
    constant = replace(tuning, model=replace(tuning.model, inertia="constant"))
    for other in (constant, replace(tuning, law="nonlinear_mpc")):
        with pytest.raises(ModelError, match="whose numbers are built in"):
            make_controller(adapting, other).start(scene.start())
    with pytest.raises(GenerationError, match="no observer that adapts"):
        check_scope(adapting, tuning)
    mine = replace(load_tuning(CONTROLLERS / "default.toml"), observer=tuning.observer)
    write_tuning(mine, tmp_path / "mine.toml", [])
    assert load_tuning(tmp_path / "mine.toml") == mine


def test_retuning_keeps_what_is_known_and_a_start_forgets_it(scene):
    scene = replace(untold(scene, "tip_mass"), duration=0.1)
    controller, pose = make_controller(scene), scene.start()
    controller.start(pose)
    work = controller._work
    work.adaptation.z[:] = 0.2
    controller.retune(replace(scene.tuning, input_weight=0.05, horizon=8))
    assert work.adaptation.deviation("tip_mass") == 0.2
    x = np.concatenate([pose.p, np.zeros(2), pose.q])
    controller.step(0, x)
    numbers = work.foresight.inputs["numbers"][work.foresight.kinds[0].names.index("tip_mass")]
    assert numbers == pytest.approx(1.2 * scene.robot.tip_mass, rel=0.01)
    controller.start(pose)
    assert work.adaptation.deviation("tip_mass") == 0.0
    controller.step(0, x)
    work.adaptation.z[:] = 0.2
    controller.step(1, x)
    controller.retune(replace(scene.tuning, observer=ObserverTuning()))
    assert work.adaptation is None
    assert not isinstance(work.track, AdaptedTrack)
    numbers = work.foresight.inputs["numbers"][work.foresight.kinds[0].names.index("tip_mass")]
    assert numbers == scene.robot.tip_mass
