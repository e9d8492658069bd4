"""Every example runs, says something, and fits on a screen."""

import runpy

import pytest

from tests.conftest import ROOT

SLOW = ("fmu_loop", "what_else_is_stable")
EXAMPLES = [
    pytest.param(path, id=path.stem, marks=[pytest.mark.slow] if path.stem in SLOW else [])
    for path in sorted((ROOT / "examples").glob("*.py"))
]


@pytest.mark.parametrize("path", EXAMPLES)
def test_example(path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(path), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    assert lines
    assert not any("nan" in line for line in lines if "not finite" not in line)
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 50
