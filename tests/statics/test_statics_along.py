"""Inverse statics along a path: the same poses as one by one, and the same refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import pcr_mpc.plant.statics.many_poses.along as along
from pcr_mpc import Equilibrium, Robot, inverse_statics, load_robot, solve_statics
from pcr_mpc.errors import PCRError
from pcr_mpc.plant.statics.many_poses.along import inverse_statics_along
from pcr_mpc.plant.statics.margins import largest_strains, least_rod_margins, least_stiffnesses
from pcr_mpc.plant.statics.stability import least_rod_margin

MODELS = Path(__file__).parents[2] / "models"


def walk(count: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """A loop of the tip, and forces of a motion along it that jump once."""
    angle = np.linspace(0.0, 2 * np.pi, count)
    p = np.array([0.0, 0.25]) + 0.03 * np.stack([np.sin(angle), 0.5 * np.sin(2 * angle)], axis=1)
    force = 0.1 * np.stack([np.cos(angle), np.sin(3 * angle)], axis=1)
    force[count // 2 :, 1] += 0.15
    return p, force


def one_by_one(
    robot: Robot, p: np.ndarray, force: np.ndarray, guess: Equilibrium, done: list[Equilibrium] | None = None
) -> list[Equilibrium]:
    """Poses in turn, into a list that is there also where one fails."""
    found = [] if done is None else done
    for tip, carried in zip(p, force, strict=True):
        guess = inverse_statics(robot, tip, carried, guess=guess)
        found.append(guess)
    return found


@pytest.mark.parametrize("name", ["planar_pair", "three_rods", "heavy_pair"])
def test_the_same_poses_as_one_by_one(name: str) -> None:
    robot = load_robot(MODELS / f"{name}.toml")
    p, force = walk(6 if name == "heavy_pair" else 80)
    start = inverse_statics(robot, p[0], mode="LR" if robot.n_rods == 2 else None)
    single = one_by_one(robot, p, force, start)
    poses = inverse_statics_along(robot, p, force, start)
    assert poses.solved.all()
    assert poses.stable.all()
    if robot.n_rods == 2:
        assert np.abs(poses.q - [eq.q for eq in single]).max() < 1e-9
    else:  # of many angles those nearest to the last ones: one by one the steps must be small
        single = [solve_statics(robot, eq.p, q, guess=eq) for eq, q in zip(single, poses.q, strict=True)]
    assert np.abs(poses.force - force - robot.tip_weight).max() < 1e-9 * robot.force_scale
    assert np.allclose(least_stiffnesses(poses), [eq.stiffness_eigenvalues[0] for eq in single], rtol=1e-4)
    margins, exact = least_rod_margins(poses), np.array([least_rod_margin(eq) for eq in single])
    assert margins.min() == pytest.approx(exact.min(), rel=1e-4, nan_ok=True)
    assert np.allclose(1.0 - margins, 1.0 - exact, rtol=0.011, equal_nan=True)
    assert np.allclose(largest_strains(poses), [eq.max_strain for eq in single], rtol=1e-4, equal_nan=True)


def test_more_motors_than_two_turn_by_the_least_motion_along_the_path() -> None:
    """As many small steps lead, one by one; as many as there are poses lead elsewhere."""
    robot = load_robot(MODELS / "three_rods.toml")
    p, force = (path[:40] for path in walk(80))
    start = inverse_statics(robot, p[0])
    fine = np.linspace(0.0, len(p) - 1.0, 30 * (len(p) - 1) + 1)
    small = one_by_one(robot, *(CubicSpline(np.arange(len(p)), path)(fine) for path in (p, force)), start)
    wanted = np.array([eq.q for eq in small[::30]])
    away = np.abs(inverse_statics_along(robot, p, force, start).q - wanted).max()
    assert away < 0.1 * np.abs(np.array([eq.q for eq in one_by_one(robot, p, force, start)]) - wanted).max()


def test_the_graph_does_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = load_robot(MODELS / "planar_pair.toml")
    p, force = walk()
    start = inverse_statics(robot, p[0], mode="LR")
    alone = []
    monkeypatch.setattr(along, "inverse_statics", lambda *a, **k: alone.append(a) or inverse_statics(*a, **k))
    inverse_statics_along(robot, p, force, start)
    assert len(alone) <= 3  # the first, and the jump of the force


@pytest.mark.parametrize("what", ["stop", "reach", "fold"])
def test_refused_where_and_as_one_by_one(what: str) -> None:
    robot = load_robot(MODELS / "planar_pair.toml")
    p, force = walk()
    start = inverse_statics(robot, p[0], mode="LR")
    if what == "stop":
        most = max(eq.q[0] for eq in one_by_one(robot, p, force, start))
        low, _ = robot.rods[0].angle_limits
        limited = replace(robot.rods[0], angle_limits=(low, most - 1e-3))
        robot = replace(robot, rods=(limited, *robot.rods[1:]))
    elif what == "reach":
        p = p + np.linspace(0.0, 0.5, len(p))[:, None]
    else:
        force = force * np.linspace(1.0, 600.0, len(p))[:, None]
    done: list[Equilibrium] = []
    with pytest.raises(PCRError) as single:
        one_by_one(robot, p, force, start, done)
    with pytest.raises(PCRError) as batch:
        inverse_statics_along(robot, p, force, start)
    assert batch.value.details["row"] == len(done)
    assert type(batch.value) is type(single.value)
    assert str(batch.value)[:60] == str(single.value)[:60]
