"""Learning from lap to lap: closed forms, rows held against other inverse dynamics, and what it must not do."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pcr_mpc import Blended, Circle, Lemniscate, load_run, load_scene, load_tuning, make_controller, simulate
from pcr_mpc.cli import main
from pcr_mpc.codegen.scope import check_scope
from pcr_mpc.control.tuning import LearningTuning
from pcr_mpc.errors import GenerationError, ModelError
from pcr_mpc.loop.demand.feed_forward import feed_forward
from pcr_mpc.loop.hardware.camera import Camera
from pcr_mpc.loop.learning.harmonics import Harmonics
from pcr_mpc.loop.learning.laps import laps_of
from pcr_mpc.loop.learning.learner import Learner
from pcr_mpc.study.episodes.episodes import EXACT, Spread, simulate_episode
from pcr_mpc.study.tuning.file import write_tuning
from tests.conftest import CONTROLLERS, MODELS

LAP, LAPS = 1.0, 5


@pytest.fixture(scope="module")
def scene():
    """A circle of a second; half of one passes until it is at full speed."""
    path = Blended(Circle((0.0, 0.25), 0.02, period=LAP), repeat=LAPS + 1, start=0.5, end=0.5)
    scene = load_scene(MODELS / "scenes" / "lemniscate.toml")
    start = tuple(path(np.zeros(1))[0, 0].tolist())
    plant = replace(scene.plant, integrator="velocity_verlet", dt=2e-3)
    return replace(scene, trajectory=path, duration=0.5 + LAPS * LAP, start_tip=start, plant=plant)


def learning(scene, **settings):
    return scene.tuned(replace(scene.tuning, learning=LearningTuning(**settings)))


def test_harmonics_are_found_and_their_derivatives():
    rng = np.random.default_rng(0)
    harmonics = Harmonics(duration=2.0, bandwidth=2.6)
    assert len(harmonics.passed) == 6
    assert harmonics.passed[0] == harmonics.passed[3] == 1.0
    assert 0.0 < harmonics.passed[5] < harmonics.passed[4] < 1.0
    wanted = rng.normal(size=(6, 2)) + 1j * rng.normal(size=(6, 2))
    wanted[0] = wanted[0].real

    def at(t):  # in time in which the rate itself changes
        laps, rate, change = 0.5 * t + 0.05 * t**2, 0.5 + 0.1 * t, np.full(len(t), 0.1)
        return harmonics.at(wanted, laps, rate, change)

    t, h = np.linspace(0.3, 1.7, 50), 1e-5
    here, ahead, behind = at(t), at(t + h), at(t - h)
    assert here[:, 1] == pytest.approx((ahead - behind)[:, 0] / (2 * h), rel=1e-6, abs=1e-6)
    assert here[:, 2] == pytest.approx((ahead - behind)[:, 1] / (2 * h), rel=1e-6, abs=1e-5)
    laps = np.sort(rng.uniform(3.0, 4.0, 150))
    signal = harmonics.at(wanted, laps, np.ones(150), np.zeros(150))[:, 0]
    found, rest = harmonics.found(laps, signal)
    assert found == pytest.approx(wanted, abs=1e-9)
    assert rest < 1e-20
    _, rest = harmonics.found(laps, signal + rng.normal(0.0, 0.1, signal.shape))
    assert rest == pytest.approx(2 * 0.1**2, rel=0.25)


def test_laps_are_where_the_path_comes_round():
    eight = Lemniscate((0.0, 0.25), (0.12, 0.06), period=2.0, ramp=1.0)
    circle = Blended(Circle((0.0, 0.25), 0.02, period=0.8), repeat=4, start=0.3, end=0.5, time_scale=1.5)
    for path, first, duration, count in ((eight, 1.0, 2.0, 3), (circle, 0.45, 1.2, 3)):
        laps = laps_of(path, 7.0)
        assert (laps.first, laps.duration, laps.count) == (pytest.approx(first), pytest.approx(duration), count)
        t = laps.first + laps.duration * np.linspace(0.0, count - 1e-9, 7)
        assert path(t) == pytest.approx(path(t + 1e-12 - laps.duration * np.floor((t - first) / duration)), abs=1e-6)
        own, rate, change = laps.clock(np.array([0.2, laps.first + 0.5, 3.0]))
        ahead, behind = (laps.clock(np.array([0.2, laps.first + 0.5, 3.0]) + side) for side in (1e-6, -1e-6))
        assert rate == pytest.approx((ahead[0] - behind[0]) / 2e-6, rel=1e-6)
        assert change == pytest.approx((ahead[1] - behind[1]) / 2e-6, rel=1e-6, abs=1e-6)
        assert rate[1] == pytest.approx(1 / duration)
        assert own[0] < 0.2
    assert laps_of(eight, 2.9).count == 0
    # Of two laps one is whole at full speed, and 0.75 of the other; with longer blends less than half is left.
    twice = Blended(Circle((0.0, 0.25), 0.02, period=0.8), repeat=2, start=0.2, end=0.2)
    laps = laps_of(twice, 1.8)
    assert (laps.count, laps.rest) == (1, pytest.approx(0.6))
    assert laps.judged(0.01).tolist() == [20, 100, 160]
    assert laps_of(twice, 1.55).judged(0.01).tolist() == [20, 100]  # which ends before
    assert laps_of(replace(twice, start=0.4, end=0.5), 2.1).judged(0.01).tolist() == [40, 120]
    assert laps_of(Blended(Circle((0.0, 0.25), 0.02, period=0.8)), 5.0) is None
    assert laps_of(None, 5.0) is None


@dataclass(frozen=True)
class Moved:
    """A path that is moved by harmonics of its laps."""

    path: object
    harmonics: Harmonics
    coefficients: np.ndarray

    def __call__(self, t):
        return self.path(t) + self.harmonics.at(self.coefficients, *laps_of(self.path, 9.0).clock(t))


def test_rows_are_the_inverse_dynamics_of_the_moved_path(scene):
    """To first order: what the nonlinear inverse dynamics of the moved path say is apart by the square of the move."""
    scene = replace(learning(scene), duration=1.2)
    robot, pose = scene.robot, scene.start()
    reference = feed_forward(scene, robot, pose, 10)
    model = scene.make_plant()
    laps = laps_of(scene.trajectory, scene.duration)
    apart = []
    for size in (4e-4, 2e-4):
        learner = Learner(scene.tuning.learning, laps, reference, model, pose, scene.period, 1, 0.0, np.zeros(131))
        coefficients = np.zeros((5, 2), complex)
        coefficients[1:3] = size * np.array([[1.0, -0.5j], [0.3j, 0.4]])
        learner._fade = 1  # at once
        learner._change(20, coefficients)
        moved = replace(scene, trajectory=Moved(scene.trajectory, Harmonics(LAP, 4.0), coefficients))
        begin = pose
        wanted = feed_forward(moved, robot, begin, 10)
        rows = np.hstack([wanted.states - reference.states])[1:]
        late = slice(40, None)
        assert np.abs(learner.rows[:20]).max() == 0.0
        off = np.abs(learner.rows[late, :6] - rows[late]).max(axis=0) / np.abs(rows[late]).max(axis=0)
        rates = (wanted.inputs - reference.inputs)[late]
        off_rates = np.abs(learner.rows[late, 6:8] - rates).max() / np.abs(rates).max()
        forces = (wanted.forces - reference.forces)[1:][late]
        assert learner.rows[late, 8:] == pytest.approx(forces, abs=1e-9)
        assert off[:4].max() < 1e-9
        apart.append(max(off[4:].max(), off_rates))
    assert apart[0] < 0.05
    assert apart[1] == pytest.approx(apart[0] / 2.0, rel=0.2)


def test_laps_get_better_until_noise_is_left(scene):
    """Rods, mass, bases, load and sensors are off, and commands come a period later than anybody was told."""
    seed = next(seed for seed in range(20) if Spread().sample(2, seed).delay == 1)
    plain, taught = (simulate_episode(one, one.tuning, seed) for one in (scene, learning(scene)))
    before, after = 1e3 * plain.lap_errors(), 1e3 * taught.lap_errors()
    assert len(before) == len(after) == LAPS
    assert after[0] == before[0]  # nothing is learnt yet
    assert before[1:].min() > 0.9 * before[0]
    assert after[-1] < 0.25 * before[-1]
    assert (after <= 1.1 * after[0]).all()
    assert taught.summary()["laps_rms_mm"] == after.tolist()
    assert "laps_rms_mm" not in plain.summary()
    assert taught.limit_violations() == 0


def test_tips_that_are_late_and_rare_are_learnt_from(scene):
    """A camera every second period, 25 ms late; the controller knows that."""
    rods = tuple(replace(rod, bending_stiffness=0.9 * rod.bending_stiffness) for rod in scene.robot.rods)
    seen = replace(learning(scene), camera=Camera(0.025, every=2), duration=3.5)
    tuning = replace(seen.tuning, observer=replace(seen.tuning.observer, latency=0.025))
    seen, true = replace(seen, tuning=tuning), replace(seen, robot=replace(seen.robot, rods=rods))
    laps = simulate(true, true.make_plant(), make_controller(seen), 0).lap_errors()
    assert laps[2] < 0.35 * laps[0]


def test_what_is_noise_is_not_learnt(scene):
    """With the robot as believed and noise, learning that is on changes nothing, to the last bit."""
    known = replace(scene, tip_noise=1e-4, duration=3.5)
    plain, taught = (simulate_episode(one, one.tuning, 3, EXACT) for one in (known, learning(known)))
    assert plain.hash() == taught.hash()


def test_a_lap_gets_hardly_worse_than_the_first(scene, monkeypatch):
    """Even of a learner that is told its errors with the wrong sign, which does all it can to make laps worse."""
    see = Learner.see
    monkeypatch.setattr(Learner, "see", lambda self, k, p: see(self, k, 2 * self.reference.states[k, :2] - p))
    run = simulate_episode(learning(scene), learning(scene).tuning, 0)
    laps = run.lap_errors()
    assert laps[1:].max() > 1.005 * laps[0]  # it did harm
    assert laps.max() <= 1.1 * laps[0]


@pytest.mark.slow
def test_what_was_learnt_is_kept_by_another_tuning_and_forgotten_by_a_start(scene):
    scene = learning(scene)
    controller = make_controller(scene)
    pose = scene.start()
    controller.start(pose)
    learner = controller._work.learner
    learner._change(60, 1e-4 * np.ones((5, 2), complex))
    assert learner.rows.any()
    controller.retune(replace(scene.tuning, input_weight=0.02))
    assert controller._work.learner is learner
    assert learner.rows.any()
    controller.retune(replace(scene.tuning, learning=LearningTuning(gain=0.5)))
    assert not controller._work.learner.rows.any()
    controller.retune(replace(scene.tuning, learning=None))
    assert controller._work.learner is None
    controller.retune(scene.tuning)
    controller._work.learner._change(60, 1e-4 * np.ones((5, 2), complex))
    controller.start(pose)
    assert not controller._work.learner.rows.any()
    controller.start(pose.p, pose.q)
    assert controller._work.learner is None
    decision = controller.step(tip=pose.p, angles=pose.q)
    assert any(event["kind"] == "learning" for event in decision.events)


def test_what_cannot_be_learnt_is_said(scene):
    still = load_scene(MODELS / "scenes" / "hold_with_load.toml")
    with pytest.raises(ModelError, match="does not come round; give"):
        make_controller(learning(still)).start(still.start())
    with pytest.raises(ModelError, match=r"bandwidth is 11 Hz, expected at most .* 10 Hz"):
        make_controller(learning(scene, bandwidth=11.0)).start(scene.start())
    with pytest.raises(GenerationError, match=r"no learning .*leave \[learning\] out"):
        check_scope(learning(scene), learning(scene).tuning)
    for wrong in ({"gain": 0.0}, {"gain": 1.5}, {"bandwidth": -1.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            LearningTuning(**wrong)


def test_tunings_and_records_keep_it(scene, tmp_path):
    tuning = replace(load_tuning(CONTROLLERS / "default.toml"), learning=LearningTuning(0.5, 3.0))
    write_tuning(tuning, tmp_path / "mine.toml", [])
    assert load_tuning(tmp_path / "mine.toml") == tuning
    text = (tmp_path / "mine.toml").read_text(encoding="utf-8")
    (tmp_path / "off.toml").write_text(text.replace("on = true                 # of the", "on = false  # of the"))
    assert load_tuning(tmp_path / "off.toml").learning is None
    short = replace(learning(scene), duration=0.05)
    run = simulate(short, short.make_plant(), make_controller(short))
    run.save(tmp_path / "run")
    assert load_run(tmp_path / "run").tuning == short.tuning
    assert len(run.lap_errors()) == 0


@pytest.mark.slow
def test_the_command_shows_the_laps(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pcr_mpc.cli.track.animate_run", lambda run, path, progress: path.write_bytes(b"GIF89a"))
    text = (CONTROLLERS / "lemniscate.toml").read_text(encoding="utf-8")
    (tmp_path / "learns.toml").write_text(text + "\n[learning]\non = true\n")
    text = (
        (MODELS / "scenes" / "lemniscate.toml").read_text(encoding="utf-8").replace("duration = 6.0", "duration = 5.0")
    )
    text = text.replace("../../controllers", str(CONTROLLERS)).replace("../planar_pair", str(MODELS / "planar_pair"))
    (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
    scene = str(tmp_path / "scene.toml")
    assert main(["track", scene, "--controller", str(tmp_path / "learns.toml"), "--out", str(tmp_path / "run")]) == 0
    assert "learning: RMS of each lap at full speed" in capsys.readouterr().out
    assert (tmp_path / "run" / "laps.png").stat().st_size > 10_000
