"""The linear loop against the nonlinear simulation, and its margins against what they mean."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import load_scene, load_tuning, make_controller, simulate
from pcr_mpc.errors import MarginsError
from pcr_mpc.loop.hardware.camera import Camera
from pcr_mpc.loop.hardware.motors import Motors
from pcr_mpc.loop.references.trajectory import Hold
from pcr_mpc.report.studies.margins import margins_table, plot_margins
from pcr_mpc.study.margins.linear_loop import LinearLoop
from pcr_mpc.study.margins.measured import PushTest, held_scene, measure_delay_margin, push_dies_away
from pcr_mpc.study.margins.poses import LinearLoops, scaled, scaled_scene
from pcr_mpc.study.margins.predicted import _classical, delay_margin, predict_delay_margin
from pcr_mpc.study.margins.side_by_side import compare_margins
from tests.conftest import CONTROLLERS, MODELS

TIP = (0.04, 0.27)
PUSH = np.array([0.8, -0.6])


@pytest.fixture(scope="module")
def lemniscate():
    return load_scene(MODELS / "scenes" / "lemniscate.toml")


def tuning_of(name):
    # DAQP solves to rounding: OSQP's tolerance would drown a small perturbation.
    tuning = load_tuning(CONTROLLERS / f"{name}.toml")
    return replace(tuning, solver="daqp", horizon=min(tuning.horizon, 5))


@pytest.fixture(scope="module")
def holding(lemniscate):
    """At rest off the centre, told one period of delay of 13.3 ms in all, motors that lag by 3 ms."""
    plant = replace(lemniscate.plant, dt=5e-4)
    return replace(lemniscate, duration=0.2, trajectory=Hold(TIP), start_tip=TIP, plant=plant, delay=1,
                   untold_delay=0.0033, motors=Motors(time_constant=0.003))  # fmt: skip


def deviations(scene, tuning, size):
    """Of the tip and of the decided rates after a push, from the run without."""
    scene = scene.tuned(tuning)
    pushed = replace(scene, start_velocity=tuple((size * PUSH).tolist()))
    runs = [simulate(each, each.make_plant(), make_controller(each)) for each in (pushed, scene)]
    per = runs[0].steps_per_period
    tips, rates = runs[0].x[::per, :2] - runs[1].x[::per, :2], runs[0].u - runs[1].u
    return np.hstack([tips[: len(rates)], rates])


def linear_response(loop: LinearLoop, size: float, count: int) -> np.ndarray:
    state = np.zeros(len(loop.transition()))
    state[2:4] = size * PUSH
    found = []
    for k in range(count):
        closed = loop.closed(k % loop.cycle)
        found.append(np.concatenate([state[:2], closed.C @ state]))
        state = closed.A @ state
    return np.array(found)


@pytest.mark.parametrize("name", ["default", pytest.param("lqr", marks=pytest.mark.slow), "pd"])
def test_the_linear_loop_is_the_loop_that_runs(holding, name):
    """After a push tip and rates move as the linear loop says, and what is left falls with the square of the push."""
    tuning = tuning_of(name)
    loop = LinearLoops(holding, tuning, poses=1).all()[0]
    misses = []
    for size in (2e-3, 1e-3):
        found = deviations(holding, tuning, size)
        said = linear_response(loop, size, len(found))
        misses.append(np.abs(found - said).max(axis=0) / np.abs(said).max(axis=0))
    assert np.abs(said[-1]).max() < np.abs(said).max()
    assert misses[1].max() < 6e-3
    assert (misses[1] < 0.65 * misses[0] + 1e-3).all()


@pytest.mark.slow
def test_without_an_observer_too(holding):
    tuning = replace(tuning_of("default"), observer=None)
    loop = LinearLoops(holding, tuning, poses=1).all()[0]
    found = deviations(holding, tuning, 1e-3)
    said = linear_response(loop, 1e-3, len(found))
    assert (np.abs(found - said).max(axis=0) < 6e-3 * np.abs(said).max(axis=0)).all()


def test_from_commanded_angles_too(holding):
    """With a lag that angles which are planned from do not show."""
    tuning = tuning_of("default")
    tuning = replace(tuning, model=replace(tuning.model, angles="commanded"))
    loop = LinearLoops(holding, tuning, poses=1).all()[0]
    found = deviations(holding, tuning, 1e-3)
    said = linear_response(loop, 1e-3, len(found))
    assert (np.abs(found - said).max(axis=0) < 6e-3 * np.abs(said).max(axis=0)).all()


@pytest.mark.parametrize(
    ("name", "angles", "camera", "known"),
    [
        ("default", "commanded", Camera(latency=0.027, every=2), 0.023),
        ("default", "measured", Camera(latency=0.013), 0.0),
        pytest.param("default", "measured", Camera(latency=0.013, every=3), 0.02, marks=pytest.mark.slow),
        pytest.param("pd", "measured", Camera(every=2), 0.0, marks=pytest.mark.slow),
    ],
)
def test_with_pictures_that_come_late_and_rarely_too(holding, name, angles, camera, known):
    """Known to be late or not, by the time that they are or by another: the loop is that of the periods in turn."""
    tuning = tuning_of(name)
    tuning = replace(
        tuning, model=replace(tuning.model, angles=angles), observer=replace(tuning.observer, latency=known)
    )
    scene = replace(holding, camera=camera)
    loop = LinearLoops(scene, tuning, poses=1).all()[0]
    assert loop.cycle == camera.every
    found = deviations(scene, tuning, 1e-3)
    said = linear_response(loop, 1e-3, len(found))
    assert (np.abs(found - said).max(axis=0) < 6e-3 * np.abs(said).max(axis=0)).all()
    # What the camera does is no small matter.
    without = linear_response(LinearLoops(holding, tuning, poses=1).all()[0], 1e-3, len(found))
    assert np.abs(without - said).max() > 0.05 * np.abs(said).max()


def test_a_loop_that_measures_in_some_periods_has_no_gain_at_one_frequency(holding, tmp_path):
    rare = replace(holding, camera=Camera(every=2))
    predicted, summary = compare_margins(rare, tuning_of("default"), poses=1, measure=False)
    margins = summary["margins"]
    assert not {"gain_margin", "phase_margin_deg", "sensitivity_peak"} & set(margins)
    assert 0.0 < margins["delay_margin_ms"]["predicted"] < 60.0
    assert "every 2. period" in margins_table(summary)
    plot_margins(predicted, summary, tmp_path / "margins.png")
    assert (tmp_path / "margins.png").stat().st_size > 1000


def test_another_robot_is_the_robot_that_moves(holding):
    tuning = tuning_of("default")
    other = scaled(holding.robot, stiffness=1.3, mass=1.2)
    loops = LinearLoops(holding, tuning, poses=1)
    loop = loops.at(loops.poses[0], other)
    scene = holding.tuned(tuning)
    runs = []
    for size in (1e-3, 0.0):
        true = replace(scene, robot=other, start_velocity=tuple((size * PUSH).tolist()))
        runs.append(simulate(true, true.make_plant(), make_controller(scene)))
    found = runs[0].u - runs[1].u
    said = linear_response(loop, 1e-3, len(found))[:, 2:]
    assert np.abs(found - said).max() < 6e-3 * np.abs(said).max()


def test_at_a_margin_the_loop_neither_grows_nor_decays(holding):
    """An eigenvalue has size 1 at the delay margin, and at the gain and the phase that python-control finds."""
    loop = LinearLoops(replace(holding, untold_delay=0.0, motors=None), tuning_of("lemniscate"), poses=1).all()[0]
    assert loop.later(delay_margin(loop)).spectral_radius() == pytest.approx(1.0, abs=3e-4)
    frequencies = np.geomspace(1e-3, 0.999, 400) * 0.5 / loop.period
    for motor, (gain, phase) in enumerate(_classical(loop, frequencies)):
        closed = loop.closed()
        out, into = closed.C[motor], closed.B[:, motor]
        # Eigenvalues with the motor's rates multiplied by a gain, or turned by an angle.
        for factor in (gain, np.exp(-1j * np.radians(phase))):
            turned = closed.A + (factor - 1.0) * np.outer(into, out)
            assert np.abs(np.linalg.eigvals(turned)).max() == pytest.approx(1.0, abs=2e-3)


def test_a_delay_that_is_told_is_borne(lemniscate):
    """Known, a period more costs a few milliseconds of margin; untold, all of the period."""
    tuning = tuning_of("lemniscate")
    margins = [predict_delay_margin(replace(lemniscate, duration=0.5, **more), tuning, poses=1).value
               for more in ({}, {"delay": 1}, {"untold_delay": 0.005})]  # fmt: skip
    assert margins[0] > 0.01
    assert margins[1] > margins[0] - 0.005
    assert margins[2] == pytest.approx(margins[0] - 0.005, abs=2e-5)


@pytest.mark.slow
def test_three_motors_have_margins():
    scene = load_scene(MODELS / "scenes" / "three_rods.toml")
    assert 0.0 < predict_delay_margin(scene, poses=2).value < 0.3


def test_what_has_no_margins_is_refused(lemniscate):
    with pytest.raises(MarginsError, match="no gain"):
        predict_delay_margin(lemniscate, load_tuning(CONTROLLERS / "nonlinear.toml"))
    with pytest.raises(MarginsError, match="measures nothing"):
        predict_delay_margin(lemniscate, load_tuning(CONTROLLERS / "open_loop.toml"))
    with pytest.raises(MarginsError, match="loses 10 % of its pictures"):
        predict_delay_margin(replace(lemniscate, camera=Camera(lost=0.1)))
    observer = replace(lemniscate.tuning.observer, adapts=("tip_mass",))
    with pytest.raises(MarginsError, match="adapts tip_mass"):
        predict_delay_margin(lemniscate, replace(lemniscate.tuning, observer=observer))
    with pytest.raises(MarginsError, match="no reference"):
        predict_delay_margin(load_scene(MODELS / "scenes" / "release.toml"))


@pytest.mark.slow
def test_a_push_dies_away_below_the_margin_and_grows_above(lemniscate):
    tuning = load_tuning(CONTROLLERS / "frozen.toml")
    margin = predict_delay_margin(lemniscate, tuning, poses=4)
    here = held_scene(lemniscate.tuned(tuning), margin.p)
    assert push_dies_away(here, replace(here, untold_delay=0.93 * margin.value))
    assert not push_dies_away(here, replace(here, untold_delay=1.1 * margin.value))


def test_one_controller_pushes_as_new_ones_do(lemniscate):
    """What was made for one push, and what a lost run has left in it, changes no bit of the next."""
    told = replace(lemniscate, duration=0.4).tuned(load_tuning(CONTROLLERS / "frozen.toml"))
    lost, borne = (replace(told, untold_delay=time) for time in (0.03, 0.005))
    test = PushTest(told)
    assert not test(lost).dies_away
    again, new = test(borne), PushTest(told)(borne)
    assert again.dies_away
    assert new.dies_away
    assert np.array_equal(again.run.x, new.run.x)


def test_what_a_solver_leaves_of_a_push_is_not_the_loop(lemniscate):
    """With two periods of horizon and small weights OSQP's tolerance is a tenth of the push."""
    told = replace(lemniscate, duration=1.2).tuned(replace(load_tuning(CONTROLLERS / "frozen.toml"), horizon=2))
    assert told.tuning.solver == "osqp"
    assert push_dies_away(told, told)


def test_a_stiffer_robot_stands_where_the_softer_one_does(lemniscate):
    """Holding takes as much more torque, which scene and motors then have."""
    assert scaled_scene(lemniscate, stiffness=2.5).start().motor_torque == pytest.approx(
        2.5 * lemniscate.start().motor_torque
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["frozen", "lqr"])
def test_measured_and_predicted_delay_margins_agree(lemniscate, name):
    tuning = load_tuning(CONTROLLERS / f"{name}.toml")
    margin = predict_delay_margin(lemniscate, tuning, poses=24)
    for p in (margin.p, None):
        # From a bad guess, so that what is found is not what was said.
        found = measure_delay_margin(lemniscate, tuning, p=p, guess=1.5 * margin.value)
        assert found.value == pytest.approx(margin.value, rel=0.15)


def test_what_was_carried_and_put_down_is_no_more_in_the_model():
    scene = load_scene(MODELS / "scenes" / "payload.toml")
    before, carrying, after = (delay_margin(loop) for loop in LinearLoops(scene, poses=3).all())
    assert carrying > 1.2 * before
    assert after == pytest.approx(before, rel=0.05)
