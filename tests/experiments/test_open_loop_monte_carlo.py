"""The study of open-loop motion moves its robots as their own plants would, and repeats."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from experiments.motion import open_loop_monte_carlo as study
from experiments.motion.open_loop_monte_carlo import KINDS, QUANTILES, main, move, told
from pcr_mpc import PCRError, Plant, forward_statics, load_scene, sensitivities
from pcr_mpc.study.episodes.episodes import lighter

ARGUMENTS = ["--robots", "3", "--duration", "0.2", "--seed", "5"]


def read(path):
    with open(path, newline="", encoding="utf-8") as handle:
        return list(csv.DictReader(handle))


def test_it_runs_and_repeats(tmp_path, capsys):
    for folder in ("first", "second"):
        assert main([*ARGUMENTS, "--out", str(tmp_path / folder)]) == 0
    text = capsys.readouterr().out
    assert all(kind in text for kind in KINDS)
    for name in ("open_loop_times.csv", "open_loop_robots.csv"):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()
    assert (tmp_path / "first" / "open_loop_monte_carlo.png").stat().st_size > 10_000
    rows = read(tmp_path / "first" / "open_loop_robots.csv")
    assert [(row["off"], row["seed"]) for row in rows] == [(kind, seed) for kind in KINDS for seed in "567"]
    times = read(tmp_path / "first" / "open_loop_times.csv")
    assert len(times) == len(KINDS) * 2 * 21
    levels = np.array([[float(row[f"{name}_mm"]) for name in QUANTILES] for row in times])
    assert (np.diff(levels, axis=1) >= 0.0).all()
    largest = max(float(row["max_mm"]) for row in rows if row["off"] == "all")
    moved = [
        level[-1] for level, row in zip(levels, times, strict=True) if (row["off"], row["how"]) == ("all", "moved")
    ]
    assert max(moved) == pytest.approx(largest, rel=1e-3)


@pytest.fixture(scope="module")
def scene():
    return lighter(replace(load_scene(study.DEFAULT_SCENE), duration=0.2))


@pytest.fixture(scope="module")
def believed(scene):
    pose, inputs = scene.start(), told(scene)
    start = np.concatenate([pose.p, np.zeros(2), pose.q])
    return pose, inputs, sensitivities(scene.make_plant(), start, inputs, guess=pose)


def test_the_rates_are_those_of_the_reference(scene, believed):
    """The believed robot follows it: to the error of a plant step of 1 ms under rates held for 10 ms."""
    _, _, motion = believed
    assert scene.trajectory is not None
    wanted = scene.trajectory(motion.t)[:, 0]
    assert np.abs(motion.x[:, :2] - wanted).max() < 1e-4
    assert np.abs(wanted - wanted[0]).max() > 2e-4


def test_robots_move_as_by_their_own_plants(scene, believed):
    pose, inputs, motion = believed
    robots = {seed: KINDS["all"][0].sample(2, seed).applied_to(scene).robot for seed in (1, 2)}
    found = move(scene.make_plant(), pose, motion, inputs, {0: scene.robot, **robots}, 1)
    assert found.seeds == [0, 1, 2]
    assert found.failures == {}
    assert found.error[0].max() < 1e-9
    for error, robot in zip(found.error[1:], robots.values(), strict=True):
        plant = Plant(robot, integrator="velocity_verlet", dt=scene.plant.dt)
        rest = forward_statics(robot, pose.q, guess=pose)
        x = np.concatenate([rest.p, np.zeros(2), pose.q])
        plant.reset(x, pose)
        for k, u in enumerate(inputs):
            assert error[k] == pytest.approx(np.hypot(*(x[:2] - motion.x[k, :2])), abs=1e-9)
            x = plant.step(x, u)
        assert error[-1] > 1e-4


def test_small_mismatch_is_what_the_derivatives_say(scene, believed):
    """To second order: a tenth of the mismatch leaves a hundredth of the difference."""
    pose, inputs, motion = believed
    spread = KINDS["all"][0]
    tenth = replace(spread, stiffness=spread.stiffness / 10, mass=spread.mass / 10, drag=spread.drag**0.1,
                    base_offset=spread.base_offset / 10)  # fmt: skip
    differences = []
    for one in (spread, tenth):
        robots = {seed: one.sample(2, seed).applied_to(scene).robot for seed in (1, 2)}
        found = move(scene.make_plant(), pose, motion, inputs, robots, 1)
        differences.append(np.abs(found.error - found.predicted).max())
        assert found.error.max() > 20.0 * differences[-1]
    assert differences[1] < 0.02 * differences[0]


def test_robots_that_cannot_follow_are_counted(scene, believed):
    pose, inputs, motion = believed
    short = replace(scene.robot, rods=tuple(replace(rod, length=0.26) for rod in scene.robot.rods))
    light = replace(scene.robot, tip_mass=1e-6)  # its swing is too fast for the step
    found = move(scene.make_plant(), pose, motion, inputs, {3: short, 4: scene.robot, 7: light}, 1)
    assert found.seeds == [4]
    assert list(found.failures) == [3, 7]
    assert found.failures[3].startswith(("at rest", "step 0"))
    assert found.failures[7].startswith("step ")
    with pytest.raises(PCRError, match="none of 1 robots came to the end"):
        move(scene.make_plant(), pose, motion, inputs, {7: light}, 1)


def test_failures_are_one_clear_line(tmp_path, capsys):
    assert main(["--robots", "0", "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err == "open_loop_monte_carlo: --robots is 0, expected at least 1\n"
    for name, message in (("release", "nothing to track"), ("payload", "something to carry")):
        assert main(["--scene", str(study.MODELS / "scenes" / f"{name}.toml"), "--out", str(tmp_path)]) == 1
        assert message in capsys.readouterr().err
