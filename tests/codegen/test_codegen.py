"""C of plant and controller against Python: the same rates, rungs and iterations, by compilers that forgive nothing."""

import re
import subprocess
from collections import Counter
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc.codegen.folder import write_folder
from pcr_mpc.codegen.library import GeneratedController, build
from pcr_mpc.codegen.solver import flops
from pcr_mpc.codegen.subject import Subject
from pcr_mpc.codegen.tables import parameters
from pcr_mpc.codegen.timing import time_in_c, worst_case
from pcr_mpc.codegen.vectors import recorded
from pcr_mpc.control.tuning import load_tuning
from pcr_mpc.errors import MeasurementError, PCRError
from pcr_mpc.loop.controller.make_controller import make_controller
from pcr_mpc.loop.hardware.camera import Camera
from pcr_mpc.loop.hardware.motors import Motors
from pcr_mpc.loop.scene.file import load_scene
from tests.codegen.conftest import CC, QUICK, SCENES, copied, generated, make, needs_compiler, run
from tests.conftest import ROOT


@needs_compiler
def test_the_lemniscate_runs_in_c_as_it_does_in_python(lemniscate):
    said = run(make(lemniscate, *QUICK))
    rms, other = (float(word) for word in re.findall(r"([\d.]+) mm", said)[:2])
    assert abs(rms - other) <= 1e-9
    assert 0.001 < rms < 0.003  # what the README says of the scene
    differences = [float(word) for word in re.findall(r"at most ([\d.e+-]+) rad/s", said)]
    assert len(differences) == 2
    assert max(differences) <= 1e-9
    assert said.count("rung or iterations in 0 of 600 periods") == 2
    assert "plant, recorded rates       differs by at most 0 m" in said


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "solver"), [("sensors", "osqp"), ("payload", "osqp"), ("lemniscate", "daqp"), ("limited", "daqp")]
)
def test_a_scene_runs_in_c_as_it_does_in_python(scene, solver, tmp_path):
    said = run(make(generated(scene, tmp_path / scene, solver), *QUICK))
    assert said.count("rung or iterations in 0 of ") == 2
    assert max(float(word) for word in re.findall(r"at most ([\d.e+-]+) rad/s", said)) <= 1e-9


def side_by_side(scene, folder, seconds):
    """Controllers in C and in Python in the same loop; how often each limit was active."""
    scene = scene.tuned(replace(scene.tuning, model=replace(scene.tuning.model, compiled=False)))
    subject = Subject.of_scene(scene)
    write_folder(subject, None, folder)
    in_c = GeneratedController(build(folder, f"CC={CC}", *QUICK), subject)
    in_python, plant, active = make_controller(scene), scene.make_plant(), Counter()
    in_python.start(subject.pose)
    in_c.start()
    x = np.concatenate([subject.pose.p, [0.0, 0.0], subject.pose.q])
    plant.reset(x, subject.pose)
    for k in range(round(seconds / scene.period)):
        measured = hostile(np.random.default_rng(k), k, x) if 0 < k < 40 else x
        expected, found = in_python.step(k, measured), in_c.step(k, measured)
        assert found.u == pytest.approx(expected.u, abs=1e-9), k
        mine, other = found.plan, expected.plan
        assert (mine.fallback, mine.iterations, mine.active) == (other.fallback, other.iterations, other.active), k
        active.update(mine.active)
        for _ in range(round(scene.period / plant.dt)):
            x = plant.step(x, found.u)
    return active


@needs_compiler
@pytest.mark.slow
def test_a_motor_target_that_is_shot_follows_in_c(tmp_path):
    # Three kinds of rods with different numbers: a model with weight by its potential, a target that sags, plain ones.
    side_by_side(load_scene(SCENES / "heavy_rods.toml"), tmp_path, 0.8)


@needs_compiler
@pytest.mark.slow
def test_what_is_late_in_the_loop_is_late_in_c(tmp_path):
    # Servos with lag and play, pictures that are old, rare and sometimes lost, commands that come within a step.
    scene = replace(
        load_scene(SCENES / "servo.toml"),
        duration=0.8,
        motors=Motors(time_constant=0.015, backlash=0.01, command="angle"),
        camera=Camera(latency=0.0133, every=2, lost=0.2),
        untold_delay=0.0037,
        delay=1,
    )
    scene = scene.tuned(replace(scene.tuning, model=replace(scene.tuning.model, compiled=False)))
    subject = Subject.of_scene(scene)
    write_folder(subject, recorded(subject), tmp_path)
    said = run(make(tmp_path, *QUICK))
    assert said.count("rung or iterations in 0 of 80 periods") == 2
    assert "plant, recorded rates       differs by at most 0 m" in said


@needs_compiler
@pytest.mark.slow
def test_limits_of_rods_that_are_shot_are_kept_in_c(tmp_path):
    # So little strain is allowed that the QP keeps to it, from the start on.
    scene = load_scene(SCENES / "curved_rods.toml")
    scene = replace(scene, pose_limits=replace(scene.pose_limits, strain=0.0046))
    assert side_by_side(scene, tmp_path, 1.2)["strain"] > 20


def hostile(rng, k, x):
    """What is measured in period k where the sensors do their worst."""
    x = x.copy()
    kind = k % 23
    if kind == 3:
        x[rng.integers(len(x))] = rng.choice([np.nan, np.inf, -np.inf])
    elif kind == 7:
        x[:2] += rng.normal(0.0, 0.3, 2)  # out of reach, now and then
    elif kind == 11:
        x[4:] += rng.normal(0.0, 2.0, len(x) - 4)
    elif kind == 15:
        x[:] = rng.choice([1e308, -1e308, 0.0], len(x))
    elif 200 <= k < 240:
        x[:2] += [0.02, 0.0]  # a sensor that insists
    return x


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize(("tuning", "solver", "most"), [("default", "osqp", 25), ("lemniscate", "daqp", 15)])
def test_the_worst_leads_to_the_same_rungs(tuning, solver, most, tmp_path):
    # Few iterations and a load that throws the tip about: every rung of the ladder has its turn.
    tuning = load_tuning(ROOT / "controllers" / f"{tuning}.toml")
    scene = load_scene(SCENES / "lemniscate.toml").tuned(replace(tuning, max_iterations=most, solver=solver))
    subject = Subject.of_scene(scene)
    write_folder(subject, None, tmp_path / "c")
    library = build(tmp_path / "c", f"CC={CC}", *QUICK)
    in_c, other = GeneratedController(library, subject), GeneratedController(library, subject)
    in_python = make_controller(scene)
    in_python.start(subject.pose)
    in_c.start()
    plant, rng = scene.make_plant(), np.random.default_rng(5)
    x = np.concatenate([subject.pose.p, [0.0, 0.0], subject.pose.q])
    plant.reset(x, subject.pose)
    rungs, doubts = set(), 0
    for k in range(380):
        measured = hostile(rng, k, x) if k else x
        expected, found = in_python.step(k, measured), in_c.step(k, measured)
        assert (found.plan.fallback, found.plan.iterations) == (expected.plan.fallback, expected.plan.iterations), k
        assert found.u == pytest.approx(expected.u, abs=1e-9), k
        # Of a plan that is moved on, a limit counts that changes it, by rounding too, in which builds of DAQP differ.
        if solver == "osqp" or found.plan.fallback is None:
            assert found.plan.active == expected.plan.active, k
        assert bool(in_c.output.doubts) == bool(expected.events), k
        rungs.add(found.plan.fallback)
        doubts += in_c.output.doubts != 0
        if k == 100:
            other.start()  # a second controller in this process changes nothing of the first
            other.step(0, x)
        push = 6.0 * np.array([np.sin(k / 7), np.cos(k / 5)]) if k >= 240 and k // 50 % 2 else np.zeros(2)
        with suppress(PCRError):
            for _ in range(10):
                x = plant.step(x, found.u, push)
    assert doubts > 40
    assert rungs >= {None, "shifted_plan", "lqr"}


@needs_compiler
@pytest.mark.slow
def test_parameters_that_change_while_it_runs_do_what_retune_does(lemniscate, tmp_path):
    scene = load_scene(SCENES / "lemniscate.toml")
    subject = Subject.of_scene(scene)
    other = replace(scene.tuning, position_weight=3e4, input_weight=0.02)
    in_c = GeneratedController(build(copied(lemniscate, tmp_path), f"CC={CC}", *QUICK), subject)
    in_python, as_before = make_controller(scene), make_controller(scene)
    for controller in (in_c, in_python, as_before):
        controller.start(subject.pose)
    plant, x, changed = scene.make_plant(), np.concatenate([subject.pose.p, [0.0, 0.0], subject.pose.q]), 0.0
    for controller in (in_c, in_python):  # before it is on its way
        with pytest.raises(MeasurementError, match=r"centimetres|other units"):
            controller.step(0, np.concatenate([1e2 * x[:2], x[2:]]))  # centimetres
    plant.reset(x, subject.pose)
    for k in range(80):
        if k == 20:  # what is refused changes nothing
            for name, value in (
                ("weights", -np.asarray(parameters(subject)["weights"])),
                ("angle_lower", np.full(2, 9.0)),
            ):
                with pytest.raises(PCRError, match="refuses"):
                    in_c.set_parameters(parameters(subject) | {name: value})
            measured, horizon = in_c._measured, scene.tuning.horizon
            for name, size, wrong in (
                ("window", 10 * horizon, (np.nan, np.inf)),
                ("payloads", subject.work.foresight.places.count, (np.nan, np.inf, -5.0)),
            ):
                for place, value in ((0, wrong[0]), *((size - 1, each) for each in wrong)):
                    given = np.zeros(size)
                    given[place] = value
                    setattr(measured, name, given.ctypes.data)
                    assert in_c.raw_step(x) == 2, (name, place, value)
                setattr(measured, name, None)
        if k == 40:
            in_python.retune(other)
            in_c.set_parameters(parameters(Subject.of_scene(scene, other)))
        expected, found = in_python.step(k, x), in_c.step(k, x)
        assert found.u == pytest.approx(expected.u, abs=1e-9), k
        assert found.plan.iterations == expected.plan.iterations, k
        changed = max(changed, float(np.abs(as_before.step(k, x).u - found.u).max()))
        for _ in range(10):
            x = plant.step(x, found.u)
    assert changed > 1e-5


def test_the_longest_step_is_the_iterations_allowed_times_what_one_costs():
    """Of the largest QP, whose iterations cost as many times more as they have more operations."""
    subject = Subject.of_scene(replace(load_scene(SCENES / "lemniscate.toml"), duration=0.05))
    counts, capped = np.array([5, 5, 10, 15, 20]), np.full(5, 1e-6 * (30 + 0.4 * 500))
    ratio = flops(subject.limited[-1], "osqp", 12) / flops(subject.rates, "osqp", 12)
    assert ratio > 2  # what is soft counts
    found = worst_case(subject, counts, 1e-6 * (30 + 0.4 * counts), capped)
    assert found["iteration_us"] == pytest.approx(0.4 * ratio)
    assert found["rest_us"] == pytest.approx(30)
    assert found["us"] == pytest.approx(30 + 500 * 0.4 * ratio)
    assert worst_case(subject, counts, np.full(5, 1e-5), None)["us"] is None


@needs_compiler
@pytest.mark.slow
def test_steps_in_c_are_timed_one_by_one(monkeypatch):
    monkeypatch.setenv("MAKEFLAGS", f"CC={CC} CFLAGS=-O0 GRAPH_CFLAGS=-O0")
    scene = replace(load_scene(SCENES / "lemniscate.toml"), duration=0.2)
    found = time_in_c(scene, "osqp", 35)
    assert (found["control"].shape, found["plant"].shape) == ((40, 2), (400, 2))  # whole runs
    assert (found["plant"] > 0).all()
    worst = found["worst"]
    assert worst["iterations"] == scene.tuning.max_iterations
    assert worst["us"] == pytest.approx(worst["rest_us"] + worst["iterations"] * worst["iteration_us"])


@needs_compiler
def test_the_program_of_the_readme_compiles_as_it_says(lemniscate, tmp_path):
    text = (lemniscate / "README.md").read_text()
    (tmp_path / "loop.c").write_text(re.search(r"```c\n(.*?)```", text, re.DOTALL)[1])
    line = re.search(r"^cc (.*) loop\.c libpcr\.a -lm -o loop$", text, re.MULTILINE)[1].split()
    words = [CC, *line, "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only", str(tmp_path / "loop.c")]
    done = subprocess.run(words, cwd=lemniscate, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
