"""The condensed inertia of the rods against shapes of the rods, Lagrange's equations and energies."""

from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest
from scipy.integrate import simpson

from pcr_mpc import ConvergenceError, Plant, inverse_statics, load_robot
from pcr_mpc.plant.motion.integrators import INTEGRATORS
from tests.conftest import MODELS

POINTS = 201
ORDERS = [("semi_implicit_euler", 1), ("velocity_verlet", 2), ("rk4", 4)]


def state(pose, velocity=(0.3, -0.2)):
    return np.concatenate([pose.p, velocity, pose.q])


def started(robot, pose, x, **settings):
    plant = Plant(robot, **{"inertia": "condensed", "integrator": "rk4", **settings})
    plant.reset(x, pose)
    return plant


def rollout(plant, x, seconds, u=(0.0, 0.0)):
    states = [x]
    for _ in range(round(seconds / plant.dt)):
        states.append(plant.step(states[-1], u))
    return np.array(states)


def kinetic_energy(plant, p, v, q, u):
    """T from two neighbouring shapes of the rods, in which nothing of the mass matrix is used."""
    h = 1e-5
    ahead, behind = (
        plant.equilibrium(np.concatenate([p + s * h * v, [0, 0], q + s * h * u])).shape(POINTS) for s in (1, -1)
    )
    density = (((ahead - behind) / (2 * h)) ** 2).sum(axis=2)
    s = np.linspace(0.0, 1.0, POINTS)
    of_rods = [r.line_density * r.length * simpson(d, x=s) for r, d in zip(plant.robot.rods, density, strict=True)]
    return (plant.robot.tip_mass * v @ v + sum(of_rods)) / 2


def test_mass_is_the_kinetic_energy_of_the_shapes(pair, poses):
    rng = np.random.default_rng(3)
    for pose in poses:
        plant = started(pair, pose, state(pose))
        for _ in range(3):
            w = rng.normal(size=4) * [0.3, 0.3, 2.0, 2.0]
            of_shapes = kinetic_energy(plant, pose.p, w[:2], pose.q, w[2:])
            of_tip = pair.tip_mass * w[:2] @ w[:2] / 2
            mass, _ = plant.mass(pose.p, pose.q)
            assert w @ mass @ w / 2 - of_tip == pytest.approx(of_shapes - of_tip, rel=1e-3)


def test_slopes_of_the_mass(pair, poses):
    h = 1e-5
    for pose in poses:
        plant = started(pair, pose, state(pose))
        _, slopes = plant.mass(pose.p, pose.q)
        differences = []
        for direction in np.eye(4):
            ahead, behind = (plant.mass(pose.p + s * direction[:2], pose.q + s * direction[2:])[0] for s in (h, -h))
            differences.append((ahead - behind).ravel(order="F") / (2 * h))
        assert slopes == pytest.approx(np.array(differences).T, abs=1e-8)


def test_three_rods_and_hands():
    robot = load_robot(MODELS / "three_rods.toml")
    for mode in ("LLL", "RRR"):
        pose = inverse_statics(robot, (0.0, 0.115), mode=mode)
        plant = started(robot, pose, state(pose))
        v, u = np.array([0.2, -0.1]), np.array([1.0, -0.5, 0.3])
        w = np.concatenate([v, u])
        mass, _ = plant.mass(pose.p, pose.q)
        assert w @ mass @ w / 2 == pytest.approx(kinetic_energy(plant, pose.p, v, pose.q, u), rel=1e-6)
        assert mass == pytest.approx(mass.T, abs=1e-15)


def test_lagrange(pair, centre):
    """Along a motion with turning motors d/dt dT/dv = dT/dp - F - c v, with T from the shapes of the rods."""
    heavy = replace(pair, rods=tuple(replace(rod, line_density=20 * rod.line_density) for rod in pair.rods))
    u, x = np.array([4.0, -3.0]), state(centre, (1.0, -0.8))
    plant = started(heavy, centre, x, dt=1e-3)
    states = rollout(plant, x, 0.05, u)

    def gradient(x, of_velocity):
        """DT/dv or DT/dp; T is quadratic in v."""
        step = 0.1 if of_velocity else 1e-3
        energies = []
        for change in step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]):
            p, v = x[:2], plant.tip_velocity(x, u)
            p, v = (p, v + change) if of_velocity else (p + change, v)
            energies.append(kinetic_energy(plant, p, v, x[4:], u))
        return np.array([energies[0] - energies[1], energies[2] - energies[3]]) / (2 * step)

    middle, gap = 25, 4
    plant.reset(states[middle - gap], centre)
    before, after = (gradient(states[middle + k], True) for k in (-gap, gap))
    x = states[middle]
    pull, force = gradient(x, False), plant.force(x[:2], x[4:])
    wanted = pull - force - heavy.drag * plant.tip_velocity(x, u)
    assert (after - before) / (2 * gap * plant.dt) == pytest.approx(wanted, abs=0.02 * np.linalg.norm(pull))


@pytest.mark.parametrize(("integrator", "order"), ORDERS)
def test_order(pair, centre, integrator, order):
    """With rods as heavy as the tip, moving fast, so that no term hides behind another."""
    x, u = state(centre, (1.0, -0.8)), (5.0, -4.0)
    heavy = replace(pair, rods=tuple(replace(rod, line_density=0.6) for rod in pair.rods))
    ends = [
        rollout(started(heavy, centre, x, integrator=integrator, dt=dt), x, 0.04, u)[-1] for dt in (2e-3, 1e-3, 5e-4)
    ]
    observed = np.log2(np.linalg.norm(ends[0] - ends[1]) / np.linalg.norm(ends[1] - ends[2]))
    assert observed == pytest.approx(order, abs=0.25)


@pytest.mark.parametrize(("integrator", "order"), [*ORDERS[:2], ("rk4", 5)])  # RK4 damps
def test_energy_is_kept_without_drag(pair, centre, integrator, order):
    robot = replace(pair, drag=0.0)
    changes = []
    for dt in (2e-3, 1e-3):
        plant = started(robot, centre, state(centre), integrator=integrator, dt=dt)
        states = rollout(plant, state(centre), 1.0)
        plant.reset(states[0], centre)
        energies = []
        for x in states[::10]:
            mass, _ = plant.mass(x[:2], x[4:])
            energies.append(plant.equilibrium(x).energy + x[2:4] @ mass[:2, :2] @ x[2:4] / 2)
        changes.append(np.abs(np.array(energies) / energies[0] - 1).max())
    assert np.log2(changes[0] / changes[1]) == pytest.approx(order, abs=0.4)
    assert changes[1] < {1: 1e-3, 2: 1e-5, 5: 1e-9}[order]


@pytest.mark.parametrize("integrator", sorted(INTEGRATORS))
def test_a_jump_of_the_rates_moves_the_tip_and_not_the_momentum(pair, centre, integrator):
    u, x = np.array([5.0, 4.0]), state(centre, (0.1, 0.0))
    plant = started(pair, centre, x, integrator=integrator, dt=1e-7)
    mass, _ = plant.mass(centre.p, centre.q)
    after = plant.step(x, u)
    assert after[2:4] == pytest.approx(x[2:4], abs=1e-6)
    moved = (after[:2] - x[:2]) / plant.dt
    assert mass[:2, :2] @ moved + mass[:2, 2:] @ u == pytest.approx(mass[:2, :2] @ x[2:4], abs=1e-6)
    assert moved == pytest.approx(plant.tip_velocity(x, u), abs=1e-6)
    assert np.linalg.norm(moved - x[2:4]) > 5e-4


def test_a_jump_is_the_limit_of_a_ramp(pair, centre):
    """Against p'' from Lagrange's equations with M_pq q'' in them, for rates that grow to u ever faster."""
    u, seconds, dt = np.array([5.0, 4.0]), 0.05, 2.5e-4
    plant = started(pair, centre, state(centre), dt=dt)

    def slope(y, q_dot, q_ddot):
        p, v, q = y[:2], y[2:4], y[4:]
        force, (mass, slopes) = plant.force_and_mass(p, q)
        w = np.concatenate([v, q_dot])
        change = (slopes @ w).reshape(4, 4, order="F")[:2] @ w
        pull = slopes[:, :2].T @ np.outer(w, w).ravel() / 2
        right = pull - change - force - mass[:2, 2:] @ q_ddot - pair.drag * v
        return np.concatenate([np.linalg.solve(mass[:2, :2], right), q_dot])

    def ramped(ramp):
        y, n = state(centre, (0.0, 0.0)), round(ramp / dt)
        plant.reset(y, centre)

        def f(y, part):  # of the ramp that has passed
            growing = part < 1.0
            return np.concatenate([y[2:4], slope(y, u * min(part, 1.0), u / ramp * growing)])

        # Of the same turn as with a jump: the ramp begins half its length earlier.
        for k in range(n + round((seconds - ramp / 2) / dt)):
            begin, middle, end = k / n, (k + 0.5) / n, min((k + 1) / n, 1.0 - 1e-12) if k < n else 1.0
            k1 = f(y, begin)
            k2 = f(y + dt / 2 * k1, middle)
            k3 = f(y + dt / 2 * k2, middle)
            y = y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + f(y + dt * k3, end))
        return y[:2]

    long, short = ramped(0.01), ramped(0.005)
    x = state(centre, (0.0, 0.0))
    plant.reset(x, centre)
    jump = rollout(plant, x, seconds, u)[-1][:2]
    light = rollout(started(pair, centre, x, dt=dt, inertia="none"), x, seconds, u)[-1][:2]
    assert (4 * short - long) / 3 == pytest.approx(jump, abs=2e-7)
    assert np.linalg.norm(jump - light) > 5e-6


def test_constant_is_the_mass_at_the_reset(pair, centre):
    plant = started(pair, centre, state(centre), inertia="constant")
    mass, slopes = plant.mass(centre.p, centre.q)
    assert mass == pytest.approx(started(pair, centre, state(centre)).mass(centre.p, centre.q)[0], abs=0)
    x = state(centre)
    for _ in range(50):
        x = plant.step(x, (1.0, 1.0))
    assert np.abs(x[4:] - centre.q) == pytest.approx(0.05, abs=1e-12)
    moved = started(pair, centre, x).mass(x[:2], x[4:])[0]
    assert np.abs(moved - mass).max() > 1e-3 * np.abs(mass[:2, 2:]).max()  # it would have changed
    assert (plant.mass(x[:2], x[4:])[0] == mass).all()
    assert not slopes.any()


@pytest.mark.parametrize("integrator", sorted(INTEGRATORS))
def test_weightless_rods_have_no_inertia(pair, centre, integrator):
    light = replace(pair, rods=tuple(replace(rod, line_density=0.0) for rod in pair.rods))
    x, u = state(centre), (0.8, -0.5)
    ends = [
        rollout(started(light, centre, x, inertia=inertia, integrator=integrator, dt=2e-3), x, 0.1, u)[-1]
        for inertia in ("none", "constant", "condensed")
    ]
    assert ends[1] == pytest.approx(ends[0], abs=1e-13)
    assert ends[2] == pytest.approx(ends[0], abs=1e-13)


def test_a_symmetric_robot_stays_symmetric(pair, centre):
    x = state(centre, (0.0, -0.3))
    states = rollout(started(pair, centre, x, dt=2e-3), x, 0.3, (1.0, -1.0))
    assert np.abs(states[:, [0, 2]]).max() < 1e-12
    assert states[:, 4] + states[:, 5] == pytest.approx(np.pi, abs=1e-12)


def test_bad_arguments_are_named(pair, centre):
    with pytest.raises(ValueError, match="inertia is 'some', expected one of none, constant, condensed"):
        Plant(pair, inertia="some")
    with pytest.raises(ValueError, match="needs method='closed_form' or 'multiple_shooting', not 'single_shooting'"):
        Plant(pair, inertia="condensed", method="single_shooting")


def test_inertia_that_is_not_finite_is_an_error(pair, centre, monkeypatch):
    plant = started(pair, centre, state(centre))
    graph = plant._rods._condensed._graph
    outputs = [graph.outputs[0], np.full_like(graph.outputs[1], np.nan)]
    monkeypatch.setattr(plant._rods._condensed, "_graph", MagicMock(inputs=graph.inputs, outputs=outputs))
    with pytest.raises(ConvergenceError, match="no finite derivative"):
        plant.mass(centre.p + 1e-3, centre.q)
