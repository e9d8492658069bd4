"""Figures in the README and in docs/ are those of the records that commands have written.

A figure stands between two comments, which no page shows::

    <!--figure scenes lemniscate.rms_after_1s_mm .2g-->0.0019<!--/-->

that is: docs/records/scenes.json, the keys to follow in it, and how to write the number down. A factor may come last,
as in ``.0f 1000``. Without arguments this tells where text and record differ, and ends with status 1;
``python -m experiments.upkeep.text_figures --write`` puts the records' figures into the text.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "docs" / "records"
_MARK = re.compile(
    r"(<!--figure (?P<record>\S+) (?P<keys>\S+) (?P<form>\S*?)(?: (?P<factor>\S+?))?-->)(?P<text>.*?)(<!--/-->)"
)


def pages() -> Iterable[Path]:
    """Everything in which figures may stand."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md"))]


@cache
def _record(name: str) -> Any:
    return json.loads((RECORDS / f"{name}.json").read_text(encoding="utf-8"))


def figure(record: str, keys: str, form: str, factor: str | None) -> str:
    """What the text should say; KeyError if the record has no such figure."""
    value = _record(record)
    for key in keys.split("."):
        value = value[int(key) if isinstance(value, list) else key]
    return format(value if factor is None else value * float(factor), form)


def corrected(text: str) -> tuple[str, list[str]]:
    """The text with the records' figures, and a line for each that was another."""
    wrong = []

    def replaced(found: re.Match[str]) -> str:
        wanted = figure(found["record"], found["keys"], found["form"], found["factor"])
        if wanted != found["text"]:
            wrong.append(f"{found['record']} {found['keys']}: the text says {found['text']}, the record {wanted}")
        return f"{found[1]}{wanted}{found[7]}"

    return _MARK.sub(replaced, text), wrong


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare, or write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="put the records' figures into the text")
    options = parser.parse_args(arguments)
    differing = 0
    for page in pages():
        text, wrong = corrected(page.read_text(encoding="utf-8"))
        for line in wrong:
            print(f"{page.relative_to(ROOT)}: {line}")
        if options.write:
            page.write_text(text, encoding="utf-8")
        differing += len(wrong)
    if differing and not options.write:
        print("run `python -m experiments.upkeep.text_figures --write`, and read what it changed")
        sys.exit(1)


if __name__ == "__main__":
    main()
