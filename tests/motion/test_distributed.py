"""Rods of distributed mass: beams, statics, energies, and the condensed inertia in the limit of light rods."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh, null_space
from scipy.optimize import brentq

from pcr_mpc import ConvergenceError, ModelError, Plant, inverse_statics, load_robot, solve_statics
from pcr_mpc.plant.motion.distributed import DistributedRods
from pcr_mpc.plant.rods.equations import sample_rod
from pcr_mpc.plant.rods.strain_modes import StrainModes
from tests.conftest import MODELS

from .test_inertia import rollout, state


def heavier(robot, times):
    return replace(robot, rods=tuple(replace(rod, line_density=times * rod.line_density) for rod in robot.rods))


def released(robot, pose, velocity=(0.3, -0.2), u=(0.0, 0.0), seconds=0.2, **settings):
    """States from the pose on, at rest but for the tip."""
    settings = {"inertia": "full", "integrator": "gauss", "dt": 2e-3, **settings}
    plant, x = Plant(robot, **settings), state(pose, velocity)
    plant.reset(x, pose)
    return rollout(plant, x, seconds, u)


def distance(states, others):
    """Largest distance of the tips [mm]."""
    return 1e3 * np.linalg.norm((states - others)[:, :2], axis=1).max()


def test_frequencies_of_beams(pair):
    """Straight beams, in sqrt(EI / mu L^4): clamped and free (3.516, 22.03, ...), clamped and pinned (15.418, ...)."""
    free = [brentq(lambda x: np.cos(x) + 1 / np.cosh(x), i * np.pi, (i + 1) * np.pi) ** 2 for i in range(3)]
    pinned = [
        brentq(lambda x: np.sin(x) - np.cos(x) * np.tanh(x), i * np.pi, (i + 0.5) * np.pi) ** 2 for i in (1, 2, 3)
    ]
    assert [free[0], pinned[0]] == pytest.approx([3.516, 15.418], abs=5e-4)
    modes = StrainModes(pair, 12)
    straight = modes.angles(np.zeros((2, 12)), np.zeros(2))
    blocks = modes.blocks(straight, 0 * straight, 0 * straight, np.zeros((2, 2)))
    for shapes, expected in ((np.eye(12), free), (null_space(blocks.jacobian[0, 1:]), pinned)):
        stiffness, mass = (shapes.T @ matrix[0] @ shapes for matrix in (blocks.stiffness, blocks.mass / modes.beta[0]))
        frequencies = np.sqrt(eigh(stiffness, mass, eigvals_only=True)[:3])
        assert frequencies == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("which", ["pair", "inextensible"])
def test_blocks_against_differences(which, request):
    """Of bent rods in motion."""
    rng, modes, n_modes = np.random.default_rng(5), StrainModes(request.getfixturevalue(which), 6), 6
    q, u, tip_forces = rng.normal(size=2), rng.normal(size=2), rng.normal(size=(2, 2))
    motion = rng.normal(size=(3, 2, n_modes))

    def angles(motion):
        return modes.angles(motion[0], q), modes.turned(motion[1], u), modes.turned(motion[2], 0 * q)

    def forces(motion):
        on_modes, tips = modes.forces(*angles(motion), tip_forces)
        return np.concatenate([on_modes + modes.elastic_moments(motion[0]), tips], axis=1)

    blocks = modes.blocks(*angles(motion), tip_forces)
    wanted = (
        (blocks.stiffness, blocks.tip_stiffness),
        (blocks.damping, blocks.tip_damping),
        (blocks.mass, blocks.jacobian),
    )
    for order, (of_modes, of_tips) in enumerate(wanted):
        for j in range(n_modes):
            step = np.zeros_like(motion)
            step[order, :, j] = 1e-5
            slope = (forces(motion + step) - forces(motion - step)) / 2e-5
            assert of_modes[:, :, j] == pytest.approx(slope[:, :n_modes], abs=1e-8)
            assert of_tips[:, :, j] == pytest.approx(slope[:, n_modes:], abs=1e-8)


def test_rods_at_rest_are_the_closed_form(pair, poses):
    """Energy, angle at the tip and force at the pin; errors fall by orders of magnitude with every four modes."""
    still = np.zeros(2)
    for pose in poses:
        errors = []
        for n_modes in (6, 10, 14):
            rods = DistributedRods(pair, n_modes)
            settled = rods.settled(pose.p, still, pose.q, pose.nodes)
            # The integrals of all modes but the first vanish at the tip.
            angles = pose.q + settled.a[:, 0]
            # Held by F, it stays where it is.
            held = rods.step(settled, still, pose.force, 1e-3)
            errors.append(
                [
                    abs(rods.energy(settled) / pose.energy - 1),
                    np.abs(angles - [sample_rod(nodes, 2)[2, -1] for nodes in pose.nodes]).max(),
                    pair.tip_mass * np.linalg.norm(held.v) / 1e-3,
                ]
            )
        errors = np.array(errors)
        assert (errors[1] < 0.03 * errors[0]).all()
        assert (errors[2] < [1e-9, 1e-6, 1e-4]).all()


def test_rods_at_rest_are_those_of_multiple_shooting(inextensible):
    """As above, with weight, and with knots in their curvature and stiffness."""
    still, errors = np.zeros(2), []
    pose = solve_statics(inextensible, (0.01, 0.24), (3.2, 0.1), segments=16, steps=2)
    for n_modes in (6, 10, 14):
        rods = DistributedRods(inextensible, n_modes)
        settled = rods.settled(pose.p, still, pose.q, pose.nodes)
        held = rods.step(settled, still, pose.force, 1e-3)
        accelerated = inextensible.tip_mass * np.linalg.norm(held.v) / 1e-3
        errors.append([abs(rods.energy(settled) / pose.energy - 1), accelerated])
    errors = np.array(errors)
    assert (errors[1] < 0.01 * errors[0]).all()
    assert (errors[2] < [1e-10, 1e-8]).all()


def test_modes_converge(pair, centre):
    reference = released(pair, centre, modes=14)
    errors = [distance(released(pair, centre, modes=n_modes), reference) for n_modes in (6, 8, 10)]
    assert errors[0] < 0.02
    assert errors[1] < 0.2 * errors[0]
    assert errors[2] < 0.05 * errors[1]


def test_time_steps_converge(pair, centre):
    """In the fourth order where they resolve the fastest mode; long before, the tip is right to a nanometre."""
    ends = [released(pair, centre, modes=8, dt=dt)[-1] for dt in (1e-3, 5e-4)]
    assert np.linalg.norm((ends[0] - ends[1])[:2]) < 1e-9
    ends = [released(pair, centre, modes=4, dt=dt, seconds=0.01)[-1] for dt in (4e-4, 2e-4, 1e-4)]
    observed = np.log2(np.linalg.norm(ends[0] - ends[1]) / np.linalg.norm(ends[1] - ends[2]))
    assert observed == pytest.approx(4.0, abs=0.3)


def test_energy(pair, centre):
    """Without drag it stays; with it, it falls by what the drag takes."""
    for drag in (0.0, 0.2):
        rods = DistributedRods(replace(heavier(pair, 10.0), drag=drag), 8)
        motion = [rods.settled(centre.p, np.array([0.3, -0.2]), centre.q, centre.nodes)]
        for _ in range(200):
            motion.append(rods.step(motion[-1], np.zeros(2), np.zeros(2), 1e-3))
        energies = np.array([rods.energy(at) for at in motion])
        lost = np.trapezoid([drag * at.v @ at.v for at in motion], dx=1e-3)
        assert energies[0] - energies[-1] == pytest.approx(lost, rel=1e-3, abs=1e-9 * energies[0])


def test_the_pin_holds(pair, centre):
    """Tips and their velocities, in a motion so violent and steps so long that the stages alone lose them."""
    rods, dt = DistributedRods(heavier(pair, 10.0), 8), 4e-3
    at = rods.settled(centre.p, np.array([1.0, -0.8]), centre.q, centre.nodes)
    for _ in range(20):
        at = rods.step(at, np.array([3.0, 2.0]), np.zeros(2), dt)
        ends = pair.bases + pair.lengths[:, None] * rods.modes.tips(at.a, at.q)
        assert ends == pytest.approx(np.stack([at.p] * 2), abs=1e-12)
        velocities = pair.lengths[:, None] * rods.modes.tip_velocities(at.a, at.a_dot, at.q, at.u)
        assert velocities == pytest.approx(np.stack([at.v] * 2), abs=1e-12)


def test_energy_with_weight(inextensible):
    """Of rods and tip; their height counts."""
    robot = replace(inextensible, drag=0.0)
    pose = solve_statics(robot, (0.01, 0.24), (3.2, 0.1))
    rods = DistributedRods(robot, 8)
    motion = [rods.settled(pose.p, np.array([0.3, -0.2]), pose.q, pose.nodes)]
    for _ in range(100):
        motion.append(rods.step(motion[-1], np.zeros(2), robot.tip_weight, 1e-3))
    heights = np.array([-robot.tip_weight @ at.p for at in motion])
    assert np.ptp(heights + [rods.energy(at) for at in motion]) < 1e-10
    assert np.ptp(heights) > 1e-3


@pytest.mark.parametrize("u", [(0.0, 0.0), (1.0, -0.5)])
def test_heavy_rods_that_sag(heavy, sagging, u):
    """Whose weight makes no difference to the impulse of motors that jump."""
    reference = released(heavy, sagging, u=u)
    errors = {
        inertia: distance(released(heavy, sagging, u=u, inertia=inertia, integrator="rk4"), reference)
        for inertia in ("none", "constant", "condensed")
    }
    assert errors["condensed"] < 0.06
    assert errors["condensed"] < 0.6 * errors["constant"]
    assert errors["none"] > 5.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "gravity", "none", "constant", "condensed"),
    [
        ("heavy_pair", -9.81, 20.0, 2.5, 0.1),
        ("planar_pair", -9.81, 2.0, 0.4, 0.002),
        ("curved_pair", 0.0, 2.0, 0.4, 0.002),
    ],
)
def test_a_second_of_free_motion_of_rods_as_built(model, gravity, none, constant, condensed):
    """Let go 30 mm to the right of the balance and 20 mm above it; errors in mm: at least, at most, at most."""
    robot = replace(load_robot(MODELS / f"{model}.toml"), gravity=(0.0, gravity))
    rest = inverse_statics(robot, (0.0, 0.25), mode="LR")
    pose = solve_statics(robot, rest.p + [0.03, 0.02], rest.q, guess=rest)
    reference, fewer = (released(robot, pose, (0.0, 0.0), seconds=1.0, modes=modes) for modes in (14, 10))
    assert distance(fewer, reference) < 1e-4
    errors = {
        inertia: distance(released(robot, pose, (0.0, 0.0), seconds=1.0, inertia=inertia, integrator="rk4"), reference)
        for inertia in ("none", "constant", "condensed")
    }
    assert errors["none"] > none
    assert errors["constant"] < constant
    assert errors["condensed"] < condensed


@pytest.mark.parametrize("u", [(0.0, 0.0), (1.0, -0.5)])
def test_the_condensed_inertia_is_its_limit(pair, centre, u):
    """With lighter rods the condensed error vanishes as the square of their mass, that of none as the mass.

    With turning motors this is also the evidence for what a jump of the rates does.
    """
    errors = {inertia: [] for inertia in ("none", "condensed")}
    for times in (1.0, 4.0):
        robot = heavier(pair, times)
        reference = released(robot, centre, u=u)
        for inertia, of_inertia in errors.items():
            of_inertia.append(distance(released(robot, centre, u=u, inertia=inertia, integrator="rk4"), reference))
    assert errors["none"][1] / errors["none"][0] == pytest.approx(4.0, rel=0.1)
    assert 9.0 < errors["condensed"][1] / errors["condensed"][0] < 20.0
    assert errors["condensed"][0] < 1e-3 < 0.7 < errors["none"][0]


def test_what_the_velocity_of_the_state_means(pair, centre):
    """Vibrations of the rods averaged out, p' = v - M_pp^-1 M_pq u, seen in the motion of distributed rods."""
    u = np.array([1.0, -0.5])
    states, others = (
        released(pair, centre, u=u, seconds=0.1, dt=1e-3, inertia=inertia, integrator=integrator)
        for inertia, integrator in (("full", "gauss"), ("condensed", "rk4"))
    )
    plant = Plant(pair, inertia="condensed")
    plant.reset(states[0], centre)
    coupling = np.mean([x[2:4] - plant.tip_velocity(x, u) for x in states], axis=0)
    assert np.linalg.norm(coupling) > 1e-4
    assert (states - others)[:, 2:4].mean(axis=0) == pytest.approx([0, 0], abs=0.03 * np.linalg.norm(coupling))


def test_a_symmetric_robot_stays_symmetric(pair, centre):
    states = released(pair, centre, (0.0, -0.3), (1.0, -1.0), seconds=0.3)
    assert np.abs(states[:, [0, 2]]).max() < 1e-10
    assert states[:, 4] + states[:, 5] == pytest.approx(np.pi, abs=1e-12)


def test_a_jump_of_the_rates_does_not_move_the_tip_at_once(pair, centre):
    """It starts a wave at the clamp; more modes, less of it at the tip in the first instant."""
    moved = []
    for n_modes in (4, 16):
        rods = DistributedRods(pair, n_modes)
        settled = rods.settled(centre.p, np.zeros(2), centre.q, centre.nodes)
        moved.append(np.linalg.norm(rods.step(settled, np.array([5.0, 4.0]), np.zeros(2), 1e-9).v))
    assert moved[1] < 0.3 * moved[0]


def test_a_state_from_outside_finds_the_rods_at_rest(pair, centre):
    plant, x = Plant(pair, inertia="full", integrator="gauss", modes=8), state(centre)
    plant.reset(x, centre)
    states = rollout(plant, x, 0.02)
    # From where it is, the second half is another motion if the rods calm down first.
    calmed = rollout(plant, states[10], 0.01)
    assert 1e-6 < distance(calmed, states[10:]) < 1e-3
    plant.reset(x, centre)
    assert rollout(plant, x, 0.01) == pytest.approx(states[:11], abs=0)
    # A reset calms them too, where no change of the state shows it.
    plant.reset(states[10], centre)
    assert plant.step(states[10], (0.0, 0.0)) == pytest.approx(calmed[1], abs=1e-12)
    assert np.abs(calmed[1] - states[11]).max() > 1e-8


def test_three_rods():
    robot = load_robot(MODELS / "three_rods.toml")
    pose = inverse_statics(robot, (0.0, 0.115), mode="LLL")
    u = (0.3, -0.2, 0.1)
    reference = released(robot, pose, (0.05, 0.0), u)
    assert distance(released(robot, pose, (0.05, 0.0), u, inertia="condensed", integrator="rk4"), reference) < 1e-2
    assert distance(released(robot, pose, (0.05, 0.0), u, inertia="none", integrator="rk4"), reference) > 5e-2


def test_a_step_that_is_too_long_is_an_error_that_changes_nothing(pair, centre):
    plant = Plant(pair, inertia="full", integrator="gauss", modes=8, dt=0.2)
    x = state(centre, (30.0, -2.0))
    plant.reset(x, centre)
    with pytest.raises(ConvergenceError, match=r"a step of 0\.2 s was not solved; shorten it") as caught:
        plant.step(x, (0.0, 0.0))
    assert (caught.value.state == x).all()


def test_bad_arguments_are_named(pair):
    with pytest.raises(ValueError, match="'full' needs 'gauss'"):
        Plant(pair, inertia="full", integrator="rk4")
    with pytest.raises(ValueError, match="inertia='none' does not go with integrator='gauss'"):
        Plant(pair, integrator="gauss")
    stretching = replace(pair, rods=tuple(replace(rod, axial_stiffness=1e4) for rod in pair.rods))
    with pytest.raises(ModelError, match="do not stretch, and a rod of planar_pair does"):
        Plant(stretching, inertia="full", integrator="gauss")
    with pytest.raises(ValueError, match="take weight='exact' or 'none'"):
        Plant(replace(pair, gravity=(0.0, -9.81)), method="closed_form", inertia="full", integrator="gauss")
    with pytest.raises(ValueError, match="modes = 3 must be a whole number from 4 to 64"):
        Plant(pair, inertia="full", integrator="gauss", modes=3)
