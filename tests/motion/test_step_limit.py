"""A step too long for the tip is named as what it is."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import PCRError, Plant, rollout
from pcr_mpc.plant.motion.step_limit import longest_step


def amplification(integrator, omega, g, dt):
    """Matrix of one step of x'' + g x' + omega^2 x = 0, by the scheme's own words."""

    def slope(y):
        return np.array([y[1], -(omega**2) * y[0] - g * y[1]])

    def euler(x, v):
        v = v + dt * (-(omega**2) * x - g * v)
        return x + dt * v, v

    def verlet(x, v):
        half = (v - dt / 2 * omega**2 * x) / (1 + dt / 2 * g)
        x = x + dt * half
        return x, half - dt / 2 * (omega**2 * x + g * half)

    def rk4(x, v):
        y = np.array([x, v])
        k1 = slope(y)
        k2 = slope(y + dt / 2 * k1)
        k3 = slope(y + dt / 2 * k2)
        return y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + slope(y + dt * k3))

    step = {"semi_implicit_euler": euler, "velocity_verlet": verlet, "rk4": rk4}[integrator]
    return np.column_stack([step(1.0, 0.0), step(0.0, 1.0)])


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "velocity_verlet", "rk4"])
@pytest.mark.parametrize("g", [0.1, 30.0, 150.0, 500.0])
def test_the_longest_step_is_where_the_scheme_becomes_unstable(integrator, g):
    """Against the eigenvalues of one step; RK4's figure is the least over all drags, 4 % below its largest."""
    omega, mass = 90.0, 0.2
    longest, found = longest_step(integrator, np.diag([mass * omega**2, 1.0]), mass * np.eye(2), mass * g)
    assert found == pytest.approx(omega)

    def growth(dt):
        return np.abs(np.linalg.eigvals(amplification(integrator, omega, g, dt))).max()

    assert growth(0.999 * longest) <= 1 + 1e-12
    assert growth((1.2 if integrator == "rk4" else 1.001) * longest) > 1


def test_soft_and_unstable_directions_do_not_count():
    assert longest_step("velocity_verlet", np.diag([-5.0, 0.0]), np.eye(2), 1.0) == (np.inf, 0.0)
    assert longest_step("gauss", np.diag([1e9, 1e9]), np.eye(2), 1.0)[0] == np.inf


def moved(plant, x, steps):
    for _ in range(steps):
        x = plant.step(x, (0.0, 0.0))
    return x


def light(pair, mass, **changes):
    return replace(pair, tip_mass=mass, **changes)


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "velocity_verlet", "rk4"])
def test_a_light_tip_names_the_step(pair, centre, integrator):
    """10 mg at 1 ms."""
    plant = Plant(light(pair, 1e-5, drag=0.0), integrator=integrator, dt=1e-3)
    x = np.concatenate([centre.p, [1e-3, 0.0], centre.q])
    omega = np.sqrt(np.linalg.eigvalsh(centre.dforce_dp)[-1] / 1e-5)
    assert omega * plant.dt > 2.9
    plant.reset(x, centre)
    with pytest.raises(
        PCRError, match=rf"a step of 0\.001 s is too long.*{integrator} is unstable; take dt below"
    ) as caught:
        moved(plant, x, 100)
    assert caught.value.state.shape == (6,)
    # What it advises is enough.
    dt = float(str(caught.value).split("take dt below ")[1].split(" s")[0])
    plant = Plant(plant.robot, integrator=integrator, dt=0.8 * dt)
    x = np.concatenate([centre.p, [1e-3, 0.0], centre.q])
    plant.reset(x, centre)
    x = moved(plant, x, 100)
    assert np.abs(x[:2] - centre.p).max() < 1e-4


def test_drag_on_a_light_tip_names_the_step(pair, centre):
    """omega dt = 1, but c dt/m = 5."""
    plant = Plant(light(pair, 1e-4, drag=0.5), dt=1e-3)
    x = np.concatenate([centre.p, [1e-3, 0.0], centre.q])
    plant.reset(x, centre)
    with pytest.raises(PCRError, match="too long for this tip"):
        moved(plant, x, 100)


def test_a_rollout_names_it_too(pair, centre):
    plant = Plant(light(pair, 1e-5), dt=1e-3)
    with pytest.raises(PCRError, match="too long for this tip"):
        rollout(plant, np.concatenate([centre.p, [1e-3, 0.0], centre.q]), np.zeros((100, 2)), guess=centre)


def test_a_tip_that_is_thrown_away_is_not_blamed_on_the_step(pair, centre):
    plant = Plant(pair, dt=1e-3)
    x = np.concatenate([centre.p, [0.0, 300.0], centre.q])
    plant.reset(x, centre)
    with pytest.raises(PCRError, match="move the tip at least") as caught:
        moved(plant, x, 3)
    assert "too long" not in str(caught.value)
