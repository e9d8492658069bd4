"""Derivatives of a motion in its start and in the robot's numbers, against differences, closed forms and symmetries."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm, expm_frechet

from pcr_mpc import (
    Plant,
    UnreachableError,
    UnstableError,
    inverse_statics,
    load_robot,
    rollout,
    sensitivities,
    solve_statics,
)
from tests.conftest import MODELS

from .numbers_of import number_of, with_number

STEPS = 20
PLAIN = [
    {"integrator": integrator, "inertia": inertia}
    for integrator in ("semi_implicit_euler", "velocity_verlet", "rk4")
    for inertia in ("none", "constant", "condensed")
]
# Sizes by which numbers are changed that may be zero.
SIZES = {"base": 0.1, "grav": 9.81, "curv": 1.0, "line": 0.01}


def start_at(pose, velocity=(0.3, -0.2)):
    return np.concatenate([pose.p, velocity, pose.q])


def motion(steps=STEPS, n=2):
    inputs = 2.0 * np.sin(0.11 * np.arange(steps)[:, None] + np.arange(n))
    return inputs, np.random.default_rng(3).normal(0.0, 0.5, (steps, 2))


def fourth_order(x, h):
    """Central difference from x at -2h, -h, h, 2h."""
    return (x[0] - 8.0 * x[1] + 8.0 * x[2] - x[3]) / (12.0 * h)


def differences(plant, x0, inputs, f_ext, guess):
    """dx/dnumbers by differences of other robots' own motions, times the numbers' sizes, and these."""
    names, robot = plant.step_model.kind.names, plant.robot
    sizes = np.array([max(abs(number_of(robot, name)), SIZES.get(name.split(".")[-1][:4], 0.0)) for name in names])
    robots = [
        with_number(robot, name, number_of(robot, name) + 1e-4 * k * size)
        for name, size in zip(names, sizes, strict=True)
        for k in (-2, -1, 1, 2)
    ]
    x = rollout(plant, x0, inputs, f_ext, guess=guess, robots=robots).x
    return np.stack([fourth_order(x[4 * j : 4 * j + 4], 1e-4) for j in range(len(names))], axis=2), sizes


def assert_close(found, wanted, tolerance):
    """Each derivative of each kind of state (p, v, q), relative to its largest in the motion."""
    for rows in (slice(0, 2), slice(2, 4), slice(4, None)):
        scale = np.abs(wanted[:, rows]).max(axis=(0, 1))
        error = np.abs(found[:, rows] - wanted[:, rows]).max(axis=(0, 1))
        assert (error <= tolerance * scale + 1e-10).all(), np.stack([error, scale]).tolist()


def check(robot, pose, tolerance=1e-5, **settings):
    plant, x0 = Plant(robot, **settings), start_at(pose)
    inputs, f_ext = motion(n=robot.n_rods)
    ways = np.random.default_rng(4).normal(0.0, 1.0, (STEPS, robot.n_rods + 2, 2))
    found = sensitivities(plant, x0, inputs, f_ext, guess=pose, ways=ways)
    assert found.names == plant.step_model.kind.names
    assert found.x == pytest.approx(rollout(plant, x0, inputs, f_ext, guess=pose).x, abs=1e-10)
    by_differences, sizes = differences(plant, x0, inputs, f_ext, pose)
    assert_close(found.dx_dnumbers * sizes, by_differences, tolerance)
    h, size = 1e-5, plant.n_states
    starts = np.stack([x0 + k * h * np.eye(size)[i] for i in range(size) for k in (-2, -1, 1, 2)])
    x = rollout(plant, starts, inputs, f_ext, guess=pose).x
    columns = [fourth_order(x[4 * i : 4 * i + 4], h) for i in range(size)]
    assert_close(found.dx_dx0, np.stack(columns, axis=2), 1e-7)
    changes = [k * 1e-3 * ways[:, :, j] for j in range(2) for k in (-2, -1, 1, 2)]
    n = robot.n_rods
    x = [rollout(plant, x0, inputs + c[:, :n], f_ext + c[:, n:], guess=pose).x for c in changes]
    along = np.stack([fourth_order(x[4 * j : 4 * j + 4], 1e-3) for j in range(2)], axis=2)
    assert_close(found.dx_dways, along, 1e-6)
    return found


@pytest.mark.parametrize(
    "kind",
    # By default each integrator and each inertia once.
    [kind if k % 4 == 0 else pytest.param(kind, marks=pytest.mark.slow) for k, kind in enumerate(PLAIN)],
    ids=[" ".join(kind.values()) for kind in PLAIN],
)
def test_differences_for_every_number(pair, centre, kind):
    found = check(replace(pair, gravity=(1.0, -9.81)), centre, weight="none", **kind)
    # What a motion depends on at all: all but the stops and the limit of rate, and rods that count for their mass.
    moving = np.abs(found.dx_dnumbers).max(axis=(0, 1)) > 0.0
    idle = {name for name, moves in zip(found.names, moving, strict=True) if not moves}
    still = {"rate_limit", *(f"rods[{i}].angle_{side}" for i in (0, 1) for side in ("lower", "upper"))}
    still |= {"rods[0].line_density", "rods[1].line_density"} if kind["inertia"] == "none" else set()
    assert idle == still


def test_differences_with_condensed_weight(pair, centre):
    robot = replace(pair, gravity=(1.0, -9.81))
    check(robot, centre, method="closed_form", integrator="velocity_verlet", inertia="condensed")


def test_differences_for_three_rods():
    robot = load_robot(MODELS / "three_rods.toml")
    pose = solve_statics(robot, (0.02, 0.24), inverse_statics(robot, (0.02, 0.24)).q)
    check(robot, pose, weight="none", integrator="velocity_verlet", inertia="condensed")


COARSE = {"segments": 3, "scheme": "rk4", "steps": 2}


@pytest.mark.parametrize(
    "integrator",
    ["velocity_verlet", *(pytest.param(name, marks=pytest.mark.slow) for name in ("semi_implicit_euler", "rk4"))],
)
def test_differences_for_rods_that_are_not_plain(knotted, bent, integrator):
    check(knotted, solve_statics(knotted, bent.p, bent.q, guess=bent), integrator=integrator, **COARSE)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [PLAIN[2], PLAIN[5], PLAIN[8]], ids=lambda kind: " ".join(kind.values()))
def test_differences_for_rods_that_are_not_plain_with_inertia(knotted, bent, kind):
    check(knotted, solve_statics(knotted, bent.p, bent.q, guess=bent), **kind)


def test_shooting_and_closed_form_agree(pair, centre):
    inputs, f_ext = motion()
    results = [
        sensitivities(Plant(pair, method=method, integrator="velocity_verlet"), start_at(centre), inputs, f_ext,
                      guess=centre).dx_dnumbers
        for method in ("closed_form", "multiple_shooting")
    ]  # fmt: skip
    assert_close(results[1], results[0], 1e-7)


def test_where_two_iterations_are_too_little(pair, centre):
    """A fast tip by long steps (see test_rollout)."""
    plant = Plant(pair, integrator="velocity_verlet", weight="none", dt=4e-3)
    x0, steps = start_at(centre, (2.0, -3.0)), 20
    moved = rollout(plant, x0, np.zeros((steps, 2)), guess=centre)
    assert moved.stepped == (0,)
    found = sensitivities(plant, x0, np.zeros((steps, 2)), guess=centre)
    assert found.x == pytest.approx(moved.x, abs=1e-10)
    by_differences, sizes = differences(plant, x0, np.zeros((steps, 2)), (0.0, 0.0), centre)
    assert_close(found.dx_dnumbers * sizes, by_differences, 1e-5)


def test_small_oscillations_in_closed_form(pair, centre):
    """About rest the motion is linear: m v' = -K dp - G dq - c v, and its derivatives are matrix exponentials."""
    robot, dt, steps = replace(pair, drag=0.5), 5e-4, 100
    m, c = robot.tip_mass, robot.drag

    def slope(mass):
        a = np.zeros((6, 6))
        a[:2, 2:4] = np.eye(2)
        a[2:4] = np.hstack([-centre.dforce_dp, -c * np.eye(2), -centre.dforce_dq]) / mass
        return a

    plant, time = Plant(robot, integrator="rk4", dt=dt), dt * steps
    found = sensitivities(plant, start_at(centre, (0, 0)), np.zeros((steps, 2)), guess=centre)
    assert_close(found.dx_dx0[-1:], expm(slope(m) * time)[None], 1e-8)
    # Tip mass and drag count where the tip moves, in proportion to how far.
    small = 1e-6 * np.array([0.3, -0.2])
    moving = sensitivities(plant, start_at(centre, small), np.zeros((steps, 2)), guess=centre)
    by_mass = -slope(m) / m
    by_mass[:2] = 0.0
    by_drag = np.zeros((6, 6))
    by_drag[2:4, 2:4] = -np.eye(2) / m
    start = np.concatenate([(0, 0), small, (0, 0)])
    for name, change in (("tip_mass", by_mass), ("drag", by_drag)):
        exact = expm_frechet(slope(m) * time, change * time, compute_expm=False) @ start
        mine = moving.dx_dnumbers[-1, :, moving.names.index(name)]
        assert mine == pytest.approx(exact, rel=1e-4, abs=1e-13)


@pytest.mark.parametrize("kind", PLAIN, ids=lambda kind: " ".join(kind.values()))
def test_symmetries(pair, centre, kind):
    """Units of mass do not matter, and neither does where the robot stands."""
    robot = replace(pair, gravity=(1.0, -9.81), drag=0.3)
    inputs, _ = motion()
    found = sensitivities(Plant(robot, weight="none", **kind), start_at(centre), inputs, guess=centre)
    column = dict(zip(found.names, np.moveaxis(found.dx_dnumbers, 2, 0), strict=True))
    with_mass = [name for name in found.names if name.endswith(("bending_stiffness", "line_density", "mass", "drag"))]
    scaled = sum(number_of(robot, name) * column[name] for name in with_mass)
    largest = max(np.abs(number_of(robot, name) * column[name]).max() for name in with_mass)
    assert largest > 1e-3
    assert np.abs(scaled).max() < 1e-9 * largest
    for axis, name in enumerate(("base_x", "base_y")):
        moved = found.dx_dx0[:, :, axis] + column[f"rods[0].{name}"] + column[f"rods[1].{name}"]
        assert moved == pytest.approx(np.broadcast_to(np.eye(6)[axis], moved.shape), abs=1e-8)


def test_limits_count_where_they_hold(pair, centre):
    """A motor at its limit of rate, and one that runs into its stop."""
    low = centre.q[1] - 0.0105  # within the eleventh step
    rods = pair.rods[0], replace(pair.rods[1], angle_limits=(low, 4.0))
    plant, dt = Plant(replace(pair, rods=rods, rate_limit=1.5), integrator="velocity_verlet"), 1e-3
    inputs = np.tile([2.0, -1.0], (STEPS, 1))
    found = sensitivities(plant, start_at(centre), inputs, guess=centre)
    column = dict(zip(found.names, np.moveaxis(found.dx_dnumbers, 2, 0), strict=True))
    ramp = dt * np.arange(STEPS + 1)
    assert column["rate_limit"][:, 4] == pytest.approx(ramp, abs=1e-12)
    assert column["rate_limit"][:, 5] == pytest.approx(0.0, abs=1e-12)
    reached = np.arange(STEPS + 1) >= 11
    assert column["rods[1].angle_lower"][:, 5] == pytest.approx(reached.astype(float), abs=1e-9)
    assert np.abs(column["rods[1].angle_lower"][:, :4]).max() > 1e-4
    for name in ("rods[0].angle_lower", "rods[0].angle_upper", "rods[1].angle_upper"):
        assert not column[name].any()
    # Where the motor stands at its stop, its own angle at the start no longer matters.
    assert found.dx_dx0[:, 5, 5] == pytest.approx((~reached).astype(float), abs=1e-9)


def test_what_is_returned(pair, centre):
    plant = Plant(pair, integrator="velocity_verlet", dt=2e-3)
    plant.reset(start_at(centre), centre)
    plant.carry(0.1, start_at(centre))
    found = sensitivities(plant, start_at(centre), np.zeros((3, 2)), guess=centre)
    assert plant.payload == 0.0
    assert found.t == pytest.approx([0.0, 0.002, 0.004, 0.006])
    assert found.dx_dx0.shape == (4, 6, 6)
    assert found.dx_dnumbers.shape == (4, 6, len(found.names))
    assert (found.dx_dx0[0] == np.eye(6)).all()
    assert not found.dx_dnumbers[0].any()
    assert not found.dx_dnumbers.flags.writeable


def test_what_cannot_be_differentiated_is_refused(pair, centre):
    x, inputs = start_at(centre), np.zeros((5, 2))
    for settings in ({"method": "single_shooting"}, {"inertia": "full", "integrator": "gauss"}):
        with pytest.raises(ValueError, match="no sensitivities"):
            sensitivities(Plant(pair, **settings), x, inputs)
    plant = Plant(pair)
    for arguments in ((np.stack([x] * 2), inputs), (x, np.zeros((2, 5, 2))), (x, inputs, np.zeros((2, 5, 2)))):
        with pytest.raises(ValueError, match="one robot"):
            sensitivities(plant, *arguments)
    with pytest.raises(ValueError, match="f_ext"):
        sensitivities(plant, x, inputs, np.zeros((4, 2)))
    with pytest.raises(UnreachableError) as caught:
        sensitivities(plant, x + [1.0, 0, 0, 0, 0, 0], inputs)
    assert caught.value.step == 0


def test_a_snap_has_no_derivative(pair, centre):
    """One motor is wound up with the tip under heavy drag, as in test_rollout."""
    rods = tuple(replace(rod, angle_limits=(-20.0, 20.0)) for rod in pair.rods)
    robot, inputs = replace(pair, drag=1e4, rods=rods), np.zeros((240, 2))
    inputs[:, 0] = 6.0
    for on_snap, message in (("raise", "would snap"), ("jump", "no derivative")):
        plant = Plant(robot, integrator="velocity_verlet", on_snap=on_snap, dt=5e-3)
        with pytest.raises(UnstableError, match=message) as caught:
            sensitivities(plant, start_at(centre, (0, 0)), inputs, guess=centre)
        error = caught.value
        assert 20 < error.step < 240
        assert error.state[4] - centre.q[0] == pytest.approx(0.03 * error.step)


def test_ways_of_another_shape_are_refused(pair, centre):
    plant = Plant(pair)
    with pytest.raises(ValueError, match=r"ways has shape \(3, 4\), expected \(3, 4, 1\)"):
        sensitivities(plant, start_at(centre), np.zeros((3, 2)), guess=centre, ways=np.zeros((3, 4)))
