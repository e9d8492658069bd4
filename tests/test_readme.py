"""The README's Python example runs, and prints what its comments say."""

import re

import numpy as np
import pytest

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
    said = re.search(r'final_error_mm"\]\)  # (\S+)\n', blocks[0])
    assert said
    assert 1 / 3 < float(lines[-1]) / float(said[1]) < 3


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda page: page.name
)
def test_links_and_pictures_exist(page):
    links = re.findall(r"\[.*?\]\((.*?)\)", page.read_text())
    assert links or page.parent.name == "docs"  # a page may have none, the README has some
    for link in links:
        target = page.parent / link.partition("#")[0]
        assert target.stat().st_size > (5_000 if target.suffix in (".png", ".gif") else 0), link
