"""What studies promise: what is drawn, scored, named, counted and put back; on made-up figures where they will do."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import load_scene
from pcr_mpc.errors import ModelError
from pcr_mpc.loop.scene.settings import PlantSettings
from pcr_mpc.study.choice import choice as choosing
from pcr_mpc.study.choice.choice import Bench, Choice, Measured
from pcr_mpc.study.choice.estimates import Estimate, Estimates
from pcr_mpc.study.choice.file import write_rung
from pcr_mpc.study.choice.rungs import all_physics, ladders
from pcr_mpc.study.episodes import episodes
from pcr_mpc.study.episodes.episodes import EXACT, Mismatch, Spread, run_episode
from pcr_mpc.study.episodes.provenance import differences
from pcr_mpc.study.tuning import score as tuning_score
from pcr_mpc.study.tuning.score import Costs
from tests.conftest import CONTROLLERS, MODELS

SCENES = MODELS / "scenes"
START = Costs(10.0, 0.04, 100.0, 250.0, 1.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def lemniscate():
    scene = load_scene(SCENES / "lemniscate.toml")
    return replace(scene, duration=0.05, plant=replace(scene.plant, integrator="velocity_verlet"))


@pytest.fixture(scope="module")
def release():
    return replace(load_scene(SCENES / "release.toml"), duration=0.05)


def test_records_of_other_settings_are_told_by_their_place():
    assert differences({"a": [1, {"b": 2.0}], "c": 0}, {"a": [1, {"b": 3.0}], "d": 0}) == [
        "a[1].b was 2.0, is 3.0", "c was 0, is None", "d was None, is 0"]  # fmt: skip
    for old, new in (([1, 2], [1]), ([1], [1, 2]), ([1], 1), ({"b": 1}, [1])):
        assert differences({"a": old}, {"a": new}) == [f"a was {old}, is {new}"]
    assert differences({"a": [1, (2,)]}, {"a": [1, (2,)]}) == []


def test_tunings_are_compared_on_the_same_episodes(lemniscate, monkeypatch):
    """Without mismatch both by seed 0, with it by the seeds that are given."""
    start, seen = lemniscate.tuning, []

    def noted(scene, tuning, seed, spread):
        seen.append((tuning.name, seed, spread))
        timing = {"control_cpu_us": 100.0, "late": 0.0}
        return {"rms_mm": 1.0 + seed, "effort_rad_s2": 2.0, "failure": "", "timing": timing}

    monkeypatch.setattr(tuning_score, "run_episode", noted)
    costs = tuning_score.measure(lemniscate, start, replace(start, name="other", input_weight=1.0), [4, 5], Spread())
    assert seen == [(start.name, 0, EXACT), ("other", 0, EXACT), ("other", 4, Spread()), ("other", 5, Spread())]
    assert (costs.nominal_mm, costs.failure_rate, costs.late) == (1.0, 0.0, 0.0)
    assert 5.0 <= costs.tracking_mm <= 6.0


# --- the choice of a rung ---------------------------------------------------------------------------------------------


def test_the_step_error_is_that_of_twice_the_yardsticks_step(release, monkeypatch):
    measured = []

    def made_up(self, rung):
        measured.append(rung)
        return Measured(rung, 3e-6, 1e-5)

    monkeypatch.setattr(Bench, "measure", made_up)
    bench = Bench(release)
    assert bench.step_error == 3e-6
    assert measured == [replace(bench.yardstick, dt=2 * bench.yardstick.dt)]


def test_a_choice_does_not_hang_on_late_decisions(lemniscate, monkeypatch):
    """With a deadline that every decision misses, the motion that rungs are measured on is the same."""
    only = all_physics(lemniscate, 1e-3)[0]
    monkeypatch.setattr(choosing, "all_physics", lambda scene, dt: [replace(only, dt=dt)])
    scene = replace(lemniscate, duration=0.03)
    benches = [Bench(replace(scene, deadline=deadline)) for deadline in (math.inf, 0.0)]
    assert benches[0]._run.hash() == benches[1]._run.hash()


def made_up_choice(scene, lacking):
    rung = next(one for one in all_physics(scene, 5e-4) if one.inertia == "condensed")
    rung = replace(rung, integrator="velocity_verlet", method="closed_form")
    chosen = Measured(rung, 1.0e-6, 2e-5)
    return Choice(scene, None, rung, lacking, 2.0e-7, [], [chosen], [chosen], None, chosen)


def test_a_choice_adds_what_the_yardstick_may_be_off(release):
    choice = made_up_choice(release, {"a": Estimate(3e-7, ""), "b": Estimate(4e-7, "")})
    assert choice.unmeasured == pytest.approx(9e-7)
    assert choice.tip_error == pytest.approx(1.9e-6)


def test_figures_of_a_choice_are_written_in_millimetres_and_read_back_in_metres(release, tmp_path):
    for folder in (MODELS, CONTROLLERS):
        (tmp_path / folder.name).symlink_to(folder)
    path = tmp_path / "mine" / "release.toml"
    path.parent.mkdir()
    path.write_text((SCENES / "release.toml").read_text().replace("../", "../models/", 1))
    choice = made_up_choice(release, {"a": Estimate(3e-7, ""), "b": Estimate(4.12e-7, "")})
    write_rung(choice, path)
    finding = load_scene(path).finding
    assert finding.tip_error == pytest.approx(1.912e-6, rel=3e-3)
    assert finding.estimated == pytest.approx(7.12e-7, rel=1e-3)  # three digits
    text = path.read_text()
    assert "estimated = 0.000712      # mm of it" in text
    # What the scene says of snaps stays; a rung that does not read back is refused, and nothing is written.
    path.write_text(text.replace('method = "closed_form"', 'method = "closed_form"\non_snap = "jump"'))
    write_rung(choice, path)
    assert load_scene(path).plant.on_snap == "jump"
    before = path.read_text()
    wrong = replace(choice, chosen=replace(choice.chosen, rung=replace(choice.chosen.rung, steps=3)))
    with pytest.raises(ModelError, match="does not read back as it is"):
        write_rung(wrong, path)
    assert path.read_text() == before
    assert [one.name for one in path.parent.iterdir()] == ["release.toml"]


# --- estimates --------------------------------------------------------------------------------------------------------


def test_a_sudden_force_counts_twice_its_displacement_at_rest():
    """A spring on which a force appears at once swings to twice its rest; by hand."""
    scene = load_scene(SCENES / "payload.toml")
    estimates = Estimates(scene, scene.start())
    least = estimates.slowest**2 * scene.robot.tip_mass
    t = np.arange(0.0, scene.duration, scene.period)
    a = np.linalg.norm(scene.trajectory(t)[:, 2], axis=1).max()
    found = estimates.of_level("payload", "ignored")["payload"].error
    assert found == pytest.approx(2 * scene.payload.mass * a / least, rel=1e-9)


def test_estimates_of_what_a_robot_does_not_have_are_none(release):
    estimates = Estimates(release, release.start())
    assert estimates.of_level("weight", "none") == {}
    assert estimates.of_level("payload", "ignored") == {}
    assert estimates.of_level("rods", "plain") == {}
    plain = next(rung for rung in all_physics(release, 1e-3) if rung.inertia == "none")
    assert estimates.total(plain) == sum(one.error for one in estimates.of(plain).values()) > 0
    assert estimates.rods(replace(plain, method="closed_form")).error == 0.0
    coarse, fine = (
        estimates.rods(replace(plain, method="multiple_shooting", segments=n, steps=1, scheme="rk4")).error
        for n in (4, 8)
    )
    assert coarse == pytest.approx(16 * fine)


def test_steps_beyond_stability_cost_everything_but_for_gauss(release):
    estimates = Estimates(release, release.start())
    limit = 2.0 / estimates.fastest
    for integrator in ("semi_implicit_euler", "velocity_verlet", "rk4"):
        assert math.isfinite(estimates.step(integrator, 0.99 * limit).error)
        assert estimates.step(integrator, 1.01 * limit).error == math.inf
    assert math.isfinite(estimates.step("gauss", 1.01 * limit).error)
    assert estimates.step("semi_implicit_euler", 2e-3).error == pytest.approx(
        2 * estimates.step("semi_implicit_euler", 1e-3).error
    )


# --- episodes ---------------------------------------------------------------------------------------------------------


def test_times_of_an_episode_are_in_the_units_of_their_names(lemniscate, monkeypatch):
    simulated = episodes.simulate_episode

    def timed(*arguments, **keywords):
        run = simulated(*arguments, **keywords)
        times = np.full_like(run.control_time, 7.0)
        times[:, 5] = [2e-4, 3e-4, 5e-3, 0.02, 0.010001]
        return replace(run, control_time=times)

    monkeypatch.setattr(episodes, "simulate_episode", timed)
    row = run_episode(lemniscate, lemniscate.tuning, 0, EXACT)
    assert row["timing"]["control_cpu_us"] == pytest.approx(5000.0)
    assert row["timing"]["late"] == pytest.approx(2 / 5)  # longer than 10 ms
    assert 0 < row["timing"]["episode_s"] < 600


def test_a_mismatch_is_applied_to_the_robot_and_to_what_the_scene_has_already(lemniscate):
    scene = replace(lemniscate, delay=1, tip_noise=3e-5, angle_step=1e-3, force=(0.1, -0.2))
    off = Mismatch((1.1, 0.9), 1.2, 0.5, ((1e-3, -2e-3), (0.0, 3e-3)), 2, 4e-5, 5e-4, (1.0, 2.0))
    true = off.applied_to(scene)
    assert [rod.bending_stiffness for rod in true.robot.rods] == pytest.approx([0.055, 0.045])
    assert [rod.base for rod in true.robot.rods] == [pytest.approx((-0.099, -0.002)), pytest.approx((0.1, 0.003))]
    assert (true.robot.tip_mass, true.robot.drag) == (pytest.approx(0.3), pytest.approx(0.1))
    assert (true.delay, true.tip_noise, true.angle_step) == (3, pytest.approx(5e-5), 1e-3)
    assert true.force == pytest.approx((1.1, 1.8))
    assert replace(off, angle_step=2e-3).applied_to(scene).angle_step == 2e-3
    row = off.row()
    assert (row["base0_y_m"], row["base1_x_m"], row["base1_y_m"]) == (-2e-3, 0.0, 3e-3)
    assert (row["stiffness1"], row["delay"], row["force_x_N"], row["force_y_N"]) == (0.9, 2, 1.0, 2.0)
    assert (row["mass"], row["drag"], row["tip_noise_m"], row["angle_step_rad"]) == (1.2, 0.5, 4e-5, 5e-4)


def test_rungs_leave_out_what_their_names_say(lemniscate):
    """The lowest of payload scenes ignores it; plain rods are made of a robot that is plain."""
    curved = load_scene(SCENES / "curved_rods.toml")
    low, high = (PlantSettings.make(one, curved.robot) for one in (
        next(r for r in all_physics(curved, 1e-3) if (r.rods, r.inertia) == ("plain", "none")),
        next(r for r in all_physics(curved, 1e-3) if (r.rods, r.inertia) == ("as_built", "none"))))  # fmt: skip
    assert low.robot == curved.robot.plain() != high.robot == curved.robot
    assert ladders(lemniscate)["payload"] == ("carried",)
