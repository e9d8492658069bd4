"""README and pages: their Python runs, the tutorial's commands do, and links lead somewhere."""

import re
import shlex

import numpy as np
import pytest

from pcr_mpc.cli import main
from tests.conftest import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
RUN_ELSEWHERE = ("README.md", "your_loop.md", "identification.md")  # below, in test_your_loop, in test_identification


def blocks(page, language):
    fences = re.findall(r"^```([^\n]*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    return [text for name, text in fences if name == language]


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if blocks(page, "python") and page.name not in RUN_ELSEWHERE],
    ids=lambda page: page.name,
)
def test_python_runs(page, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in blocks(page, "python"):
        exec(block, names)


def test_readme_prints_what_it_says(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    (block,) = blocks(ROOT / "README.md", "python")
    exec(block, {})
    said = re.search(r"print\(.*# (\S+)\n", block)
    assert said
    assert np.isclose(float(capsys.readouterr().out), float(said[1]), atol=5e-5)


@pytest.mark.slow
def test_tutorial_to_the_letter(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    page = ROOT / "docs" / "new_robot.md"
    commands = [line for block in blocks(page, "") for line in block.splitlines()]
    assert [line.split()[1] for line in commands] == ["new", "new", "check", "track"]
    for line in commands:
        status = main(shlex.split(line)[1:])
        said = capsys.readouterr()
        # The second one shows a robot that cannot be.
        assert (status == 0) == (" stiff " not in line), said.err
    for table in ("rods        2 of nitinol", "nearest that works: 1.5 mm diameter"):
        assert table in page.read_text(encoding="utf-8")
    assert {path.name for path in (tmp_path / "results" / "mine").iterdir()} >= {"run.npz", "track.png", "track.gif"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_pictures_exist(page):
    for link in re.findall(r"\[.*?\]\((.*?)\)", page.read_text(encoding="utf-8")):
        target = page.parent / link.partition("#")[0]
        assert target.stat().st_size > (5_000 if target.suffix in (".png", ".gif") else 0), link


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120
