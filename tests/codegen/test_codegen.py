"""C of plant and controller against Python: the same rates, rungs and iterations, by compilers that forgive nothing."""

import os
import re
import shutil
import subprocess
from collections import Counter
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc.cli import main
from pcr_mpc.codegen.folder import write_folder
from pcr_mpc.codegen.library import GeneratedController, build
from pcr_mpc.codegen.scope import check_scope
from pcr_mpc.codegen.solver import flops
from pcr_mpc.codegen.subject import Subject
from pcr_mpc.codegen.tables import parameters
from pcr_mpc.codegen.timing import time_in_c, worst_case
from pcr_mpc.codegen.vectors import recorded
from pcr_mpc.control.observer import ObserverTuning
from pcr_mpc.control.tuning import LearningTuning, load_tuning
from pcr_mpc.errors import GenerationError, MeasurementError, PCRError
from pcr_mpc.loop.controller.make_controller import make_controller
from pcr_mpc.loop.hardware.camera import Camera
from pcr_mpc.loop.hardware.motors import Motors
from pcr_mpc.loop.scene.file import load_scene
from tests.conftest import ROOT

SCENES = ROOT / "models" / "scenes"
CC = os.environ.get("CC") or "gcc"
needs_compiler = pytest.mark.skipif(
    not (shutil.which(CC) and shutil.which("make")), reason="generated C is compiled here: needs gcc and make"
)
# Quick to build; no optimisation may change a bit of what it computes.
QUICK = ["CFLAGS=-O0", "GRAPH_CFLAGS=-O0"]
INCLUDED = ["-isystem", "osqp/public", "-isystem", "osqp/private", "-isystem", "daqp/include"]


def generated(scene, folder, solver="osqp"):
    assert main(["generate", str(SCENES / f"{scene}.toml"), "--solver", solver, "--out", str(folder)]) == 0
    return folder


def make(folder, *words):
    done = subprocess.run(["make", "-s", "-C", str(folder), f"CC={CC}", *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr, done.stderr
    return folder


def run(folder, *words, **more):
    """Standard output of the example, whose exit status says whether all is as recorded."""
    done = subprocess.run([str(folder / "example"), *words], capture_output=True, text=True, **more)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="session")
def lemniscate(tmp_path_factory):
    return generated("lemniscate", tmp_path_factory.mktemp("c") / "lemniscate")


@pytest.fixture(scope="session")
def by_daqp(tmp_path_factory):
    return generated("lemniscate", tmp_path_factory.mktemp("daqp") / "lemniscate", "daqp")


@pytest.fixture(params=["osqp", "daqp"])
def each(request):
    """A folder for each solver."""
    return request.getfixturevalue({"osqp": "lemniscate", "daqp": "by_daqp"}[request.param])


def copied(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copy", ignore=shutil.ignore_patterns("*.o", "*.a", "example"))


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
@pytest.mark.slow
def test_sanitisers_find_nothing(each, tmp_path):
    folder = copied(each, tmp_path)
    checked = "-O0 -fsanitize=address,undefined -fno-sanitize-recover=all"
    # Instructions without an index, which is what CasADi writes, take long to be checked.
    make(folder, f"CFLAGS={checked}", "GRAPH_CFLAGS=-O0")
    run(folder)


@needs_compiler
def test_the_program_of_the_readme_compiles_as_it_says(lemniscate, tmp_path):
    text = (lemniscate / "README.md").read_text()
    (tmp_path / "loop.c").write_text(re.search(r"```c\n(.*?)```", text, re.DOTALL)[1])
    line = re.search(r"^cc (.*) loop\.c libpcr\.a -lm -o loop$", text, re.MULTILINE)[1].split()
    words = [CC, *line, "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only", str(tmp_path / "loop.c")]
    done = subprocess.run(words, cwd=lemniscate, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_no_compiler_warns_of_the_runtime(compiler, each):
    if not shutil.which(compiler):
        pytest.skip(f"there is no {compiler} here")
    own = sorted(path.name for path in each.glob("*.c"))
    assert {"main.c", "pcr_controller.c", "pcr_graphs.c", "pcr_tables.c", "pcr_qp.c"} < set(own)
    words = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2", "-fsyntax-only", "-I.", *INCLUDED]
    done = subprocess.run([compiler, *words, *own], cwd=each, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@needs_compiler
@pytest.mark.slow
def test_cpp_may_include_the_header(each, tmp_path):
    if not shutil.which("g++"):
        pytest.skip("there is no g++ here")
    program = tmp_path / "main.cpp"
    program.write_text('#include "pcr.h"\nint main() { static pcr_plant p; return pcr_plant_init(&p, nullptr); }\n')
    words = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "-I.", *INCLUDED]
    done = subprocess.run(["g++", *words, str(program)], cwd=each, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@needs_compiler
@pytest.mark.slow
def test_nothing_of_the_library_allocates_or_prints(each, tmp_path):
    folder = copied(each, tmp_path)
    make(folder, *QUICK, "size")
    kept, whole = ((folder / name).stat().st_size for name in ("controller.linked", "libpcr.a"))
    assert 50e3 < kept < whole
    listed = subprocess.run(["nm", "-u", str(folder / "libpcr.a")], capture_output=True, text=True, check=True).stdout
    needed = {line.split()[-1] for line in listed.splitlines() if " U " in f" {line}"}
    assert "sqrt" in needed  # it lists what it should
    banned = re.compile(r"alloc|^free$|print|put[sc]|^f?write$|errno|locale|^exit$|^abort$")
    assert not [name for name in needed if banned.search(name)]
    held = subprocess.run(["nm", str(folder / "libpcr.a")], capture_output=True, text=True, check=True).stdout
    variables = [line.split() for line in held.splitlines() if re.search(r" [bBC] ", line)]
    assert not variables  # state is in the structures alone


NOT_IN_C = {"release": "reference"}


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_scene_is_generated_or_refused_by_name(path):
    scene, part = load_scene(path), NOT_IN_C.get(path.stem)
    if part is None:
        assert check_scope(scene, scene.tuning) is scene.tuning
        return
    with pytest.raises(GenerationError) as error:
        check_scope(scene, scene.tuning)
    assert error.value.part == part


REFUSED = {
    "lqr": "law",
    "nonlinear": "law",
    "open_loop": "law",
    "pd": "law",
}


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"motors": Motors(saturated=True)}, "motors at their torque limit"),
        ({"plant": {"on_snap": "jump"}}, "snapping plant"),
        ({"plant": {"method": "single_shooting"}}, "method of the plant's rods"),
        ({"plant": {"inertia": "full"}}, "inertia of the plant"),
        ({"tuning": {"fallback": "raise"}}, "fallback"),
        ({"tuning": {"learning": LearningTuning()}}, "learning"),
        ({"tuning": {"observer": ObserverTuning(adapts=("tip_mass",))}}, "observer that adapts"),
        ({"start_velocity": (0.1, 0.0)}, "start that moves, at [m/s]"),
    ],
)
def test_what_c_does_not_have_is_said_by_name(changes, part):
    scene = load_scene(SCENES / "lemniscate.toml")
    whole = {key: replace(getattr(scene, key), **value) if isinstance(value, dict) else value
             for key, value in changes.items()}  # fmt: skip
    scene = replace(scene, **whole)
    with pytest.raises(GenerationError, match="C has no") as error:
        check_scope(scene, scene.tuning)
    assert error.value.part == part


@pytest.mark.parametrize("path", sorted((ROOT / "controllers").glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_tuning_is_generated_or_refused_by_name(path):
    scene = load_scene(SCENES / "lemniscate.toml")
    tuning, part = load_tuning(path), REFUSED.get(path.stem)
    if part is None:
        assert check_scope(scene.tuned(tuning), tuning) is tuning
        return
    with pytest.raises(GenerationError) as error:
        check_scope(scene.tuned(tuning), tuning)
    assert error.value.part == part


def test_files_of_others_are_left_alone(tmp_path, capsys):
    (tmp_path / "README.md").write_text("mine")
    assert main(["generate", str(SCENES / "lemniscate.toml"), "--out", str(tmp_path)]) == 1
    assert "README.md" in capsys.readouterr().err
    assert (tmp_path / "README.md").read_text() == "mine"


def test_a_folder_has_one_solver(tmp_path, capsys):
    """Their sources would be compiled together."""
    (tmp_path / "osqp").mkdir()
    assert main(["generate", str(SCENES / "lemniscate.toml"), "--solver", "daqp", "--out", str(tmp_path)]) == 1
    assert "was generated with osqp" in capsys.readouterr().err
    assert not (tmp_path / "pcr.h").exists()
