"""What is public takes effect or cannot be set; copies and pickles are whole, and start afresh."""

import copy
import importlib
import pickle
import pkgutil
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest

import pcr_mpc
from pcr_mpc import Plant, linearise
from pcr_mpc.errors import ReadOnlyError


@pytest.fixture
def x0(centre):
    return np.concatenate([centre.p, [0.0, 0.0], centre.q])


@pytest.fixture
def plant(pair, centre, x0):
    made = Plant(pair, integrator="velocity_verlet", inertia="condensed", dt=5e-4)
    made.reset(x0, centre)
    made.step(x0, (0.3, -0.2))
    return made


@pytest.mark.parametrize(
    ("name", "value", "way"),
    [
        ("dt", 5e-4, "make a new Plant"),
        ("payload", 0.1, "call carry"),
        ("robot", None, "make a new Plant"),
        ("inertia", "none", "make a new Plant"),
        ("method", "multiple_shooting", "make a new Plant"),
        ("integrator", "rk4", "make a new Plant"),
        ("weight", "none", "make a new Plant"),
        ("compiled", True, "make a new Plant"),
        ("n_states", 7, "make a new Plant"),
    ],
)
def test_a_plant_s_settings_are_read_only(plant, name, value, way):
    before = getattr(plant, name)
    with pytest.raises(ReadOnlyError, match=f"Plant.{name} .*{way}") as caught:
        setattr(plant, name, value)
    assert isinstance(caught.value, AttributeError)
    assert caught.value.attribute == name
    assert getattr(plant, name) is before
    with pytest.raises(AttributeError):
        delattr(plant, name)


def test_the_step_s_model_may_be_taken_away_after_a_step(pair, centre, x0):
    """Then the step goes its slow way, to the same result."""
    plants = [Plant(pair), Plant(pair)]
    ends = []
    for plant in plants:
        plant.reset(x0, centre)
        x = plant.step(x0, (0.3, -0.2))
        if plant is plants[1]:
            plant.step_model = None
        for _ in range(3):
            x = plant.step(x, (0.3, -0.2))
        ends.append(x)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-12)
    # The slow way leaves its pose with the solver, not with the graph of the step.
    assert plants[1]._rods.at is not plants[1]._quick_at
    assert plants[0]._rods.at is plants[0]._quick_at


def test_payload_is_carried_and_taken_away(plant, x0, centre):
    plant.carry(0.05, x0)
    assert plant.payload == 0.05
    plant.reset(x0, centre)
    assert plant.payload == 0.0


COPIES = {
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
}


@pytest.fixture(params=COPIES)
def copied(request):
    return COPIES[request.param]


def test_a_copied_plant_is_made_of_the_same_and_starts_afresh(plant, x0, centre, copied):
    plant.carry(0.05, x0)
    other = copied(plant)
    for name in ("robot", "method", "inertia", "weight", "integrator", "dt", "compiled", "shooting"):
        assert getattr(other, name) == getattr(plant, name)
    assert other.payload == 0.0
    with pytest.raises(RuntimeError, match="reset"):
        other.step(x0, (0.3, -0.2))
    for one in (plant, other):
        one.reset(x0, centre)
    x, y = x0, x0
    for _ in range(5):
        x, y = plant.step(x, (0.3, -0.2)), other.step(y, (0.3, -0.2))
    np.testing.assert_array_equal(x, y)


def test_copies_of_frozen_values_are_read_only(pair, centre, plant, x0, copied):
    model = linearise(plant, x0, (0.0, 0.0), 0.01)
    assert centre.stiffness_eigenvalues[0] > 0  # a cached one
    assert pair.lengths[0] > 0
    for value in (centre, model, pair):
        other = copied(value)
        arrays = {name: array for name, array in vars(other).items() if isinstance(array, np.ndarray)}
        assert arrays
        for name, array in arrays.items():
            np.testing.assert_array_equal(array, vars(value)[name])
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0.0
    assert copied(centre).mode == centre.mode
    assert copied(pair) == pair


def test_a_frozen_value_made_by_replace_is_read_only(centre):
    other = replace(centre, force=np.zeros(2))
    with pytest.raises(ValueError, match="read-only"):
        other.force[0] = 1.0


def test_values_that_hold_arrays_are_equal_to_themselves_alone():
    """Arrays have no one answer to ``==``; a class that compared them would raise where it is compared."""
    found = []
    for module in pkgutil.walk_packages(pcr_mpc.__path__, "pcr_mpc."):
        for made in vars(importlib.import_module(module.name)).values():
            if isinstance(made, type) and is_dataclass(made) and made.__module__ == module.name:
                holds = any("ndarray" in str(field.type) for field in fields(made))
                assert not holds or made.__eq__ is object.__eq__, made
                found.append(holds)
    assert sum(found) > 15
    assert not all(found)
