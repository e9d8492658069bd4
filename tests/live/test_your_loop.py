"""The page on one's own loop: its Python runs from top to bottom, and prints what it says."""

import re

from tests.conftest import ROOT


def test_the_page_runs(monkeypatch, capsys):
    page = (ROOT / "docs" / "your_loop.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 6
    monkeypatch.chdir(ROOT)
    names: dict[str, object] = {}
    exec("\n".join(blocks), names)
    said = [line.split("#")[1].split(":")[0].strip() for line in re.findall(r"^print\(.*#.*$", page, re.MULTILINE)]
    assert capsys.readouterr().out.splitlines() == said
