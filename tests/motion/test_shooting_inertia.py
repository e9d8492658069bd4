"""The condensed inertia of rods without a closed form, against the closed form, shapes, differences and energies."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import Plant, forward_statics, linearise
from pcr_mpc.plant.rods.closed_form import elastica, inertia
from pcr_mpc.plant.rods.shooting import inertia as shooting_inertia

from .test_inertia import kinetic_energy, rollout, started, state


def test_plain_rods_have_the_inertia_of_the_closed_form(poses, monkeypatch):
    monkeypatch.setattr(inertia, "_POINTS", 14)  # beyond all doubt
    exact, of_nodes = inertia.rod_mass.__wrapped__.__wrapped__(), shooting_inertia.rod_mass(16, 1, "rk8")
    for pose in poses:
        for nodes, angle in zip(pose.nodes, pose.q, strict=True):
            unknowns = elastica.from_nodes(nodes)
            nodes = elastica.nodes(unknowns, angle, 16)
            wanted = [result.full() for result in exact(unknowns, angle)]
            found = [result.full() for result in of_nodes(nodes.ravel(order="F"), angle)]
            assert found[0] == pytest.approx(wanted[0], abs=1e-7 * np.abs(wanted[0]).max())
            assert found[1] == pytest.approx(wanted[1], abs=1e-6 * np.abs(wanted[1]).max())


def test_mass_is_the_kinetic_energy_of_the_shapes(general, bent):
    rng = np.random.default_rng(3)
    plant = started(general, bent, state(bent))
    mass, _ = plant.mass(bent.p, bent.q)
    assert plant.method == "multiple_shooting"
    for _ in range(4):
        w = rng.normal(size=4) * [0.3, 0.3, 2.0, 2.0]
        assert w @ mass @ w / 2 == pytest.approx(kinetic_energy(plant, bent.p, w[:2], bent.q, w[2:]), rel=1e-7)


def test_slopes_of_the_mass(general, bent):
    h = 1e-5
    plant = started(general, bent, state(bent))
    _, slopes = plant.mass(bent.p, bent.q)
    differences = []
    for direction in np.eye(4):
        ahead, behind = (plant.mass(bent.p + s * direction[:2], bent.q + s * direction[2:])[0] for s in (h, -h))
        differences.append((ahead - behind).ravel(order="F") / (2 * h))
    assert slopes == pytest.approx(np.array(differences).T, abs=1e-7 * np.abs(slopes).max())


def test_knots_between_the_nodes(general, bent):
    """Three segments take two steps each, for the knots of these rods to be ends of steps."""
    exact = started(general, bent, state(bent)).mass(bent.p, bent.q)
    found = started(general, bent, state(bent), segments=3).mass(bent.p, bent.q)
    for part, whole in zip(found, exact, strict=True):
        assert part == pytest.approx(whole, abs=1e-5 * np.abs(whole).max())


@pytest.mark.parametrize(("integrator", "order"), [("velocity_verlet", 2), ("rk4", 5)])  # RK4 damps
def test_energy_of_heavy_rods_is_kept_without_drag(heavy, sagging, integrator, order):
    """Kinetic, elastic, and that of the weight of tip and rods, which are in U and m g."""
    robot, changes = replace(heavy, drag=0.0), []
    for dt in (8e-3, 4e-3):
        plant = started(robot, sagging, state(sagging), integrator=integrator, dt=dt)
        states = rollout(plant, state(sagging), 0.4)
        plant.reset(states[0], sagging)
        energies = []
        for x in states:
            mass, _ = plant.mass(x[:2], x[4:])
            kinetic = x[2:4] @ mass[:2, :2] @ x[2:4] / 2
            energies.append([plant.equilibrium(x).energy + kinetic - robot.tip_weight @ x[:2], kinetic])
        total, kinetic = np.array(energies).T
        changes.append(np.ptp(total) / np.ptp(kinetic))
    assert np.log2(changes[0] / changes[1]) == pytest.approx(order, abs=0.4)
    assert changes[1] < {2: 1e-3, 5: 1e-7}[order]


def test_linear_model_of_heavy_rods(heavy, sagging):
    plant = Plant(heavy, inertia="condensed", integrator="rk4", dt=1e-3)
    x, u = np.concatenate([sagging.p + [0.002, 0.001], [0.02, -0.01], sagging.q]), np.array([0.1, -0.1])
    plant.reset(x, sagging)
    model = linearise(plant, x, u, 1e-3)
    assert model(x, u) == pytest.approx(plant.step(x, u), abs=2e-7)
    for j in range(6):
        w = 1e-4 * np.eye(6)[j]
        column = (plant.step(x + w, u) - plant.step(x - w, u)) / 2e-4
        assert column == pytest.approx(model.A[:, j], abs=3e-4), j
    massless = Plant(heavy, integrator="rk4", dt=1e-3)
    massless.reset(x, sagging)
    assert np.abs(linearise(massless, x, u, 1e-3)(x, u) - plant.step(x, u)).max() > 5e-5


def test_constant_is_the_mass_at_the_reset(heavy, sagging):
    constant, condensed = (started(heavy, sagging, state(sagging), inertia=of) for of in ("constant", "condensed"))
    mass, slopes = constant.mass(sagging.p, sagging.q)
    assert mass == pytest.approx(condensed.mass(sagging.p, sagging.q)[0], rel=1e-9)
    x = rollout(constant, state(sagging), 0.02, (1.0, 1.0))[-1]
    assert (constant.mass(x[:2], x[4:])[0] == mass).all()
    assert not slopes.any()


def test_it_hangs_still_in_balance(heavy, sagging):
    plant = started(heavy, sagging, state(sagging, (0.0, 0.0)), integrator="velocity_verlet")
    states = rollout(plant, state(sagging, (0.0, 0.0)), 0.05)
    assert np.abs(states - states[0]).max() < 1e-8
    assert forward_statics(heavy, sagging.q, guess=sagging).p == pytest.approx(sagging.p, abs=1e-8)
