"""What the closed loop promises about time, events and sensors."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import HoldMotors, SimulationError, load_scene, simulate
from pcr_mpc.control.plan import Plan
from pcr_mpc.loop.parts.controllers import Decision, Replay
from pcr_mpc.plant.statics.solver import Snap
from tests.conftest import MODELS

from .test_stopwatch import Clock

PERIODS, PER, DT = 6, 10, 1e-3  # 10 ms of control


def resting():
    scene = load_scene(MODELS / "scenes" / "hold_with_load.toml")
    return replace(scene, duration=0.06, force=(0.0, 0.0), plant=replace(scene.plant, dt=DT))


scene = pytest.fixture(scope="module")(resting)


class Around:
    """A plant, with some of what it does replaced."""

    def __init__(self, plant):
        self._plant = plant

    def __getattr__(self, name):
        return getattr(self._plant, name)


class Saying(HoldMotors):
    """Rests, and answers with a given plan in each period; remembers what it measured."""

    def __init__(self, plans=None):
        super().__init__(2)
        self.plans, self.measured = plans or {}, []

    def step(self, k, x):
        self.measured.append(x.copy())
        return Decision(np.zeros(2), self.plans.get(k, planned()))


def planned(inputs=((0.0, 0.0), (0.0, 0.0)), **kinds):
    return Plan(np.array(inputs), None, None, "solved", **kinds)


def motor_rates(run):
    return np.diff(run.x[:, 4]) / run.dt


# --- time -------------------------------------------------------------------------------------------------------------


def test_what_a_decision_and_a_step_take_is_measured(scene, monkeypatch):
    clock = Clock()

    class Thinking(HoldMotors):
        def step(self, k, x):
            clock.pass_by(3e-3 + 1e-3 * k, 2e-3)
            return super().step(k, x)

    class Heavy(Around):
        def step(self, *arguments):
            clock.pass_by(5e-5, 0.0)
            return self._plant.step(*arguments)

    monkeypatch.setattr("pcr_mpc.loop.run.simulate.time", clock)
    clock.pass_by(1234.5, 67.8)
    run = simulate(scene, Heavy(scene.make_plant()), Thinking(2))
    assert run.control_time[:, 0] == pytest.approx(3e-3 + 1e-3 * np.arange(PERIODS))
    assert run.control_time[:, 5] == pytest.approx(np.full(PERIODS, 2e-3))
    assert run.plant_time == pytest.approx(np.full(PERIODS * PER, 5e-5))
    assert run.decision_time == pytest.approx(run.control_time[:, 0])


@pytest.mark.parametrize(("cost", "steps"), [(0.9e-3, 0), (1.1e-3, 2), (3.2e-3, 4), (9.9e-3, 10)])
def test_a_late_decision_is_not_early(scene, cost, steps):
    """It counts from the first step of the plant at which it is there."""
    run = simulate(
        replace(scene, deadline=1e-3), scene.make_plant(), Replay(np.outer([0.0, 0.1, 0.2, 0.3, 0.4, 0.5], np.ones(2))),
        spent=lambda k, _: cost if k == 2 else 0.0,
    )  # fmt: skip
    wanted = np.repeat([0.0, 0.1, 0.2, 0.3, 0.4, 0.5], PER)
    wanted[2 * PER : 2 * PER + steps] = 0.1
    assert motor_rates(run) == pytest.approx(wanted, abs=1e-9)
    assert [(event["t"], event["kind"]) for event in run.events] == ([(0.02, "late")] if steps else [])
    assert run.summary()["deadline_misses"] == (1 if steps else 0)


@pytest.mark.parametrize(("late", "meanwhile"), [("hold", 0.1), ("shifted_plan", 0.7)])
def test_meanwhile_the_motors_go_on_as_before_or_as_the_last_plan_foresaw(scene, late, meanwhile):
    class Foreseeing(Saying):
        def step(self, k, x):
            inputs = np.array([[0.1, 0.1], [0.7, 0.7]])
            return Decision(inputs[0], planned(inputs))

    run = simulate(
        replace(scene, deadline=1e-3, late=late), scene.make_plant(), Foreseeing(),
        spent=lambda k, _: 5e-3 if k == 3 else 0.0,
    )  # fmt: skip
    wanted = np.full(PERIODS * PER, 0.1)
    wanted[3 * PER : 3 * PER + 5] = meanwhile
    assert motor_rates(run) == pytest.approx(wanted, abs=1e-9)


def test_events_carry_the_time_and_the_name_of_what_happened(scene):
    """A fall-back the start of its period, a snap and a failure the plant's own time."""

    class Snapping(Around):
        def __init__(self, plant):
            super().__init__(plant)
            self.count, self.found = 0, []

        @property
        def snaps(self):
            return self.found

        def step(self, *arguments):
            self.count += 1
            if self.count == 34:
                self.found = [Snap(rod=1, p=(0.1, 0.2), q=1.25, energy_lost=0.5)]
            if self.count == 57:
                raise ArithmeticError("made up")
            return self._plant.step(*arguments)

    plans = {2: planned(fallback="lqr"), 4: planned(fallback="hold")}
    with pytest.raises(SimulationError, match=r"stopped at t = 0\.0560 s of 0\.06 s: ArithmeticError: made up") as info:
        simulate(scene, Snapping(scene.make_plant()), Saying(plans))
    run = info.value.run
    assert info.value.t == pytest.approx(0.056)
    seen = [(round(event["t"], 9), event["kind"]) for event in run.events]
    assert seen == [(0.02, "fallback"), (0.034, "snap"), (0.04, "fallback"), (0.056, "failure")]
    assert [event.get("rung") for event in run.events] == ["lqr", None, "hold", None]
    assert run.events[0]["message"] == "lqr: solved"
    assert run.events[1]["message"] == "rod 1 snapped at p = (0.1, 0.2) m, q1 = 1.2500 rad and lost 0.5 J"
    summary = run.summary()
    assert (summary["fallbacks"], summary["snaps"], summary["failures"]) == (2, 1, 1)
    assert summary["control_rungs"] == {"solved": 4, "lqr": 1, "hold": 1}
    assert summary["duration_s"] == pytest.approx(0.056)


def test_times_of_a_plan_and_what_it_met_are_kept(scene):
    plans = {
        1: planned(active=("rate",), slack={"torque": 0.2}, iterations=7, update_time=1.0, solve_time=2.0,
                   solver_time=1.5),
        3: planned(active=("rate", "angle"), slack={"torque": 0.1, "tip": 3e-3}, iterations=3),
    }  # fmt: skip
    run = simulate(scene, scene.make_plant(), Saying(plans))
    assert run.active_limits == {"rate": 2, "angle": 1}
    assert run.slack == {"torque": 0.2, "tip": 3e-3}
    assert run.iterations.tolist() == [0, 7, 0, 3, 0, 0]
    assert run.control_time[1, 1:5].tolist() == [0.0, 1.0, 2.0, 1.5]
    assert run.summary()["qp_iterations"] == {"p50": 0, "max": 7}


def test_progress_is_shown_where_it_is_asked_for(scene, capsys):
    for wanted in (False, True):
        simulate(scene, scene.make_plant(), HoldMotors(2), progress=wanted)
        out, err = capsys.readouterr()
        assert out == ""
        assert (f"{scene.name}: 100%" in err and f"{PERIODS}/{PERIODS}" in err) if wanted else err == ""


# --- what is measured -------------------------------------------------------------------------------------------------


def test_sensors_are_as_the_scene_says(scene):
    """The tip with noise of the given deviation; angles whole multiples of the step, the nearest; the state is not."""
    noisy = replace(scene, duration=4.0, period=0.01, tip_noise=2e-4, angle_step=0.01, force=(0.3, -0.2))
    controller = Saying()
    run = simulate(noisy, replace(scene.plant, dt=0.01, integrator="semi_implicit_euler").make(scene.robot), controller)
    measured, true = np.array(controller.measured), run.x[:-1]
    noise = (measured - true)[:, :2]
    assert noise.std(axis=0) == pytest.approx([2e-4, 2e-4], rel=0.15)  # 400 samples: 3.5 % each
    assert np.abs(noise.mean(axis=0)).max() < 4 * 2e-4 / 20
    assert abs(np.corrcoef(noise.T)[0, 1]) < 0.2
    steps = measured[:, 4:] / 0.01
    assert np.abs(steps - np.round(steps)).max() < 1e-9
    assert np.abs(measured[:, 4:] - true[:, 4:]).max() <= 0.005
    assert np.abs(true[0, 4:] / 0.01 - np.round(true[0, 4:] / 0.01)).max() > 1e-3  # else rounding shows nothing
    assert (measured[:, 2:4] == true[:, 2:4]).all()


def test_without_noise_the_state_is_measured(scene):
    controller = Saying()
    run = simulate(scene, scene.make_plant(), controller)
    assert (np.array(controller.measured) == run.x[:-1:PER]).all()


def test_commands_take_effect_after_the_delay(scene):
    run = simulate(replace(scene, delay=2), scene.make_plant(), Replay(0.1 * np.arange(1, 7)[:, None] * np.ones(2)))
    assert motor_rates(run)[::PER] == pytest.approx([0.0, 0.0, 0.1, 0.2, 0.3, 0.4], abs=1e-9)
    assert run.u[:, 0] == pytest.approx(0.1 * np.arange(1, 7))


def test_a_load_pushes_the_tip_its_way(scene):
    for force in ((0.5, 0.0), (0.0, -0.5)):
        run = simulate(replace(scene, force=force, duration=0.01), scene.make_plant(), HoldMotors(2))
        moved = run.x[-1, :2] - run.x[0, :2]
        assert moved == pytest.approx(np.array(force) / 0.25 * 0.01**2 / 2, rel=0.1, abs=5e-7)


@pytest.mark.parametrize("dt", [3e-3, 0.02])
def test_a_step_that_does_not_divide_the_period_is_refused(scene, dt):
    with pytest.raises(ValueError, match=rf"dt = {dt} s does not divide the control period 0\.01 s"):
        simulate(scene, replace(scene.plant, dt=dt).make(scene.robot), HoldMotors(2))
