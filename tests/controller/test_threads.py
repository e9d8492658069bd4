"""Objects made in one thread and used in others give what they give alone."""

import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    Plant,
    Reference,
    all_equilibria,
    forward_statics,
    inverse_statics,
    linearise,
    load_scene,
    load_tuning,
    make_controller,
    rollout,
    solve_statics,
)
from pcr_mpc.buffered import graph_cache, per_thread
from pcr_mpc.control.mpc import LinearMPC
from pcr_mpc.loop.parts.assembled import motor_limits
from tests.conftest import CONTROLLERS, MODELS

SCENE = MODELS / "scenes" / "lemniscate.toml"


def at_once(*tasks):
    """Results of the tasks, each in a thread of its own, begun together and interleaved as often as Python can."""
    gate = threading.Barrier(len(tasks))

    def run(task):
        gate.wait()
        return task()

    with ThreadPoolExecutor(len(tasks)) as pool:
        return list(pool.map(run, tasks))


@pytest.fixture(autouse=True)
def eager_switching():
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def steps(controller, pose, factor, count=100):
    """Rates that a controller answers to measurements near the start."""
    x = np.concatenate([pose.p, [0, 0], pose.q])
    shift = factor * np.array([1e-5, -2e-5, 0, 0, 1e-5, 3e-5])
    return np.array([controller.step(k, x + k * shift).u for k in range(count)])


def test_controllers_made_here_and_stepped_elsewhere():
    tuning = replace(load_tuning(CONTROLLERS / "default.toml"), horizon=8)
    scene = replace(load_scene(SCENE).tuned(tuning), duration=1.0)
    pose, factors = scene.start(), (1.0, -1.0)
    alone = []
    for factor in factors:
        controller = make_controller(scene)
        controller.start(pose)
        alone.append(steps(controller, pose, factor))
    assert np.abs(alone[0] - alone[1]).max() > 1e-3  # what would be seen if they were mixed up
    together = [make_controller(scene) for _ in factors]
    for controller in together:
        controller.start(pose)
    found = at_once(
        *(
            lambda c=controller, f=factor: steps(c, pose, f)
            for controller, factor in zip(together, factors, strict=True)
        )
    )
    for one, other in zip(found, alone, strict=True):
        np.testing.assert_array_equal(one, other)


def test_linear_mpcs_made_here_and_solved_elsewhere(pair, centre):
    tuning = replace(load_tuning(CONTROLLERS / "default.toml"), horizon=6)
    target = np.concatenate([centre.p, [0, 0], centre.q])
    plant = Plant(pair)
    plant.reset(target, centre)
    model = linearise(plant, target, (0.0, 0.0), 0.01)
    reference = Reference(np.tile(target, (6, 1)), np.zeros((6, 2)))

    def plans(mpc, factor):
        x, u, found = target + factor * np.array([1e-3, 2e-3, 0, 0, 0, 0]), np.zeros(2), []
        for _ in range(60):
            plan = mpc.solve(x, [model] * 6, reference, u)
            u = plan.inputs[0]
            found.append(np.concatenate([plan.inputs.ravel(), plan.states.ravel()]))
            x = model(x, u)
        return np.array(found)

    def made():
        mpc = LinearMPC(tuning, motor_limits(pair, 0.01))
        mpc.prepare(model)
        return mpc

    factors = (1.0, -1.0, 3.0)
    alone = [plans(made(), factor) for factor in factors]
    together = [made() for _ in factors]
    found = at_once(*(lambda m=mpc, f=factor: plans(m, f) for mpc, factor in zip(together, factors, strict=True)))
    for one, other in zip(found, alone, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("inertia", ["none", "condensed"])
def test_plants_made_here_and_moved_elsewhere(pair, centre, inertia):
    x0 = np.concatenate([centre.p, [0, 0], centre.q])

    def motion(plant, rate):
        x, found = x0, []
        for k in range(60):
            x = plant.step(x, (rate, -rate))
            model = linearise(plant, x, (0.0, 0.0), 0.01)
            found.append(np.concatenate([x, model.A.ravel(), model.c]) if k % 3 else np.tile(x, 9)[:48])
        return np.array([row[:6] for row in found]), found[-1]

    def made():
        plant = Plant(pair, inertia=inertia)
        plant.reset(x0, centre)
        return plant

    rates = (0.5, -0.5, 1.0)
    alone = [motion(made(), rate) for rate in rates]
    together = [made() for _ in rates]
    found = at_once(*(lambda p=plant, r=rate: motion(p, r) for plant, rate in zip(together, rates, strict=True)))
    for one, other in zip(found, alone, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])


def test_functions_called_at_once(pair, centre):
    rng = np.random.default_rng(3)
    poses = [(centre.p + rng.uniform(-0.05, 0.05, 2), centre.q + rng.uniform(-0.3, 0.3, 2)) for _ in range(6)]

    def statics(method):
        return [solve_statics(pair, p, q, method=method).force for p, q in poses]

    def balance():
        tips = [forward_statics(pair, q, guess=centre).p for _, q in poses[:3]]
        return tips + [inverse_statics(pair, p, guess=centre).q for p, _ in poses]

    def moved(rate):
        x0 = np.concatenate([centre.p, [0, 0], centre.q])
        return [rollout(Plant(pair), x0, np.full((2, 40, 2), rate), guess=centre).x]

    def others():
        return [eq.force for eq in all_equilibria(pair, poses[0][0], poses[0][1])]

    tasks = [
        lambda: statics("closed_form"),
        lambda: statics("multiple_shooting"),
        balance,
        lambda: moved(0.5),
        lambda: moved(-0.7),
        others,
    ]
    alone = [task() for task in tasks]
    for one, other in zip(at_once(*tasks), alone, strict=True):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_graphs_are_built_by_one_thread_at_a_time():
    """CasADi crashes where two threads build expressions."""
    inside, most = [], []

    @graph_cache()
    def build(name):
        inside.append(name)
        most.append(len(inside))
        time.sleep(0.01)
        inside.remove(name)
        return name

    assert at_once(*(lambda n=name: build(n) for name in "abcda")) == list("abcda")
    assert most == [1, 1, 1, 1]


def test_what_is_made_per_thread_is_made_once_in_each():
    @per_thread(maxsize=2)
    def make(name):
        return object()

    def twice():
        return make("a"), make("a")

    found = [twice(), *at_once(twice, twice)]
    assert all(one is other for one, other in found)
    assert len({one for one, _ in found}) == 3
