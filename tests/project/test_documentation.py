"""Figures on the pages are those of the records, and every public name has a page with what it takes and returns."""

import inspect
import re

import pytest

import pcr_mpc
from experiments.upkeep import text_figures
from tests.conftest import ROOT


@pytest.mark.parametrize("page", text_figures.pages(), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_figures_are_those_of_the_records(page):
    text = page.read_text(encoding="utf-8")
    assert text.count("<!--figure") == text.count("<!--/-->")
    assert text_figures.corrected(text) == (text, [])


def test_a_wrong_figure_is_found(monkeypatch):
    monkeypatch.setattr(text_figures, "_record", lambda name: {"a": [{"b": 1.2345}]})
    marked = "x <!--figure any a.0.b .2f-->{}<!--/--> <!--figure any a.0.b .0f 1000-->{}<!--/--> y"
    right = marked.format("1.23", "1234")
    assert text_figures.corrected(right) == (right, [])
    text, wrong = text_figures.corrected(marked.format("1.24", "1234"))
    assert text == right
    assert wrong == ["any a.0.b: the text says 1.24, the record 1.23"]
    with pytest.raises(KeyError):
        text_figures.corrected("<!--figure any c .2f-->1<!--/-->")


def test_reference_lists_every_public_name():
    listed = re.findall(r"^   (\w+)$", (ROOT / "docs" / "reference.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(pcr_mpc.__all__)
    assert len(listed) == len(set(listed))


@pytest.mark.parametrize("name", pcr_mpc.__all__)
def test_public_docstrings_say_what_is_taken_and_returned(name):
    value = getattr(pcr_mpc, name)
    text = inspect.getdoc(value) or ""
    assert text.split("\n")[0].strip()
    if inspect.isfunction(value):
        # What is called robot is a Robot; and one argument whose name says it all needs no table.
        parameters = [name for name in inspect.signature(value).parameters if name != "robot"]
        if len(parameters) > 1:
            section = text.partition("Parameters\n")[2].partition("\n\n")[0]
            for parameter in parameters:
                assert re.search(rf"\b{parameter}\b", section), f"{name}: nothing is said of {parameter}"
