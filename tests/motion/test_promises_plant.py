"""What the docstrings of the plant promise, one promise a test."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ConvergenceError, Equilibrium, ModelError, Plant, Robot, rollout

REST = np.zeros(2)


@pytest.fixture(scope="module")
def x0(centre: Equilibrium) -> np.ndarray:
    return np.concatenate([centre.p, REST, centre.q])


@pytest.fixture
def plant(pair: Robot, centre: Equilibrium, x0: np.ndarray) -> Plant:
    plant = Plant(pair)
    plant.reset(x0, centre)
    return plant


def with_stops(robot: Robot, motor: int, lower: float, upper: float) -> Robot:
    rods = list(robot.rods)
    rods[motor] = replace(rods[motor], angle_limits=(lower, upper))
    return replace(robot, rods=tuple(rods))


# Motors


@pytest.mark.parametrize("motor", [0, 1])
@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "velocity_verlet", "rk4"])
def test_a_motor_stops_at_either_stop(pair, centre, x0, motor, side, integrator):
    """Both stops, both motors, on the first step and on the next, which is one call."""
    stop = centre.q[motor] + (2 * side - 1) * 4e-3
    stops = (stop, 9.0) if side == 0 else (-9.0, stop)
    plant = Plant(with_stops(pair, motor, *stops), integrator=integrator)
    plant.reset(x0, centre)
    u = np.zeros(2)
    u[motor] = (2 * side - 1) * 3.0
    x = plant.step(x0, u)
    assert x[4 + motor] == pytest.approx(centre.q[motor] + 1e-3 * u[motor])
    for _ in range(2):
        x = plant.step(x, u)
        assert x[4 + motor] == pytest.approx(stop, abs=1e-15)
    assert x[5 - motor] == centre.q[1 - motor]


@pytest.mark.parametrize("sign", [1, -1])
def test_rates_are_clipped_to_both_signs_of_the_limit(pair, plant, x0, sign):
    for _ in range(2):
        x = plant.step(x0, sign * np.array([1.5, -2.0]) * pair.rate_limit)
        assert x[4:] - x0[4:] == pytest.approx(sign * 1e-3 * pair.rate_limit * np.array([1, -1]))


@pytest.mark.parametrize("side", [0, 1])
def test_a_motor_beyond_either_stop_comes_back_no_faster_than_it_can(pair, x0, side):
    q = pair.angle_limits[:, side] + (2 * side - 1) * 0.1
    assert pair.motor_rates(np.zeros(2), q, 1e-3) == pytest.approx(np.full(2, (1 - 2 * side) * pair.rate_limit))


# What is refused leaves the plant as it was


def test_a_pose_refused_for_its_drift_leaves_the_rods_where_they_were(pair, centre, x0):
    plant = Plant(pair, method="multiple_shooting", segments=4)
    plant.reset(x0, centre)
    residual = plant.residual
    taut = centre.p + [0.0, 0.1]
    with pytest.raises(ConvergenceError, match="invariant drifts"):
        plant.force(taut, centre.q)
    assert plant.residual == residual
    before = plant.rungs
    plant.force(centre.p + [0.0, 1e-5], centre.q)
    after = plant.rungs
    assert {rung for rung in after if after[rung] != before.get(rung, 0)} == {"warm"}


@pytest.mark.parametrize("method", ["closed_form", "multiple_shooting"])
def test_a_carried_payload_is_taken_away_by_a_reset(pair, centre, x0, method):
    pair = replace(pair, gravity=(0.0, -9.81))
    fresh, used = Plant(pair, method=method), Plant(pair, method=method)
    used.reset(x0, centre)
    used.carry(0.3, x0)
    assert used.payload == 0.3
    assert used.tip_weight == pytest.approx([0.0, -9.81 * (pair.tip_mass + 0.3)])
    for plant in (fresh, used):
        plant.reset(x0, centre)
    assert used.payload == 0.0
    assert (used.tip_weight == fresh.tip_weight).all()
    for _ in range(2):
        assert (used.step(x0, (0.5, -0.5)) == fresh.step(x0, (0.5, -0.5))).all()


def test_a_payload_of_mujoco_is_taken_away_by_a_reset(pair, centre, x0):
    from pcr_mpc.plant.mujoco.plant import MuJoCoPlant

    used, fresh = (MuJoCoPlant(pair, links=10) for _ in range(2))
    used.reset(x0, centre)
    used.carry(0.3, x0)
    for plant in (used, fresh):
        plant.reset(x0, centre)
    assert used.payload == 0.0
    pushed = [plant.step(x0, REST, (1.0, 0.0)) for plant in (used, fresh)]
    assert (pushed[0] == pushed[1]).all()
    # m dv = f dt to first order.
    assert pushed[0][2] == pytest.approx(1e-3 / pair.tip_mass, rel=0.1)


def test_snaps_and_rungs_of_mujoco_are_empty(pair):
    from pcr_mpc.plant.mujoco.plant import MuJoCoPlant

    plant = MuJoCoPlant(pair, links=10)
    assert (plant.snaps, plant.rungs) == ([], {})


def test_single_shooting_says_what_it_does_not_keep(pair, centre, x0):
    plant = Plant(pair, method="single_shooting")
    plant.reset(x0, centre)
    with pytest.raises(ValueError, match="single_shooting keeps no residual"):
        _ = plant.residual
    with pytest.raises(ValueError, match="single_shooting keeps no unknowns"):
        plant.rods(centre.p, centre.q)
    with pytest.raises(ValueError, match=r"'single_shooting' with .* has no rollout; use Plant\.step"):
        rollout(plant, x0, np.zeros((3, 2)))


@pytest.mark.parametrize("f_ext", [(2,), (4, 2), (3, 4, 2)])
def test_a_rollout_takes_forces_for_all_for_each_step_and_for_each_robot(pair, centre, x0, f_ext):
    """Against `Plant.step`, robot by robot; the shapes of the result and its clock too."""
    rng = np.random.default_rng(1)
    force, inputs = rng.normal(0, 1, f_ext), rng.normal(0, 1, (4, 2))
    found = rollout(Plant(pair), x0, inputs, force, guess=centre)
    robots = 3 if len(f_ext) == 3 else 1
    states = found.x if robots == 3 else found.x[None]
    assert found.x.shape == ((3, 5, 6) if robots == 3 else (5, 6))
    assert found.residual.shape == ((3, 4) if robots == 3 else (4,))
    assert found.t == pytest.approx([0, 1e-3, 2e-3, 3e-3, 4e-3])
    assert found.stepped == ()
    for robot in range(robots):
        plant = Plant(pair)
        plant.reset(x0, centre)
        x = x0
        for k in range(4):
            x = plant.step(x, inputs[k], np.broadcast_to(force, (robots, 4, 2))[robot, k])
            assert states[robot, k + 1] == pytest.approx(x, abs=1e-9)


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"on_snap": "fall"}, "on_snap is 'fall', expected one of raise, jump"),
        ({"inertia": "some"}, "inertia is 'some', expected one of none"),
        ({"inertia": "full"}, "'full' needs 'gauss'"),
        ({"integrator": "gauss"}, "'full' needs 'gauss'"),
        ({"weight": "some"}, "weight is 'some', expected one of none"),
        ({"weight": "condensed", "method": "multiple_shooting"}, "needs method='closed_form', not 'multiple_shooting'"),
        ({"weight": "condensed", "method": "closed_form", "inertia": "full", "integrator": "gauss"}, "not condense"),
        ({"inertia": "constant", "method": "single_shooting"}, "needs method='closed_form' or 'multiple_shooting'"),
        ({"dt": 0.0}, "dt is 0.0 s, expected a positive number"),
        ({"dt": -1e-3}, "dt is -0.001 s"),
        ({"dt": np.inf}, "dt is inf s"),
        ({"dt": np.nan}, "dt is nan s"),
        ({"modes": 3}, "modes = 3 must be a whole number from 4 to 64"),
        ({"modes": 65}, "modes = 65 must"),
        ({"modes": True}, "modes = True must"),
        ({"modes": 12.0}, "modes = 12.0 must"),
        ({"segments": 0}, "segments = 0 must be a whole number of at least 1"),
        ({"steps": True}, "steps = True must be a whole number of at least 1"),
        ({"segments": 1000, "steps": 1000}, "segments = 1000 times steps = 1000 is more than"),
        ({"scheme": "euler"}, "scheme is 'euler'"),
    ],
)
def test_choices_that_do_not_go_together_are_named(pair, choices, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        Plant(pair, **choices)


def test_what_a_plant_takes_by_itself(pair, heavy, general):
    """Method and weight by the robot: the closed form where it is exact, weight where there is gravity and mass."""
    chosen = [(Plant(robot).method, Plant(robot).weight) for robot in (pair, heavy, general)]
    assert chosen == [("closed_form", "none"), ("multiple_shooting", "exact"), ("multiple_shooting", "exact")]
    assert Plant(heavy, method="closed_form").weight == "condensed"
    assert Plant(heavy, weight="none").method == "closed_form"
    massless = replace(heavy, rods=tuple(replace(rod, line_density=0.0) for rod in heavy.rods))
    assert (Plant(massless).method, Plant(massless).weight) == ("closed_form", "none")
    assert Plant(pair, modes=np.int64(4)).dt == 1e-3


def test_condensed_weight_adds_its_potential_to_force_and_derivatives(heavy, sagging):
    """F, K and G of a condensed weight against differences of the plant's own energy."""
    plant = Plant(heavy, method="closed_form")
    q = sagging.q
    plant.reset(np.concatenate([sagging.p, REST, q]))
    force, k, g = plant.force_and_jacobians(sagging.p, q)
    h = 1e-5

    def energy(dp, dq):
        return plant.equilibrium(np.concatenate([sagging.p + dp, REST, q + dq])).energy

    def force_at(dp, dq):
        return plant.force(sagging.p + dp, q + dq)

    steps = h * np.eye(2)
    assert force == pytest.approx([(energy(s, REST) - energy(-s, REST)) / (2 * h) for s in steps], rel=1e-5, abs=1e-6)
    by_tip = np.stack([(force_at(s, REST) - force_at(-s, REST)) / (2 * h) for s in steps], axis=1)
    by_motor = np.stack([(force_at(REST, s) - force_at(REST, -s)) / (2 * h) for s in steps], axis=1)
    assert k == pytest.approx(by_tip, rel=1e-4, abs=1e-3)
    assert g == pytest.approx(by_motor, rel=1e-4, abs=1e-3)
    weightless = Plant(heavy, weight="none")
    weightless.reset(np.concatenate([sagging.p, REST, q]))
    assert abs(force[1] - weightless.force(sagging.p, q)[1]) > 1e-3


def test_what_a_kind_of_rods_cannot_do_is_said_of_the_robot(pair, general):
    bowed = replace(pair, rods=(replace(pair.rods[0], curvature=0.1), pair.rods[1]))
    with pytest.raises(ModelError, match=r"on_snap='jump' is for uniform, .* is curved at rest"):
        Plant(bowed, on_snap="jump")
    with pytest.raises(ModelError, match=r"'closed_form' is for uniform"):
        Plant(bowed, method="closed_form")
    with pytest.raises(ModelError, match="for rods that do not stretch"):
        Plant(general, inertia="full", integrator="gauss")
    odd = replace(pair.rods[0], curvature=(0.1,) * 60 + (0.2,), stiffness_factors=(1.0,) * 46 + (0.9,))
    with pytest.raises(ModelError, match=r"lists of \[\d+, 47, 61\] values .* give lists of equal length"):
        Plant(replace(pair, rods=(odd, pair.rods[1])))
