"""A robot's numbers: one table, one order, and graphs that serve all robots of a kind."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from pcr_mpc import (
    ConvergenceError,
    ModelError,
    Plant,
    UnreachableError,
    UnstableError,
    inverse_statics,
    load_robot,
    rollout,
    solve_statics,
)
from pcr_mpc.plant.rods.equations import Layout
from pcr_mpc.plant.rods.numbers import Kind
from tests.conftest import MODELS

from .numbers_of import number_of, with_number

OF_ROD = {"bending_stiffness": "N m^2", "length": "m", "base_x": "m", "base_y": "m", "line_density": "kg/m",
          "angle_lower": "rad", "angle_upper": "rad"}  # fmt: skip
OF_ROBOT = {"tip_mass": "kg", "drag": "N s/m", "gravity_x": "m/s^2", "gravity_y": "m/s^2", "rate_limit": "rad/s"}
KNOTTED = Kind(2, Layout(intervals=2, varying=True, stretching=True))


@pytest.mark.parametrize(
    ("kind", "more"),
    [
        (Kind(2), {}),
        (Kind(3), {}),
        (Kind(2, Layout(0, False, False)), {"curvature[0]": "1/m"}),
        (Kind(2, Layout(0, False, True)), {"axial_compliance": "1/N", "curvature[0]": "1/m"}),
        (
            Kind(2, Layout(1, True, False)),
            {"curvature[0]": "1/m", "curvature[1]": "1/m", "stiffness_factors[0]": "-", "stiffness_factors[1]": "-"},
        ),
    ],
    ids=["two rods", "three rods", "curved", "stretching", "varying"],
)
def test_names_and_units(kind, more):
    of_rods = {f"rods[{i}].{name}": unit for i in range(kind.n_rods) for name, unit in (OF_ROD | more).items()}
    assert list(kind.units.items()) == list((of_rods | OF_ROBOT).items())
    assert kind.names == tuple(kind.units)
    assert kind.size == len(kind.names)
    # The table of the documentation has them all.
    for name in OF_ROD | more | OF_ROBOT:
        stem = name.split("[")[0]
        assert stem in Kind.__doc__, name


@pytest.mark.parametrize("which", ["pair", "knotted"])
def test_every_number_has_one_place(pair, knotted, which):
    robot, kind = (pair, Kind(2)) if which == "pair" else (knotted, KNOTTED)
    packed = kind.pack(robot)
    for i, name in enumerate(kind.names):
        assert packed[i] == pytest.approx(number_of(robot, name), rel=1e-15), name
        other = kind.pack(with_number(robot, name, 1.01 * packed[i] + 0.0007))
        assert np.flatnonzero(other != packed).tolist() == [i], name
        assert other[i] == pytest.approx(1.01 * packed[i] + 0.0007, rel=1e-12)


def test_what_is_packed_is_unpacked(knotted):
    """The rods' own units by their definitions."""
    vector = ca.SX.sym("numbers", KNOTTED.size)
    numbers = KNOTTED.unpack(vector)

    def value(expression):
        return ca.Function("value", [vector], [expression])(KNOTTED.pack(knotted)).full().ravel()

    for rod, true in zip(numbers.rods, knotted.rods, strict=True):
        ei, length = true.bending_stiffness, true.length
        assert value(ca.vertcat(rod.bending_stiffness, rod.length, rod.base, rod.line_density)).tolist() == [
            ei, length, *true.base, true.line_density]  # fmt: skip
        weight = true.line_density * length**3 / ei * np.array(knotted.gravity)
        stretch = ei / length**2 / true.axial_stiffness
        physics = [*weight, stretch, *(length * np.array(true.curvature)), *true.stiffness_factors]
        assert value(rod.physics[0]) == pytest.approx(physics, rel=1e-14)
    assert value(numbers.angle_lower).tolist() == knotted.angle_limits[:, 0].tolist()
    assert value(numbers.angle_upper).tolist() == knotted.angle_limits[:, 1].tolist()
    of_robot = ca.vertcat(numbers.tip_mass, numbers.drag, numbers.gravity, numbers.rate_limit)
    assert value(of_robot).tolist() == [knotted.tip_mass, knotted.drag, *knotted.gravity, knotted.rate_limit]
    light = ca.Function("light", [vector], [KNOTTED.weightless(vector)])(KNOTTED.pack(knotted)).full().ravel()
    assert (light == KNOTTED.pack(knotted.weightless())).all()


def test_a_robot_of_another_kind_is_refused_by_name(pair, knotted):
    for kind, robot in ((Kind(3), pair), (Kind(2), knotted), (Kind(2, Layout(0, False, False)), knotted)):
        with pytest.raises(ValueError, match=f"^{robot.name} has 2 rods .*, expected {kind.n_rods} of"):
            kind.pack(robot)


@pytest.fixture
def built(monkeypatch):
    """Names of the graphs that are made from now on."""
    names, make = [], ca.Function.__init__

    def counting(self, *args):
        names.append(args[0] if args else "")
        make(self, *args)

    monkeypatch.setattr(ca.Function, "__init__", counting)
    return names


@pytest.mark.parametrize("inertia", ["none", "constant", "condensed"])
def test_a_payload_and_another_robot_build_no_graph(pair, centre, built, inertia):
    x, u = np.concatenate([centre.p, (0.1, -0.1), centre.q]), (1.0, -2.0)
    plant = Plant(pair, integrator="velocity_verlet", inertia=inertia, dt=0.93e-3)
    plant.reset(x, centre)
    x = plant.step(x, u)
    assert "step" in built  # what is counted
    built.clear()
    before = plant.step(x, u)
    after = x = plant.carry(0.05, before)
    states = [x := plant.step(x, u) for _ in range(5)]
    x = plant.carry(0.0, x)
    plant.step(x, u)
    assert built == []
    other = plant.of(replace(pair, tip_mass=0.3, drag=0.1, rods=(replace(pair.rods[0], length=0.41), pair.rods[1])))
    other.reset(x, centre)
    other.step(x, u)
    assert built == []
    # And it counts: the tip with its payload moves as one that is heavier from the start. (The constant mass matrix is
    # that of the pose at the reset.)
    heavy = replace(pair, tip_mass=pair.tip_mass + 0.05)
    heavier, x = Plant(heavy, integrator="velocity_verlet", inertia=inertia, dt=0.93e-3), after
    heavier.reset(x, centre)
    for state in states:
        x = heavier.step(x, u)
        assert state == pytest.approx(x, abs=1e-6 if inertia == "constant" else 1e-11)


def spread(robot, count, seed=2):
    """Robots that differ in every number that moves them."""
    rng = np.random.default_rng(seed)

    def off(value, size=0.03):
        return value * (1.0 + size * rng.uniform(-1.0, 1.0))

    found = []
    for i in range(count):
        rods = tuple(
            replace(
                rod,
                base=(rod.base[0] + rng.uniform(-2e-3, 2e-3), rod.base[1] + rng.uniform(-2e-3, 2e-3)),
                length=off(rod.length, 0.01),
                bending_stiffness=off(rod.bending_stiffness),
                line_density=off(rod.line_density),
                curvature=tuple(off(value) for value in rod.curvatures),
                stiffness_factors=tuple(off(value) if value != 1.0 else 1.0 for value in rod.stiffness_factors),
                axial_stiffness=off(rod.axial_stiffness),
                angle_limits=(off(rod.angle_limits[0]), off(rod.angle_limits[1])),
            )
            for rod in robot.rods
        )
        found.append(
            replace(
                robot,
                name=f"sample_{i}",
                rods=rods,
                tip_mass=off(robot.tip_mass, 0.2),
                drag=off(robot.drag, 0.5),
                gravity=tuple(off(g) for g in robot.gravity),
                rate_limit=off(robot.rate_limit, 0.2),
            )
        )
    return found


def own_steps(plant, x, inputs, f_ext, guess):
    """Motion of a robot by its own plant, step by step."""
    plant.reset(x, guess)
    states = [x]
    for u, f in zip(inputs, f_ext, strict=True):
        states.append(plant.step(states[-1], u, f))
    return np.array(states)


CASES = {
    "euler": ("planar_pair", {}),
    "rk4, constant": ("planar_pair", {"integrator": "rk4", "inertia": "constant"}),
    "condensed inertia": ("planar_pair", {"integrator": "velocity_verlet", "inertia": "condensed"}),
    "condensed weight and inertia": (
        "heavy_pair",
        {"integrator": "velocity_verlet", "inertia": "condensed", "method": "closed_form"},
    ),
    "tip weight": ("heavy_pair", {"weight": "none", "integrator": "velocity_verlet"}),
    "exact weight": ("heavy_pair", {"integrator": "velocity_verlet"}),
    "curved": ("curved_pair", {"integrator": "velocity_verlet"}),
    "curved, condensed inertia": ("curved_pair", {"integrator": "semi_implicit_euler", "inertia": "condensed"}),
    "three rods": ("three_rods", {"weight": "none", "integrator": "velocity_verlet", "inertia": "condensed"}),
}


@pytest.mark.parametrize(("case", "threads"), [*((case, 1) for case in CASES), ("condensed inertia", 2)])
def test_different_robots_move_as_by_their_own_plants(case, threads):
    file, settings = CASES[case]
    robot = load_robot(MODELS / f"{file}.toml")
    pose = solve_statics(robot, (0.02, 0.24), inverse_statics(robot.weightless().plain(), (0.02, 0.24)).q)
    count, steps, n = 4, 25, robot.n_rods
    rng = np.random.default_rng(1)
    robots = spread(robot, count)
    x0 = np.concatenate([pose.p, (0.3, -0.2), pose.q])
    inputs, f_ext = rng.uniform(-8.0, 8.0, (count, steps, n)), rng.normal(0.0, 1.0, (count, steps, 2))
    # Not to be had from a plant of the same settings that is not of this robot.
    plant = Plant(robot, **settings)
    result = rollout(plant, x0, inputs, f_ext, guess=pose, robots=robots, threads=threads)
    for i, one in enumerate(robots):
        own = own_steps(Plant(one, **settings), x0, inputs[i], f_ext[i], pose)
        assert result.x[i] == pytest.approx(own, abs=1e-10)
        others = [result.x[j] for j in range(count) if j != i]
        assert min(np.abs(own - other).max() for other in others) > 1e-4
    # One start, one sequence and one force for all; one robot keeps its axis.
    alike = rollout(plant, x0, inputs[0], f_ext[0], guess=pose, robots=robots[:2], threads=threads)
    assert alike.x[0] == pytest.approx(result.x[0], abs=1e-10)
    assert np.abs(alike.x[1] - result.x[1]).max() > 1e-4
    assert rollout(plant, x0, inputs[0], f_ext[0], guess=pose, robots=robots[:1]).x.shape == (1, steps + 1, 4 + n)


def test_steps_take_over_for_the_robot_that_needs_the_ladder(pair, centre):
    """A light tip, fast by long steps, between two that two iterations bring along."""
    light = replace(pair, name="light", tip_mass=0.02, drag=0.05)
    robots, x = [pair, light, replace(pair, drag=0.4)], np.concatenate([centre.p, (0.3, -0.2), centre.q])
    x0 = np.stack([x, x + [0, 0, 2.0, -3.0, 0, 0], x])
    settings = {"integrator": "velocity_verlet", "dt": 3e-3}
    result = rollout(Plant(pair, **settings), x0, np.zeros((20, 2)), guess=centre, robots=robots)
    assert result.stepped == (1,)
    for i, robot in enumerate(robots):
        own = own_steps(Plant(robot, **settings), x0[i], np.zeros((20, 2)), np.zeros((20, 2)), centre)
        assert result.x[i] == pytest.approx(own, abs=1e-10)
    assert result.residual.max() < 1e-10


def test_payloads_are_left_behind(pair, centre):
    x, plant = np.concatenate([centre.p, (0.3, -0.2), centre.q]), Plant(pair)
    fresh = rollout(plant, x, np.zeros((5, 2)), guess=centre).x
    plant.reset(x, centre)
    plant.carry(0.2, x)
    assert (rollout(plant, x, np.zeros((5, 2)), guess=centre, robots=[pair, pair]).x == fresh).all()


def test_rollouts_refuse_robots_of_another_kind_by_name(pair, centre):
    x, inputs = np.concatenate([centre.p, (0.0, 0.0), centre.q]), np.zeros((3, 2))
    three = replace(load_robot(MODELS / "three_rods.toml"), name="three")
    curved = replace(load_robot(MODELS / "curved_pair.toml"), name="curved")
    heavy = replace(load_robot(MODELS / "heavy_pair.toml"), name="heavy")
    for other in (three, curved, heavy):
        with pytest.raises(ValueError, match=rf"robots\[1\] \({other.name}\) is of another kind than {pair.name}"):
            rollout(Plant(pair), x, inputs, guess=centre, robots=[pair, other])
        own = np.zeros(4 + other.n_rods)
        with pytest.raises(ValueError, match=rf"robots\[1\] \({pair.name}\) is of another kind than {other.name}"):
            rollout(Plant(other), own, np.zeros((3, other.n_rods)), robots=[other, pair])
    with pytest.raises(ModelError, match="curved"):
        rollout(Plant(pair, method="closed_form"), x, inputs, guess=centre, robots=[pair, curved])
    with pytest.raises(ValueError, match="at least one step and one robot"):
        rollout(Plant(pair), x, inputs, robots=[])
    with pytest.raises(TypeError, match=r"robots\[1\] is a str"):
        rollout(Plant(pair), x, inputs, robots=[pair, "planar_pair"])
    with pytest.raises(ValueError, match=r"x0 has shape \(3, 6\), expected \(2, 6\)"):
        rollout(Plant(pair), np.stack([x] * 3), inputs, robots=[pair, pair])


def test_errors_name_the_robot(pair, centre):
    x, inputs = np.concatenate([centre.p, (0.0, 0.0), centre.q]), np.zeros((1200, 2))
    short = replace(pair, name="short", rods=tuple(replace(rod, length=0.2) for rod in pair.rods))
    with pytest.raises(UnreachableError) as caught:
        rollout(Plant(pair), x, inputs[:5], guess=centre, robots=[pair, pair, short])
    error = caught.value
    assert (error.robot, error.step) == (2, 0)
    assert (error.state == x).all()
    assert "robot 2 (short), step 0" in error.__notes__[0]

    # Wound up under heavy drag, the rod of the second robot folds (see test_rollout).
    rods = tuple(replace(rod, angle_limits=(-20.0, 20.0)) for rod in pair.rods)
    stiff, weak = (replace(pair, name=name, drag=1e4, rods=rods, rate_limit=limit)
                   for name, limit in (("slow", 0.1), ("fast", 6.0)))  # fmt: skip
    inputs[:, 0] = 6.0
    with pytest.raises((UnstableError, ConvergenceError)) as caught:
        rollout(Plant(stiff, integrator="velocity_verlet"), x, inputs, guess=centre, robots=[stiff, weak])
    error = caught.value
    assert error.robot == 1
    assert error.state[4] - centre.q[0] == pytest.approx(6e-3 * error.step)
    assert "(fast)" in error.__notes__[0]
