"""Functional mock-up units in FMPy, an importer of others: valid, the same run as Python's, loud where they fail."""

import os
import re
import shutil
import subprocess
import zipfile
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pcr_mpc.cli import main
from pcr_mpc.codegen.fmu.archive import write_fmu
from pcr_mpc.codegen.fmu.variables import PARTS, layout
from pcr_mpc.codegen.subject import Subject
from pcr_mpc.codegen.tables import parameters
from pcr_mpc.codegen.vectors import recorded
from pcr_mpc.files import require_free
from pcr_mpc.loop.controller.make_controller import make_controller
from pcr_mpc.loop.scene.file import load_scene
from pcr_mpc.plant.motion.plant import Plant
from tests.codegen.conftest import CC, QUICK, SCENES, needs_compiler

fmpy = pytest.importorskip("fmpy")
validation = pytest.importorskip("fmpy.validation")

from tests.codegen.unit import MEASURED, PERIOD, RATES, Unit  # noqa: E402  (it needs fmpy)


@pytest.fixture(scope="module")
def subject():
    return Subject.of_scene(load_scene(SCENES / "lemniscate.toml"))


@pytest.fixture(scope="module")
def files(subject, tmp_path_factory):
    """Path of the unit of each part and version."""
    folder = tmp_path_factory.mktemp("fmu")
    made = {}
    for part in PARTS:
        for version in (2, 3):
            made[part, version] = folder / f"{part}{version}.fmu"
            write_fmu(subject, part, version, made[part, version], f"CC={CC}", *QUICK)
    return made


@pytest.fixture
def units(files, tmp_path):
    """Make an instance of a part; all are freed at the end."""
    with ExitStack() as stack:

        def made(part, version=2, **more):
            folder = tmp_path / f"{part}{version}"
            if not folder.exists():
                fmpy.extract(str(files[part, version]), str(folder))
            unit = Unit(files[part, version], folder, **more)
            stack.callback(unit.slave.freeInstance)
            return unit

        yield made


@needs_compiler
@pytest.mark.slow
def test_units_are_valid_and_their_sources_whole(files, tmp_path):
    for path in files.values():
        assert validation.validate_fmu(str(path)) == []
    for version in (2, 3):
        folder = tmp_path / str(version)
        fmpy.extract(str(files["controller", version]), str(folder))
        about = fmpy.read_model_description(str(folder))
        listed = about.buildConfigurations[0].sourceFileSets[0].sourceFiles
        words = ["-std=c99", "-fsyntax-only", "-w", "-I."]  # an importer knows one place for headers
        done = subprocess.run([CC, *words, *listed], cwd=folder / "sources", capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        own = sorted(path.name for path in (folder / "sources").glob("pcr_fm*.c"))
        assert len(own) == 4
        words = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2", "-fsyntax-only", "-isystem", "."]
        done = subprocess.run([CC, *words, *own], cwd=folder / "sources", capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        library = next((folder / "binaries").rglob("*.so"))
        words = ["nm", "-D", "--defined-only", str(library)]
        seen = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
        assert len(seen) > 20
        assert all(f" fmi{version}" in line for line in seen), "others would clash"


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("version", [2, 3])
def test_coupled_units_run_as_python_does(version, subject, units):
    run = recorded(subject)
    plant, controller, tips = units("plant", version), units("controller", version), []
    x = plant.get(MEASURED)
    for k in range(subject.scene.n_periods):
        u = controller.decide(k, x)
        assert np.array_equal(u, run.u[k]), k  # bit for bit
        x = plant.move(k, u)
        tips.append(x[:2])
    error = np.array(tips) - run.reference[10::10]
    ours = run.x[10::10, :2] - run.reference[10::10]
    assert np.sqrt(np.mean(error**2)) == pytest.approx(np.sqrt(np.mean(ours**2)), abs=1e-15)
    assert controller.whole("rung") == 0
    assert not plant.said + controller.said


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("part", PARTS)
def test_a_state_is_gone_back_to_and_carried_elsewhere(part, version, units):
    # States along another run: what is fed in need not make sense, but must be the same.
    def runs(unit, first, last):
        found = []
        for k in range(first, last):
            wave = 1e-3 * np.array([np.sin(k / 5), np.cos(k / 7), 0, 0, np.sin(k / 3), np.cos(k / 4)])
            found.append(unit.decide(k, rest + wave) if part == "controller" else unit.move(k, 300 * wave[4:]))
        return np.array(found)

    one, two, fresh = units(part, version), units(part, version), units(part, version)
    rest = units("plant").get(MEASURED)
    runs(one, 0, 20)
    state = one.state("get")
    ahead = runs(one, 20, 40)
    runs(two, 0, 3)  # a second one in this process
    one.state("set", state)
    assert np.array_equal(runs(one, 20, 40), ahead)
    content = one.state("serialize", state)
    assert np.abs(np.diff(ahead, axis=0)).max() > 1e-6  # there is something to be wrong about
    for other in (two, fresh):
        carried = other.state("deserialize", content)
        other.state("set", carried)
        assert np.array_equal(runs(other, 20, 40), ahead)
        other.state("free", carried)
    one.state("free", state)
    with pytest.raises(fmpy.fmi1.FMICallException):
        one.state("deserialize", content[:-1])
    assert "no state of this model" in one.said[-1]


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("version", [2, 3])
def test_a_plant_that_fails_says_so(version, units):
    plant = units("plant", version)
    before = plant.get(MEASURED)
    refused = fmpy.fmi1.FMICallException
    with pytest.raises(refused) as error:
        plant.step(0.0, 0.0015)
    assert error.value.status == 2
    assert "no whole number" in plant.said[-1]
    plant.set({"force_x": 60.0, "force_y": -60.0})
    with pytest.raises(refused) as error:
        [plant.move(k, (0.0, 0.0)) for k in range(200)]
    assert error.value.status == 2  # discarded
    assert re.search(r"at \d\.\d+ s: the rods cannot follow, a snap is near: p = ", plant.said[-1])
    x = plant.get(MEASURED)
    assert np.all(np.isfinite(x))
    assert np.linalg.norm(x[:2] - before[:2]) > 0.01
    reached = plant.slave.getRealStatus(2) if plant.two else None
    assert reached is None or f"at {reached:.9g} s" in plant.said[-1]
    with pytest.raises(refused, match=r"DoStep"):
        plant.step(7.0, 0.001)
    assert "is to begin at 7 s" in plant.said[-1]
    other = units("plant", version, values={"tip_mass": 0.3})
    other.set({"u[1]": np.nan})
    for _ in range(2):
        with pytest.raises(refused) as error:
            other.step(0.0, 0.01)
        assert error.value.status == 3
    assert "input u[1] is nan" in other.said[0]
    assert "has failed" in other.said[1]


@needs_compiler
@pytest.mark.slow
def test_a_controller_says_what_it_makes_of_its_input(units):
    controller = units("controller")
    rest = units("plant").get(MEASURED)
    for k in range(40):
        u = controller.decide(k, np.full(6, np.nan) if 10 <= k < 14 else rest)
        assert np.all(np.isfinite(u))
        assert controller.whole("doubts") == (3 if 10 <= k < 14 else 0)
    with pytest.raises(fmpy.fmi1.FMICallException):
        controller.step(40 * PERIOD, 2 * PERIOD)
    assert "measures again" in controller.said[-1]
    held = []
    for j in range(4):  # parts of a period
        controller.step((40 + j / 4) * PERIOD, PERIOD / 4)
        held.append(controller.get(RATES))
    assert np.ptp(held, axis=0).max() == 0.0
    for name, value in (("tip_mass", -1.0), ("limits.angle_lower[0]", 9.0), ("weights.input", 0.0)):
        for part in PARTS if name == "tip_mass" else ("controller",):
            refused = units(part)
            refused.set({name: value})
            with pytest.raises(fmpy.fmi1.FMICallException):
                refused.step(0.0, PERIOD)
            assert f"{name} = {value:g} is refused" in refused.said[0]
    wrong = units("controller")
    with pytest.raises(fmpy.fmi1.FMICallException):
        wrong.decide(0, 1e3 * rest)
    assert "other units" in wrong.said[-1]
    wrong.slave.guid = "{0}"
    with pytest.raises(Exception, match="Failed to instantiate"):
        wrong.slave.instantiate()


@needs_compiler
@pytest.mark.slow
def test_a_reference_may_be_handed_in(subject, units):
    """The scene's own gives the same bits; where none is wanted to move, the robot stays, whatever the scene says."""
    track, names = subject.work.track, [v.name for v in layout(subject, "controller").inputs["WINDOW"]]
    own, given, held, plant = units("controller"), units("controller"), units("controller"), units("plant")
    rest, last = plant.get(MEASURED), subject.scene.n_periods
    x, still = rest, np.concatenate([rest, [0.0, 0.0, 0.0, 0.0]])
    held.set({"reference.given": 1.0} | dict(zip(names, np.tile(still, subject.tuning.horizon), strict=True)))
    for k in range(60):
        given.set({"reference.given": 1.0} | dict(zip(names, track.window(k, 0).ravel(), strict=True)))
        u = own.decide(k, x)
        assert np.array_equal(given.decide(k, x), u), k
        assert np.abs(held.decide(k, rest)).max() < 1e-6
        x = plant.move(k, u)
    assert last > 60
    assert np.abs(u).max() > 1e-2
    given.set({"reference[1].q[0]": np.nan})
    with pytest.raises(fmpy.fmi1.FMICallException):
        given.decide(60, x)
    assert "input reference[1].q[0] is nan" in given.said[-1]


@needs_compiler
@pytest.mark.slow
def test_tunable_numbers_are_those_of_python(subject, units):
    """A plant with other numbers is Plant of another robot; a controller with other weights is that of `retune`."""
    scene = subject.scene
    stiffer = replace(scene.robot, rods=tuple(replace(rod, bending_stiffness=1.2 * rod.bending_stiffness)
                                              for rod in scene.robot.rods), tip_mass=0.3)  # fmt: skip
    names = {f"rods[{i}].bending_stiffness": rod.bending_stiffness for i, rod in enumerate(stiffer.rods)}
    unit, later = units("plant", values=names | {"tip_mass": 0.3}), units("plant")
    x = unit.get(MEASURED)
    ours = scene.plant.make(stiffer)
    assert isinstance(ours, Plant)
    ours.reset(x)
    for k in range(30):
        u = (np.sin(k / 4), np.cos(k / 6))
        for _ in range(10):
            x = ours.step(x, u)
        assert unit.move(k, u) == pytest.approx(x, abs=1e-9), k
        between = later.move(k, u)
    assert np.abs(between - x).max() > 1e-3
    later.set(names | {"tip_mass": 0.3})
    ours.reset(between)
    for _ in range(10):
        between = ours.step(between, u)
    assert later.move(30, u) == pytest.approx(between, abs=1e-9)

    other = replace(scene.tuning, position_weight=3e4, input_weight=0.02)
    values = np.concatenate([np.ravel(v) for v in parameters(Subject.of_scene(scene, other)).values()])
    tunable = [variable.name for variable in layout(subject, "controller").flat("tunable")]
    controller, in_python = units("controller"), make_controller(scene)
    in_python.start(subject.pose)
    x = units("plant").get(MEASURED)
    for k in range(30):
        if k == 15:
            in_python.retune(other)
            controller.set(dict(zip(tunable, values, strict=True)))
        assert controller.decide(k, x) == pytest.approx(in_python.step(k, x).u, abs=1e-9), k
        x = x + 1e-4 * np.array([np.sin(k), np.cos(k), 0, 0, 0, 0])


@needs_compiler
@pytest.mark.slow
def test_instances_are_freed(units):
    """300 of them would take 80 MB."""

    def memory():
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    unit = units("controller")
    for count in range(330):
        if count == 30:
            before = memory()
        slave = type(unit.slave)(
            guid=unit.slave.guid,
            modelIdentifier=unit.slave.modelIdentifier,
            unzipDirectory=unit.slave.unzipDirectory,
            instanceName=f"number {count}",
        )
        slave.instantiate()
        slave.setupExperiment()
        slave.enterInitializationMode()
        slave.exitInitializationMode()
        slave.freeFMUstate(slave.getFMUstate())
        slave.freeInstance()
    assert memory() - before < 20e6


@needs_compiler
@pytest.mark.slow
def test_a_unit_that_was_changed_is_left_alone(files, tmp_path, capsys):
    path = tmp_path / "plant.fmu"
    shutil.copyfile(files["plant", 2], path)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("resources/mine.txt", "mine")
    assert main(["fmu", "lemniscate", "--part", "plant", "--out", str(path)]) == 1
    assert "not as pcr-mpc wrote it" in capsys.readouterr().err
    assert main(["fmu", "release", "--part", "plant", "--out", str(path)]) == 1
    assert "nothing to track" in capsys.readouterr().err
    shutil.copyfile(files["controller", 2], path)
    require_free(path)  # nobody has changed it
