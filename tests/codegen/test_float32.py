"""C in single precision: every number of it is a float, the scene runs, and what that costs is what is stated."""

import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc.cli import main
from pcr_mpc.codegen.folder import write_folder
from pcr_mpc.codegen.library import GeneratedController, build
from pcr_mpc.codegen.loss import measure_loss
from pcr_mpc.codegen.precision import in_single
from pcr_mpc.codegen.subject import Subject
from pcr_mpc.codegen.vectors import recorded
from pcr_mpc.errors import GenerationError
from pcr_mpc.loop.controller.make_controller import make_controller
from pcr_mpc.loop.scene.file import load_scene
from tests.codegen.conftest import CC, INCLUDED, QUICK, needs_compiler
from tests.conftest import ROOT

SCENES = ROOT / "models" / "scenes"


def test_types_literals_and_functions_become_those_of_floats():
    text = """/* a double, 0.5 of it */ #include <math.h>
const double x[3] = {1.0, 2, -3e-05};  // 1.0
y = fmax(sin(0.25 * x[0]), casadi_fmax(1., .5)) + 0x1e5 + v1.e2; printf("%.12f double 1.0", y);"""
    assert (
        in_single(text)
        == """/* a double, 0.5 of it */ #include <math.h>
const float x[3] = {1.0f, 2, -3e-05f};  // 1.0
y = fmaxf(sinf(0.25f * x[0]), casadi_fmax(1.f, .5f)) + 0x1e5 + v1.e2; printf("%.12f double 1.0", y);"""
    )


def test_what_single_precision_cannot_do_is_said():
    def example(*said, status=0):
        def write(folder):
            lines = ["#!/bin/sh", *(f"echo '{line}'" for line in said), f"exit {status}"]
            (folder / "example").write_text("\n".join(lines))
            (folder / "example").chmod(0o755)
            (folder / "Makefile").write_text("example:\n")

        return write

    with pytest.raises(GenerationError, match=r"does not run to its end \(plant step 3: result 4; failed\)"):
        measure_loss("a scene", example("plant step 3: result 4", "failed", status=1), 0.1, 0.5)
    rates = ["rates differ by at most 0.1 rad/s, rung or iterations in 3 of 600 periods"]
    plant = "plant, recorded rates differs by at most 1e-05 m, m/s or rad"
    runs = example("RMS error of the tip 9 mm", *rates, *rates, plant)
    with pytest.raises(GenerationError, match="of no use here"):
        measure_loss("a scene", runs, 0.1, 0.5)
    loss = measure_loss("a scene", runs, 4.0, 0.5)
    assert (loss.others, loss.apart) == (3, 1e-5)


@needs_compiler
@pytest.mark.slow
def test_daqp_and_rods_that_are_shot_do_with_single_precision():
    scene = replace(load_scene(SCENES / "limited.toml"), duration=1.5)
    scene = replace(scene, plant=replace(scene.plant, method="multiple_shooting"))
    model = replace(scene.tuning.model, method="multiple_shooting")
    subject = Subject.of_scene(scene, replace(scene.tuning, solver="daqp", model=model), single=True)
    run = recorded(subject)
    loss = measure_loss(scene.name, lambda place: write_folder(subject, run, place), run.summary()["rms_mm"], 0.5)
    assert sum(run.active_limits.values()) > 10
    assert loss.others == 0
    assert 1e-6 < loss.same < 0.01  # doubles would not differ
    assert loss.rms_mm == pytest.approx(loss.double_rms_mm, abs=1e-3)


@needs_compiler
@pytest.mark.slow
def test_the_lemniscate_runs_in_single_precision(tmp_path, capsys):
    folder = tmp_path / "c"
    words = [
        "generate",
        str(SCENES / "lemniscate.toml"),
        "--solver",
        "osqp",
        "--float32",
        "--json",
        "--out",
        str(folder),
    ]
    assert main(words) == 0
    stated = json.loads(capsys.readouterr().out)["single"]
    assert 0.001 < stated["rms_mm"] < 0.003
    assert 1e-6 < stated["same"] < 0.01  # doubles would not differ
    assert 1e-7 < stated["apart"] < 0.01

    subprocess.run(["make", "-s", "-C", str(folder), f"CC={CC}", *QUICK, "example"], check=True)
    done = subprocess.run([str(folder / "example")], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    found = float(re.search(r"RMS error of the tip\s+(\S+) mm", done.stdout)[1])
    assert found == pytest.approx(stated["rms_mm"], abs=1e-4)
    assert f"RMS {stated['rms_mm']:.6g} mm, in double" in (folder / "README.md").read_text()

    own = sorted(path.name for path in folder.glob("pcr_*.c"))
    warned = ["-std=c99", "-Wall", "-Wextra", "-Wdouble-promotion", "-Werror", "-fsyntax-only", "-I.", *INCLUDED]
    own.remove("pcr_graphs.c")
    done = subprocess.run([CC, *warned, *own], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    done = subprocess.run([CC, "-w", "-Werror=double-promotion", "-fsyntax-only", "pcr_graphs.c"], cwd=folder)
    assert done.returncode == 0

    subject = Subject.of_scene(load_scene(SCENES / "lemniscate.toml"), single=True)
    in_c, in_python = GeneratedController(build(folder, f"CC={CC}", *QUICK), subject), make_controller(subject.scene)
    in_c.start()
    in_python.start(subject.pose)
    x = np.concatenate([subject.pose.p, [0.0, 0.0], subject.pose.q])
    for k in range(20):
        assert in_c.step(k, x).u == pytest.approx(in_python.step(k, x).u, abs=0.01)
        x = x + 1e-4 * np.array([np.sin(k), np.cos(k), 0, 0, 0, 0])
    shutil.rmtree(folder)
