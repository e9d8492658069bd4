"""Imports go one way: among the files of the package there is no circle, those for type checkers included."""

import ast
from graphlib import CycleError, TopologicalSorter

import pytest

from tests.conftest import ROOT

PACKAGE = ROOT / "pcr_mpc"
ROOMS = ("mujoco", "motion", "statics", "rods")


def modules():
    """Name of every module below the package -> its file."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(name, path, known):
    """Modules of the package that a module imports, wherever in it that stands."""
    base = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            start = base[: len(base) - node.level + 1] if node.level else []
            source = ".".join([*start, *([node.module] if node.module else [])])
            for alias in node.names:
                inner = f"{source}.{alias.name}"
                found.add(inner if inner in known else source)
    return {one for one in found if one in known and one != name}


@pytest.fixture(scope="module")
def graph():
    known = modules()
    found = {name: imports(name, path, known) for name, path in known.items() if name != "pcr_mpc"}
    # The package's own file hands out names lazily, and everybody may ask it.
    return {name: others - {"pcr_mpc"} for name, others in found.items()}


def test_no_circle(graph):
    assert len(graph) > 80
    assert sum(map(len, graph.values())) > 300  # else the test says nothing
    TopologicalSorter(graph).prepare()


def test_a_circle_would_be_found():
    with pytest.raises(CycleError):
        TopologicalSorter({"a": {"b"}, "b": {"c"}, "c": {"a"}}).prepare()


def test_rooms_of_the_plant_import_downwards(graph):
    for level, room in enumerate(ROOMS):
        above = tuple(f"pcr_mpc.plant.{one}" for one in ROOMS[:level])
        for name, others in graph.items():
            if name.startswith(f"pcr_mpc.plant.{room}."):
                assert not [one for one in others if one.startswith(above)] if above else True, name
