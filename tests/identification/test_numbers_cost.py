"""What numbers are worth on a motion: by differences of motions, by sampling, and what follows for rungs."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import Plant, Uncertainty, load_scene, make_controller, rollout, simulate
from pcr_mpc.report.studies.choice import choice_record, choice_table
from pcr_mpc.study.choice.choice import Choice, Measured
from pcr_mpc.study.choice.estimates import Estimates
from pcr_mpc.study.choice.numbers_cost import NumbersCost, assumed_uncertainty, numbers_cost
from pcr_mpc.study.choice.rungs import all_physics
from pcr_mpc.study.identification.parameters import robot_with
from tests.conftest import MODELS

NAMES = ("rods[0].bending_stiffness", "rods[1].bending_stiffness", "rods[0].base_x")
FASTEST = 20.0  # rad/s


@pytest.fixture(scope="module")
def run():
    scene = load_scene(MODELS / "scenes" / "lemniscate.toml")
    scene = replace(scene, duration=0.8, force=(0.2, -0.1))
    return simulate(scene, scene.make_plant(), make_controller(scene))


@pytest.fixture(scope="module")
def known():
    correlation = np.eye(3)
    correlation[0, 1] = correlation[1, 0] = 0.9
    return Uncertainty(NAMES, np.array([0.002, 0.002, 2e-4]), correlation)


def test_each_number_alone_by_differences_of_motions(run, known):
    cost = numbers_cost(run, FASTEST, known)
    robot = run.scene.robot
    plant = Plant(robot, integrator="rk4", dt=0.01)
    rates = run.applied.reshape(80, 10, 2).mean(axis=1)
    values = {f"rods[{i}].bending_stiffness": rod.bending_stiffness for i, rod in enumerate(robot.rods)}
    values |= {"rods[0].base_x": robot.rods[0].base[0]}
    for name, sd in zip(NAMES, known.sd, strict=True):
        ends = []
        for side in (1e-3, -1e-3):
            other = plant.of(robot_with(robot, {name: values[name] + side * sd}))
            ends.append(rollout(other, run.x[0], rates, (0.2, -0.1), guess=run.pose).x[:, :2])
        apart = np.linalg.norm(ends[0] - ends[1], axis=1).max() / 2e-3
        assert cost.by_number[name] == pytest.approx(apart, rel=1e-3), name


@pytest.mark.slow
def test_all_together_by_robots_that_were_drawn(run, known):
    cost = numbers_cost(run, FASTEST, known)
    assert cost.sampled == pytest.approx(cost.error, rel=0.25)  # 48 robots
    assert not cost.assumed
    half = numbers_cost(run, FASTEST, replace(known, sd=known.sd / 2))
    assert half.error == pytest.approx(cost.error / 2, rel=1e-9)
    independent = numbers_cost(run, FASTEST, replace(known, correlation=np.eye(3)))
    assert independent.error != pytest.approx(cost.error, rel=0.05)  # both rods pull together, or against each other


def test_what_is_assumed_where_nobody_says(run):
    found = assumed_uncertainty(run.scene.robot)
    assert len(found.names) == 8
    assert found.sd[found.names.index("tip_mass")] == pytest.approx(0.25 * 0.2 / math.sqrt(3.0))
    assert numbers_cost(run, FASTEST, None).assumed
    without = assumed_uncertainty(replace(run.scene.robot, drag=0.0))
    assert "drag" not in without.names
    payload = load_scene(MODELS / "scenes" / "payload.toml").payload
    assert numbers_cost(replace(run, scene=replace(run.scene, payload=payload)), FASTEST, None) is None


def test_what_is_finer_than_a_third_is_marked():
    scene = load_scene(MODELS / "scenes" / "release.toml")
    errors = (3e-3, 9e-4, 1e-5, 0.0)
    rungs = all_physics(scene, 1e-3)
    tips = np.zeros((3, 2))
    physics = [Measured(rung, error, 1e-5, tips=tips + (error, 0.0)) for rung, error in zip(rungs, errors, strict=True)]
    estimates = Estimates(scene, scene.start())
    choice = Choice(scene, estimates, rungs[-1], {}, 0.0, [], physics, physics[:1], None, physics[2])
    assert [choice.worth_its_time(one) for one in physics] == [True] * 4
    assert "not worth" not in choice_table(choice).replace("not worth its time before", "")
    cost = NumbersCost(3e-3, 2.9e-3, {"tip_mass": 3e-3}, assumed=True)
    choice = replace(choice, numbers=cost)
    assert [choice.worth_its_time(one) for one in physics] == [True, True, False, False]
    record = choice_record(choice)
    assert [one["worth_its_time"] for one in record["physics"]] == [True, True, False, False]
    assert [one["worth_its_time"] for one in record["neighbours"]] == [True, False, False]
    assert record["numbers"] == {"mm": 3.0, "sampled_mm": 2.9, "third_mm": 1.0, "by_number_mm": {"tip_mass": 3.0},
                                 "assumed": True}  # fmt: skip
    assert choice_table(choice).count("not worth its time\n") == 4
    assert "pcr-mpc identify" in choice_table(choice)
