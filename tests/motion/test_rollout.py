"""A whole step in one call is what its parts are, and a rollout what its steps are."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    CompilerError,
    Plant,
    UnreachableError,
    UnstableError,
    inverse_statics,
    load_robot,
    rollout,
    solve_statics,
)
from pcr_mpc.plant.motion.integrators import INTEGRATORS
from tests.conftest import MODELS

STEPS = 60
KINDS = [
    *(
        {"integrator": name, "inertia": inertia}
        for name in INTEGRATORS
        for inertia in ("none", "constant", "condensed")
    ),
    {"integrator": "velocity_verlet", "method": "multiple_shooting"},
    {"integrator": "velocity_verlet", "method": "multiple_shooting", "inertia": "condensed"},
]


def ids(kind):
    return " ".join(kind.values())


def start_at(pose):
    return np.concatenate([pose.p, (0.3, -0.2), pose.q])


def brisk(steps, n=2):
    """Rates that reach the motors' limit."""
    return 8.0 * np.sin(0.11 * np.arange(steps)[:, None] + np.arange(n))


def gusts(steps):
    return np.random.default_rng(3).normal(0.0, 0.5, (steps, 2))


def one_by_one(plant, x, inputs, f_ext, guess):
    plant.reset(x, guess)
    states = [x]
    for u, f in zip(inputs, np.broadcast_to(f_ext, (len(inputs), 2)), strict=True):
        states.append(plant.step(states[-1], u, f))
    return np.array(states)


def in_parts(plant):
    """The plant without the graph of a whole step."""
    plant.step_model = None
    return plant


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_a_step_in_one_call_is_what_its_parts_are(pair, centre, kind):
    x, inputs, forces = start_at(centre), brisk(STEPS), gusts(STEPS)
    plant, parts = Plant(pair, dt=1e-3, **kind), in_parts(Plant(pair, dt=1e-3, **kind))
    quick, slow = (one_by_one(one, x, inputs, forces, centre) for one in (plant, parts))
    assert quick == pytest.approx(slow, abs=1e-10)
    assert plant.rungs["warm"] >= STEPS
    # What the plant tells of its rods afterwards is theirs, whatever it was that moved them.
    for name in ("force", "dforce_dp", "dforce_dq", "motor_torque"):
        mine, theirs = (getattr(one.equilibrium(quick[-1]), name) for one in (plant, parts))
        assert mine == pytest.approx(theirs, rel=1e-8, abs=1e-8)
    assert plant.mass(quick[-1, :2], quick[-1, 4:])[0] == pytest.approx(parts.mass(quick[-1, :2], quick[-1, 4:])[0])


@pytest.mark.parametrize("kind", KINDS, ids=ids)
def test_rollout_is_what_steps_are(pair, centre, kind):
    x, inputs, forces = start_at(centre), brisk(STEPS), gusts(STEPS)
    plant = Plant(pair, dt=1e-3, **kind)
    result = rollout(plant, x, inputs, forces, guess=centre)
    assert result.x == pytest.approx(one_by_one(in_parts(plant), x, inputs, forces, centre), abs=1e-10)
    assert result.t == pytest.approx(1e-3 * np.arange(STEPS + 1))
    assert result.residual.shape == (STEPS,)
    assert 0.0 < result.residual.max() < 1e-10
    assert result.stepped == ()


@pytest.mark.parametrize(
    ("file", "changes", "settings"),
    [
        ("three_rods", {}, {}),
        ("planar_pair", {"gravity": (1.0, -9.81)}, {"method": "closed_form"}),
        ("planar_pair", {"gravity": (1.0, -9.81)}, {"weight": "none"}),
        ("curved_pair", {}, {}),
    ],
    ids=["three rods", "condensed weight", "weight of the tip alone", "curved rods"],
)
def test_other_robots(file, changes, settings):
    robot = replace(load_robot(MODELS / f"{file}.toml"), **changes)
    pose = solve_statics(robot.weightless(), (0.02, 0.24), load_start(robot))
    x, inputs = start_at(pose), brisk(20, robot.n_rods)
    plant, parts = (Plant(robot, integrator="velocity_verlet", **settings) for _ in range(2))
    result = rollout(plant, x, inputs, (0.1, 0.2), guess=pose)
    assert result.stepped == ()
    assert result.x == pytest.approx(one_by_one(in_parts(parts), x, inputs, (0.1, 0.2), pose), abs=1e-10)


def load_start(robot):
    plain = replace(robot.weightless(), rods=tuple(replace(rod, curvature=0.0) for rod in robot.rods))
    return inverse_statics(plain, (0.02, 0.24)).q


@pytest.mark.parametrize("threads", [1, 2])
def test_many_robots(pair, centre, threads):
    rng = np.random.default_rng(5)
    x = start_at(centre) + np.concatenate([rng.uniform(-0.02, 0.02, (7, 4)), np.zeros((7, 2))], axis=1)
    inputs = rng.uniform(-2.0, 2.0, (7, 30, 2))
    plant = Plant(pair, integrator="velocity_verlet")
    result = rollout(plant, x, inputs, guess=centre, threads=threads)
    assert result.x.shape == (7, 31, 6)
    assert result.residual.shape == (7, 30)
    for i in range(7):
        assert result.x[i] == pytest.approx(one_by_one(plant, x[i], inputs[i], (0, 0), centre), abs=1e-10)
    assert result.stepped == ()
    # One start, or one sequence, for all.
    assert rollout(plant, x[0], inputs, guess=centre).x[4, 0] == pytest.approx(x[0])
    alike = rollout(plant, x, inputs[3], guess=centre)
    assert alike.x[3] == pytest.approx(result.x[3], abs=1e-10)


def test_every_robot_has_its_own_force_at_every_step(pair, centre):
    x = np.stack([start_at(centre)] * 3)
    gusts = np.random.default_rng(6).uniform(-1.0, 1.0, (3, 20, 2))
    plant = Plant(pair, integrator="velocity_verlet")
    for inputs in (np.zeros((20, 2)), np.random.default_rng(7).uniform(-2.0, 2.0, (3, 20, 2))):
        result = rollout(plant, x, inputs, gusts, guess=centre)
        for i, own in enumerate(np.broadcast_to(inputs, (3, 20, 2))):
            assert result.x[i] == pytest.approx(one_by_one(plant, x[i], own, gusts[i], centre), abs=1e-10)
    # One start for all, and robots from the forces alone.
    assert rollout(plant, x[0], np.zeros((20, 2)), gusts, guess=centre).x.shape == (3, 21, 6)
    with pytest.raises(ValueError, match=r"f_ext has shape \(2, 20, 2\), expected \(3, 20, 2\)"):
        rollout(plant, x, np.zeros((20, 2)), gusts[:2], guess=centre)


def test_more_steps_than_one_call_takes(pair, centre, monkeypatch):
    monkeypatch.setattr("pcr_mpc.plant.motion.rollout.STEPS_AT_ONCE", 25)
    monkeypatch.setattr("pcr_mpc.plant.motion.rollout._MOST_STEPS", 50)
    x, inputs = start_at(centre), np.stack([brisk(STEPS), -brisk(STEPS), 0.5 * brisk(STEPS)])
    plant = Plant(pair, inertia="condensed")
    result = rollout(plant, x, inputs, guess=centre)
    assert result.stepped == ()
    for i in range(3):
        assert result.x[i] == pytest.approx(one_by_one(plant, x, inputs[i], (0, 0), centre), abs=1e-10)


def test_where_two_iterations_are_too_little_steps_take_over(pair, centre):
    """Fast tips by long steps: some of them miss the tolerance, and none of that shows in the motion."""
    x = np.stack([start_at(centre), start_at(centre)])
    x[1, 2:4] = 2.0, -3.0
    plant = Plant(pair, integrator="velocity_verlet", dt=4e-3)
    result = rollout(plant, x, np.zeros((20, 2)), guess=centre)
    assert result.stepped == (1,)
    assert result.x[1] == pytest.approx(one_by_one(plant, x[1], np.zeros((20, 2)), (0, 0), centre), abs=1e-10)
    assert result.residual.max() < 1e-10


def test_a_branch_that_ends_is_an_error_that_says_where(pair, centre):
    """One motor is wound up with the tip under heavy drag: its rod folds (see test_snap)."""
    robot = replace(pair, drag=1e4)
    x = np.stack([np.concatenate([centre.p, np.zeros(2), centre.q])] * 2)
    inputs = np.zeros((2, 1200, 2))
    inputs[1, :, 0] = 6.0
    robot = replace(robot, rods=tuple(replace(rod, angle_limits=(-20.0, 20.0)) for rod in robot.rods))
    plant = Plant(robot, integrator="velocity_verlet")
    with pytest.raises(UnstableError, match="would snap") as caught:
        rollout(plant, x, inputs, guess=centre)
    error = caught.value
    assert (error.robot, error.state.shape) == (1, (6,))
    assert 100 < error.step < 1200
    assert error.state[4] - centre.q[0] == pytest.approx(6e-3 * error.step)
    with pytest.raises(UnstableError) as again:
        one_by_one(plant, x[1], inputs[1], (0, 0), centre)
    assert again.value.state == pytest.approx(error.state)


def test_arguments_are_checked(pair, centre):
    x, plant = start_at(centre), Plant(pair)
    for wrong in (brisk(5, 3), np.full((5, 2), np.nan), np.zeros((0, 2)), np.zeros(2)):
        with pytest.raises(ValueError, match="inputs"):
            rollout(plant, x, wrong)
    with pytest.raises(ValueError, match=r"inputs has shape \(2, 5, 2\), expected \(3, 5, 2\)"):
        rollout(plant, np.stack([x] * 3), np.zeros((2, 5, 2)))
    with pytest.raises(ValueError, match="x0"):
        rollout(plant, x[:5], np.zeros((2, 5, 2)))
    with pytest.raises(ValueError, match="f_ext"):
        rollout(plant, x, brisk(5), np.zeros((4, 2)))
    with pytest.raises(ValueError, match="threads"):
        rollout(plant, x, brisk(5), threads=0)
    for settings in ({"method": "single_shooting"}, {"inertia": "full", "integrator": "gauss"}):
        with pytest.raises(ValueError, match="no rollout"):
            rollout(Plant(pair, **settings), x, brisk(5))
    with pytest.raises(UnreachableError):
        rollout(plant, x + [1.0, 0, 0, 0, 0, 0], brisk(5))


def test_a_step_that_is_refused_leaves_the_plant_where_it_was(pair, centre):
    x = start_at(centre)
    plant, other = (Plant(pair, integrator="rk4") for _ in range(2))
    for one in (plant, other):
        one.reset(x, centre)
    x = plant.step(x, (1.0, -1.0))
    assert (other.step(start_at(centre), (1.0, -1.0)) == x).all()
    for wrong in ((np.nan, 0.0), (np.inf, 0.0), (1.0,), 1.0):
        with pytest.raises(ValueError, match="u "):
            plant.step(x, wrong)
    with pytest.raises(ValueError, match="f_ext"):
        plant.step(x, (1.0, 0.0), (np.nan, 0.0))
    with pytest.raises(ValueError, match="x "):
        plant.step(x[:5], (1.0, 0.0))
    assert (plant.step(x, (2.0, 1.0)) == other.step(x, (2.0, 1.0))).all()


def test_states_that_are_not_the_last_one(pair, centre):
    """The plant moves there first, as it would in parts."""
    plant, parts = Plant(pair, integrator="velocity_verlet"), in_parts(Plant(pair, integrator="velocity_verlet"))
    x = start_at(centre)
    moved = x + [0.01, -0.005, 0, 0, 0.02, 0.01]
    for one in (plant, parts):
        one.reset(x, centre)
    for state in (x, moved, x, x, moved):
        assert plant.step(state, (1.0, 2.0)) == pytest.approx(parts.step(state, (1.0, 2.0)), abs=1e-10)


def test_a_reset_forgets_the_branch_of_the_steps_before(pair, centre):
    plant = Plant(pair)
    plant.reset(start_at(centre), centre)
    x = plant.step(start_at(centre), (0.0, 0.0))
    crossed = inverse_statics(pair, centre.p, mode="LL")
    plant.reset(start_at(crossed), crossed)
    assert plant.equilibrium(start_at(crossed)).mode == "LL"
    plant.reset(x, centre)
    assert plant.equilibrium(x).mode == "LR"


@pytest.mark.parametrize("inertia", ["none", "condensed"])
def test_payloads(pair, centre, inertia):
    """A step knows what the tip carries; a rollout begins with a reset, and without a payload."""
    x, inputs = start_at(centre), brisk(20)
    plant, parts, other = (Plant(pair, integrator="velocity_verlet", inertia=inertia) for _ in range(3))
    parts = in_parts(parts)
    ends = []
    for one in (plant, parts):
        states = one_by_one(one, x, inputs, (0, 0), centre)
        end = one.carry(0.1, states[-1])
        for u in inputs:
            end = one.step(end, u)
        ends.append(end)
    assert ends[0] == pytest.approx(ends[1], abs=1e-10)
    assert plant.payload == 0.1
    assert (rollout(plant, x, inputs, guess=centre).x == rollout(other, x, inputs, guess=centre).x).all()
    assert plant.payload == 0.0


def test_machine_code_gives_the_same_numbers(pair, centre, compiler):
    x, inputs = start_at(centre), 0.1 * brisk(STEPS)
    code, plain = (Plant(pair, integrator="velocity_verlet", compiled=flag) for flag in (True, False))
    assert (one_by_one(code, x, inputs, (0, 0), centre) == one_by_one(plain, x, inputs, (0, 0), centre)).all()
    results = [rollout(one, x, np.stack([inputs] * 3), guess=centre, threads=2).x for one in (code, plain)]
    assert (results[0] == results[1]).all()


def test_no_compiler_is_an_error_that_says_so(pair, centre, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    plant = Plant(pair, compiled=True, dt=0.77e-3)  # not compiled before
    plant.reset(start_at(centre), centre)
    with pytest.raises(CompilerError, match=r"no-such-compiler.*set CC"):
        plant.step(start_at(centre), (0.0, 0.0))
