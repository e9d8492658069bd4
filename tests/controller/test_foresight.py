"""What a controller's first graph foresees: models, delays, the motor target, rods that need the ladder."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    PCRError,
    Plant,
    inverse_statics,
    linearise,
    load_scene,
    load_tuning,
    make_controller,
    simulate,
    solve_statics,
)
from pcr_mpc.loop.parts.foresight import Foresight
from pcr_mpc.loop.parts.foresight_graph import Places
from tests.conftest import CONTROLLERS, MODELS

DT = 0.01
SCENES = MODELS / "scenes"


ONE = Places(0, 1, 1)


def made(robot, pose, places=ONE, velocity=(0.0, 0.0), **settings):
    foresight = Foresight(Plant(robot, **settings), Plant(robot), places, DT, None, compiled=False)
    x = np.concatenate([pose.p, velocity, pose.q])
    foresight.reset(x, pose)
    given = foresight.inputs
    given["estimate"][:-2] = x
    given["measured"][:] = [*pose.p, *pose.q]
    given["carries"][:] = 1.0
    foresight.rows["states"][:] = x
    given["end_force"][:] = pose.force - robot.tip_weight
    return foresight, x


@pytest.mark.parametrize(
    "settings", [{}, {"inertia": "condensed"}, {"inertia": "constant"}, {"method": "multiple_shooting"}]
)
def test_models_along_a_plan_are_those_of_fresh_linearisations(pair, centre, settings):
    """While the plan moves on in time and to the side, under a force that grows, with a payload on the way."""
    foresight, x = made(pair, centre, Places(0, 5, 5), (0.1, -0.2), **settings)
    rng = np.random.default_rng(5)
    force, path = np.zeros(2), x + np.outer(np.arange(5), [2e-3, 1e-3, 0, 0, 5e-3, -5e-3])
    for step in range(5):
        payloads = np.where(step + np.arange(5) >= 5, 0.1, 0.0)
        foresight.inputs["estimate"][:] = [*path[0], *force]
        foresight.inputs["measured"][:] = [*path[0, :2], *path[0, 4:]]
        foresight.rows["path"][:], foresight.rows["payloads"][:, 0] = path[1:], payloads
        outlook = foresight()
        assert len(outlook.models) == 5
        for at, model, payload in zip(path, outlook.models, payloads, strict=True):
            plant = Plant(pair, **settings)
            plant.reset(x if settings.get("inertia") == "constant" else at, centre)
            plant.carry(payload, at)
            fresh = linearise(plant, at, np.zeros(2), DT, force)
            near = at + rng.normal(0, 1e-3, 6) * [1, 1, 10, 10, 1, 1]
            u = rng.normal(0, 1, 2)
            off = np.abs(model(near, u) - fresh(near, u))
            assert (off < [2e-7, 2e-7, 1e-5, 1e-5, 1e-12, 1e-12]).all()
        path = np.vstack([path[1:], path[-1] + [2e-3, 1e-3, 0, 0, 5e-3, -5e-3]])
        path = path + np.array([1e-5, -1e-5, 0, 0, 1e-5, 0]) * (step % 2) + (step == 3) * 3e-3
        force = force + [0.02, -0.01]


def test_commands_on_the_way_are_applied_one_after_the_other(pair, centre):
    foresight, x = made(pair, centre, Places(2, 1, 1), (0.05, 0.02))
    rates = np.array([[0.8, -0.5], [-0.3, 1.0]])
    foresight.rows["on_the_way"][:] = rates
    outlook = foresight()
    plant = Plant(pair)
    plant.reset(x, centre)
    first = linearise(plant, x, np.zeros(2), DT)(x, rates[0])
    second = linearise(plant, first, np.zeros(2), DT)(first, rates[1])
    assert outlook.arriving == pytest.approx(first, abs=1e-9)
    assert outlook.ahead == pytest.approx(second, abs=1e-8)
    assert outlook.models[0](second, rates[0]) == pytest.approx(
        linearise(plant, second, np.zeros(2), DT)(second, rates[0]), abs=1e-8
    )


def test_rods_that_do_not_follow_take_the_ladder(pair, centre):
    """A place 60 mm from where the rods were: further than two Newton iterations go."""
    foresight, x = made(pair, centre)
    there = x + [0.05, -0.04, 0, 0, 0.1, 0.05]
    foresight.inputs["estimate"][:-2] = there
    foresight.inputs["measured"][:] = [*there[:2], *there[4:]]
    foresight._graph()
    assert foresight._outputs["good"][0] == 0.0  # else the test says nothing
    outlook = foresight()
    plant = Plant(pair)
    plant.reset(x, centre)
    wanted = linearise(plant, there, np.zeros(2), DT)
    assert outlook.models[0](there, np.ones(2)) == pytest.approx(wanted(there, np.ones(2)), abs=1e-9)


def test_rods_that_are_near_take_more_iterations_and_no_ladder(pair, centre, monkeypatch):
    """An estimate that jumps by 5 mm: all places, and the motor target, miss at once."""
    foresight, x = made(pair, centre, Places(0, 3, 3))
    there = x + [0.005, -0.004, 0, 0, 0.02, 0.01]
    foresight.inputs["estimate"][:-2] = there
    foresight.inputs["measured"][:] = [*there[:2], *there[4:]]
    foresight.rows["path"][:] = there
    foresight.rows["states"][:] = there
    foresight._graph()
    assert foresight._outputs["good"].tolist() == [0.5] * len(foresight._outputs["good"])  # else the test says nothing
    monkeypatch.setattr(Foresight, "_climb", None)
    monkeypatch.setattr(Foresight, "_follow_target", None)
    outlook = foresight()
    plant = Plant(pair)
    plant.reset(x, centre)
    wanted = linearise(plant, there, np.zeros(2), DT)
    for model in outlook.models:
        assert model(there, np.ones(2)) == pytest.approx(wanted(there, np.ones(2)), abs=1e-7)


def test_a_place_that_cannot_be_had_is_named_and_forgotten(pair, centre):
    foresight, x = made(pair, centre)
    before = foresight().models[0].A.copy()
    foresight.inputs["estimate"][:2] = foresight.inputs["measured"][:2] = [0.9, 0.0]
    with pytest.raises(PCRError, match="from the base of rod 0"):
        foresight()
    foresight.inputs["estimate"][:-2] = x
    foresight.inputs["measured"][:2] = x[:2]
    assert foresight().models[0].A == pytest.approx(before, abs=1e-9)


@pytest.mark.parametrize("force", [(4e-4, -3e-4), (0.5, -1.0)])
def test_the_motor_target_carries_the_force(pair, centre, force):
    """Against inverse statics, which knows no Newton step of it."""
    foresight, x = made(pair, centre)
    wanted = inverse_statics(pair, centre.p, force, guess=centre).q - centre.q
    foresight.inputs["estimate"][-2:] = force
    for _ in range(6):
        outlook = foresight()
    assert outlook.shift == pytest.approx(wanted, abs=1e-11)
    assert outlook.states[0] == pytest.approx(x + [0, 0, 0, 0, *wanted], abs=1e-11)


def test_a_large_shift_is_taken_in_steps_and_one_out_of_reach_not_at_all(pair, centre):
    foresight, _ = made(pair, centre)
    foresight.inputs["estimate"][-2:] = [0.0, -8.0]
    first = foresight().shift.copy()
    assert np.abs(first).max() == pytest.approx(0.1)
    foresight.rows["states"][0, :2] = [0.0, 0.9]
    assert foresight().shift.tolist() == first.tolist()


def test_motors_that_have_lost_a_direction_stay_where_they_are(pair):
    """The tip between two rods that are images of each other by half a turn: both motors push it along one line."""
    pose = solve_statics(pair, (0.0, 0.0), (2.5, 2.5 - np.pi))
    assert np.linalg.svd(pose.dforce_dq, compute_uv=False)[1] < 1e-8 * np.abs(pose.dforce_dq).max()
    foresight, _ = made(pair, pose)
    foresight.inputs["estimate"][-2:] = [0.3, -0.2]
    assert foresight().shift.tolist() == [0.0, 0.0]


def test_without_an_observer_nothing_is_carried(pair, centre):
    foresight, _ = made(pair, centre)
    foresight.inputs["carries"][:] = 0.0
    foresight.inputs["end_force"][:] = [0.5, 0.5]
    assert foresight().shift.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("tuning", ["default", pytest.param("frozen", marks=pytest.mark.slow), "pd"])
def test_machine_code_gives_the_same_bits(tuning, compiler, machine_code):
    scene = replace(load_scene(SCENES / "lemniscate.toml"), duration=0.3, delay=1)
    known = load_tuning(CONTROLLERS / f"{tuning}.toml")
    hashes = []
    for compiled in (True, False):
        told = replace(known, horizon=min(known.horizon, 4), model=replace(known.model, compiled=compiled))
        hashes.append(simulate(scene, scene.make_plant(), make_controller(scene, told)).hash())
    assert hashes[0] == hashes[1]
    assert list((machine_code / "pcr_mpc").glob("*.so"))
