"""Motor torques in a log: derivatives by differences, and the scale of forces that motion alone does not show."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import LogError, identify, inverse_statics, load_robot, read_log, solve_statics
from pcr_mpc.study.identification.logs.checks import checked_log
from pcr_mpc.study.identification.parameters import robot_with
from pcr_mpc.study.identification.torques import torques_along
from tests.conftest import MODELS

from .test_identification import TRUE, log, noisy, scene, true_robot, truth, write_csv

__all__ = ["log", "scene", "true_robot"]
NOISE = 2e-3  # N m


@pytest.fixture(scope="module")
def with_torque(scene, log, true_robot):
    """What motors of the true robot had to supply, by statics one by one, as a sensor would tell it."""
    eq, found = scene.start(), []
    for p, q in zip(log.p, log.q, strict=True):
        eq = solve_statics(true_robot, p, q, guess=eq)
        found.append(eq.motor_torque)
    torque = np.array(found) + np.random.default_rng(2).normal(0.0, NOISE, (len(found), 2))
    torque[40:45] = np.nan
    return replace(noisy(log), torque=torque)


def test_derivatives_by_differences():
    robot = load_robot(MODELS / "planar_pair.toml")
    pose = inverse_statics(robot, (0.0, 0.25), mode="LR")
    x = np.concatenate([pose.p + (0.01, -0.02), (0.3, 0.1), pose.q + (0.05, 0.1)])[None]
    found = torques_along(robot, x, pose)
    assert found.values[0] == pytest.approx(solve_statics(robot, x[0, :2], x[0, 4:], guess=pose).motor_torque, rel=1e-9)
    h = 1e-6
    for j in range(6):
        step = h * np.eye(6)[j]
        ahead, behind = (torques_along(robot, x + side * step, pose).values for side in (1, -1))
        assert found.by_state[0, :, j] == pytest.approx((ahead - behind)[0] / (2 * h), rel=1e-6, abs=1e-7), j
    for name, slope in found.by_number.items():
        i, what = int(name[5]), name.split(".")[1]
        rod = robot.rods[i]
        value = rod.base["xy".index(what[-1])] if what.startswith("base") else getattr(rod, what)
        step = 1e-6 * max(abs(value), 0.1)
        ahead, behind = (torques_along(robot_with(robot, {name: value + side * step}), x, pose).values
                         for side in (1, -1))  # fmt: skip
        assert slope[0] == pytest.approx((ahead - behind)[0] / (2 * step), rel=1e-5, abs=1e-6), name


@pytest.mark.slow
def test_torque_tells_the_scale(scene, with_torque):
    found = identify(scene, [with_torque])
    assert found.unidentified == ()
    wanted = truth() | {"tip_mass": TRUE["mass"]}
    for one in found.estimates:
        assert abs(one.value - wanted[one.name]) < 4.0 * one.sd, one
    mass = found.estimate("tip_mass")
    assert mass.told == "data"
    assert mass.sd / mass.value < 0.01
    assert "motor torques tell the scale of forces; they are explained to 0.002 N m" in " ".join(found.warnings)
    assert found.method == "whole runs"


def test_columns_of_torque(tmp_path, scene, with_torque):
    path = write_csv(tmp_path / "log.csv", with_torque)
    lines = path.read_text().splitlines()
    rows = ["", *(",".join("" if np.isnan(v) else f"{v:.9g}" for v in row) for row in with_torque.torque)]
    rows[0] = "torque0_Nm,torque1_Nm"
    path.write_text("\n".join(f"{a},{b}" for a, b in zip(lines, rows, strict=True)) + "\n")
    [read] = read_log(path, 2)
    known = ~np.isnan(with_torque.torque)
    assert (np.isnan(read.torque) == ~known).all()
    assert read.torque[known] == pytest.approx(with_torque.torque[known], rel=1e-8)
    assert (np.isnan(read.part(38, 50).torque).sum(axis=0) == 5).all()
    path.write_text(path.read_text().replace("torque1_Nm", "torque2_Nm"))
    with pytest.raises(LogError, match="torque2_Nm"):
        read_log(path, 2)
    rods = tuple(replace(rod, curvature=1.0) for rod in scene.robot.rods)
    with pytest.raises(LogError, match="understood of plain rods only"):
        checked_log(with_torque, replace(scene.robot, rods=rods), scene.start())
