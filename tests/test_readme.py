"""The README's Python example runs, and prints what its comments say."""

import re

import numpy as np

from .conftest import ROOT


def test_python_example(monkeypatch, capsys):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(blocks) == 1
    monkeypatch.chdir(ROOT)
    names: dict[str, object] = {}
    exec(blocks[0], names)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("True")
    assert np.allclose(np.fromstring(lines[0].split("]")[0].strip("[ "), sep=" "), [3.367, -0.225], atol=1e-3)
    assert float(lines[-1]) < 1e-5


def test_pictures_exist():
    for path in re.findall(r"!\[.*?\]\((.*?)\)", (ROOT / "README.md").read_text()):
        assert (ROOT / path).stat().st_size > 5_000
