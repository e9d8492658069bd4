"""What no robot and no controller can have is refused by C as by Python."""

import ctypes
import re
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc.codegen.folder import write_folder
from pcr_mpc.codegen.subject import Subject
from pcr_mpc.codegen.tables import parameters
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.loop.scene.file import load_scene
from tests.codegen.conftest import CC, SCENES, needs_compiler

LEAST, MOST = 1e-30, 1e30
NUMBERS = [-1.0, 0.0, 1e-31, LEAST, 0.002, 0.4, 9.0, 26.0, -26.0, MOST, 2e30, np.nan, np.inf, -np.inf]


@pytest.fixture(scope="module")
def subject():
    scene = load_scene(SCENES / "lemniscate.toml")
    return Subject.of_scene(replace(scene, duration=0.05))


@pytest.fixture(scope="module")
def code(subject, tmp_path_factory):
    """The checks alone, and the scene's tables."""
    folder = tmp_path_factory.mktemp("refusals")
    write_folder(subject, None, folder)
    own = ["pcr_sound.c", "pcr_tables.c", "-o", "sound.so", "-lm"]
    words = ["-std=c99", "-O0", "-shared", "-fPIC", "-I.", "-isystem", "osqp/public", "-isystem", "osqp/private"]
    subprocess.run([CC, *words, *own], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "sound.so"))


def refused(function, values):
    flat = np.concatenate([np.ravel(value) for value in values]).astype(float)
    return function((ctypes.c_double * len(flat))(*flat))


def robot_with(robot, name, value):
    """The robot with another number, by the name that C has for it."""
    if not (found := re.fullmatch(r"rods\[(\d)\]\.(\w+)", name)):
        place = {"gravity_x": 0, "gravity_y": 1}.get(name)
        if place is None:
            return replace(robot, **{name: value})
        return replace(robot, gravity=tuple(value if i == place else g for i, g in enumerate(robot.gravity)))
    i, key = int(found[1]), found[2]
    pairs = {"base_x": ("base", 0), "base_y": ("base", 1), "angle_lower": ("angle_limits", 0),
             "angle_upper": ("angle_limits", 1)}  # fmt: skip
    rod = replace(robot.rods[i], thickness_ratio=None, strain_limit=np.inf)
    if key in pairs:
        pair, place = pairs[key]
        values = list(getattr(rod, pair))
        values[place] = value
        changed = replace(rod, **{pair: tuple(values)})
    else:
        changed = replace(rod, **{key: value})
    return replace(robot, rods=tuple(changed if j == i else other for j, other in enumerate(robot.rods)))


@needs_compiler
def test_numbers_that_python_refuses_are_refused_in_c(subject, code):
    robot, own, plant = subject.robot, parameters(subject), np.array(subject.plant.numbers)
    model = subject.work.foresight.step_models[0].kind
    outcomes = set()
    for kind, vector in ((model, np.asarray(own["numbers"])), (subject.plant.step_model.kind, plant)):
        for at, name in enumerate(kind.names):
            for value in (*NUMBERS, *(robot.rods[0].base if "base" in name else ())):
                numbers = vector.copy()
                numbers[at] = value
                if name == "rods[1].base_x":  # then one coordinate may make the bases one
                    numbers[kind.names.index("rods[1].base_y")] = robot.rods[0].base[1]
                try:
                    start = robot if name != "rods[1].base_x" else robot_with(robot, "rods[1].base_y",
                                                                              robot.rods[0].base[1])  # fmt: skip
                    robot_with(start, name, value)
                    expected = False
                except ValueError:
                    expected = True
                if vector is plant:
                    place = refused(code.pcr_plant_refused_number, [numbers])
                else:
                    place = refused(code.pcr_refused_parameter, (own | {"numbers": numbers}).values())
                assert (place >= 0) == expected, (name, value, place)
                assert place in (-1, at) or kind.names[place].startswith(name.split(".")[0]), (name, value, place)
                outcomes.add((name, expected))
    assert len({name for name, expected in outcomes if expected}) == model.size  # each can be refused


@needs_compiler
def test_limits_and_weights_that_python_refuses_are_refused_in_c(subject, code):
    own, n = parameters(subject), subject.robot.n_rods
    places = dict(zip(own, np.cumsum([0, *(np.size(value) for value in own.values())]), strict=False))

    def place(**changes):
        return refused(code.pcr_refused_parameter, (own | changes).values())

    assert place() == -1
    for rate in NUMBERS:
        for key in ("rate", "rate_change"):
            limits = {name: own[name] for name in ("rate", "rate_change", "angle_lower", "angle_upper")} | {key: rate}
            try:
                Limits(**limits)
                assert place(**{key: rate}) == -1
            except ValueError:
                assert place(**{key: rate}) == places[key]
    crossed = np.array(own["angle_lower"])
    crossed[0] = 9.0
    assert place(angle_lower=crossed) == places["angle_lower"]
    assert place(angle_lower=np.full(n, -np.inf), angle_upper=np.full(n, np.inf)) == -1
    assert own["weights"][2] == 0.0  # the angles'
    for i, value, good in ((0, 0.0, 0), (0, -1.0, 0), (1, 0.0, 1), (1, -1.0, 0), (2, 1.0, 0), (3, 0.0, 0), (3, 2.0, 1)):
        weights = np.array(own["weights"])
        weights[i] = value
        assert place(weights=weights) == (-1 if good else places["weights"] + i), (i, value)
    terminal = np.array(own["terminal"])
    assert place(terminal=-terminal) == places["terminal"]
    terminal[2] *= 2.0  # no longer symmetric
    assert place(terminal=terminal) == places["terminal"]
    for key, value in (("torque", 0.0), ("torque", -1.0), ("rod_margin", 0.95), ("rod_margin", -0.1), ("reach", 0.0),
                       ("stiffness", -1.0), ("stiffness", np.inf), ("strain", np.array([0.01, -0.01])),
                       ("strain", np.array([0.01, 0.8])), ("tip_lower", np.array([np.inf, 0.0])),
                       # What the scene does not watch cannot be switched on, nor one rod's strain switched off.
                       ("strain", np.array([np.inf, 0.01])), ("strain", np.full(2, np.inf)),
                       ("tip_upper", np.array([1.0, np.inf])), ("tip_lower", np.array([-np.inf, -1.0])),
                       ("gain", np.full(np.size(own["gain"]), np.inf))):  # fmt: skip
        assert places[key] <= place(**{key: value}) < places[key] + np.size(value), (key, value)
    # No square of two states has a negative weight, all of them together have.
    pulled = np.eye(6)
    pulled[:3, :3] -= 0.9 * (1.0 - np.eye(3))
    assert np.linalg.eigvalsh(pulled).min() < -0.7
    assert place(terminal=pulled.ravel()) == places["terminal"]
    assert place(terminal=np.ones(36)) == -1  # of rank one
    assert place(terminal=np.zeros(36)) == -1
    assert place(torque=0.5, stiffness=-np.inf, rod_margin=-np.inf, strain=np.full(n, 0.005)) == -1
