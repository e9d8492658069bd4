import numpy as np
import pytest
from scipy.linalg import expm

from pcr_mpc import ConvergenceError, PCRError, Plant, UnreachableError, inverse_statics, load_robot
from pcr_mpc.plant.motion.plant import INTEGRATORS
from tests.conftest import MODELS


def start(centre, velocity=(0.0, 0.0)):
    return np.concatenate([centre.p, velocity, centre.q])


def rollout(plant, centre, x, seconds, u=(0.0, 0.0), f_ext=(0.0, 0.0)):
    plant.reset(x, centre)
    states = [x]
    for _ in range(round(seconds / plant.dt)):
        states.append(plant.step(states[-1], u, f_ext))
    return np.array(states)


@pytest.mark.parametrize(("integrator", "order"), [("semi_implicit_euler", 1), ("velocity_verlet", 2), ("rk4", 4)])
def test_order(pair, centre, integrator, order):
    x = start(centre, (0.3, -0.2))
    ends = [
        rollout(Plant(pair, integrator=integrator, dt=dt), centre, x, 0.2, u=(0.8, -0.5))[-1]
        for dt in (4e-3, 2e-3, 1e-3)
    ]
    observed = np.log2(np.linalg.norm(ends[0] - ends[1]) / np.linalg.norm(ends[1] - ends[2]))
    assert observed == pytest.approx(order, abs=0.25)


@pytest.mark.parametrize("method", ["multiple_shooting", "single_shooting"])
def test_methods_move_alike(pair, centre, method):
    x = start(centre, (0.3, -0.2))
    exact = rollout(Plant(pair, integrator="velocity_verlet", dt=2e-3), centre, x, 0.1, u=(1.0, -1.0))
    other = rollout(Plant(pair, method=method, integrator="velocity_verlet", dt=2e-3), centre, x, 0.1, u=(1.0, -1.0))
    assert other == pytest.approx(exact, abs=2e-6)


def test_energy_is_kept_without_drag(pair, centre):
    from dataclasses import replace

    robot = replace(pair, drag=0.0)
    plant = Plant(robot, integrator="velocity_verlet", dt=1e-3)
    states = rollout(plant, centre, start(centre, (0.3, -0.2)), 1.0)

    def energy(x):
        return plant.equilibrium(x).energy + robot.tip_mass / 2 * (x[2] ** 2 + x[3] ** 2)

    plant.reset(states[0], centre)
    energies = np.array([energy(x) for x in states[::5]])
    kinetic = robot.tip_mass / 2 * (0.3**2 + 0.2**2)
    assert np.abs(energies - energies[0]).max() < 1e-3 * kinetic
    # Bounded, not growing: the second half is no worse than the first.
    half = len(energies) // 2
    assert np.abs(energies[half:] - energies[0]).max() < 2 * np.abs(energies[:half] - energies[0]).max()


def test_power_of_drag_and_motors_balances_the_energy(pair, centre):
    """d/dt (U + T) = tau . u - c |v|^2 + f_ext . v, the sign of every term."""
    plant = Plant(pair, integrator="rk4", dt=5e-4)
    u, f_ext = np.array([0.8, -0.4]), np.array([0.2, -0.3])
    states = rollout(plant, centre, start(centre, (0.3, -0.2)), 0.1, u=u, f_ext=f_ext)
    plant.reset(states[0], centre)
    poses = [plant.equilibrium(x) for x in states]
    v = states[:, 2:4]
    power = [eq.motor_torque @ u for eq in poses] - pair.drag * (v**2).sum(axis=1) + v @ f_ext
    done = np.trapezoid(power, dx=plant.dt)
    gained = poses[-1].energy - poses[0].energy + pair.tip_mass / 2 * ((v[-1] ** 2).sum() - (v[0] ** 2).sum())
    assert gained == pytest.approx(done, rel=1e-5)


def test_released_tip_returns(pair, centre):
    """With the sign of eq. (13) as printed it would run away."""
    x = start(centre)
    x[:2] += [0.02, -0.01]
    plant = Plant(pair, integrator="velocity_verlet", dt=2e-3)
    states = rollout(plant, centre, x, 12.0)
    distance = np.linalg.norm(states[:, :2] - centre.p, axis=1)
    assert distance.max() < 0.03
    assert distance[-500:].max() < 1e-3


def test_small_swings_have_the_frequency_of_k(pair, centre):
    """omega^2 = eigenvalues of K over m; here K is diagonal."""
    x = start(centre, (1e-3, 0.0))
    plant = Plant(pair, integrator="rk4", dt=1e-3)
    swing = rollout(plant, centre, x, 1.0)[:, 0]
    crossings = np.flatnonzero(np.sign(swing[1:]) != np.sign(swing[:-1]))
    times = crossings - swing[crossings] / (swing[crossings + 1] - swing[crossings])
    period = 2 * np.mean(np.diff(times[1:])) * plant.dt
    damping = pair.drag / (2 * pair.tip_mass)
    omega = np.sqrt(centre.dforce_dp[0, 0] / pair.tip_mass - damping**2)
    assert 2 * np.pi / period == pytest.approx(omega, rel=1e-3)


def test_motors_saturate(pair, centre):
    plant = Plant(pair, dt=1e-3)
    x = start(centre)
    plant.reset(x, centre)
    assert plant.step(x, (100.0, -100.0))[4:] == pytest.approx(centre.q + [6e-3, -6e-3])
    stop = pair.angle_limits[1, 1]
    x[5] = stop - 1e-3
    plant.reset(x)
    assert plant.step(x, (0.0, 6.0))[5] == stop


@pytest.mark.parametrize("integrator", sorted(INTEGRATORS))
def test_a_tip_that_flies_out_of_reach_is_an_error_with_its_state(pair, centre, integrator):
    plant = Plant(pair, integrator=integrator, dt=1e-3)
    x = start(centre, (0.0, 300.0))
    plant.reset(x, centre)
    x_kept = x.copy()
    with pytest.raises(UnreachableError) as caught:
        plant.step(plant.step(x, (0.0, 0.0)), (0.0, 0.0))
    assert caught.value.state[4:] == pytest.approx(centre.q)
    assert (x == x_kept).all()


def test_a_failed_step_leaves_the_branch_as_it_was(pair, centre):
    plant = Plant(pair, integrator="velocity_verlet", dt=1e-3)
    x = start(centre)
    plant.reset(x, centre)
    fresh = plant.step(x, (0.5, 0.5))
    plant.reset(x, centre)
    with pytest.raises(PCRError):
        plant.step(start(centre, (0.0, 500.0)), (0.0, 0.0))
    assert plant.step(x, (0.5, 0.5)) == pytest.approx(fresh, abs=1e-9)


def test_large_steps_stay_on_the_branch(pair, centre):
    """Continuation carries the rods over a move that Newton's method alone would not."""
    plant = Plant(pair, dt=1e-3)
    plant.reset(start(centre), centre)
    far = np.array([0.05, 0.15])
    force = plant.force(far, centre.q)
    assert plant.equilibrium(np.concatenate([far, [0, 0], centre.q])).mode == "LR"
    assert plant.force(centre.p, centre.q) == pytest.approx([0, 0], abs=1e-8)
    assert plant.force(far, centre.q) == pytest.approx(force, abs=1e-8)


def test_too_coarse_a_discretisation_is_refused(pair, centre):
    plant = Plant(pair, method="multiple_shooting", segments=2, steps=1, scheme="rk4")
    with pytest.raises(ConvergenceError, match="too taut for this discretisation"):
        plant.reset(start(centre), centre)


def test_a_motor_beyond_its_stop_comes_back_at_its_rate(pair, centre):
    plant = Plant(pair, dt=1e-3)
    x = start(centre)
    x[5] = pair.angle_limits[1, 1] + 0.1
    plant.reset(x)
    assert plant.step(x, (0.0, 0.0))[5] == pytest.approx(x[5] - 6e-3)


def test_forces_are_read_only(pair, centre):
    plant = Plant(pair)
    plant.reset(start(centre), centre)
    with pytest.raises(ValueError, match="read-only"):
        plant.force(centre.p, centre.q)[0] = 1.0


def test_bad_arguments_are_named(pair, centre):
    plant = Plant(pair)
    with pytest.raises(RuntimeError, match="reset"):
        plant.step(start(centre), (0.0, 0.0))
    plant.reset(start(centre), centre)
    with pytest.raises(ValueError, match=r"x has shape \(5,\), expected \(6,\)"):
        plant.step(np.zeros(5), (0.0, 0.0))
    with pytest.raises(ValueError, match="u is not finite"):
        plant.step(start(centre), (0.0, np.nan))
    with pytest.raises(ValueError, match="integrator is 'euler'"):
        Plant(pair, integrator="euler")
    with pytest.raises(ValueError, match=r"dt is 0\.0 s"):
        Plant(pair, dt=0.0)
    with pytest.raises(ValueError, match="method is 'magic'"):
        Plant(pair, method="magic")


def test_three_rods_move():
    """Against the linear equation m dp'' + c dp' = -K dp - G dq, whose K and G other tests hold to differences of F."""
    robot = load_robot(MODELS / "three_rods.toml")
    pose = inverse_statics(robot, (0.0, 0.115), mode="LLL")
    plant = Plant(robot, integrator="rk4", dt=1e-3)
    u, seconds = np.array([0.01, 0.0, -0.02]), 0.05
    x = np.concatenate([pose.p, [5e-3, -2e-3], pose.q])
    plant.reset(x, pose)
    rates = np.zeros((7, 7))
    rates[:2, 2:4] = np.eye(2)
    rates[2:4] = np.hstack([-pose.dforce_dp, -robot.drag * np.eye(2), -pose.dforce_dq]) / robot.tip_mass
    # Motors turn at u: q = q0 + u t, as a state of its own.
    whole = np.block([[rates, np.vstack([np.zeros((4, 3)), np.eye(3)])], [np.zeros((3, 10))]])
    moved = (expm(seconds * whole) @ np.concatenate([[0.0, 0.0], x[2:4], np.zeros(3), u]))[:7]
    for _ in range(round(seconds / plant.dt)):
        x = plant.step(x, u)
    assert x[4:] == pytest.approx(pose.q + seconds * u, abs=1e-12)
    assert np.abs(moved[:2]).max() > 5e-5
    assert x[:2] - pose.p == pytest.approx(moved[:2], abs=0.02 * np.abs(moved[:2]).max())
    assert x[2:4] == pytest.approx(moved[2:4], abs=0.02 * np.abs(moved[2:4]).max())
