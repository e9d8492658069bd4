"""Whatever is put in: an equilibrium by the rod equation, or an error with a name. Never a crash, a hang or a NaN."""

import math
import time
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
from pcr_mpc.control.qp import Reference
from pcr_mpc.control.tuning import Limits

from .conftest import CONTROLLERS, MODELS
from .rod_check import TOLERANCE, residuals

PAIR = load_robot(MODELS / "planar_pair.toml")
# What callers are told to expect; anything else is a crash.
NAMED = (PCRError, ValueError, TypeError)
PATIENCE = 20.0  # s for one call: a hang, not a timing


def cases(count):
    return settings(
        max_examples=count, derandomize=True, deadline=None, print_blob=True, database=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip


strange = st.sampled_from([0.0, -0.0, 5e-324, 1e-300, -1e-9, 1e8, 1e200, -1e200, math.inf, -math.inf, math.nan])
tip = st.one_of(st.floats(-0.6, 0.6), strange)
tips = st.one_of(
    st.tuples(st.floats(-0.3, 0.3), st.floats(-0.4, 0.4)),
    st.tuples(tip, tip),
    # Exactly at a base, and along a ray from it, up to full stretch.
    st.builds(
        lambda stretch, angle: (-0.1 + 0.4 * stretch * math.cos(angle), 0.4 * stretch * math.sin(angle)),
        st.sampled_from([0.0, 1e-12, 0.5, 0.99, 0.9999, 1 - 1e-9, 1.0, 1 + 1e-12]),
        st.floats(-math.pi, math.pi),
    ),
)
angle = st.one_of(st.floats(-4.0, 7.0), st.floats(-1e3, 1e3), strange)
angles = st.one_of(st.tuples(st.floats(-4.0, 7.0), st.floats(-4.0, 4.0)), st.tuples(angle, angle))
shapes = st.sampled_from([None, "text", 1.0, True, [], [0.1], [0.1, 0.2, 0.3], [[0.1, 0.2]], [None, 0.1], ["a", "b"]])


def checked(call):
    """The result of a call, or None if it refused by name; fails on anything else."""
    began = time.perf_counter()
    try:
        result = call()
    except NAMED as error:
        result, words = None, str(error)
    else:
        words = "a result"
    assert time.perf_counter() - began < PATIENCE
    assert words
    return result


def require_equilibrium(eq):
    for field in fields(Equilibrium):
        value = getattr(eq, field.name)
        if isinstance(value, np.ndarray | float):
            assert np.isfinite(value).all(), field.name
    tolerance = TOLERANCE[eq.method]
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


@cases(1000)
@given(tips, angles)
def test_closed_form(p, q):
    eq = checked(lambda: solve_statics(PAIR, p, q))
    if eq is not None:
        require_equilibrium(eq)


@pytest.mark.slow
@cases(5000)
@given(tips, angles)
def test_closed_form_over_5000_more(p, q):
    eq = checked(lambda: solve_statics(PAIR, p, q))
    if eq is not None:
        require_equilibrium(eq)


@cases(120)
@given(tips, angles, st.integers(-1, 12), st.sampled_from([None, 0, 1, 2]))
def test_multiple_shooting(p, q, segments, steps):
    eq = checked(lambda: solve_statics(PAIR, p, q, method="multiple_shooting", segments=segments, steps=steps))
    if eq is not None and steps is None:
        require_equilibrium(eq)


@cases(15)
@given(tips, angles)
def test_single_shooting(p, q):
    eq = checked(lambda: solve_statics(PAIR, p, q, method="single_shooting"))
    if eq is not None:
        require_equilibrium(eq)


@cases(400)
@given(tips, angles, tips, angles)
def test_followed(p, q, p_end, q_end):
    start = checked(lambda: solve_statics(PAIR, p, q))
    if start is None:
        return
    end = checked(lambda: solve_statics(PAIR, p_end, q_end, guess=start))
    if end is not None:
        require_equilibrium(end)


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


@cases(2000)
@given(st.lists(st.tuples(number, number, number, number), max_size=3), number, number, number)
def test_robots_are_sound_or_refused(rods, mass, drag, rate):
    def build():
        return Robot(
            name="generated",
            rods=tuple(
                Rod(base=(x, y), length=length, bending_stiffness=stiffness, angle_limits=(-3.0, 3.0))
                for x, y, length, stiffness in rods
            ),
            tip_mass=mass, drag=drag, rate_limit=rate, acceleration_limit=100.0, torque_limit=1.0,
        )  # fmt: skip

    robot = checked(build)
    if robot is None:
        return
    assert robot.rods
    assert (robot.lengths > 0).all()
    assert (robot.stiffnesses > 0).all()
    assert robot.tip_mass > 0
    for centre in robot.bases:
        eq = checked(lambda at=centre: solve_statics(robot, at + 0.3 * robot.lengths.min(), np.ones(robot.n_rods)))
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
        robot = load_robot(path)
    except ModelError as error:
        words = str(error)
    else:
        words = ""
        assert np.isfinite(robot.lengths).all()
    assert not words or "generated.toml" in words


@cases(1000)
@given(
    tips,
    st.tuples(tip, tip),
    angles,
    st.tuples(tip, tip),
    st.sampled_from([1e-4, 1e-3, 0.05]),
    st.sampled_from(["none", "constant", "condensed"]),
)
def test_plant_and_linear_model(p, v, q, u, dt, inertia):
    plant = Plant(PAIR, inertia=inertia, dt=dt)
    x = [*p, *v, *q]
    if checked(lambda: plant.reset(x) or True) is None:
        return
    moved = checked(lambda: plant.step(x, u))
    if moved is not None:
        assert np.isfinite(moved).all()
    model = checked(lambda: linearise(plant, x, u, dt))
    if model is not None:
        assert all(np.isfinite(block).all() for block in (model.A, model.B, model.c, model.E))


@cases(300)
@given(st.lists(tip, min_size=6, max_size=6), st.tuples(tip, tip), st.tuples(tip, tip))
def test_mpc(x, previous, wanted):
    tuning = replace(load_tuning(CONTROLLERS / "default.toml"), horizon=5, fallback="raise")
    a = np.eye(6) + 0.01 * np.eye(6, k=2)
    model = LinearModel(a, 0.01 * np.eye(6, 2, k=-4), np.zeros(6), np.zeros((6, 2)), 0.01, np.zeros(2))
    mpc = LinearMPC(tuning, Limits(7.0, 1.0, np.full(2, -2.0), np.full(2, 5.0)))
    reference = Reference(np.tile([*wanted, 0, 0, 0, 0], (5, 1)), np.zeros((5, 2)))
    plan = checked(lambda: mpc.solve(np.array(x), model, reference, np.array(previous)))
    if plan is not None:
        assert np.isfinite(plan.inputs).all()
        assert np.abs(plan.inputs[0]).max() <= 7.0


@pytest.mark.slow
@cases(60)
@given(tips, angles)
def test_free_tips(p, q):
    for call in (lambda: forward_statics(PAIR, q), lambda: inverse_statics(PAIR, p)):
        eq = checked(call)
        if eq is not None:
            require_equilibrium(eq)
            assert eq.stable
            assert np.linalg.norm(eq.force) < 1e-4
