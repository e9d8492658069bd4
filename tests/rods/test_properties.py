"""Whatever is put in: an equilibrium by the rod equation, or an error with a name. Never a crash, a hang or a NaN."""

import math
import time
import warnings
from collections import Counter
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pcr_mpc import (
    Equilibrium,
    LinearModel,
    LinearMPC,
    ModelError,
    PCRError,
    Plant,
    Robot,
    Rod,
    forward_statics,
    inverse_statics,
    linearise,
    load_robot,
    load_tuning,
    solve_statics,
)
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.control.qp.program import Reference
from tests.conftest import CONTROLLERS, MODELS

from .rod_check import TOLERANCE, residuals

PAIR = load_robot(MODELS / "planar_pair.toml")
TUNING = replace(load_tuning(CONTROLLERS / "default.toml"), horizon=5, fallback="raise", max_iterations=4000)
# What callers are told to expect; anything else is a crash.
NAMED = (PCRError, ValueError)
PATIENCE = 20.0  # s of the processor for one call: a hang, not a timing


def cases(count):
    return settings(
        max_examples=count, derandomize=True, deadline=None, print_blob=True, database=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip


def in_earnest(few, many, check, *strategies):
    """The test of a few cases, and the slow one of many."""
    return cases(few)(given(*strategies)(check)), pytest.mark.slow(cases(many)(given(*strategies)(check)))


@pytest.fixture
def count():
    """Of cases, and of those that came to the assertion: most, or the test says nothing."""
    counted = Counter()
    yield counted
    assert counted["reached"] > 0.6 * counted["cases"] > 0, counted


def mostly(ordinary, *others):
    """One in sixteen is of each other kind: so few that of 30 cases, with four such arguments, six in ten arrive.

    Hypothesis draws the constants of all modules that are loaded, too: cases differ from one company to another.
    """
    return st.integers(0, 15).flatmap(lambda k: others[k] if k < len(others) else ordinary)


strange = st.sampled_from([0.0, -0.0, 5e-324, 1e-300, -1e-9, 1e8, 1e200, -1e200, math.inf, -math.inf, math.nan])
tip = st.one_of(st.floats(-0.6, 0.6), strange)
tips = mostly(
    st.tuples(st.floats(-0.2, 0.2), st.floats(-0.3, 0.3)),
    st.tuples(tip, tip),
    # Exactly at a base, and along a ray from it, up to full stretch.
    st.builds(
        lambda stretch, angle: (-0.1 + 0.4 * stretch * math.cos(angle), 0.4 * stretch * math.sin(angle)),
        st.sampled_from([0.0, 1e-12, 0.5, 0.99, 0.9999, 1 - 1e-9, 1.0, 1 + 1e-12]),
        st.floats(-math.pi, math.pi),
    ),
)
angle = st.one_of(st.floats(-4.0, 7.0), st.floats(-1e3, 1e3), strange)
angles = mostly(st.tuples(st.floats(-4.0, 7.0), st.floats(-4.0, 4.0)), st.tuples(angle, angle))
# Where every method works: about the pose with rods bowed outward.
near_tips = mostly(st.tuples(st.floats(-0.05, 0.05), st.floats(0.2, 0.28)), tips)
near_angles = mostly(st.tuples(st.floats(3.1, 3.6), st.floats(-0.4, 0.0)), angles)
shapes = st.sampled_from([None, "text", 1.0, True, [], [0.1], [0.1, 0.2, 0.3], [[0.1, 0.2]], [None, 0.1], ["a", "b"]])


def checked(call, count=None):
    """The result of a call, or None if it refused by name; fails on anything else."""
    count = Counter() if count is None else count
    count["cases"] += 1
    began = time.process_time()
    try:
        result = call()
    except NAMED as error:
        result, words = None, str(error)
    else:
        words = "a result"
        count["reached"] += 1
    assert time.process_time() - began < PATIENCE
    assert words
    return result


def require_equilibrium(eq):
    for field in fields(Equilibrium):
        value = getattr(eq, field.name)
        if isinstance(value, np.ndarray | float):
            assert np.isfinite(value).all(), field.name
    # The rounding of the tip position counts by the slack.
    tolerance = TOLERANCE[eq.method] + 1e-14 / max(min(eq.robot.slacks(eq.p)), 1e-9)
    wrong = {name: value for name, value in residuals(eq).items() if not value < tolerance}
    assert not wrong, (eq.p, eq.q, wrong)


def test_the_judge_can_tell():
    eq = solve_statics(PAIR, (0.05, 0.25), (3.0, 0.0))
    require_equilibrium(eq)
    for field, spoiled in (
        ("rod_forces", eq.rod_forces * 1.001),
        ("nodes", eq.nodes + 1e-4),
        ("force", eq.force * math.nan),
        ("motor_torque", -eq.motor_torque),
    ):
        with pytest.raises(AssertionError):
            require_equilibrium(replace(eq, **{field: spoiled}))


@cases(80)
@given(tips, angles)
def test_closed_form(count, p, q):
    eq = checked(lambda: solve_statics(PAIR, p, q), count)
    if eq is not None:
        require_equilibrium(eq)


@pytest.mark.slow
@pytest.mark.longest
@cases(5000)
@given(tips, angles)
def test_closed_form_over_5000_more(count, p, q):
    eq = checked(lambda: solve_statics(PAIR, p, q), count)
    if eq is not None:
        require_equilibrium(eq)


def multiple_shooting(count, p, q, segments, steps):
    eq = checked(lambda: solve_statics(PAIR, p, q, method="multiple_shooting", segments=segments, steps=steps), count)
    if eq is not None and steps is None:
        require_equilibrium(eq)


test_multiple_shooting, test_multiple_shooting_more = in_earnest(
    30,
    40,
    multiple_shooting,
    near_tips,
    near_angles,
    mostly(st.integers(4, 12), st.integers(-1, 3)),
    mostly(st.none(), st.integers(0, 2)),
)


def single_shooting(count, p, q):
    eq = checked(lambda: solve_statics(PAIR, p, q, method="single_shooting"), count)
    if eq is not None:
        require_equilibrium(eq)


test_single_shooting, test_single_shooting_more = in_earnest(
    8,
    15,
    single_shooting,
    near_tips,
    near_angles,
)


def followed(count, p, q, p_end, q_end):
    start = checked(lambda: solve_statics(PAIR, p, q))
    if start is None:
        return
    end = checked(lambda: solve_statics(PAIR, p_end, q_end, guess=start), count)
    if end is not None:
        require_equilibrium(end)


test_followed, test_followed_more = in_earnest(
    40,
    120,
    followed,
    near_tips,
    near_angles,
    near_tips,
    near_angles,
)


@cases(300)
@given(shapes, shapes)
def test_wrong_shapes_are_refused(p, q):
    for call in (
        lambda: solve_statics(PAIR, p, q),
        lambda: forward_statics(PAIR, q if q != [0.1, 0.2] else None),
        lambda: inverse_statics(PAIR, p),
        lambda: Plant(PAIR).reset(p),
    ):
        with pytest.raises(NAMED):
            call()


number = st.one_of(st.floats(-1.0, 2.0), strange, st.sampled_from([True, "1", None]))
rods = st.fixed_dictionaries(
    {
        "base": st.tuples(st.floats(-0.3, 0.3), st.floats(0.0, 0.05)),
        "length": st.floats(0.2, 0.6),
        "bending_stiffness": st.floats(1e-3, 1.0),
        "line_density": st.floats(0.0, 0.1),
        "angle_limits": st.just((-3.0, 3.0)),
    }
)
numbers = st.fixed_dictionaries(
    {
        "tip_mass": st.floats(1e-3, 2.0),
        "drag": st.floats(0.0, 1.0),
        "rate_limit": st.floats(0.1, 10.0),
        "acceleration_limit": st.floats(1.0, 1e3),
        "torque_limit": st.floats(0.1, 10.0),
    }
)
# At most one number of a sound robot is replaced.
spoiled = mostly(
    st.none(),
    st.tuples(
        st.sampled_from(["length", "bending_stiffness", "line_density", "tip_mass", "drag", "rate_limit"]), number
    ),
)


@cases(40)
@given(st.lists(rods, min_size=2, max_size=3), numbers, spoiled)
def test_robots_are_sound_or_refused(count, rods, numbers, spoiled):
    if spoiled is not None:
        key, value = spoiled
        (numbers if key in numbers else rods[0])[key] = value

    for k, rod in enumerate(rods):  # side by side
        x, y = rod["base"]
        rod["base"] = (x, y + 0.1 * k)

    robot = checked(lambda: Robot(name="generated", rods=tuple(Rod(**rod) for rod in rods), **numbers), count)
    if robot is None:
        return
    assert (robot.lengths > 0).all()
    assert (robot.stiffnesses > 0).all()
    assert robot.tip_mass > 0
    assert robot.drag >= 0
    assert np.isfinite([*robot.lengths, *robot.stiffnesses, robot.tip_mass, robot.drag, robot.rate_limit]).all()
    at = robot.bases[0] + 0.3 * robot.lengths.min()
    if min(robot.slacks(at)) > 0.0 and 1e-9 < robot.stiffnesses.min() and robot.stiffnesses.max() < 1e6:
        eq = checked(lambda: solve_statics(robot, at, np.ones(robot.n_rods)))
        if eq is not None:
            require_equilibrium(eq)


@cases(200)
@given(st.sampled_from(["tip_mass", "drag", "length", "bending_stiffness", "base", "angle_limits"]), number)
def test_robot_files_are_read_or_refused(tmp_path_factory, key, value):
    text = (MODELS / "planar_pair.toml").read_text(encoding="utf-8")
    lines = [
        f"{key} = {str(value).lower()}" if line.split("=")[0].strip() == key else line for line in text.splitlines()
    ]
    path = tmp_path_factory.getbasetemp() / "generated.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    try:
        with warnings.catch_warnings(action="ignore"):  # doubts about units
            robot = load_robot(path)
    except ModelError as error:
        words = str(error)
    else:
        words = ""
        assert np.isfinite(robot.lengths).all()
    assert not words or "generated.toml" in words


def plant_and_linear_model(count, p, v, q, u, dt, inertia):
    plant = Plant(PAIR, inertia=inertia, dt=dt)
    x = [*p, *v, *q]
    if checked(lambda: plant.reset(x) or True) is None:
        return
    moved = checked(lambda: plant.step(x, u), count)
    if moved is not None:
        assert np.isfinite(moved).all()
    model = checked(lambda: linearise(plant, x, u, dt), count)
    if model is not None:
        assert all(np.isfinite(block).all() for block in (model.A, model.B, model.c, model.E))


test_plant_and_linear_model, test_plant_and_linear_model_more = in_earnest(
    100,
    300,
    plant_and_linear_model,
    near_tips,
    mostly(st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)), st.tuples(tip, tip)),
    near_angles,
    mostly(st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)), st.tuples(tip, tip)),
    st.sampled_from([1e-4, 1e-3, 0.05]),
    st.sampled_from(["none", "constant", "condensed"]),
)


@cases(60)
@given(
    mostly(st.lists(st.floats(-0.6, 0.6), min_size=6, max_size=6), st.lists(tip, min_size=6, max_size=6)),
    mostly(st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)), st.tuples(tip, tip)),
    mostly(st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)), st.tuples(tip, tip)),
)
def test_mpc(count, x, previous, wanted):
    a = np.eye(6) + 0.01 * np.eye(6, k=2)
    model = LinearModel(a, 0.01 * np.eye(6, 2, k=-4), np.zeros(6), np.zeros((6, 2)), 0.01, np.zeros(2))
    mpc = LinearMPC(TUNING, Limits(7.0, 1.0, np.full(2, -2.0), np.full(2, 5.0)))
    reference = Reference(np.tile([*wanted, 0, 0, 0, 0], (5, 1)), np.zeros((5, 2)))
    plan = checked(lambda: mpc.solve(np.array(x), model, reference, np.array(previous)), count)
    if plan is not None:
        assert np.isfinite(plan.inputs).all()
        assert np.abs(plan.inputs[0]).max() <= 7.0
        assert np.abs(plan.inputs[0] - previous).max() <= 1.0 + 1e-12


@pytest.mark.slow
@cases(60)
@given(tips, angles)
def test_free_tips(count, p, q):
    for call in (lambda: forward_statics(PAIR, q), lambda: inverse_statics(PAIR, p)):
        eq = checked(call, count)
        if eq is not None:
            require_equilibrium(eq)
            assert eq.stable
            assert np.linalg.norm(eq.force) < 1e-4
