"""What the command line understands; loads nothing that takes time."""

from __future__ import annotations

import argparse
import re
from typing import Any

from .options import code, files, loops, poses, studies

_EXAMPLES = """\
examples:
  pcr-mpc track lemniscate                              closed loop, pictures and a table
  pcr-mpc track limited --json                          the same figures for a machine
  pcr-mpc track lemniscate --controller mine:Mine       a controller of your own, in mine.py
  pcr-mpc statics planar_pair --p 0 0.25 --mode LR      motor angles that hold the tip there
  pcr-mpc statics rfrfr --q 120 60 --degrees            where the free tip comes to rest
  pcr-mpc statics planar_pair --p 0.18 0.12 --equilibria           what else it could snap to
  pcr-mpc track lemniscate --plant mujoco               against another engine's robot
  pcr-mpc export planar_pair --p 0 0.25 --mode LR --out pair.xml   that robot as MJCF
  pcr-mpc plan waypoints --out fast.csv                 that path as fast as the robot can
  pcr-mpc choose vertical                               what physics the scene needs, and why
  pcr-mpc identify lemniscate run.csv --out mine.toml   a robot's numbers from recorded motion
  pcr-mpc excite lemniscate --duration 6                a motion worth recording
  pcr-mpc generate lemniscate --out build/lemniscate       controller and plant as C
  pcr-mpc fmu lemniscate --part plant                   for Simulink, Modelica and others, by FMI
  pcr-mpc hil lemniscate                                in real time, the controller over a wire
  pcr-mpc view lemniscate                               the robot live in a browser: pull at it
  pcr-mpc replay results/lemniscate                     a recorded run as one page
  pcr-mpc timing lemniscate                             step times against the real-time budgets
  pcr-mpc tune pick_and_place --trials 20 --jobs 2 --out better.toml   a better controller
  pcr-mpc margins lemniscate                            how much delay, lag and mismatch the loop bears
  pcr-mpc copy lemniscate mine                          a copy of that scene to change
  pcr-mpc new mine --diameter 1e-3 --length 0.5         a robot of your own to start from, in mine/
  pcr-mpc check mine/scene.toml                         what can be said of it without running it

Where a file is wanted, a name is one of pcr-mpc models; a path, such as ./mine/scene.toml, is that file.
"""

# Least values of the options that are whole numbers.
LEAST = {"seed": 0, "links": 2, "steps": 1, "trials": 1, "jobs": 1, "episodes": 1, "cells": 8, "poses": 1, "silence": 1}
# Options that are lengths, times and the like; each has a unit, in which it is given back where it is wrong.
ABOVE_ZERO = {
    "tolerance": "mm", "tip_speed": "m/s", "tip_acceleration": "m/s^2", "tip_jerk": "m/s^3", "duration": "s",
    "period": "s",
}  # fmt: skip
# How the file ends that a command writes, by the function that runs it: it would be taken for another kind.
ENDINGS = {
    "plan": ".csv", "fmu": ".fmu", "identify_robot": ".toml", "tune_controller": ".toml", "export": ".xml",
    "replay": ".html",
}  # fmt: skip


class _Version(argparse.Action):
    """Looks the version up only where it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"pcr-mpc {version('pcr_mpc')}")
        parser.exit()


def parser() -> argparse.ArgumentParser:
    """Build the parser; ``run`` of what it parses is module and function, so that only what is needed is loaded."""
    top = argparse.ArgumentParser(
        prog="pcr-mpc",
        description="Model-predictive control of planar parallel continuum robots.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = top.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, module: str, run: str, text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        # Python 3.14's pattern; before, argparse takes -1e-2 for an option.
        sub._negative_number_matcher = re.compile(r"-\.?\d")
        sub.set_defaults(run=(module, run), command=name)
        sub.add_argument("--json", action="store_true", help="print one JSON object on stdout instead of tables")
        sub.add_argument("--traceback", action="store_true", help="show the traceback of a failure")
        # The force of `statics` is one in newtons.
        flags = ("--overwrite",) if name == "statics" else ("--force", "--overwrite")
        if name in ("copy", "new"):
            sub.add_argument(*flags, dest="overwrite", action="store_true", help="overwrite files that are there")
        elif name not in ("choose", "models"):
            sub.add_argument(*flags, dest="overwrite", action="store_true",
                             help="overwrite files that pcr-mpc did not write, or that were changed since")  # fmt: skip
        return sub

    for group in (loops, poses, studies, code, files):
        group.add(command)
    return top
