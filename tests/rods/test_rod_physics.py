"""Weight, curvature at rest, varying stiffness and stretch against arcs, beams, SciPy's solve_bvp and differences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_bvp

from pcr_mpc import (
    ModelError,
    Plant,
    all_equilibria,
    assess_stability,
    forward_statics,
    inverse_statics,
    linearise,
    load_scene,
    make_controller,
    simulate,
    solve_statics,
)
from pcr_mpc.plant.rods.closed_form.elastica import tip_map
from pcr_mpc.plant.rods.equations import Layout, RodPhysics, propagation, sample_rod
from pcr_mpc.plant.rods.physics import robot_physics
from pcr_mpc.plant.rods.shooting.multiple_shooting import rod_newton
from pcr_mpc.plant.statics.stability import count_conjugate_points
from pcr_mpc.plant.statics.weight import _rod_weight
from tests.conftest import MODELS

H = 1e-5


def changed(robot, **properties):
    return replace(robot, rods=tuple(replace(rod, **properties) for rod in robot.rods))


@pytest.fixture(scope="module")
def full(pair):
    """All at once, and different for the two rods."""
    rods = (
        replace(pair.rods[0], curvature=(0.5, 1.0, 0.3), stiffness_factors=(1.2, 1.0, 0.7), axial_stiffness=5e3),
        replace(pair.rods[1], curvature=-0.8, stiffness_factors=(1.0, 0.8), line_density=0.1),
    )
    return replace(pair, gravity=(2.0, -9.81), rods=rods)


@pytest.fixture(scope="module")
def vertical(pair):
    return replace(pair, gravity=(0.0, -9.81))


@pytest.fixture(scope="module")
def hanging(vertical):
    return inverse_statics(vertical, (0.0, 0.25), mode="LR")


def integrated(physics, base_loads):
    """End state of a rod from its base, clamped along +x, in 64 steps of order 8."""
    end = propagation(64, "rk8", physics.layout)([0.0, *base_loads], 1.0, 0.0, physics.values)
    return end.full().ravel()


def test_light_cantilever_bends_as_a_beam():
    """Deflection mu g L^4 / (8 EI) of a horizontal cantilever under its own weight."""
    w = 1e-3
    physics = RodPhysics(Layout(0, False, False), np.array([0.0, -w, 0.0, 0.0]))
    end = integrated(physics, [0.0, -w, -w / 2])
    assert end[1] == pytest.approx(-w / 8, rel=1e-5)
    assert end[3:6] == pytest.approx([0.0, 0.0, 0.0], abs=1e-8)


@pytest.mark.parametrize("w", [5.0, 20.0])
def test_heavy_cantilever_against_the_second_order_equation(w):
    """theta'' = w (1 - s) cos(theta) for a cantilever clamped along x with a weight w downwards, written anew."""
    found = solve_bvp(
        lambda s, y: np.array([y[1], w * (1 - s) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]),
        lambda a, b: np.array([a[0], b[1], a[2], a[3]]),
        np.linspace(0, 1, 101),
        np.zeros((4, 101)),
        tol=1e-10,
        max_nodes=20000,
    )
    assert found.success
    theta, m = found.y[:2, -1], found.y[1, 0]
    physics = RodPhysics(Layout(0, False, False), np.array([0.0, -w, 0.0, 0.0]))
    end = integrated(physics, [0.0, -w, m])
    assert end[[2, 0, 1, 5]] == pytest.approx([theta[0], *found.y[2:, -1], 0.0], abs=1e-7)
    # Sagging: the clamp carries the weight's moment.
    assert end[1] < -0.4


def test_curved_rod_without_load_is_an_arc(pair):
    """And its chord holds without a force: energy zero."""
    kappa = 2.5
    robot = changed(pair, curvature=kappa)
    physics = robot_physics(robot)[0]
    shape = sample_rod(np.array([[0.3], [0.0], [0.0], [0.0]]), 9, physics)
    bend, s = kappa * 0.4, np.linspace(0.0, 1.0, 9)
    assert shape[0] == pytest.approx((np.sin(0.3 + bend * s) - np.sin(0.3)) / bend, abs=1e-12)
    assert shape[1] == pytest.approx((np.cos(0.3) - np.cos(0.3 + bend * s)) / bend, abs=1e-12)
    arc = 0.4 * shape[:2, -1]
    p = np.array([0.0, 0.25])
    chord = np.arctan2(*(p - pair.rods[0].base)[::-1])
    angle = 0.3 + chord - np.arctan2(arc[1], arc[0])
    at = pair.rods[0].base + np.hypot(*arc) * np.array([np.cos(chord), np.sin(chord)])
    eq = solve_statics(robot, at, (angle, 0.0))
    assert eq.rod_forces[0] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert eq.motor_torque[0] == pytest.approx(0.0, abs=1e-7)


def test_pulled_rod_extends():
    """By n L / EA along its own direction; the stiffness of a straight rod is EA / L."""
    compliance, pull = 1e-3, 4.0
    physics = RodPhysics(Layout(0, False, True), np.array([0.0, 0.0, compliance, 0.0]))
    newton, _ = rod_newton(8, 2, "rk8", physics.layout)
    tip = 1 + compliance * pull
    nodes = np.tile([0.0, 0.5 * pull, 0.0, 0.0], 8)
    for _ in range(5):
        step, _, loads, load_tangent, scalars = newton(nodes, [tip, 0.0, 0.0], physics.values)
        nodes = nodes + step.full().ravel()
    assert float(scalars[0]) < 1e-12
    assert loads.full().ravel() == pytest.approx([pull, 0.0, 0.0], abs=1e-9)
    assert float(load_tangent[0, 0]) == pytest.approx(1 / compliance, rel=1e-9)
    assert float(scalars[2]) == pytest.approx(compliance * pull**2 / 2, rel=1e-9)
    assert float(scalars[3]) == 0


def test_general_rod_against_a_boundary_value_solver(full):
    """The equations written anew in s [m], with n from its balance, solved by collocation for the tip of each rod."""
    eq = solve_statics(full, (0.01, 0.24), (3.2, 0.1))
    for i, rod in enumerate(full.rods):
        knots = np.linspace(0.0, rod.length, 41)

        def along(values, s, length=rod.length):
            return np.interp(s, np.linspace(0.0, length, len(values)), values) if len(values) > 1 else values[0]

        def rhs(s, y, rod=rod, along=along):
            _, _, theta, n_x, n_y, m = y
            ei = rod.bending_stiffness * along(rod.stiffness_factors, s)
            strain = (n_x * np.cos(theta) + n_y * np.sin(theta)) / rod.axial_stiffness
            r_x, r_y = (1 + strain) * np.cos(theta), (1 + strain) * np.sin(theta)
            weight = rod.line_density * np.array(full.gravity)
            one = np.ones_like(s)
            return np.array(
                [r_x, r_y, m / ei + along(rod.curvatures, s), -weight[0] * one, -weight[1] * one, r_y * n_x - r_x * n_y]
            )

        d = eq.p - rod.base
        sampled = sample_rod(eq.nodes[i], 41, eq.physics[i])
        unit = rod.bending_stiffness / rod.length**2
        start = sampled * np.array([rod.length, rod.length, 1, unit, unit, unit * rod.length])[:, None]
        start += 0.02 * np.abs(start).max(axis=1, keepdims=True)  # not the answer itself

        def ends(a, b, d=d, q=eq.q[i]):
            return np.array([a[0], a[1], a[2] - q, b[0] - d[0], b[1] - d[1], b[5]])

        found = solve_bvp(rhs, ends, knots, start, tol=1e-8, max_nodes=20000)
        assert found.success
        assert found.y[3:5, -1] == pytest.approx(eq.rod_forces[i], rel=1e-5)
        assert -found.y[5, 0] == pytest.approx(eq.motor_torque[i], rel=1e-5)


def test_plain_limit_is_the_closed_form(pair, centre):
    """A weight, a curvature and a compliance that are next to nothing leave the graphs of the general rod."""
    robot = changed(replace(pair, gravity=(0.0, -1e-12)), curvature=1e-14, axial_stiffness=1e15)
    p, q = centre.p + [0.02, -0.03], centre.q
    general, exact = solve_statics(robot, p, q), solve_statics(pair, p, q)
    assert general.method == "multiple_shooting"
    for name in ("force", "dforce_dp", "dforce_dq", "motor_torque", "dtorque_dq", "energy"):
        wanted = getattr(exact, name)
        assert getattr(general, name) == pytest.approx(wanted, abs=1e-6 * np.abs(wanted).max()), name


def differences(at, p, q):
    """Central differences of energy and force in (p, q)."""
    energies, forces = [], []
    for w in np.eye(2 + len(q)):
        ahead, behind = at(p + H * w[:2], q + H * w[2:]), at(p - H * w[:2], q - H * w[2:])
        energies.append((ahead.energy - behind.energy) / (2 * H))
        forces.append((ahead.force - behind.force) / (2 * H))
    return np.array(energies), np.array(forces).T


def check_derivatives(eq, at):
    slope, stiffness = differences(at, eq.p, eq.q)
    assert slope[:2] == pytest.approx(eq.force, abs=1e-7)
    assert slope[2:] == pytest.approx(eq.motor_torque, abs=1e-7)
    assert stiffness[:, :2] == pytest.approx(eq.dforce_dp, abs=1e-5)
    assert stiffness[:, 2:] == pytest.approx(eq.dforce_dq, abs=1e-6)


def test_force_torque_and_their_derivatives_of_the_general_rod(full):
    eq = solve_statics(full, (0.01, 0.24), (3.2, 0.1), steps=2)
    check_derivatives(eq, lambda p, q: solve_statics(full, p, q, guess=eq, steps=2))
    assert eq.drift < 1e-9


def condensed(robot, pose):
    plant = Plant(robot, method="closed_form")
    assert plant.weight == "condensed"
    plant.reset(np.concatenate([pose.p, [0, 0], pose.q]), pose)
    return plant


def test_condensed_weight_has_a_potential(vertical, hanging):
    tilted = replace(vertical, gravity=(3.0, -9.0))
    plant = condensed(tilted, hanging)
    eq = plant.equilibrium(np.concatenate([hanging.p, [0, 0], hanging.q]))
    check_derivatives(eq, lambda p, q: plant.equilibrium(np.concatenate([p, [0, 0], q])))


@pytest.mark.parametrize(("load", "over"), [(3.0, 2.0), (20.0, 1.5), (200.0, 1.0), (600.0, 1.0)])
def test_second_derivatives_of_the_condensed_weight(load, over):
    """They are symmetric, and turning rod and gravity together changes nothing but the frame; taut rods too."""
    first, second = _rod_weight()
    for hand, angle, down in ((1.0, 0.4, (0.3, -1.0)), (-1.0, -2.0, (1.0, 0.2))):
        unknowns = [over - load if load > 10 else np.log(over), load, hand]
        (x, y), *_ = (part.full().ravel() for part in tip_map()(unknowns[:2]))
        tip = np.array([np.cos(angle) * x - hand * np.sin(angle) * y, np.sin(angle) * x + hand * np.cos(angle) * y])
        quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
        slope, turned = (first(unknowns, angle, g)[1].full().ravel() for g in (down, quarter @ down))
        curvature = second(unknowns, angle, down).full()
        size = np.abs(curvature).max()
        assert curvature == pytest.approx(curvature.T, abs=1e-7 * size)
        left = curvature[:, :2] @ quarter @ tip + curvature[:, 2] + turned
        assert left == pytest.approx(np.append(quarter @ slope[:2], 0.0), abs=1e-8 * size)


def test_condensed_weight_is_exact_to_first_order(vertical, hanging):
    errors = []
    for density in (0.0139, 0.0278, 0.0556):
        robot = changed(vertical, line_density=density)
        exact = solve_statics(robot, hanging.p, hanging.q, guess=None, steps=2)
        plant = condensed(robot, exact)
        found = plant.equilibrium(np.concatenate([hanging.p, [0, 0], hanging.q]))
        errors.append([np.abs(getattr(exact, n) - getattr(found, n)).max() for n in ("force", "dforce_dp", "energy")])
    assert np.log2(np.array(errors[1:]) / errors[:-1]) == pytest.approx(np.full((2, 3), 2.0), abs=0.1)
    assert errors[0][0] < 1e-3 * 0.0139 * 0.4 * 9.81


@pytest.mark.parametrize("method", ["closed_form", "multiple_shooting"])
def test_vertical_robot_keeps_its_energy(vertical, hanging, method):
    robot = replace(vertical, drag=0.0)
    plant = Plant(robot, method=method, integrator="velocity_verlet", dt=1e-3)
    x = np.concatenate([hanging.p + [0.01, 0.005], [0.2, -0.1], hanging.q])
    plant.reset(x, hanging)
    energies = []
    for _ in range(300):
        x = plant.step(x, (0.0, 0.0))
        kinetic, height = robot.tip_mass * x[2:4] @ x[2:4] / 2, -robot.tip_weight @ x[:2]
        energies.append(plant.equilibrium(x).energy + kinetic + height)
    assert np.ptp(energies) < 2e-5
    assert np.ptp(energies) < 1e-2 * robot.tip_mass * 9.81 * 0.01


@pytest.mark.parametrize("weight", ["condensed", "exact"])
def test_linear_model_of_a_vertical_robot(vertical, hanging, weight):
    plant = Plant(vertical, weight=weight, integrator="rk4", dt=1e-3)
    x, u = np.concatenate([hanging.p + [0.002, 0.001], [0.02, -0.01], hanging.q]), np.array([0.1, -0.1])
    plant.reset(x, hanging)
    model = linearise(plant, x, u, 1e-3)
    assert model(x, u) == pytest.approx(plant.step(x, u), abs=2e-9)
    for j in range(6):
        w = 1e-4 * np.eye(6)[j]
        column = (plant.step(x + w, u) - plant.step(x - w, u)) / 2e-4
        assert column == pytest.approx(model.A[:, j], abs=1e-4), j


def test_robot_rests_where_its_rods_carry_the_tip(vertical, hanging):
    assert hanging.force == pytest.approx([0.0, -0.25 * 9.81], abs=1e-8)
    resting = forward_statics(vertical, hanging.q, guess=hanging)
    assert resting.p == pytest.approx(hanging.p, abs=1e-9)
    for weight in ("condensed", "exact"):
        plant = Plant(vertical, weight=weight, integrator="velocity_verlet")
        x = np.concatenate([hanging.p, [0, 0], hanging.q])
        plant.reset(x, hanging)
        assert plant.step(x, (0.0, 0.0))[:2] == pytest.approx(hanging.p, abs=1e-9)


def test_stability_of_rods_that_are_not_plain(full):
    eq = solve_statics(full, (0.01, 0.24), (3.2, 0.1))
    verdict = assess_stability(eq)
    assert verdict.stable == eq.stable
    assert np.isnan(verdict.rod_margins).all()
    assert count_conjugate_points(eq) == 0


@pytest.mark.parametrize(
    ("properties", "reason"),
    [
        ({"curvature": 1.0}, "is curved at rest"),
        ({"stiffness_factors": (1.0, 0.5)}, "changes its stiffness"),
        ({"axial_stiffness": 1e5}, "stretches"),
    ],
)
def test_closed_form_is_refused_by_name(pair, centre, properties, reason):
    robot = changed(pair, **properties)
    assert reason in robot.needs_shooting
    for method in ("closed_form", "single_shooting"):
        with pytest.raises(ModelError, match=f"{method}.*{reason}.*use method 'multiple_shooting'"):
            solve_statics(robot, centre.p, centre.q, method=method)
    with pytest.raises(ModelError, match=reason):
        Plant(robot, method="closed_form")
    with pytest.raises(ModelError, match=reason):
        all_equilibria(robot, q=centre.q)
    with pytest.raises(ModelError, match=r"jump.*" + reason):
        Plant(robot, on_snap="jump")


def test_weight_and_methods(vertical, centre):
    assert "has weight" in vertical.needs_shooting
    with pytest.raises(ModelError, match="has weight"):
        solve_statics(vertical, centre.p, centre.q, method="closed_form")
    assert Plant(vertical).weight == "exact"
    with pytest.raises(ValueError, match="needs method='closed_form'"):
        Plant(vertical, method="multiple_shooting", weight="condensed")
    with pytest.raises(ValueError, match="weight is 'some'"):
        Plant(vertical, weight="some")


@pytest.mark.parametrize(
    ("key", "value"),
    [("curvature", ()), ("curvature", (1.0, np.nan)), ("stiffness_factors", (1.0, 0.0)), ("axial_stiffness", -1.0)],
)
def test_wrong_properties_are_named(pair, key, value):
    with pytest.raises(ModelError, match=key):
        replace(pair.rods[0], **{key: value})


def test_vertical_robot_tracks_and_what_leaving_the_weight_out_costs():
    """A model without weight leans on its observer; without one it misses by millimetres."""
    scene = replace(load_scene(MODELS / "scenes/vertical.toml"), duration=0.8)
    exact = replace(scene.plant, method="multiple_shooting", weight="exact", integrator="velocity_verlet", dt=2e-3)
    scene = replace(scene, plant=exact)
    weightless = scene.robot.weightless()
    errors = {}
    for name, robot in (("known", scene.robot), ("left out", weightless)):
        for observer in (scene.tuning.observer, None):
            controller = make_controller(scene, replace(scene.tuning, observer=observer), robot)
            run = simulate(scene, scene.make_plant(), controller)
            errors[name, observer is not None] = run.summary()["rms_mm"]
    assert errors["known", True] < 0.01
    assert errors["known", False] < 0.05
    assert errors["left out", True] > 1.0
    assert errors["left out", False] > 10.0
