"""What the options of several commands share."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from pathlib import Path

# (name, module and function that run it, what it does) -> its parser
Command = Callable[[str, str, str, str], argparse.ArgumentParser]

LINKS = 40  # of a rod in MuJoCo
_CLASS = re.compile(r".+:[A-Za-z_]\w*")


def tuning_or_class(text: str) -> Path | str:
    """Path of a tuning, or ``module:Class`` as it stands."""
    return text if _CLASS.fullmatch(text) and not Path(text).exists() else Path(text)
