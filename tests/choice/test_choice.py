"""The choice of a scene's physics: made-up measurements, estimates, short motions."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ConvergenceError, forward_statics, inverse_statics, load_scene, make_controller, simulate
from pcr_mpc.errors import NoRungError
from pcr_mpc.loop.hardware.motors import Motors
from pcr_mpc.loop.parts.controllers import Replay
from pcr_mpc.loop.scene.settings import Need, PlantSettings
from pcr_mpc.report.studies.choice import choice_record, choice_table
from pcr_mpc.study.choice.choice import Bench, Measured, apart, choose, lowest
from pcr_mpc.study.choice.estimates import Estimates
from pcr_mpc.study.choice.rungs import all_physics, discretisations, ladders, levels, named
from tests.conftest import MODELS

SCENES = MODELS / "scenes"
ANY_TIME = {"plant_step": 1.0, "control_step": 10.0}  # s


def short(name, duration, **need):
    """A scene cut short, whose need is not a matter of this machine's speed."""
    scene = load_scene(SCENES / f"{name}.toml")
    return replace(scene, duration=duration, need=replace(scene.need, **ANY_TIME, **need))


@pytest.fixture(scope="module")
def release():
    return short("release", 0.4)


@pytest.fixture(scope="module")
def choice(release):
    return choose(release)


# --- made-up measurements ---------------------------------------------------------------------------------------------


def made_up(scene, errors, times):
    """Rungs of inertia with errors [mm] and times [us], and what a coarser discretisation makes of them."""
    physics = [
        Measured(rung, 1e-3 * errors[rung.inertia], 1e-6 * times[rung.inertia]) for rung in all_physics(scene, 1e-3)
    ]

    def measure(rung):
        coarseness = rung.dt / (5e-4 if rung.integrator == "semi_implicit_euler" else 1e-3)
        return Measured(rung, 1e-3 * (errors[rung.inertia] + 0.001 * coarseness), 1e-6 * times[rung.inertia])

    return physics, measure


ERRORS = {"none": 2.6, "constant": 0.008, "condensed": 0.0005, "full": 0.0}
TIMES = {"none": 30.0, "constant": 31.0, "condensed": 70.0, "full": 1300.0}


@pytest.mark.parametrize(
    ("accuracy", "plant_step", "inertia", "integrator", "dt"),
    [
        (5.0, 100.0, "none", "semi_implicit_euler", 2e-3),
        (0.013, 100.0, "constant", "semi_implicit_euler", 2e-3),
        (0.0105, 100.0, "constant", "velocity_verlet", 2e-3),  # Euler's 4 um are too many
        (0.0082, 100.0, "condensed", "semi_implicit_euler", 2e-3),  # 8 um and a step's error do not fit
        (0.003, 100.0, "condensed", "velocity_verlet", 2e-3),
        (0.0016, 100.0, "condensed", "velocity_verlet", 1e-3),
        (0.0004, 2000.0, "full", "gauss", 2.5e-4),
    ],
)
def test_the_lowest_that_meets_the_need_is_taken(release, accuracy, plant_step, inertia, integrator, dt):
    need = Need(1e-3 * accuracy, 1e-6 * plant_step, 1e-2)
    physics, measure = made_up(release, ERRORS, TIMES)
    tried, chosen = lowest(release, need, physics, measure)
    assert (chosen.rung.inertia, chosen.rung.integrator) == (inertia, integrator)
    assert chosen.rung.dt == pytest.approx(dt)
    assert tried[-1] is chosen
    assert all(one.error > need.tip_accuracy for one in tried[:-1])


def test_a_rung_that_is_too_slow_is_passed_over(release):
    """Nobody waits for condensed rods at 70 us here, but nothing above them is quicker."""
    physics, measure = made_up(release, ERRORS, {**TIMES, "constant": 500.0})
    _, chosen = lowest(release, Need(2e-5, 2e-4, 1e-2), physics, measure)
    assert chosen.rung.inertia == "condensed"


def test_refusal_carries_the_numbers(release):
    physics, measure = made_up(release, ERRORS, TIMES)
    with pytest.raises(NoRungError) as caught:
        lowest(release, Need(1e-6, 5e-5, 1e-2), physics, measure)
    text = str(caught.value)
    for words in ("release needs the tip to 0.001 mm at 50 us", "inertia none 2.6 mm", "inertia constant 0.008 mm",
                  "inertia condensed 70 us a step", "inertia full 1300 us a step"):  # fmt: skip
        assert words in text
    assert caught.value.best_error == 0.0
    assert len(caught.value.rejected) == 4
    with pytest.raises(NoRungError, match="control step takes 20000 us, at most 10000"):
        lowest(release, Need(1.0, 1.0, 1e-2), physics, measure, control_step=0.02)


def test_what_the_yardstick_may_be_off_counts(release):
    physics, measure = made_up(release, ERRORS, TIMES)
    need = Need(1.3e-5, 1.0, 1.0)
    assert lowest(release, need, physics, measure)[1].rung.inertia == "constant"
    assert lowest(release, need, physics, measure, unmeasured=2e-6)[1].rung.inertia == "constant"
    assert lowest(release, need, physics, measure, unmeasured=6e-6)[1].rung.inertia == "condensed"
    with pytest.raises(NoRungError, match=r"0\.02 mm of each by which the yardstick may be off"):
        lowest(release, need, physics, measure, unmeasured=2e-5)


# --- the ladders ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "sizes"),
    [
        ("hold_slow", (4, 1, 1, 1, 1)),
        ("vertical", (4, 3, 1, 1, 1)),
        ("curved_rods", (4, 1, 2, 1, 1)),
        ("near_straight", (4, 3, 2, 1, 1)),
        ("payload", (4, 1, 1, 2, 1)),
        ("servo", (4, 1, 1, 1, 2)),
    ],
)
def test_a_scene_has_the_ladders_of_its_effects(name, sizes):
    scene = load_scene(SCENES / f"{name}.toml")
    assert tuple(map(len, ladders(scene).values())) == sizes
    rungs = all_physics(scene, 1e-3)
    assert len({tuple(levels(rung).values()) for rung in rungs}) == len(rungs) == math.prod(sizes)
    assert all(
        level == steps[0] for level, steps in zip(levels(rungs[0]).values(), ladders(scene).values(), strict=True)
    )
    assert all(
        level == steps[-1] for level, steps in zip(levels(rungs[-1]).values(), ladders(scene).values(), strict=True)
    )


def test_discretisations_come_cheapest_first():
    scene = load_scene(SCENES / "curved_rods.toml")
    rung = next(rung for rung in all_physics(scene, 1e-3) if rung.method == "multiple_shooting")
    found = discretisations(scene, rung)
    assert len(set(found)) == len(found) == 3 * 4 * 3
    assert (found[0].segments, found[0].integrator, found[0].dt) == (4, "semi_implicit_euler", 2e-3)
    assert (found[-1].segments, found[-1].integrator, found[-1].dt) == (8, "rk4", 2.5e-4)
    for one in found:
        ratio = scene.period / one.dt
        assert ratio == pytest.approx(round(ratio), abs=1e-9)


def test_apart_compares_at_common_times():
    rung = all_physics(load_scene(SCENES / "release.toml"), 1e-3)[0]
    t = np.linspace(0.0, 1.0, 11)
    fine, coarse = np.column_stack([t, t**2]), np.column_stack([t, t**2])[::5]
    coarse = coarse + [[0.0, 0.0], [0.0, 0.1], [0.3, 0.4]]
    one, other = Measured(rung, 0.0, 0.0, tips=fine), Measured(rung, 0.0, 0.0, tips=coarse)
    assert apart(one, other) == apart(other, one) == pytest.approx(0.5)
    assert apart(one, Measured(rung, math.inf, 0.0, "failed")) == math.inf


# --- on the scenes' own motions ---------------------------------------------------------------------------------------


def test_release_needs_the_condensed_mass(release, choice):
    errors = {one.rung.inertia: 1e3 * one.error for one in choice.physics}
    assert errors["none"] > 0.3 > 0.02 > errors["constant"] > 2e-3 > errors["condensed"] > errors["full"] == 0.0
    assert choice.chosen.rung.inertia == "condensed"
    assert choice.yardstick.inertia == "full"
    assert not choice.lacking
    assert choice.tip_error <= release.need.tip_accuracy
    # Gauss's at 0.25 ms; its fourth order leaves nanometres, not nothing.
    assert 2e-10 < choice.step_error < 2e-8


@pytest.mark.slow
def test_estimates_are_of_the_right_size():
    """By a factor of 1.5 too small to 3 too large, against what the neighbouring rungs differ by over the motion."""
    expected = {  # mm; docs/figures/rungs.csv
        "release": {"rods' inertia": 2.6},
        "payload": {"payload": 59.0, "rods' inertia": 0.68, "change of inertia": 0.11, "rods' vibration": 0.012},
        "vertical": {"rods' weight": 0.92, "rods' sag": 5e-4, "rods' inertia": 0.13, "change of inertia": 0.032},
        "heavy_rods": {"rods' weight": 9.2, "rods' sag": 0.053, "rods' inertia": 1.4, "rods' vibration": 0.037},
        "curved_rods": {"curvature at rest": 20.0, "rods' inertia": 0.10},
        "near_straight": {"stretch": 0.0031, "rods' weight": 0.008},
    }
    for name, effects in expected.items():
        scene = load_scene(SCENES / f"{name}.toml")
        estimates = Estimates(scene, scene.start())
        found = {}
        for ladder, steps in ladders(scene).items():
            for level in steps:
                found |= estimates.of_level(ladder, level)
        for effect, error in effects.items():
            largest = 6 if (name, effect) == ("heavy_rods", "rods' vibration") else 3
            assert error / 1.5 < 1e3 * found[effect].error < largest * error, (name, effect, found[effect])
        highest = all_physics(scene, 1e-3)[-1]
        assert estimates.of(highest) == {}


def test_estimate_of_varying_stiffness():
    scene = load_scene(SCENES / "curved_rods.toml")
    rods = tuple(replace(rod, curvature=0.0, stiffness_factors=(1.1, 0.9)) for rod in scene.robot.rods)
    scene = replace(scene, robot=replace(scene.robot, rods=rods))
    found = Estimates(scene, scene.start()).of_level("rods", "plain")
    assert list(found) == ["stiffness along the rods"]
    # Where the tip rests at the same motor angles on plain rods.
    pose, plain = scene.start(), scene.robot.plain()
    there = forward_statics(plain, pose.q, guess=inverse_statics(plain, pose.p, mode=pose.mode))
    off = np.linalg.norm(there.p - pose.p)
    assert off / 1.5 < found["stiffness along the rods"].error < 6 * off


def test_estimated_steps(release, choice):
    """Stability, and orders; against what was measured on the chosen physics."""
    estimates = choice.estimates
    assert estimates.step("rk4", 1.0).error == math.inf
    assert estimates.step("velocity_verlet", 2e-3).error == pytest.approx(
        4 * estimates.step("velocity_verlet", 1e-3).error
    )
    assert estimates.step("rk4", 2e-3).error == pytest.approx(16 * estimates.step("rk4", 1e-3).error)
    for one in choice.discretisations:
        own = estimates.step(one.rung.integrator, one.rung.dt).error
        # Euler's estimate is that of the velocity, half a step late, all the way; Verlet's is its phase.
        least, largest = (10, 1) if one.rung.integrator == "semi_implicit_euler" else (1.5, 1.5)
        assert own / least < one.error < largest * own, named(release, one.rung)


def test_a_rung_that_the_plant_refuses_is_listed_and_the_yardstick_says_what_it_lacks(release, monkeypatch):
    make = PlantSettings.make

    def without_full(self, robot):
        if self.inertia == "full":
            raise ValueError("no such inertia for these rods")
        return make(self, robot)

    monkeypatch.setattr(PlantSettings, "make", without_full)
    found = choose(replace(release, duration=0.1, need=replace(release.need, tip_accuracy=1e-3)))
    assert [rung.inertia for rung, _ in found.unavailable] == ["full"]
    assert found.yardstick.inertia == "condensed"
    assert list(found.lacking) == ["rods' vibration"]
    assert found.tip_error >= found.lacking["rods' vibration"].error > 0.0
    text = choice_table(found)
    assert "it lacks rods' vibration" in text
    assert "inertia full: no such inertia for these rods" in text


def test_a_rung_that_fails_on_the_way_is_not_taken(release, monkeypatch):
    bench = Bench(replace(release, duration=0.1))
    step = bench.rungs[0].make(release.robot).__class__.step

    def failing(self, x, u, f_ext=(0.0, 0.0)):
        if self.inertia == "none":
            raise ConvergenceError("made up", residual=1.0, iterations=1, last=None)
        return step(self, x, u, f_ext)

    monkeypatch.setattr("pcr_mpc.plant.motion.plant.Plant.step", failing)
    measured = bench.measure(bench.rungs[0])
    assert measured.error == math.inf
    assert "made up" in measured.failure
    assert bench.measure(bench.yardstick).error == 0.0


def test_payload_and_control_step_are_measured():
    bench = Bench(short("payload", 0.35))
    errors = {}
    for rung in bench.rungs:
        if rung.inertia in ("none", "constant"):
            errors[rung.inertia, rung.payload] = bench.measure(rung).error
    assert min(errors["none", "ignored"], errors["constant", "ignored"]) > 1e-3
    assert errors["constant", "carried"] < 1e-4 < errors["none", "carried"]
    assert 0.0 < bench.control_step < 10.0


def test_table_and_record(release, choice):
    text = choice_table(choice)
    for words in ("release needs the tip to 0.002 mm", "K^-1 dM a", "inertia: none -> constant", "us a step",
                  "chosen: inertia condensed", "yardstick: inertia full", "no lower rung is, the best"):  # fmt: skip
        assert words in text
    record = json.loads(json.dumps(choice_record(choice), allow_nan=False))
    assert record["chosen"]["inertia"] == "condensed"
    assert record["chosen"]["tip_error_mm"] <= record["need"]["tip_accuracy_mm"]
    steps = {(one["from"], one["to"]): one["mm"] for one in record["neighbours"]}
    by_inertia = {one["inertia"]: one["error_mm"] for one in record["physics"]}
    assert steps["condensed", "full"] == by_inertia["condensed"]
    assert steps["none", "constant"] == pytest.approx(by_inertia["none"], rel=0.02)


def test_a_scene_without_need_is_refused():
    with pytest.raises(ValueError, match=r"lemniscate states no need; give it a \[need\] table"):
        choose(load_scene(SCENES / "lemniscate.toml"))


# --- motors -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lagging():
    """Massless rods on motors that lag, with play and enough torque."""
    scene = load_scene(SCENES / "lemniscate.toml")
    motors = Motors(time_constant=0.01, backlash=0.004, saturated=True)
    massless = replace(scene.robot, rods=tuple(replace(rod, line_density=0.0) for rod in scene.robot.rods))
    return replace(scene, robot=massless, duration=0.4, motors=motors, need=Need(1e-4, **ANY_TIME))


def test_motors_are_an_effect_like_the_others(lagging):
    """What they cost is measured on the scene's motion; they are left out where what is needed allows."""
    found = choose(lagging)
    assert [levels(one.rung)["motors"] for one in found.physics] == ["ideal", "as_built"]
    ideal, built = found.physics
    assert built.error == 0.0
    # In the simulator itself, motors of the same commands with and without.
    runs = [simulate(each, each.make_plant(), Replay(make_run(lagging).u)) for each in
            (lagging, replace(lagging, motors=None))]  # fmt: skip
    apart = np.linalg.norm(runs[0].x[:, :2] - runs[1].x[:, :2], axis=1).max()
    assert ideal.error == pytest.approx(apart, rel=0.05)
    said = found.estimates.of_level("motors", "ideal")
    assert set(said) == {"motor lag", "backlash", "torque limit"}
    assert 0.3 < sum(each.error for each in said.values()) / ideal.error < 5.0
    assert said["torque limit"].error == 0.0
    assert found.chosen.rung.motors == "as_built"
    assert "motors: ideal -> as_built" in choice_table(found)
    need = replace(lagging.need, tip_accuracy=2.0 * ideal.error)
    _, rough = lowest(lagging, need, found.physics, lambda rung: replace(ideal, rung=rung))
    assert rough.rung.motors == "ideal"


def make_run(scene):
    return simulate(scene, scene.make_plant(), make_controller(scene))


def test_a_motor_that_lacks_torque_is_estimated(lagging):
    weak = replace(lagging, robot=replace(lagging.robot, torque_limit=0.7))
    start = lagging.start()
    assert Estimates(weak, start).of_level("motors", "ideal")["torque limit"].error > 1e-3
    assert ladders(replace(lagging, motors=Motors()))["motors"] == ("as_built",)


def test_motors_that_are_left_out_change_no_bit(lagging):
    """A plant with ideal motors is that of a scene without any."""
    short = replace(lagging, duration=0.1)
    ideal = replace(short, plant=replace(short.plant, motors="ideal"))
    assert make_run(ideal).hash() == make_run(replace(short, motors=None)).hash()
    assert make_run(short).hash() != make_run(ideal).hash()
